"""Frames drawn part by part into a file, with their depth and the bound that no estimator can beat."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ConfigError, SpadwarpWarning
from spadwarp.frames.cramer_rao import bound_of_result, photons_for_noise
from spadwarp.frames.depth import METHODS, Method
from spadwarp.frames.file import FramesWriter, SequenceFile, SequenceWriter
from spadwarp.frames.frames import Frames
from spadwarp.frames.response import detector_response
from spadwarp.frames.spad import MonteCarloNoise, detect, monte_carlo_noise
from spadwarp.io.hdf5 import write_hdf5
from spadwarp.limits import SEED, check_integer
from spadwarp.result.result import Result
from spadwarp.scene import SceneLike, Trajectory, as_scene, load_trajectory
from spadwarp.scene.sight import depth_from_time, depth_per_time

__all__ = ["FrameErrors", "Recording", "record_frames", "simulate_sequence"]

_PART_BYTES = 1 << 28  # of counts that are held at a time

Map = NDArray[np.float64]


@dataclass(frozen=True, kw_only=True)
class FrameErrors:
    """How far the depth frames of one estimator are from the truth, over all pixels and frames that have both.

    Attributes:
        estimate_fraction: Estimates over pixels with a target.
        median: Median absolute error [m].
        p90: 90th percentile of the absolute errors [m].
    """

    estimate_fraction: float
    median: float
    p90: float


@dataclass(frozen=True, eq=False, kw_only=True)
class Recording:
    """Summary of what `record_frames` wrote.

    Attributes:
        path: The file.
        first: The first frame, its counts `[1, H, W, T]`.
        depth: First frame by each estimator, float64 `[H, W]` [m].
        errors: By estimator; of at most the first 256 MiB of counts.
        bound_time, bound_depth: Cramér–Rao bound of one frame, float64 `[H, W]` [s], [m]; see `crlb`. NaN where that
            refuses, which the notes then say.
        bound_noise: Part of the histograms' information that was noise of the simulation and is subtracted, median of
            the pixels; NaN if the result keeps no standard errors.
        bound_photons: Photons that would make that part a tenth.
        detections: Counts of all frames.
        notes: What the simulation could not give, in words.
        monte_carlo: Its noise against the shot noise of one frame; None if the result keeps no standard errors.
    """

    path: Path
    first: Frames
    depth: dict[Method, Map]
    errors: dict[Method, FrameErrors]
    bound_time: Map
    bound_depth: Map
    bound_noise: float
    bound_photons: float
    detections: int
    notes: tuple[str, ...]
    monte_carlo: MonteCarloNoise | None


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

    Frames are drawn in parts, the same as `spadwarp.detect` draws: memory does not grow with their number.

    Args:
        result: Of `spadwarp.simulate`; its scene has the camera.
        path: The file.
        pulses: Per frame; default: the detector's.
        frames: ≥ 1.
        seed: 64 bits.
        methods: Estimators of depth, see `spadwarp.arrival_time`. They know background and response.
        undo_pile_up: Estimate from Coates' correction of the counts.
        tags: Also keep every detection.
        window: (start [s], bins) of the detector; default: the result's gate.
        device: Warp device.
        progress: Called with ("frames", done, frames).

    Raises:
        ArgumentError: An argument out of range.
        FileError: The file cannot be written.
    """
    frames = check_integer("frames", frames, "[1, 2147483647]")
    scene = result.scene
    pulses = scene.detector.pulses_per_frame if pulses is None else pulses
    bins = scene.gate.bins if window is None else window[1]
    size = max(1, _PART_BYTES // (4 * scene.camera.width * scene.camera.height * bins))
    options: dict[str, Any] = {"pulses": pulses, "seed": seed, "tags": tags, "window": window, "device": device}
    bound_time, bound_depth, bound_noise, notes = _bounds(result, pulses, device)
    recording: Recording | None = None
    detections = 0
    with write_hdf5(path) as opened:
        file = FramesWriter(opened)
        for start in range(0, frames, size):
            count = min(size, frames - start)
            part = detect(result, frames=count, first_frame=start, **options)
            part = replace(part, notes=(*part.notes, *notes))
            depth: dict[Method, Map] = {}
            for method in methods:
                time = part.arrival_time(method, undo_pile_up=undo_pile_up, device=device)
                depth[method] = depth_from_time(time, scene=scene)
            if recording is None:
                file.begin(result, part, frames=frames, methods=methods, time=bound_time, depth=bound_depth)
                recording = Recording(
                    path=Path(path),
                    first=replace(part, counts=part.counts[:1].copy(), frames=1, tags=None),
                    depth={method: values[0] for method, values in depth.items()},
                    errors={method: _errors(values, result.truth.depth) for method, values in depth.items()},
                    bound_time=bound_time,
                    bound_depth=bound_depth,
                    bound_noise=bound_noise,
                    bound_photons=photons_for_noise(result.photons, bound_noise, 0.1),
                    detections=0,
                    notes=part.notes,
                    monte_carlo=monte_carlo_noise(result, pulses=pulses),
                )
            file.add(part, depth)
            detections += int(part.intensity.sum())
            if progress is not None:
                progress("frames", start + part.frames, frames)
    assert recording is not None
    return replace(recording, detections=detections)


def _bounds(result: Result, pulses: int, device: Any) -> tuple[Map, Map, float, tuple[str, ...]]:
    """Cramér–Rao bounds of one frame [s], [m], NaN for a response without a derivative or too few photons; the part
    that was noise; and notes."""
    scene, distance = result.scene, result.truth.range.astype(np.float64)
    missing = np.full(distance.shape, np.nan)
    if not detector_response(scene.detector, scene.laser).is_smooth:
        return missing, missing, np.nan, ()
    law: Literal["poisson", "first_photon"] = "poisson" if scene.detector.mode == "free_running" else "first_photon"
    bound = bound_of_result(result, pulses=pulses, law=law, device=device)
    if bound.problem is not None:
        return missing, missing, bound.noise, (f"no Cramér–Rao bound: {bound.problem}",)
    return bound.sigma, bound.sigma * depth_per_time(scene, distance), bound.noise, ()


def _errors(depth: Map, truth: NDArray[np.float32]) -> FrameErrors:
    targets = np.isfinite(truth)
    error = np.abs(depth - truth)[:, targets]
    known = error[np.isfinite(error)]
    middle, high = np.quantile(known, (0.5, 0.9)) if known.size else (np.nan, np.nan)
    fraction = known.size / error.size if error.size else 0.0
    return FrameErrors(estimate_fraction=fraction, median=float(middle), p90=float(high))


# A scene that moves along a trajectory


def simulate_sequence(
    scene: SceneLike,
    trajectory: Trajectory | str | Path,
    path: str | Path,
    *,
    frame_rate: float | None = None,
    photons: int | None = None,
    pulses: int | None = None,
    seed: int | None = None,
    methods: Sequence[Method] = ("matched",),
    tags: bool = False,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> SequenceFile:
    """Simulates a frame at each row of a trajectory and writes counts, depth and truth of all to one HDF5 file.

    In a frame the scene stands still. The mesh stays on the device, and its tree is refitted where only poses change.
    Frame n has random numbers of its own, of `seed` and n.

    Args:
        scene: Of which the trajectory changes fields.
        trajectory: From `spadwarp.scene.load_trajectory`, or the path of its .csv file.
        path: The file, whole or not at all.
        frame_rate: Frames a second, at even times between the rows; None: a frame at each row.
        photons: Traced for each frame; default: the scene's.
        pulses: Of a frame; default: the detector's.
        seed: 64 bits; default: the scene's.
        methods: Estimators of depth, see `spadwarp.arrival_time`.
        tags: Also keep every detection.
        device: "cpu", "cuda:0", ...; by default the first GPU, else the CPU.
        progress: Called with ("frames", done, frames).

    Raises:
        ConfigError: A row whose scene cannot be simulated; all rows are tried before the first photon.
        FileError: A file cannot be read or written.
    """
    from spadwarp.transport import simulate

    base = as_scene(scene)
    moves = trajectory if isinstance(trajectory, Trajectory) else load_trajectory(trajectory)
    if frame_rate is not None:
        moves = moves.sampled(frame_rate)
    scenes = list(moves.scenes(base))
    fixed = ("camera.width", "camera.height", "gate.", "scan.")  # that all frames of a file share
    if wrong := [name for name in moves.fields if name.startswith(fixed)]:
        raise ConfigError([f"{wrong[0]} cannot change from frame to frame"], source=moves.source)
    seed = base.transport.seed if seed is None else check_integer("seed", seed, SEED)
    pulses = base.detector.pulses_per_frame if pulses is None else pulses
    photons = base.transport.photons if photons is None else photons
    first_device = (
        None if device is None else "cuda:0" if device == "cuda:all" else device.split(",")[0]
    )  # for the rest
    options: dict[str, Any] = {"pulses": pulses, "frames": 1, "seed": seed, "tags": tags, "device": first_device}
    kept: dict[str, Any] = {}
    with write_hdf5(path) as opened:
        file = SequenceWriter(opened, base, moves, photons=photons)
        for number, at in enumerate(scenes):
            frame_seed = int(np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0])
            with warnings.catch_warnings():
                if number:  # said of the first frame
                    warnings.simplefilter("ignore", SpadwarpWarning)
                result = simulate(at, photons=photons, seed=frame_seed, device=device, mesh_cache=kept)
                part = detect(result, first_frame=number, **options)
            times = {method: part.arrival_time(method, device=first_device) for method in methods}
            file.add_frame(result, part, {method: depth_from_time(time, scene=at) for method, time in times.items()})
            if progress is not None:
                progress("frames", number + 1, len(scenes))
    return SequenceFile.load(path)
