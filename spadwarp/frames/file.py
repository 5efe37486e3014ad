"""Frames of a camera on disk: counts, depth by every estimator and the bound that none of them can beat."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.frames.arrival_time import METHODS, Method
from spadwarp.frames.frames import Frames
from spadwarp.frames.spad import detect
from spadwarp.io.hdf5 import write_hdf5
from spadwarp.result.result import Result
from spadwarp.scene.geometry import depth_from_time, depth_per_time, pixel_directions
from spadwarp.scene.intrinsics import camera_attributes

if TYPE_CHECKING:
    pass

__all__ = ["FORMAT", "FORMAT_VERSION", "FrameErrors", "Recording", "depth_from_time", "record_frames"]

FORMAT = "spadwarp frames"
FORMAT_VERSION = 1

_PART_BYTES = 1 << 28  # of counts that are held at a time
_CHUNK_BYTES = 1 << 20
_TAG_CHUNK = 1 << 16
_READ_ME = (
    "counts: [frame, height, width, bin], detections in bin k, which covers gate_start + edges[k] to edges[k + 1] "
    "seconds of flight. depth/NAME: [frame, height, width], planar depth in metres by that estimator, NaN where "
    "nothing was detected. intensity: counts over all bins. bound/time and bound/depth: Cramér–Rao standard deviation "
    "of one frame [s], [m], NaN where there is no information. expected, background: expected detections per pulse and "
    "bin of all light and noise, and of what is not target. "
    "tags, if there: detections one by one. Camera frame: +x right, +y down, +z forward."
)


@dataclass(frozen=True, kw_only=True)
class FrameErrors:
    """How far the depth frames of one estimator are from the truth, over all pixels and frames that have both.

    Attributes:
        estimate_fraction: Estimates over pixels that see a target.
        median: Median absolute error [m].
        p90: What 90 % of the absolute errors stay below [m].
    """

    estimate_fraction: float
    median: float
    p90: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """What `record_frames` wrote, in short.

    Attributes:
        path: The file.
        first: The first frame, its counts `[1, H, W, T]`.
        depth: First frame by each estimator, float64 `[H, W]` [m].
        errors: By estimator; of at most the first 256 MiB of counts.
        bound_time, bound_depth: Cramér–Rao bound of one frame, float64 `[H, W]` [s], [m].
        detections: Counted in all frames.
        notes: What the simulation could not give, in words.
    """

    path: Path
    first: Frames
    depth: dict[Method, NDArray[np.float64]]
    errors: dict[Method, FrameErrors]
    bound_time: NDArray[np.float64]
    bound_depth: NDArray[np.float64]
    detections: int
    notes: tuple[str, ...]


def record_frames(
    result: Result,
    path: str | Path,
    *,
    pulses: int | None = None,
    frames: int = 1,
    seed: int,
    methods: Sequence[Method] = METHODS,
    undo_pile_up: bool = False,
    tags: bool = False,
    window: tuple[float, int] | None = None,
    device: Any = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Recording:
    """Writes frames of counts that the camera would record, and their depth, to one HDF5 file, whole or not at all.

    Frames are drawn in parts, as `spadwarp.detect` draws them all: memory does not grow with their number.

    Args:
        result: Of `spadwarp.simulate`; its scene says what camera it is.
        path: The file.
        pulses: Per frame; default: the detector's.
        frames: ≥ 1.
        seed: 64 bits.
        methods: Estimators of depth, see `spadwarp.arrival_time`. Background and response are known to them.
        undo_pile_up: Estimate from Coates' correction of the counts.
        tags: Also keep every detection.
        window: (start [s], bins) of the detector; default: the result's gate.
        device: Warp device.
        progress: Called with ("frames", done, frames).

    Raises:
        ArgumentError: An argument out of range.
        FileError: The file cannot be written.
    """

    from spadwarp.frames.cramer_rao import crlb

    scene = result.scene
    pulses = scene.detector.pulses if pulses is None else pulses
    bins = scene.gate.bins if window is None else window[1]
    part = max(1, _PART_BYTES // (4 * scene.camera.width * scene.camera.height * bins))
    options = {"pulses": pulses, "seed": seed, "tags": tags, "window": window, "device": device}
    bound_time = np.full(result.truth.depth.shape, np.nan)
    if scene.laser.pulse_fwhm_ps or scene.detector.jitter_fwhm_ps or scene.detector.irf.lower().endswith(".csv"):
        law: Any = "poisson" if scene.detector.mode == "free_running" else "first_photon"
        bound_time = crlb(result, pulses=pulses, law=law, device=device)
    bound_depth = bound_time * _depth_per_time(result)

    first: Frames | None = None
    depth: dict[Method, NDArray[np.float64]] = {}
    errors: dict[Method, FrameErrors] = {}
    detections = 0
    with write_hdf5(path) as file:
        for start in range(0, frames, part) if frames > 0 else (0,):
            some = detect(result, frames=min(part, frames - start), first_frame=start, **options)
            depths = {
                method: depth_from_time(
                    some.arrival_time(method, undo_pile_up=undo_pile_up, device=device), scene=scene
                )
                for method in methods
            }
            if first is None:
                first = replace(some, counts=some.counts[:1].copy(), frames=1, tags=None)
                depth = {method: frame[0] for method, frame in depths.items()}
                errors = {method: _errors(frame, result) for method, frame in depths.items()}
                _begin(file, result, some, frames, methods, tags)
                for name, values in {"time": bound_time, "depth": bound_depth}.items():
                    file.create_dataset(f"bound/{name}", data=values)
            stop = start + some.frames
            file["counts"][start:stop] = some.counts
            file["intensity"][start:stop] = some.intensity
            for method, frame in depths.items():
                file[f"depth/{method}"][start:stop] = frame
            if some.tags is not None:
                _append(file["tags"], some.tags._asdict())
            detections += int(some.intensity.sum())
            if progress is not None:
                progress("frames", stop, frames)
    assert first is not None
    return Recording(
        path=Path(path),
        first=first,
        depth=depth,
        errors=errors,
        bound_time=bound_time,
        bound_depth=bound_depth,
        detections=detections,
        notes=first.notes,
    )


def _depth_per_time(result: Result) -> NDArray[np.float64]:
    distance = result.truth.range.astype(np.float64)
    view = pixel_directions(result.scene.camera)
    return depth_per_time(result.scene, view.reshape(-1, 3), distance.reshape(-1)).reshape(distance.shape)


def _errors(depth: NDArray[np.float64], result: Result) -> FrameErrors:
    truth = result.truth.depth
    targets = np.isfinite(truth)
    error = np.abs(depth - truth)[:, targets]
    known = error[np.isfinite(error)]
    middle, high = np.quantile(known, (0.5, 0.9)) if known.size else (np.nan, np.nan)
    fraction = known.size / error.size if error.size else 0.0
    return FrameErrors(estimate_fraction=fraction, median=float(middle), p90=float(high))


# HDF5


def _begin(file: Any, result: Result, some: Frames, frames: int, methods: Sequence[Method], tags: bool) -> None:
    """Everything but the frames, and room for them."""
    scene = result.scene
    _, height, width, bins = some.counts.shape
    file.attrs.update(
        {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "read_me": _READ_ME,
            "pulses": some.pulses,
            "frames": frames,
            "seed": str(some.seed),
            "gate_start": some.gate_start,
            "bin_width": some.bin_width,
            "period": np.inf if some.period is None else some.period,
            "group_index": scene.medium.group_index,
            "laser_position": scene.beam.position,
            "pixel_tangent": scene.camera.pixel_tangent,
            **camera_attributes(scene.camera),
            "irf_sigma": some.irf.sigma,
            "irf_tail": some.irf.tail,
            "notes": list(some.notes),
            "source": str(scene.source or ""),
            "photons": result.photons,
        }
    )
    file.create_dataset("config", data=scene.to_toml())
    file.create_dataset("edges", data=some.edges)
    if some.irf.times is not None:
        file.create_dataset("irf", data=np.array([some.irf.times, some.irf.values], np.float64))
    packed = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
    file.create_dataset("expected", data=some.expected, **packed)
    file.create_dataset("background", data=some.background, **packed)
    file.create_dataset("truth/depth", data=result.truth.depth, **packed)
    columns = max(1, min(width, _CHUNK_BYTES // (4 * bins)))
    lines = max(1, min(height, _CHUNK_BYTES // (4 * bins * columns)))
    file.create_dataset("counts", (frames, height, width, bins), np.int32, chunks=(1, lines, columns, bins), **packed)
    image = {"shape": (frames, height, width), "chunks": (1, height, width), **packed}
    file.create_dataset("intensity", dtype=np.int64, **image)
    for method in methods:
        file.create_dataset(f"depth/{method}", dtype=np.float32, **image).attrs["unit"] = "m"
    if tags:
        for name, kind in {"frame": np.int64, "y": np.int32, "x": np.int32, "pulse": np.int64, "bin": np.int32}.items():
            file.create_dataset(f"tags/{name}", (0,), kind, maxshape=(None,), chunks=(_TAG_CHUNK,), **packed)


def _append(group: Any, columns: dict[str, NDArray[Any]]) -> None:
    for name, values in columns.items():
        column = group[name]
        before = column.shape[0]
        column.resize((before + len(values),))
        column[before:] = values
