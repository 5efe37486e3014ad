"""A result as labelled arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from spadwarp.interop import Variable, labelled
from spadwarp.result.result import COMPONENTS, Result

if TYPE_CHECKING:
    import xarray

__all__ = ["to_xarray"]


def to_xarray(result: Result) -> xarray.Dataset:
    """Histograms by component, and truth, as an xarray data set with coordinates and units.

    `histogram` has the dimensions (component, y, x, time); `.sum("component")` is all light, `.sel(component=
    "backscatter")` a part of it. Coordinates: time of flight [s] at the bins' centres, `path` [m] along it, pixels.
    `derivative`, of results that have some, has the dimension parameter before these, and `polarisation` the dimension
    channel. Attributes: photons, seed, partial and the scene as TOML.

    Raises:
        FileError: xarray is not installed.
    """
    image, cube = ("y", "x"), ("component", "y", "x", "time")
    height, width = result.truth.depth.shape
    values = np.stack([result.component(name) for name in COMPONENTS])
    truth = result.truth
    variables: dict[str, Variable] = {
        "histogram": (cube, values, "1", "expected fraction of the emitted photons per pixel and bin"),
        "detections_per_photon": ((), result.scene.detections_per_photon, "1", "detection efficiency with the filter"),
        "depth": (image, truth.depth, "m", "true planar depth"),
        "range": (image, truth.range, "m", "true distance along the line of sight"),
        "normal": ((*image, "axis"), truth.normal, "1", "unit normals towards the camera"),
        "reflectance": (image, truth.reflectance, "1", "Lambertian reflectance"),
    }
    if result.second_moment is not None and result.photons >= 2 * result.batch_size:
        variables["standard_error"] = ((*image, "time"), result.standard_error, "1", "of the histogram of all light")
    coordinates: dict[str, Variable] = {}
    if result.derivatives:
        slopes = np.stack([*result.derivatives.values()])
        variables["derivative"] = (("parameter", *cube), slopes, "1", "of the histogram, per unit of the parameter")
        coordinates["parameter"] = (("parameter",), list(result.derivatives), "1", "by which it is differentiated")
    if result.channels:
        channels = np.stack([*result.channels.values()])
        variables["polarisation"] = (("channel", *cube), channels, "1", "fraction of the emitted photons in a channel")
        coordinates["channel"] = (("channel",), list(result.channels), "1", "of the receiver of polarised light")
    coordinates |= {
        "component": (("component",), list(COMPONENTS), "1", "history of the light"),
        "time": (("time",), result.bin_centres, "s", "time of flight at the centre of the bin"),
        "path": (("time",), result.bin_centres * result.pulse_speed, "m", "geometric path, laser to target to lens"),
        "y": (("y",), np.arange(height), "1", "row of pixels, downwards"),
        "x": (("x",), np.arange(width), "1", "column of pixels, to the right"),
        "axis": (("axis",), ["x", "y", "z"], "1", "of the camera frame: right, down, away"),
    }
    attributes = {
        "photons": result.photons,
        "photons_per_pulse": result.scene.laser.photons_per_pulse,
        "seed": str(result.seed),
        "partial": int(result.partial),
        "scene": result.scene.to_toml(),
    }
    return labelled(variables, coordinates, attributes)
