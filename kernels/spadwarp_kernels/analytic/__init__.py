"""The analytic simulator: photon budget, Cramér–Rao bound, depth frames."""

from .backscatter import TABLE_EDGES, single_scatter_table
from .cramer_rao import COUNT_LAWS, histogram_information, statistics_maps
from .depth_frames import Sampler, sample_frames
from .labelled_frames import FrameCoding, draw_frames
from .lidar import BACKSCATTER_SOURCES, Lidar
from .outliers import outlier_probabilities
from .signal import signal_map

__all__ = [
    "BACKSCATTER_SOURCES",
    "COUNT_LAWS",
    "TABLE_EDGES",
    "FrameCoding",
    "Lidar",
    "Sampler",
    "draw_frames",
    "histogram_information",
    "outlier_probabilities",
    "sample_frames",
    "signal_map",
    "single_scatter_table",
    "statistics_maps",
]
