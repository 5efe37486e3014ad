"""Frames of a camera as labelled arrays."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from spadwarp.arrays import on_host
from spadwarp.frames.frames import Frames
from spadwarp.interop import Variable, labelled

if TYPE_CHECKING:
    import xarray

__all__ = ["to_xarray"]


def to_xarray(frames: Frames) -> xarray.Dataset:
    """Counts, and the expectation that they were drawn from, as an xarray data set with coordinates and units.

    `counts` has the dimensions (frame, y, x, time), without frame where they are added up; `expected` and `background`
    are detections per pulse and bin before pile-up. Torch tensors are copied to the host.

    Raises:
        FileError: xarray is not installed.
    """
    counts, expected = on_host(frames.counts), on_host(frames.expected)
    background = np.broadcast_to(on_host(frames.background), expected.shape)
    height, width, _ = expected.shape
    cube = ("y", "x", "time")
    dimensions = cube if frames.summed else ("frame", *cube)
    edges = frames.gate_start + frames.edges
    variables: dict[str, Variable] = {
        "counts": (dimensions, counts, "1", "detections in the bin"),
        "expected": (cube, expected, "1", "expected detections per pulse and bin before pile-up"),
        "background": (cube, background, "1", "the part of `expected` that is not target"),
    }
    coordinates: dict[str, Variable] = {
        "time": (("time",), 0.5 * (edges[:-1] + edges[1:]), "s", "time of flight at the centre of the bin"),
        "bin_width": (("time",), np.diff(edges), "s", "width of the bin"),
        "y": (("y",), np.arange(height), "1", "row of pixels, downwards"),
        "x": (("x",), np.arange(width), "1", "column of pixels, to the right"),
    }
    if not frames.summed:
        numbers = np.arange(frames.first_frame, frames.first_frame + frames.frames)
        coordinates["frame"] = (("frame",), numbers, "1", "number of the frame")
    attributes = {
        "pulses": frames.exposure,
        "seed": str(frames.seed),
        "period": np.inf if frames.period is None else frames.period,
        "response_fwhm": frames.irf.fwhm,
        "notes": list(frames.notes),
    }
    return labelled(variables, coordinates, attributes)
