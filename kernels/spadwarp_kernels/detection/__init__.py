"""SPAD and TCSPC: counts from expected detections, and arrival times from histograms."""

from .arrival_time import PHASES, ArrivalEstimator, arrival_bins
from .events import EVENT_LIMIT, event_counts
from .expected import (
    add_crosstalk,
    coates,
    dark_count_rates,
    expected_detections,
    first_photon_probabilities,
    free_running_probabilities,
)
from .first_photon import first_photon_counts, first_photon_step
from .rates import first_invalid_row

__all__ = [
    "EVENT_LIMIT",
    "PHASES",
    "ArrivalEstimator",
    "add_crosstalk",
    "arrival_bins",
    "coates",
    "dark_count_rates",
    "event_counts",
    "expected_detections",
    "first_invalid_row",
    "first_photon_counts",
    "first_photon_probabilities",
    "first_photon_step",
    "free_running_probabilities",
]
