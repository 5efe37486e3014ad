"""Maps and frames of the analytic simulator as labelled arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from spadwarp.interop import Variable, labelled

if TYPE_CHECKING:
    import xarray

    from spadwarp.analytic.result import AnalyticResult

__all__ = ["MAP_UNITS", "to_xarray"]

MAP_UNITS = {
    "signal": "1",
    "arrival": "s",
    "backscatter": "1",
    "alpha": "1",
    "fisher": "s^-2",
    "sigma_time": "s",
    "sigma_depth": "m",
    "signal_to_backscatter": "1",
    "background_level": "1",
    "outlier_probability": "1",
    "background_probability": "1",
}
"""Maps of an `AnalyticResult` and their units."""


def to_xarray(result: AnalyticResult) -> xarray.Dataset:
    """The maps (y, x) of an `AnalyticResult`, its truth and its depth frames (frame, y, x), with units.

    Raises:
        FileError: xarray is not installed.
    """
    image = ("y", "x")
    height, width = result.truth.depth.shape
    variables: dict[str, Variable] = {
        name: (image, getattr(result, name), unit, name.replace("_", " ")) for name, unit in MAP_UNITS.items()
    }
    variables |= {
        "true_depth": (image, result.truth.depth, "m", "true planar depth"),
        "true_range": (image, result.truth.range, "m", "true distance along the line of sight"),
        "reflectance": (image, result.truth.reflectance, "1", "Lambertian reflectance"),
        "depth": (("frame", *image), result.depth, "m", "depth frames"),
        "label": (("frame", *image), result.labels, "1", "whether the pixel reports a background photon"),
    }
    coordinates: dict[str, Variable] = {
        "frame": (("frame",), np.arange(len(result.depth)), "1", "number of the frame"),
        "y": (("y",), np.arange(height), "1", "row of pixels, downwards"),
        "x": (("x",), np.arange(width), "1", "column of pixels, to the right"),
    }
    return labelled(variables, coordinates, {"seed": str(result.seed), "scene": result.scene.to_toml()})
