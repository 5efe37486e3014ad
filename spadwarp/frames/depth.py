"""Depth of histograms of any origin."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError
from spadwarp.frames.estimators import Method, arrival_time
from spadwarp.frames.measured import Histograms
from spadwarp.limits import check_choice, check_real
from spadwarp.scene import Camera
from spadwarp.scene.sight import LinesOfSight, lines_of_camera, lines_of_sight
from spadwarp.units import path_from_time

if TYPE_CHECKING:
    from spadwarp.result import Result

__all__ = ["Reduction", "depth_frame", "depth_of"]


def depth_frame(
    result: Result, *, method: Method = "centroid", quantity: Literal["depth", "range"] = "depth", **options: Any
) -> NDArray[np.float64]:
    """Depth frame of a simulation's histograms [m], float64 `[H, W]`; NaN where nothing returned.

    Args:
        result: From `spadwarp.simulate`.
        method: `"peak"`, `"centroid"`, `"matched"` or `"likelihood"`; see `spadwarp.arrival_time`, which also takes
            `options` (`irf`, `background`, `gate`, `device`).
        quantity: `"depth"` is planar, z; `"range"` runs along the line of sight.
    """
    check_choice("quantity", quantity, ("depth", "range"))
    scene, gate = result.scene, result.scene.gate
    time = arrival_time(result.histogram, gate_start=gate.start, bin_width=gate.bin_width, method=method, **options)
    lines = lines_of_sight(scene)
    distance = lines.range_from_path(time * result.pulse_speed)
    return lines.depth_from_range(distance) if quantity == "depth" else distance


@dataclass(frozen=True, eq=False, kw_only=True)
class Reduction:
    """Depth of histograms.

    Attributes:
        quantity: `"depth"`: planar, z; `"range"`: along the line of sight, where the view is not known.
        values: float64 `[frames, H, W]` [m]; NaN where nothing returned.
        range: The same along the line of sight.
        intensity: Sum over the bins, `[frames, H, W]`.
        lines: Lines of sight `[H, W]`, or None.
        method: Estimator of the arrival time, or "stored" for depth that was read.
        camera: That of a simulation, with its pose in the world; else None.
    """

    quantity: Literal["depth", "range"]
    values: NDArray[np.float64]
    range: NDArray[np.float64]
    intensity: NDArray[Any]
    lines: LinesOfSight | None
    method: str
    camera: Camera | None = None

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.values)

    @property
    def first(self) -> NDArray[np.float64]:
        """The first frame, `[H, W]` [m]."""
        return self.values[0]


def depth_of(
    histograms: Histograms,
    *,
    method: Method = "centroid",
    group_index: float | None = None,
    horizontal_fov_deg: float | None = None,
    background: float | Literal["median"] | None = None,
    device: Any = None,
) -> Reduction:
    """Depth of histograms from a file.

    Args:
        histograms: From `spadwarp.frames.read_histograms`.
        method: See `spadwarp.arrival_time`; `"matched"` and `"likelihood"` need a response.
        group_index: Vacuum speed of light over that of the pulse, ≥ 1; a simulation has its own.
        horizontal_fov_deg: Full horizontal field of view of a measuring camera with square pixels, in (0, 180).
        background: Expected background per bin in the unit of the values, ≥ 0; `"median"`: the median bin of each
            pixel. Default: that of the file; else none, with `"likelihood"` the median.
        device: Warp device.

    Measured histograms count as those of a laser in the lens, whose pulse leaves at time 0.

    Raises:
        ArgumentError: Something that is needed is missing, given twice or out of range.
    """
    if histograms.bin_width is None:
        raise ArgumentError("bin width is missing (bin_width): the file does not hold it")
    index, lines = _geometry(histograms, group_index, horizontal_fov_deg)
    values = histograms.values
    height, width = values.shape[-3:-1]
    filtered = method in ("matched", "likelihood")
    response = histograms.response if filtered else histograms.irf
    if filtered and response is None:
        raise ArgumentError(f"method = {method!r} needs an instrument response (irf)")
    known: Any = histograms.background if background is None else background
    if background == "median" or (known is None and method == "likelihood"):
        known = _median_background(values)
    time = arrival_time(
        values,
        gate_start=histograms.gate_start,
        bin_width=histograms.bin_width,
        method=method,
        irf=response,
        background=known,
        device=device,
    ).reshape(-1, height, width)
    path = path_from_time(time, index)
    distance = 0.5 * path if lines is None else lines.range_from_path(path)
    return Reduction(
        quantity="range" if lines is None else "depth",
        values=distance if lines is None else lines.depth_from_range(distance),
        range=distance,
        intensity=values.sum(axis=-1).reshape(-1, height, width),
        lines=lines,
        method=method,
        camera=None if histograms.scene is None else histograms.scene.camera,
    )


def _geometry(
    histograms: Histograms, group_index: float | None, horizontal_fov_deg: float | None
) -> tuple[float, LinesOfSight | None]:
    """Group index, and lines of sight where they are known."""
    scene = histograms.scene
    if scene is None and group_index is None:
        raise ArgumentError("group index is missing (group_index): 1 in air, 1.3566 in fresh water, 1.3638 in seawater")
    if scene is not None and (group_index is not None or horizontal_fov_deg is not None):
        raise ArgumentError("group index and field of view are those of the file's scene")
    index = check_real("group index", scene.medium.group_index if scene is not None else group_index, "[1, 3]")
    if scene is not None:
        return index, lines_of_sight(scene)
    if horizontal_fov_deg is None:
        return index, None
    check_real("horizontal field of view", horizontal_fov_deg, "[1e-6, 180)")
    height, width = histograms.values.shape[-3:-1]
    camera = Camera(width=width, height=height, horizontal_fov_deg=horizontal_fov_deg, aperture_diameter=1.0)
    return index, lines_of_camera(camera)


def _median_background(values: NDArray[Any]) -> NDArray[np.float32]:
    """Median bin of each pixel, of all frames together: that of sparse counts would be 0."""
    frames = values.reshape(-1, *values.shape[-3:])
    return (np.median(frames.sum(axis=0), axis=-1, keepdims=True) / len(frames)).astype(np.float32)
