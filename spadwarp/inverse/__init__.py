"""From counts to the scene: derivatives, Fisher information, Cramér–Rao bounds of all unknowns, fits."""

from spadwarp.inverse.bounds import Bound, Bounds, bounds
from spadwarp.inverse.estimates import Estimate, EstimateMap, Fit, Iteration
from spadwarp.inverse.exposure import Exposure, read_exposure
from spadwarp.inverse.fitting import Fitter, fit
from spadwarp.inverse.start import lidar_start
from spadwarp.inverse.tensors import render
from spadwarp.inverse.unknowns import Unknown, read_unknowns

__all__ = [
    "Bound",
    "Bounds",
    "Estimate",
    "EstimateMap",
    "Exposure",
    "Fit",
    "Fitter",
    "Iteration",
    "Unknown",
    "bounds",
    "fit",
    "lidar_start",
    "read_exposure",
    "read_unknowns",
    "render",
]
