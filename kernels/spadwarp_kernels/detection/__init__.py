"""SPAD and TCSPC: counts from expected detections, and arrival times from histograms."""

from .arrival_time import PHASES, arrival_bins, first_invalid_row
from .spad import (
    EVENT_LIMIT,
    add_crosstalk,
    coates,
    dark_count_rates,
    event_counts,
    expected_detections,
    first_photon_counts,
    first_photon_probabilities,
    free_running_probabilities,
)

__all__ = [
    "EVENT_LIMIT",
    "PHASES",
    "add_crosstalk",
    "arrival_bins",
    "coates",
    "dark_count_rates",
    "event_counts",
    "expected_detections",
    "first_invalid_row",
    "first_photon_counts",
    "first_photon_probabilities",
    "free_running_probabilities",
]
