"""Frames of a scene that moves along a trajectory."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from spadwarp.errors import ConfigError, SpadwarpWarning
from spadwarp.frames.estimators import Method
from spadwarp.frames.sequence_file import SequenceFile
from spadwarp.frames.spad import detect
from spadwarp.limits import SEED, check_integer
from spadwarp.scene import SceneLike, Trajectory, as_scene, load_trajectory
from spadwarp.scene.sight import depth_from_time
from spadwarp.transport import simulate

__all__ = ["simulate_sequence"]


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
    base = as_scene(scene)
    moves = trajectory if isinstance(trajectory, Trajectory) else load_trajectory(trajectory)
    if frame_rate is not None:
        moves = moves.sampled(frame_rate)
    scenes = list(moves.scenes(base))
    _check_fixed(moves)
    seed = base.transport.seed if seed is None else check_integer("seed", seed, SEED)
    pulses = (
        base.detector.pulses_per_frame
        if pulses is None
        else check_integer("pulses", pulses, "[1, 1000000000000000000]")
    )
    photons = base.transport.photons if photons is None else photons
    kept: dict[str, Any] = {}
    facts = {"pulses": pulses, "seed": seed, "photons": photons, "methods": tuple(methods), "tags": tags}
    with SequenceFile.create(path, base, moves, **facts) as file:
        for number, at in enumerate(scenes):
            own = int(np.random.SeedSequence([seed, number]).generate_state(1, np.uint64)[0])
            with warnings.catch_warnings():
                if number:  # said of the first frame
                    warnings.simplefilter("ignore", SpadwarpWarning)
                result = simulate(at, photons=photons, seed=own, device=device, mesh_cache=kept)
                part = detect(
                    result, pulses=pulses, frames=1, first_frame=number, seed=seed, tags=tags, device=_first(device)
                )
            times = {method: part.arrival_time(method, device=_first(device)) for method in methods}
            file.add(result, part, {method: depth_from_time(time, scene=at) for method, time in times.items()})
            if progress is not None:
                progress("frames", number + 1, len(scenes))
    return SequenceFile.load(path)


def _first(device: str | None) -> str | None:
    """The device for the work that needs one."""
    return None if device is None else "cuda:0" if device == "cuda:all" else device.split(",")[0]


def _check_fixed(moves: Trajectory) -> None:
    """Raises `ConfigError` for fields that all frames of a file share."""
    fixed = ("camera.width", "camera.height", "gate.", "scan.")
    if wrong := [name for name in moves.fields if name.startswith(fixed)]:
        raise ConfigError([f"{wrong[0]} cannot change from frame to frame"], source=moves.source)
