"""Simulation of a scene: plan the photons, trace them, collect their tallies in a `Result`."""

from __future__ import annotations

import datetime
import math
import platform
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import fields, replace
from functools import partial
from itertools import accumulate
from typing import Any, Literal

import numpy as np
import warp as wp
from numpy.typing import NDArray

from spadwarp.device import pick_device, pick_devices, processor_name
from spadwarp.parallel.workers import Event, Ray, interruptible
from spadwarp.result import Result, as_result, merge, save_result
from spadwarp.result.file import TARGETS_DIFFER, same_targets
from spadwarp.result.photon_ids import IdQueue, Range, Ranges, count, joined, without
from spadwarp.result.result import NOISE_GOAL, ResultHead, largest_share, unseen_warnings
from spadwarp.result.tallies import check_capacity
from spadwarp.scene import SceneLike, as_scene
from spadwarp.transport.model import points_per_flight
from spadwarp.transport.plan import Plan, RunOptions, make_plan
from spadwarp.transport.workers import ClusterWorkers, LocalWorkers, trace_block
from spadwarp.values import (
    ArgumentError,
    ConfigError,
    DeviceError,
    FileError,
    SpadwarpWarning,
    __version__,
    check_real,
    percent,
    shown,
)

__all__ = ["Progress", "provenance", "simulate"]

Progress = Callable[[str, int, int], None]

# Rounding is worth a warning where it adds more than this to the relative error of a bin, and where contributions are
# so small, in numbers of them to one unit, that their own scatter is less.
_LARGEST_ROUNDING_ERROR = 0.05
_MANY = 10

# Seconds that a block of photons takes: long beside the milliseconds of handing it out, short beside a checkpoint's.
_BLOCK_SECONDS = 5.0

# Checkpoints take at most this share of the time.
_LARGEST_SHARE = 0.02

DEFAULT_TIME = 60.0
"""Seconds of a run whose error decides its photons."""
_LEAST_PART = 0.05  # of the time so far, for which such a run goes on

FIRST_LOOK = 32
"""Batches after which a run whose goal is a relative error first looks at it."""

# Photons beyond the number that should reach the goal, since most looks would else come a little too early.
_RESERVE = 1.05
# Errors of few batches may be far too large: at the next look there are at most so many times as many.
_MOST = 8
# A run whose error first reaches the goal goes on by this times the share of the variance that one batch has, at most
# by as many photons again.
_GOING_ON = 4.0


