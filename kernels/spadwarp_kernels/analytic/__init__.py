"""The analytic simulator: photon budget, Cramér–Rao bound, depth frames."""

from .backscatter import TABLE_EDGES, single_scatter_table
from .behind_port import make_optics
from .cramer_rao import COUNT_LAWS, histogram_information, statistics_maps
from .depth_frames import Sampler, sample_frames
from .labelled_frames import FrameCoding, draw_frames
from .lidar import BACKSCATTER_SOURCES, Lidar, Ports
from .optics import IN_WATER, Optics
from .outliers import outlier_probabilities
from .signal import signal_map

__all__ = [
    "BACKSCATTER_SOURCES",
    "COUNT_LAWS",
    "IN_WATER",
    "TABLE_EDGES",
    "FrameCoding",
    "Lidar",
    "Optics",
    "Ports",
    "Sampler",
    "draw_frames",
    "histogram_information",
    "make_optics",
    "outlier_probabilities",
    "sample_frames",
    "signal_map",
    "single_scatter_table",
    "statistics_maps",
]
