"""The pulsed laser, its measured profile, and the raster that it scans."""

from .laser import LASER_PROFILES, Laser, beam_frame, emit_along, emit_measured, emit_photon, profile_tables
from .scan import Scan

__all__ = [
    "LASER_PROFILES",
    "Laser",
    "Scan",
    "beam_frame",
    "emit_along",
    "emit_measured",
    "emit_photon",
    "profile_tables",
]
