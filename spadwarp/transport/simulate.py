"""Running a scene: which photons, on what, until when; their sums become a `Result`."""

from __future__ import annotations

import datetime
import platform
import time
import warnings
from collections.abc import Callable
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.device import pick_devices, processor_name
from spadwarp.errors import ConfigError, DeviceError, FileError
from spadwarp.parallel import Ray, interruptible
from spadwarp.result.merge import add_timing, check_capacity, check_targets, join_provenance, physics_of
from spadwarp.result.photon_ids import Range, Ranges, count, joined, shard_of, without
from spadwarp.result.result import Result
from spadwarp.scene import Scene
from spadwarp.transport.passes import Plan, Tracer, check_range

if TYPE_CHECKING:
    from spadwarp.transport.cluster import ClusterTracer

# Called with ("compile", 0, 0) before kernels are compiled or loaded, then with ("trace", photons done, photons asked
# for); any other first word is a remark for whoever watches.
Progress = Callable[[str, int, int], None]

# Checkpoints take at most this share of the time.
_CHECKPOINT_SHARE = 0.02

# Photons of a batch at most: some seconds of a GPU, so that there is enough to deal out and little to lose.
_LARGEST_BATCH = 1 << 30


def simulate(
    scene: Scene,
    *,
    photons: int | None = None,
    seed: int | None = None,
    device: str | None = None,
    engine: Ray | None = None,
    threads: int | None = None,
    pass_size: int | None = None,
    progress: Progress | None = None,
    uncertainty: bool = False,
    relative_error: float | None = None,
    first_photon: int = 0,
    shard: tuple[int, int] | None = None,
    resume: Result | None = None,
    checkpoint: str | Path | None = None,
    checkpoint_every: float = 60.0,
    tallies: Any = None,
) -> Result:
    """Traces photons through a scene into expected histograms per pixel.

    One seed gives the same bits on one kind of device, whatever their number, the engine, `threads` and `pass_size`.

    Args:
        scene: From `spadwarp.load_scene`.
        photons: Emitted photons in all, > 0; by default `scene.transport.photons`, or what the run to resume was asked
            for.
        seed: 0 ... 2^64 - 1; by default `scene.transport.seed`, or that of the run to resume.
        device: "cpu", "cuda:0", "cuda:0,cuda:2", or "cuda:all" for the GPUs of this host; by default the first GPU,
            else the CPU.
        engine: `spadwarp.Ray(...)` to run on its workers; `device` is then "cpu" or "cuda".
        threads: CPU threads; by default one a core. A GPU takes none.
        pass_size: Photons in one launch, up to 2^26, on the CPU 2^20.
        progress: Called from the caller's thread.
        uncertainty: Keep batches of photons, for `Result.standard_error`. Photons are rounded up to whole batches, by
            at most 1/32, in a scan to one photon a position at least; the histogram takes 2 2/3 times the memory.
        relative_error: Stop once `Result.relative_error` is below this, checked after 8, 16, 32, ... batches; implies
            `uncertainty`, and `photons` is the most that are traced.
        first_photon: Id of the first photon; runs with disjoint ids can be added by `merge`.
        shard: (3, 64) for the third of 64 equal parts of the photons, which `merge` makes whole.
        resume: A result of the same scene, to which photons are added until it has `photons`; the outcome is that of
            one long run. Gaps in its ids are filled.
        checkpoint: A file that holds, as a partial result, what is done so far; `resume` goes on from it. Left where
            it is when the run is done.
        checkpoint_every: Seconds between checkpoints, at least; more where writing takes long, so that it costs 2 % of
            the time at most.
        tallies: The caller's own torch tensor or Warp array for the tallies, contiguous int64 of 3·H·W·T elements on
            the device; what it holds is overwritten. Its contents are the result's tallies, which on the CPU share its
            memory; `spadwarp.to_torch(result, tallies=…)` makes histograms of it where it lies. For one device, without
            `resume`.

    Returns:
        The result. After Ctrl-C or SIGTERM it holds the photons (or batches) that were done and is marked `partial`.

    Raises:
        ConfigError, MeshError, DeviceError: The scene cannot be simulated; nothing was computed.
        DeviceError: A device failed on the way; the text names the checkpoint, if there is one.
        KeyboardInterrupt: Ctrl-C before the first pass was done, or a second Ctrl-C.
    """
    from spadwarp.mesh import build_mesh

    if resume is not None:
        _check_resumed(resume, scene, seed, first_photon, shard, uncertainty or relative_error is not None)
        seed, first_photon = resume.seed, resume.requested[0]
        photons = count([resume.requested]) if photons is None else photons
        if photons <= resume.photons:
            raise ConfigError(f"photons = {photons} is outside [{resume.photons + 1}, {10**12}]")
    photons = scene.transport.photons if photons is None else photons
    seed = scene.transport.seed if seed is None else seed
    check_range("photons", photons, 1, 10**12)
    check_range("seed", seed, 0, 2**64 - 1)
    check_range("first_photon", first_photon, 0, 2**62)
    if relative_error is not None and not 0 < relative_error < 1:
        raise ConfigError(f"relative_error = {relative_error} is outside (0, 1)")
    if relative_error is not None and shard is not None:
        raise ConfigError("relative_error goes without shard: no part knows the error of the whole")
    if tallies is not None and (resume is not None or engine is not None):
        raise ConfigError("tallies go without resume and engine: they hold one run of one device")
    if not checkpoint_every >= 0:
        raise ConfigError(f"checkpoint_every = {checkpoint_every} is outside [0, inf)")
    batch_size = 0
    if resume is not None:
        batch_size = resume.batch_size
    elif uncertainty or relative_error is not None:
        # With a stopping rule more of them, so that it can act early.
        least = 32 if relative_error is None else 1024
        # Whole rounds of a scan, so that every position has as many photons in each.
        positions = scene.scan_positions
        batch_size = positions * _batch_size(photons // positions, least if shard is None else max(least, shard[1]))
    if batch_size:
        photons = -(-photons // batch_size) * batch_size
        if first_photon % batch_size:
            raise ConfigError(
                f"first_photon = {first_photon} is not a multiple of {batch_size}, the photons of a batch"
            )
    wanted = first_photon, first_photon + photons
    if shard is not None:
        wanted = shard_of(wanted, shard, batch_size or 1)

    mesh = build_mesh(scene)
    plan = Plan(scene, mesh, seed, batch_size, pass_size)
    with ExitStack() as stack:
        stopped = stack.enter_context(interruptible())
        if progress is not None:
            progress("compile", 0, 0)
        tracer: Tracer | ClusterTracer
        if engine is None:
            tracer = Tracer(plan, pick_devices(device), threads=threads, base=resume, tallies=tallies)
        else:
            from spadwarp.transport.cluster import ClusterTracer

            tell = None if progress is None else lambda text: progress(text, 0, 0)
            tracer = stack.enter_context(ClusterTracer(plan, engine, device, base=resume, note=tell))
        run = _Run(plan, tracer, wanted, resume, progress, _Checkpoint(checkpoint, checkpoint_every))
        try:
            return run(stopped, relative_error)
        except DeviceError as error:
            if run.checkpoint.photons:
                kept = f"{run.checkpoint.path}: the {run.checkpoint.photons} photons that were done are here; resume it"
                raise DeviceError(f"{error}\n{kept}") from error
            raise


@dataclass
class _Checkpoint:
    """When what is done is written down, and where."""

    path: str | Path | None
    every: float
    photons: int = 0

    def __post_init__(self) -> None:
        self._written, self._cost = time.monotonic(), 0.0

    def due(self) -> bool:
        pause = max(self.every, self._cost / _CHECKPOINT_SHARE)
        return self.path is not None and time.monotonic() >= self._written + pause

    def write(self, collect: Callable[[], Result]) -> None:
        """The run goes on if this fails: the disk may have room again later."""
        from spadwarp.result.file import save_result

        assert self.path is not None
        began = time.monotonic()
        try:
            result = collect()
            save_result(result, self.path)
            self.photons = result.photons
        except FileError as error:
            warnings.warn(f"no checkpoint, the run goes on: {error}", RuntimeWarning, stacklevel=2)
        self._written = time.monotonic()
        self._cost = self._written - began


@dataclass
class _Run:
    """A plan on its way to a result."""

    plan: Plan
    tracer: Tracer | ClusterTracer
    wanted: Range
    resumed: Result | None
    progress: Progress | None
    checkpoint: _Checkpoint

    def __call__(self, stopped: Any, relative_error: float | None) -> Result:
        from spadwarp.transport.tally_scale import tally_scale

        self.unit = 1.0 / tally_scale(self.plan.scene, self.plan.mesh)
        if self.resumed is not None and self.resumed.unit != self.unit:
            raise ConfigError(f"resume: the tally unit is {self.unit}, that of the result {self.resumed.unit}")
        began = time.perf_counter()
        self.truth = self.tracer.truth()
        self.began = time.perf_counter()
        self.truth_seconds = self.began - began
        if self.resumed is not None:
            check_targets(self.resumed.truth, self.truth, "resume")

        self.earlier: Ranges = () if self.resumed is None else joined(self.resumed.photon_ranges)
        done = self.earlier
        start, stop = self.wanted
        for goal in [*self._milestones(count(done) if relative_error is not None else None), stop]:
            done = self._trace((start, goal), done, stopped)
            if stopped.is_set() and without((start, goal), done):
                break
            if relative_error is not None:
                result = self._collect(done)
                if self._known(result, relative_error) or goal == stop:
                    return replace(result, requested=(start, goal), partial=False)
        if count(done) == count(self.earlier):
            raise KeyboardInterrupt
        return self._collect(done)

    def _milestones(self, done: int | None) -> list[int]:
        """Where the error is looked at: after 8, 16, 32, ... batches; nowhere without a stopping rule."""
        start, stop = self.wanted
        if done is None:
            return []
        sizes = [self.plan.batch_size << power for power in range(3, 45)]
        return [start + size for size in sizes if done < size < stop - start]

    def _known(self, result: Result, relative_error: float | None) -> bool:
        assert relative_error is not None
        if result.photons < 2 * result.batch_size:
            return False
        error = result.relative_error
        if self.progress is not None:
            batches = result.photons // result.batch_size
            self.progress(f"error {100 * error:.3g} % after {batches} batches", result.photons, count([self.wanted]))
        return error <= relative_error

    def _trace(self, span: Range, done: Ranges, stopped: Any) -> Ranges:
        """The ids done once a span is, or once the run was stopped."""
        total = count([self.wanted])

        def report(now: int) -> None:
            if self.progress is not None:
                self.progress("trace", count(done) + now, total)

        def keep(now: Ranges) -> None:
            self.checkpoint.write(lambda: self._collect(joined([*done, *now])))

        todo = without(span, done)
        if not todo:
            return done
        now = self.tracer.trace(todo, stopped=stopped, report=report, due=self.checkpoint.due, keep=keep)
        return joined([*done, *now])

    def _collect(self, done: Ranges) -> Result:
        """The result of the ids done, which are what the tracer's sums hold."""
        import spadwarp_kernels as sk

        sums = self.tracer.sums()
        check_capacity(sums.tallies.sum(axis=0, dtype=np.float64))
        tracing = {"truth": self.truth_seconds, "trace": time.perf_counter() - self.began}
        fresh = Result(
            scene=self.plan.scene,
            **vars(sums),
            unit=self.unit,
            photons=count(done),
            seed=self.plan.seed,
            ledger_unit=sk.LEDGER_UNIT,
            truth=self.truth,
            timing={**self.tracer.timing, **tracing},
            provenance={**provenance(), **self.tracer.about()},
            photon_ranges=done,
            batch_size=self.plan.batch_size,
            requested=self.wanted,
            partial=bool(without(self.wanted, done)),
        )
        if difference := fresh.ledger_report()["difference"]:
            raise DeviceError(f"the energy ledger is off by {difference} units: a device has lost counts")
        if self.resumed is None:
            return fresh
        own = tuple(span for first in done for span in without(first, self.earlier))
        parts = [self.resumed, replace(fresh, photon_ranges=own, photons=count(own))] if own else [self.resumed]
        return replace(
            fresh,
            timing=add_timing([fresh.timing, self.resumed.timing]),
            provenance=join_provenance(parts),
        )


def _batch_size(photons: int, least: int) -> int:
    """A power of two, for at least so many batches."""
    return min(1 << max(0, (photons // least).bit_length() - 1), _LARGEST_BATCH)


def _check_resumed(
    resume: Result, scene: Scene, seed: int | None, first_photon: int, shard: tuple[int, int] | None, batches: bool
) -> None:
    for name, value in (("first_photon", first_photon), ("shard", shard)):
        if value:
            raise ConfigError(f"{name} = {value} goes without resume, which knows where to go on")
    if physics_of(scene) != physics_of(resume.scene):
        raise ConfigError("resume: the result is of another scene; only photons and output may differ")
    if seed not in (None, resume.seed):
        raise ConfigError(f"seed = {seed} is not {resume.seed}, the seed of the run to resume")
    if batches and not resume.batch_size:
        raise ConfigError("uncertainty: the run to resume kept no batches")


def provenance(device: Any = None) -> dict[str, Any]:
    """What made a result: versions, machine, date; and a device."""
    import warp as wp

    import spadwarp

    made = {
        "spadwarp": spadwarp.__version__,
        "warp": wp.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    return made if device is None else {**made, "device": device.alias, "device_name": processor_name(device)}
