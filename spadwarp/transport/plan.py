"""The plan of a run: scene, seed, photon ids, batches, and how its work is divided."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import spadwarp_kernels as sk
from spadwarp.errors import ConfigError
from spadwarp.limits import SEED, check_integer, check_part, check_real
from spadwarp.mesh import build_mesh, focus_distance
from spadwarp.result import COMPONENTS, Result, ResultLike
from spadwarp.result.result import ResultHead, difference
from spadwarp.result.tallies import count, shard_of
from spadwarp.scene import Scene, Transport
from spadwarp.scene.sections import field_range
from spadwarp.transport.derivatives import resolve_derivatives
from spadwarp.transport.tally_unit import scale_and_capacity

if TYPE_CHECKING:
    from spadwarp.mesh import TriangleMesh

__all__ = ["RunOptions"]

# Photons in one launch: large enough to fill the device, small enough for progress and Ctrl-C.
LAUNCH_SIZE = {"cpu": 1 << 16, "cuda": 1 << 26}
# One CPU thread walks a whole launch, and counts its events in 32 bits.
LARGEST_LAUNCH = {"cpu": 1 << 20, "cuda": 1 << 26}

_PHOTONS = field_range(Transport, "photons")
_RANGES = {"threads": "[1, 4096]", "launch_size": f"[1, {1 << 26}]", "first_photon": f"[0, {1 << 62}]"}

# Voxels that are read at the end of a batch for each of its photons, at most: 2 % of a photon's time, on a GPU too.
_VOXELS_PER_PHOTON = 16

# Photons of a batch at most: some seconds of a GPU, so that several can share the work and little is lost.
_LARGEST_BATCH = 1 << 30


@dataclass(frozen=True, kw_only=True)
class RunOptions:
    """How the photons of a run are divided, and what of the run is on disk; no choice changes the bits of a photon.

    Attributes:
        threads: CPU threads; by default one a core. A GPU takes none.
        launch_size: Photons in one launch, up to 2^26, on the CPU 2^20; by default what suits the device.
        first_photon: Id of the first photon; runs with disjoint ids can be added by `merge`.
        shard: (3, 64) for the third of 64 equal parts of the photons, which `merge` makes whole.
        resume: A result of the same scene, or its path, to which photons are added until it has `photons`; the outcome
            is that of one long run. Gaps in its ids are filled.
        checkpoint: A file for the photons done so far, as a partial result that `resume` takes. It is not removed when
            the run is done.
        checkpoint_every: Seconds between checkpoints, at least; more where writing takes long, so that it costs 2 % of
            the time at most.

    Raises:
        ArgumentError: A number out of range.
    """

    threads: int | None = None
    launch_size: int | None = None
    first_photon: int = 0
    shard: tuple[int, int] | None = None
    resume: ResultLike | None = None
    checkpoint: str | Path | None = None
    checkpoint_every: float = 60.0

    def __post_init__(self) -> None:
        checked: dict[str, Any] = {
            "checkpoint_every": check_real("checkpoint_every", self.checkpoint_every, "[0, inf]")
        }
        for name, within in _RANGES.items():
            value = getattr(self, name)
            checked[name] = None if value is None and name != "first_photon" else check_integer(name, value, within)
        checked["shard"] = None if self.shard is None else check_part("shard", self.shard)
        vars(self).update(checked)


@dataclass(frozen=True, eq=False, kw_only=True)
class Plan(ResultHead):
    """The head of a run's result, in a form that can be sent to other processes, and how it is traced: with which mesh
    and derivatives by their full names; None as `launch_size` is what suits the device."""

    mesh: TriangleMesh | None
    derivatives: tuple[str, ...] = ()
    launch_size: int | None = None

    @property
    def scale(self) -> float:
        """Tally units per emitted photon."""
        return 1.0 / self.unit


def make_plan(
    scene: Scene,
    run: RunOptions,
    *,
    photons: int | None,
    seed: int | None,
    batches: bool = False,
    relative_error: float | None = None,
    resume: Result | None = None,
    derivatives: Iterable[str] | None = None,
    blocks: Sequence[int] | None = None,
) -> Plan:
    """The plan for the arguments of `simulate`; `resume` is that of the run, read.

    Raises `ArgumentError` for those that are out of range, `ConfigError` for those that cannot be combined.
    """
    photons = None if photons is None else check_integer("photons", photons, _PHOTONS)
    seed = None if seed is None else check_integer("seed", seed, SEED)
    first_photon, shard, batch_size = run.first_photon, run.shard, 0
    if relative_error is not None:
        check_real("relative_error", relative_error, "(0, 1)")
        if shard is not None:
            raise ConfigError("relative_error cannot be combined with shard: no part knows the error of the whole")
    batches = batches or relative_error is not None
    names = () if derivatives is None else resolve_derivatives(scene, derivatives, blocks)
    if resume is not None:
        _check_resumed(resume, run, seed, batches)
        seed, first_photon, batch_size = resume.seed, resume.requested[0], resume.batch_size
        photons = count([resume.requested]) if photons is None else photons
        if photons <= resume.photons:
            raise ConfigError(f"photons = {photons} is outside [{resume.photons + 1}, {10**12}]")
        had = tuple(resume.derivatives)
        if derivatives is not None and names != had:
            text = f"the run to resume has {', '.join(had) or 'none'}, not {', '.join(names)}"
            raise ConfigError(f"derivatives: {text}")
        names = had
    photons = scene.transport.photons if photons is None else photons
    if batches and resume is None:
        batch_size = _batch_size(scene, photons, relative_error, shard)
    if batch_size:
        photons = -(-photons // batch_size) * batch_size
        if first_photon % batch_size:
            text = f"is not a multiple of {batch_size}, the photons of a batch"
            raise ConfigError(f"first_photon = {first_photon} {text}")
    mesh = build_mesh(scene)
    scale, capacity = scale_and_capacity(scene, mesh)
    if photons > capacity:
        raise ConfigError(
            f"photons = {photons} is outside [1, {capacity}]: the unit of this scene's histogram is fine enough for "
            "its furthest target, and more photons might overflow its brightest bin; average runs with other seeds "
            "instead, or start the gate later"
        )
    ids = first_photon, first_photon + photons
    ids = ids if shard is None else shard_of(ids, shard, batch_size or 1)
    plan = Plan(
        scene=scene,
        unit=1.0 / scale,
        photons=count([ids]),
        seed=scene.transport.seed if seed is None else seed,
        energy_balance_unit=sk.LEDGER_UNIT,
        photon_ranges=(ids,),
        batch_size=batch_size,
        requested=ids,
        focus_distance=focus_distance(scene, mesh),
        mesh=mesh,
        derivatives=names,
        launch_size=run.launch_size,
    )
    if resume is not None and (problem := difference(resume, plan)):
        raise ConfigError(f"resume: {problem}")
    return plan


def _batch_size(scene: Scene, photons: int, relative_error: float | None, shard: tuple[int, int] | None) -> int:
    """A power of two, times the positions of a scan so that every batch has whole rounds of it."""
    least = 32
    if relative_error is not None:
        # With a stopping rule more batches, so that it can act early; in a large histogram, all of which is read at the
        # end of a batch, fewer.
        voxels = len(COMPONENTS) * scene.camera.width * scene.camera.height * scene.gate.bins
        least = min(max(photons * _VOXELS_PER_PHOTON // voxels, 128), 1024)
    least = least if shard is None else max(least, shard[1])
    positions = scene.scan_positions
    return positions * min(1 << max(0, (photons // positions // least).bit_length() - 1), _LARGEST_BATCH)


def _check_resumed(resume: Result, run: RunOptions, seed: int | None, batches: bool) -> None:
    for name in ("first_photon", "shard"):
        if value := getattr(run, name):
            raise ConfigError(f"{name} = {value} cannot be combined with resume, which has the photon ids of its run")
    if seed not in (None, resume.seed):
        raise ConfigError(f"seed = {seed} is not {resume.seed}, the seed of the run to resume")
    if batches and not resume.batch_size:
        raise ConfigError("uncertainty: the run to resume has no batches")
    if channel := resume.provenance.get("channel"):
        raise ConfigError(f"resume: the result holds {channel}-polarised light alone; resume the run that it is of")