def simulate(
    scene: SceneLike,
    *,
    photons: int | Literal["auto"] | None = None,
    time: float | None = None,
    seed: int | None = None,
    device: str | None = None,
    engine: Ray | None = None,
    progress: Progress | None = None,
    relative_error: float | None = None,
    derivatives: Iterable[str] | None = None,
    blocks: Sequence[int] | None = None,
    tallies: Any = None,
    mesh_cache: dict[str, Any] | None = None,
    run: RunOptions | None = None,
) -> Result:
    """Traces photons through a scene into expected histograms per pixel.

    One seed gives the same bits on one kind of device, whatever their number, the engine and the `RunOptions`.

    Args:
        scene: From `spadwarp.load_scene`, or the path of its file.
        photons: Emitted photons in all, > 0; by default `scene.transport.photons`, or what the run to resume was asked
            for. "auto": as many as bring `Result.target_noise_ratio` to 0.1, or `Result.relative_error` to
            `relative_error`, by the rule of the latter; fewer where the time is over before.
        time: Seconds that "auto" takes at most, > 0, without loading kernels; by default 60.
        seed: 0 ... 2^64 - 1; by default `scene.transport.seed`, or that of the run to resume.
        device: "cpu", "cuda:0", "cuda:0,cuda:2", or "cuda:all" for the GPUs of this host; by default the first GPU,
            else the CPU.
        engine: `spadwarp.Ray(...)` to run on its workers; `device` is then "cpu" or "cuda".
        progress: Called from the caller's thread with ("compile", 0, 0) before kernels are compiled or loaded, then
            with ("trace", photons done, photons asked for); any other first word is a remark for the user.
        relative_error: Stop when `Result.relative_error` is about this; a number of `photons` is the most. The
            error is looked at after 32 batches of 1/128 to 1/1024 of the photons, and then where it says that the goal
            will be reached, whatever the device. There the run goes on by a part of its photons that is then fixed, so
            that it does not end because rare heavy photons have not arrived yet; if they do then, the error is larger
            than asked for. See "Which estimator, how many photons".
        derivatives: Parameters by which the histogram is differentiated, for `Result.derivatives`, 8 at most:
            "medium.absorption", "medium.scattering", "medium.anisotropy", "medium.layers[1].scattering",
            "targets[0].reflectance"; short, "absorption", where one parameter alone can be meant. By default none, or
            those of the run to resume. The photons and their histogram stay the same to the bit.
            "medium.grid.absorption", "medium.grid.scattering" and "medium.grid.extinction" (at fixed albedo) are those
            of all blocks of a grid's cells, 4096 at most; `Result.derivatives` has all of them by that name.
        blocks: Number of blocks along the three edges of `medium.grid`, each a divisor of the number of cells there;
            by default one block.
        tallies: The caller's own torch tensor or Warp array for the tallies, contiguous int64 of 3·H·W·T elements on
            the device; what it holds is overwritten. Its contents are the result's tallies, which on the CPU share its
            memory; `spadwarp.result.to_torch(result, tallies=…)` makes histograms of it where it lies. For one
            device, without `resume`.
        mesh_cache: A dict, empty at first, for runs of a scene that moves: it keeps the mesh on its devices, and where
            only vertices moved its tree is refitted and not built anew. Without `engine`.
        run: Threads and launches, photon ids of a part of a run, resuming and checkpoints; see `RunOptions`.

    Returns the result, which knows its standard errors from batches of its photons (8 to 63, with `relative_error` 128
    to 2047; `Result.batches`); a histogram of more than 2^27 bins keeps none. After Ctrl-C or SIGTERM it holds the
    photons that were done and is marked `partial`.

    Raises:
        ArgumentError: An argument of the wrong kind or out of range.
        ConfigError, MeshError, DeviceError: The scene cannot be simulated; nothing was computed.
        DeviceError: A device failed during the run; the text names the checkpoint, if there is one.
        KeyboardInterrupt: Ctrl-C before the first launch was done, or a second Ctrl-C.
    """
    run = RunOptions() if run is None else run
    if not isinstance(run, RunOptions):
        raise ArgumentError(f"run = {shown(run)} is not a RunOptions")
    if tallies is not None and (run.resume is not None or engine is not None):
        raise ConfigError("tallies cannot be combined with resume and engine: they hold one run of one device")
    resume = None if run.resume is None else as_result(run.resume, "resume")
    devices = pick_devices(device) if engine is None else ()
    plan = make_plan(
        as_scene(scene),
        run,
        photons=photons,
        seed=seed,
        kind="cuda" if any(item.is_cuda for item in devices) or (engine and device == "cuda") else "cpu",
        relative_error=relative_error,
        resume=resume,
        derivatives=derivatives,
        blocks=blocks,
    )
    if time is not None and not plan.is_auto:
        raise ConfigError(f"time = {shown(time)} goes with photons = 'auto'")
    seconds = DEFAULT_TIME if time is None else check_real("time", time, "(0, 1e9] s")
    with ExitStack() as stack:
        stopped = stack.enter_context(interruptible())
        if progress is not None:
            progress("compile", 0, 0)
        workers: LocalWorkers | ClusterWorkers
        if engine is None:
            workers = LocalWorkers(plan, devices, threads=run.threads, tallies=tallies, mesh_cache=mesh_cache)
            stack.callback(workers.pool.shutdown, wait=False)
        else:
            note = None if progress is None else lambda text: progress(text, 0, 0)
            workers = stack.enter_context(ClusterWorkers(plan, engine, device, note=note))
        result = _Run(plan, workers, resume, progress, run, stopped).result(relative_error, seconds)
    _warn_of_rounding(result)
    # Where the errors decide how many photons are traced, reasons to mistrust them are said.
    by_error = relative_error is not None or plan.is_auto
    for text in result.warnings if by_error else unseen_warnings(result):
        warnings.warn(text, SpadwarpWarning, stacklevel=2)
    return result


