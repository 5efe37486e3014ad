"""Photon transport: a scene in, a `Result`, truth maps or photon records out."""

from spadwarp.transport.derivatives import derivative_names, resolve_derivatives
from spadwarp.transport.light import ExpectedLight, LightTracer
from spadwarp.transport.loading import prepare_kernels
from spadwarp.transport.points import points_per_flight
from spadwarp.transport.records import PhotonRecords, load_records, save_records, trace
from spadwarp.transport.simulation import Progress, provenance, simulate
from spadwarp.transport.tally_unit import PHOTON_CAPACITY, photon_capacity, tally_scale
from spadwarp.transport.truth import truth_maps

__all__ = [
    "PHOTON_CAPACITY",
    "ExpectedLight",
    "LightTracer",
    "PhotonRecords",
    "Progress",
    "derivative_names",
    "load_records",
    "photon_capacity",
    "points_per_flight",
    "prepare_kernels",
    "provenance",
    "resolve_derivatives",
    "save_records",
    "simulate",
    "tally_scale",
    "trace",
    "truth_maps",
]