def _warn_of_rounding(result: Result) -> None:
    """Warns where contributions are so small that rounding them to the tally's unit decides the error."""
    many = _MANY * points_per_flight(result.scene)  # each point has so small a part of a flight's contribution
    for name, tally in zip(result.scene.components, result.tallies, strict=True):
        small = result.counters.get(f"below_unit_{name}", 0)
        # The first rows of pixels mostly show that there is more.
        if small <= many or any(total * many >= small for total in accumulate(map(_units, tally))):
            continue
        total, error = _units(tally), result.rounding_error[name]
        if error > _LARGEST_ROUNDING_ERROR:
            text = f"adds {percent(error)} % to the error of an average illuminated bin" if total else "left none of it"
            warnings.warn(
                f"{name}: rounding to the histogram's unit {text}: {small} contributions of less than one unit came to "
                f"{total} units in all; more photons help, and a later gate.start or narrower bins make the unit finer",
                RuntimeWarning,
                stacklevel=3,
            )


def _units(tally: NDArray[np.int64]) -> int:
    return int(tally.sum(dtype=np.float64))


class _Run:
    """The photons of a plan, each counted once, those of an earlier result included: blocks of workers that were lost
    run again, and what is done is written to a checkpoint now and then."""

    def __init__(
        self,
        plan: Plan,
        workers: LocalWorkers | ClusterWorkers,
        resumed: Result | None,
        progress: Progress | None,
        options: RunOptions,
        stopped: threading.Event,
    ) -> None:
        if resumed is not None and not same_targets(resumed.truth, workers.truth):
            raise ConfigError(f"resume: {TARGETS_DIFFER}")
        self._plan, self._workers, self._resumed, self._stopped = plan, workers, resumed, stopped
        self._report = (lambda stage, done, total: None) if progress is None else progress
        self._began = time.perf_counter()
        self._earlier: Ranges = () if resumed is None else joined(resumed.photon_ranges)
        self._waiting = IdQueue(())
        self._done: list[Range] = []  # in `workers.tallies()`
        self._held: dict[Any, list[Range]] = {}  # done, in the tallies of the worker
        self._running: dict[Any, Range | None] = {}  # None: it hands its tallies over
        self._progress: dict[Any, int] = {}  # photons of a running block that are done
        self._speed: dict[Any, float] = {}
        self._collecting: set[Any] | None = None  # workers that have yet to hand over, while a checkpoint is due
        self._photons = plan.photons  # that will be traced, as far as is known
        self._place, self._every = options.checkpoint, options.checkpoint_every
        self._written, self._cost, self._saved = time.monotonic(), 0.0, 0  # time, seconds and photons of the checkpoint

    def result(self, relative_error: float | None, seconds: float) -> Result:
        """Of all photons, of those that reach a goal, or of those done when the run was stopped."""
        try:
            if relative_error is not None or self._plan.is_auto:
                return self._known_result(StoppingRule(relative_error), seconds if self._plan.is_auto else math.inf)
            self._trace(self._plan.requested)
            if not self._done:
                raise KeyboardInterrupt
            return self._collect()
        except DeviceError as error:
            if not self._saved:
                raise
            saved = f"{self._place}: the {self._saved} photons that were done are here; resume it"
            raise DeviceError(f"{error}\n{saved}") from error

    def _known_result(self, rule: StoppingRule, seconds: float) -> Result:
        """Traces until the error is known to be small enough, looking at it where it may be, or for so many seconds."""
        size, (start, stop), began = self._plan.batch_size, self._plan.requested, time.monotonic()
        earlier, deadline, limited = count(self._earlier), began + seconds, seconds < math.inf
        end = min(start + max(FIRST_LOOK * size, earlier), stop)
        self._photons = end - start + size
        while True:
            self._trace((start, end), deadline)
            if not self._done and self._stopped.is_set():
                raise KeyboardInterrupt
            result = self._collect()
            ids, now = joined(result.photon_ranges), time.monotonic()
            if self._stopped.is_set() and without((start, end), ids):
                return result
            error, batches = rule.error_of(result), result.photons // size
            wanted = rule.next_look(batches, error, partial(largest_share, result))
            needed = result.photons * (error / rule.goal) ** 2
            if error < math.inf:
                text = f"error {100 * error:.3g} %" if rule.is_relative else f"noise ratio {error * error:.3g}"
                more = f"; about {needed:.2g} photons are needed" if rule.goal < error else ""
                self._report(f"{text} after {result.batches} batches{more}", result.photons, self._photons)
            if wanted is None or result.photons >= stop - start or deadline - now < _LEAST_PART * (now - began):
                self._report("trace", result.photons, result.photons)
                end = ids[-1][1]
                return replace(result, requested=(start, end), partial=bool(without((start, end), ids)))
            end = min(end + (wanted - batches) * size, stop)
            # Of the error's own: what is done of the photons that reach the goal, or that the time allows.
            most = min(needed, stop - start)
            if limited:
                most = min(most, result.photons + (result.photons - earlier) * (deadline - now) / (now - began))
            self._photons = max(int(most), end - start + (0 if rule.found else size))

    def _trace(self, span: Range, deadline: float = math.inf) -> None:
        """Traces the ids of a span that are not done; fewer where the run is stopped, or the time is over."""
        self._waiting = IdQueue(without(span, joined([*self._earlier, *self._done])))
        try:
            while True:
                if stopped := self._stopped.is_set():
                    self._workers.stop()
                if time.monotonic() >= deadline and (self._done or self._held or self._running):
                    self._waiting = IdQueue(())
                ending = stopped or not self._unfinished()
                pause = math.inf if self._place is None else max(self._every, self._cost / _LARGEST_SHARE)
                if self._collecting is None and not ending and time.monotonic() >= self._written + pause:
                    # None again if no worker has done or begun anything yet.
                    self._collecting = {*self._held, *self._running} or None
                self._assign(ending, stopped, deadline)
                if ending and not self._running:
                    return
                for event in self._workers.wait():
                    self._take(event)
                photons = sum(map(count, (self._earlier, self._done, *self._held.values())))
                self._report("trace", photons + sum(self._progress.values()), self._photons)
                if self._collecting is not None and not self._collecting:
                    self._collecting = None
                    if self._done and not self._stopped.is_set() and self._unfinished():
                        self._write_checkpoint()
        except BaseException:
            self._workers.stop()
            raise

    def _unfinished(self) -> bool:
        return bool(self._waiting.left or any(self._running.values()))

    def _assign(self, ending: bool, stopped: bool, deadline: float) -> None:
        """Gives every idle worker something to do."""
        idle: Sequence[Any] = self._workers.idle
        for worker in idle:
            if self._held.get(worker) and (ending or worker in (self._collecting or ())):
                self._running[worker] = None
                self._workers.collect(worker)
            elif stopped or (self._collecting is not None and self._workers.must_rest):
                continue
            elif block := self._waiting.take(self._size(worker, deadline), self._plan.batch_size or 1):
                self._running[worker] = block
                self._workers.send(worker, trace_block, block)

    def _size(self, worker: Any, deadline: float) -> int:
        """Photons of the next block: some seconds, fewer towards the end so that all workers end together."""
        first, workers, unit = self._workers.first_block, len(self._workers.workers), self._plan.batch_size or 1
        seconds = min(_BLOCK_SECONDS, max(deadline - time.monotonic(), 0.0))
        size = int(self._speed[worker] * seconds) if worker in self._speed else first
        if workers > 1:
            size = min(size, max(self._waiting.left // (2 * workers), first // 16))
        return -(-size // unit) * unit

    def _take(self, event: Event) -> None:
        """What a worker did; an event of one that has nothing to do is that it has joined, or was lost before."""
        worker = event.worker
        if event.kind == "progress":
            self._progress[worker] = self._progress.get(worker, 0) + event.value
            return
        if worker not in self._running:
            return
        block = self._running.pop(worker)
        self._progress.pop(worker, None)
        if event.kind == "returned" and block is not None:
            ids, seconds = event.value
            self._held.setdefault(worker, []).extend(ids)
            if seconds > 0:
                self._speed[worker] = count(ids) / seconds
            return
        if event.kind == "returned":
            self._done += self._held.pop(worker)
        else:
            self._waiting.put_back([*self._held.pop(worker, []), *([block] if block else [])])
        if self._collecting is not None:
            self._collecting.discard(worker)

    def _collect(self) -> Result:
        """The result of the ids done, whose tallies the workers and the earlier result hold."""
        parts, plan = [] if self._resumed is None else [self._resumed], self._plan
        if done := joined(self._done):
            total = self._workers.tallies()
            if not parts:
                check_capacity(total.tallies)
            head = {field.name: getattr(plan, field.name) for field in fields(ResultHead)}
            own = Result(
                **{**head, "photons": count(done), "photon_ranges": done},
                **vars(total),
                truth=self._workers.truth,
                timing={**self._workers.timing, "trace": time.perf_counter() - self._began},
                provenance=provenance() | self._workers.metadata(),
            )
            parts.append(own)
        whole = parts[0] if len(parts) == 1 else merge(parts)
        left = bool(without(plan.requested, joined(whole.photon_ranges)))
        result = replace(whole, scene=plan.scene, requested=plan.requested, partial=left)
        if difference := result.energy_report()["difference"]:
            raise DeviceError(f"the energy balance is off by {difference} units: a device has lost counts")
        return result

    def _write_checkpoint(self) -> None:
        """Writes what is done; where that fails the run continues, as the disk may have space again later."""
        assert self._place is not None
        began = time.monotonic()
        try:
            result = self._collect()
            save_result(result, self._place)
            self._saved = result.photons
        except FileError as error:
            warnings.warn(f"no checkpoint, the run continues: {error}", RuntimeWarning, stacklevel=2)
        self._written = time.monotonic()
        self._cost = self._written - began


class StoppingRule:
    """The rule of one run, whose error falls as the root of its photons: relative, or the root of the noise ratio.

    It looks for the number of photons at which the error reaches the goal. A run that ended there would end where rare
    bright photons have not come yet: too dark, with an error that is too small. So it goes on by a part of these
    photons that is fixed there and then, and ends whatever the last of them bring. The part is small where many photons
    matter equally, 40 to 80 batches; where few decide it is as many photons again, so that half had no say in it.
    """

    def __init__(self, relative_error: float | None) -> None:
        self.is_relative, self.found = relative_error is not None, False
        self.goal = math.sqrt(NOISE_GOAL) if relative_error is None else relative_error

    def error_of(self, result: Result) -> float:
        """Infinite: not known."""
        if result.batches < 2:
            return math.inf
        return result.relative_error if self.is_relative else math.sqrt(result.target_noise_ratio)

    def next_look(self, batches: int, error: float, share: Callable[[], float]) -> int | None:
        """Batches at the next look, None if the run ends; from those so far, the relative error after these (infinite:
        not known) and the part of the variance between batches that one of them has, in [0, 1]."""
        if self.found:
            return None
        if error <= self.goal:
            self.found = True
            return batches + math.ceil(batches * min(1.0, _GOING_ON * share()))
        most, excess = _MOST * batches, error / self.goal
        wanted = math.ceil(_RESERVE * batches * excess**2) if excess < math.inf else most
        return min(max(wanted, batches + max(1, batches // 16)), most)


def provenance(device: Any = None) -> dict[str, Any]:
    """What made a result: versions, machine, date; and a device."""
    made = {
        "spadwarp": __version__,
        "warp": wp.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }
    if device is None:
        return made
    device = pick_device(device)
    return {**made, "device": device.alias, "device_name": processor_name(device)}
