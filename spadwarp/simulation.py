"""Running a scene: passes of photons over the cores of the CPU or a GPU, into a `Result` or photon records."""

from __future__ import annotations

import datetime
import platform
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.config import Scene
from spadwarp.errors import ConfigError
from spadwarp.hardware import core_count, pick_device
from spadwarp.model import build_model, trace_truth, transport_spec
from spadwarp.result import COMPONENTS, Result, check_capacity, merge, physics_of
from spadwarp.tensors import caller_tallies

if TYPE_CHECKING:
    from spadwarp_kernels import Data, Model

# Called with ("compile", 0, 0) before kernels are compiled or loaded, then with ("trace", photons done, photons asked
# for).
Progress = Callable[[str, int, int], None]

# Photons in one launch: large enough to fill the device, small enough that progress is seen and Ctrl-C heard.
CPU_PASS = 1 << 16
CUDA_PASS = 1 << 26


def simulate(
    scene: Scene,
    *,
    photons: int | None = None,
    seed: int | None = None,
    device: str | None = None,
    threads: int | None = None,
    pass_size: int | None = None,
    progress: Progress | None = None,
    uncertainty: bool = False,
    relative_error: float | None = None,
    first_photon: int = 0,
    resume: Result | None = None,
    tallies: Any = None,
) -> Result:
    """Traces photons through a scene into expected histograms per pixel.

    One seed gives the same bits on one kind of device, whatever `threads` and `pass_size`.

    Args:
        scene: From `spadwarp.load_scene`.
        photons: Emitted photons in all, > 0; by default `scene.transport.photons`.
        seed: 0 ... 2^64 - 1; by default `scene.transport.seed`, or that of the run to resume.
        device: "cpu", "cuda:0", ...; by default the first GPU, else the CPU.
        threads: CPU threads; by default one a core. A GPU takes none.
        pass_size: Photons in one launch, up to 2^26, on the CPU 2^20.
        progress: Called from the caller's thread.
        uncertainty: Keep batches of photons, for `Result.standard_error`. Photons are rounded up to whole batches, by
            at
            most 1/32; the histogram takes 2 2/3 times the memory.
        relative_error: Stop once `Result.relative_error` is below this, checked after 8, 16, 32, ... batches; implies
            `uncertainty`, and `photons` is the most that are traced.
        first_photon: Id of the first photon; runs with disjoint ids can be added by `merge`.
        resume: A result of the same scene, to which photons are added until it has `photons`; the outcome is that of
            one long run.
        tallies: The caller's own torch tensor or Warp array for the tallies, contiguous int64 of 3·H·W·T elements on
            the device; what it holds is overwritten. Its contents are the result's tallies, which on the CPU share its
            memory; `spadwarp.to_torch(result, tallies=…)` makes histograms of it where it lies. Without `resume`.

    Returns:
        The result. After Ctrl-C it holds the photons (or batches) that were done and is marked `partial`.

    Raises:
        ConfigError, MeshError, DeviceError: The scene cannot be simulated; nothing was computed.
        KeyboardInterrupt: Ctrl-C before the first pass was done, or a second Ctrl-C.
    """
    from spadwarp.targets import build_mesh

    photons = scene.transport.photons if photons is None else photons
    _check_range("photons", photons, 1, 10**12)
    if resume is not None:
        if tallies is not None:
            raise ConfigError("tallies go without resume: they hold one run")
        if len(resume.photon_ranges) != 1:
            raise ConfigError(f"resume: the photon ids {resume.photon_ranges} have gaps; merge the missing ones first")
        if first_photon:
            raise ConfigError(f"first_photon = {first_photon} goes without resume, which knows where to go on")
        if physics_of(scene) != physics_of(resume.scene):
            raise ConfigError("resume: the result is of another scene; only photons and output may differ")
        if seed not in (None, resume.seed):
            raise ConfigError(f"seed = {seed} is not {resume.seed}, the seed of the run to resume")
        first_photon = resume.photon_ranges[0][1]
        seed = resume.seed if seed is None else seed
        photons -= resume.photons
        if photons <= 0:
            raise ConfigError(f"photons = {photons + resume.photons} is outside [{resume.photons + 1}, {10**12}]")
    seed = scene.transport.seed if seed is None else seed
    _check_range("seed", seed, 0, 2**64 - 1)
    _check_range("first_photon", first_photon, 0, 2**62)
    if relative_error is not None and not 0 < relative_error < 1:
        raise ConfigError(f"relative_error = {relative_error} is outside (0, 1)")
    batch_size = 0
    if resume is not None:
        batch_size = resume.batch_size
        if batch_size == 0 and (uncertainty or relative_error):
            raise ConfigError("uncertainty: the run to resume kept no batches")
    elif uncertainty or relative_error is not None:
        # At least 32 batches; with a stopping rule up to 1024, so that it can act early.
        batch_size = 1 << max(0, (photons // (32 if relative_error is None else 1024)).bit_length() - 1)
    if batch_size:
        photons = -(-photons // batch_size) * batch_size
        if first_photon % batch_size:
            raise ConfigError(
                f"first_photon = {first_photon} is not a multiple of {batch_size}, the photons of a batch"
            )

    began = time.perf_counter()
    wp_device = pick_device(device)
    mesh = build_mesh(scene)
    model = build_model(scene, wp_device, mesh, copies=2 + 2 / len(COMPONENTS) if batch_size else 1)
    if resume is not None and resume.unit != 1.0 / model.scale:
        raise ConfigError(f"resume: the tally unit is {1.0 / model.scale}, that of the result {resume.unit}")
    ready = time.perf_counter()
    spec = transport_spec(scene, mesh)
    run = _Run(model, spec, seed=seed, progress=progress, batch_size=batch_size, tallies=tallies)
    compiled = time.perf_counter()
    truth = trace_truth(scene, model)
    traced = time.perf_counter()
    result: Result | None = None

    def collect(done: int) -> Result:
        counted, squares = run.tallies()
        check_capacity(counted.sum(axis=0, dtype=np.float64))
        ledger, counters = run.accounts()
        part = Result(
            scene=scene,
            tallies=counted,
            unit=1.0 / model.scale,
            photons=done,
            seed=seed,
            ledger=ledger,
            ledger_unit=run.ledger_unit,
            counters=counters,
            truth=truth,
            timing={
                "setup": ready - began,
                "compile": compiled - ready,
                "truth": traced - compiled,
                "trace": time.perf_counter() - traced,
            },
            provenance=provenance(wp_device),
            partial=False,
            photon_ranges=((first_photon, first_photon + done),),
            batch_size=batch_size,
            squares=squares,
        )
        return part if resume is None else merge([replace(resume, partial=False), part])

    def enough(done: int) -> bool:
        nonlocal result
        batches = done // batch_size
        if relative_error is None or batches < 8 or batches & (batches - 1):
            return False
        result = collect(done)
        return result.relative_error <= relative_error

    done = run.trace(
        first_photon,
        first_photon + photons,
        threads=threads,
        pass_size=pass_size,
        enough=enough if batch_size else None,
    )
    if done == 0:
        raise KeyboardInterrupt
    if result is None or not run.stopped_early:
        result = collect(done)
    return replace(result, partial=done < photons and not run.stopped_early)


@dataclass(frozen=True, eq=False)
class PhotonRecords:
    """How each photon ended.

    Attributes:
        id: uint64 `[N]`.
        position: float32 `[N, 3]`, where it ended [m].
        direction: float32 `[N, 3]`, unit vector of its last flight.
        weight: float32 `[N]`, what was left of it.
        path: float32 `[N]`, geometric path [m].
        collisions: int32 `[N]`, events, surfaces included.
        reason: int32 `[N]`, index into `reasons`.
        reasons: Names of the ledger's entries: weight_cutoff, max_collisions, max_path, lateral_limit, exit_x_low, ...
        ledger: As in `Result`, with its unit.
    """

    id: NDArray[np.uint64]
    position: NDArray[np.float32]
    direction: NDArray[np.float32]
    weight: NDArray[np.float32]
    path: NDArray[np.float32]
    collisions: NDArray[np.int32]
    reason: NDArray[np.int32]
    reasons: tuple[str, ...]
    ledger: dict[str, int]
    ledger_unit: float

    def ended(self, *names: str) -> NDArray[np.bool_]:
        """Mask of the photons that ended for one of the named reasons."""
        return np.isin(self.reason, [self.reasons.index(name) for name in names])


def trace(
    scene: Scene,
    *,
    photons: int | None = None,
    seed: int | None = None,
    device: str | None = None,
    progress: Progress | None = None,
) -> PhotonRecords:
    """Walks photons without a camera and returns the terminal state of each.

    Path is limited by `transport.max_path` alone; the gate plays no part. A photon takes 44 bytes.

    Args and raises: as `simulate`.
    """
    import spadwarp_kernels as sk
    from spadwarp.targets import build_mesh

    photons = scene.transport.photons if photons is None else photons
    seed = scene.transport.seed if seed is None else seed
    _check_range("photons", photons, 1, 2**31 - 1)
    _check_range("seed", seed, 0, 2**64 - 1)
    mesh = build_mesh(scene)
    model = build_model(scene, pick_device(device), mesh, camera=False)
    spec = transport_spec(scene, mesh, estimator="none", records=True)
    run = _Run(model, spec, seed=seed, progress=progress)
    size = CUDA_PASS if model.device.is_cuda else CPU_PASS
    parts: list[dict[str, NDArray[Any]]] = []
    for first in range(0, photons, size):
        count = min(size, photons - first)
        run.data.records = sk.make_records(count, device=model.device)
        run.launch(first, count)
        names = ("position", "direction", "weight", "path", "collisions", "reason")
        parts.append({name: getattr(run.data.records, name).numpy() for name in names})
        run.report(first + count, photons)
    ledger, _ = run.accounts()
    return PhotonRecords(
        id=np.arange(photons, dtype=np.uint64),
        **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
        reasons=sk.LEDGER_ENTRIES,
        ledger=ledger,
        ledger_unit=run.ledger_unit,
    )


class _Run:
    """One model, its tallies, and the passes over photon ids."""

    def __init__(
        self,
        model: Model,
        spec: Any,
        *,
        seed: int,
        progress: Progress | None,
        batch_size: int = 0,
        tallies: Any = None,
    ) -> None:
        import spadwarp_kernels as sk

        shape = (len(COMPONENTS), model.camera.height, model.camera.width, model.gate.bins)
        own = None if tallies is None else caller_tallies(tallies, shape=shape, device=model.device)

        self.model, self.spec, self.seed, self.progress = model, spec, seed, progress
        self.ledger_unit = sk.LEDGER_UNIT
        self.data: Data = sk.make_data(model, tally=None if batch_size else own, histogram=spec.estimator != "none")
        self.batch_size = batch_size
        self.batches = sk.Batches(self.data.tally, len(COMPONENTS), total=own) if batch_size else None
        self.stopped_early = False
        self._accounts: list[tuple[dict[str, int], dict[str, int]]] = []
        if progress is not None:
            progress("compile", 0, 0)
        # Compiles, or loads from Warp's cache, before the clock of the passes starts.
        sk.load_transport_kernel(spec, model.device)

    def launch(self, first: int, count: int) -> None:
        """One pass; back when its photons are done."""
        import warp as wp

        import spadwarp_kernels as sk

        sk.launch_transport(self.spec, self.model, self.data, seed=self.seed, first_id=first, photon_count=count)
        wp.synchronize_device(self.model.device)

    def report(self, done: int, total: int) -> None:
        if self.progress is not None:
            self.progress("trace", done, total)

    def accounts(self) -> tuple[dict[str, int], dict[str, int]]:
        """Ledger and counters of what `tallies` holds."""
        import spadwarp_kernels as sk

        parts = self._accounts if self.batches is not None else [sk.read_ledger(self.data)]
        ledger, counters = ({name: sum(p[i][name] for p in parts) for name in parts[0][i]} for i in range(2))
        return ledger, counters

    def tallies(self) -> tuple[NDArray[np.int64], NDArray[np.uint64] | None]:
        """Tallies [component, height, width, bin] and the sums of squares, if there are batches."""
        camera, gate = self.model.camera, self.model.gate
        shape = (camera.height, camera.width, gate.bins)
        if self.batches is None:
            return self.data.tally.numpy().reshape(len(COMPONENTS), *shape), None
        squares = np.stack([half.numpy().reshape(shape) for half in self.batches.squares])
        return self.batches.total.numpy().reshape(len(COMPONENTS), *shape), squares

    def trace(
        self,
        start: int,
        stop: int,
        *,
        threads: int | None = None,
        pass_size: int | None = None,
        enough: Callable[[int], bool] | None = None,
    ) -> int:
        """Walks the photons start ... stop - 1; returns how many were done before an interrupt, always a prefix.

        With batches only whole ones count, and `enough(done)` is asked after each whether to stop.
        """
        import spadwarp_kernels as sk

        cuda = self.model.device.is_cuda
        size = (CUDA_PASS if cuda else CPU_PASS) if pass_size is None else pass_size
        # One CPU thread walks a whole pass, and counts its events in 32 bits.
        _check_range("pass_size", size, 1, CUDA_PASS if cuda else 1 << 20)
        workers = 1 if cuda else core_count() if threads is None else threads
        _check_range("threads", workers, 1, 4096)
        total = stop - start
        with _interruptible() as interrupted:
            if self.batches is None:
                return self._passes(start, stop, size, workers, interrupted, lambda done: self.report(done, total))
            for first in range(start, stop, self.batch_size):
                before = first - start
                part = self._passes(
                    first,
                    first + self.batch_size,
                    size,
                    workers,
                    interrupted,
                    lambda done, before=before: self.report(before + done, total),  # type: ignore[misc]
                )
                if part < self.batch_size:
                    return before
                self.batches.close(self.data.tally)
                self._accounts.append(sk.read_ledger(self.data))
                self.data.ledger.zero_()
                if enough is not None and enough(before + part):
                    self.stopped_early = True
                    return before + part
            return total

    def _passes(
        self,
        start: int,
        stop: int,
        size: int,
        workers: int,
        interrupted: threading.Event,
        report: Callable[[int], None],
    ) -> int:
        workers = min(workers, -(-(stop - start) // size))
        if workers > 1:
            return self._trace_in_threads(start, stop, size, workers, interrupted, report)
        done = start
        while done < stop and not interrupted.is_set():
            count = min(size, stop - done)
            self.launch(done, count)
            done += count
            report(done - start)
        return done - start

    def _trace_in_threads(
        self,
        start: int,
        stop: int,
        size: int,
        workers: int,
        interrupted: threading.Event,
        report: Callable[[int], None],
    ) -> int:
        """CPU passes on several threads; all add to one tally, with atomics of their own."""
        queue = iter(range(start, stop, size))
        lock = threading.Condition()
        finished = 0
        errors: list[BaseException] = []

        def work() -> None:
            nonlocal finished
            while not interrupted.is_set():
                with lock:
                    first = next(queue, None)
                if first is None:
                    return
                try:
                    self.launch(first, min(size, stop - first))
                except BaseException as error:
                    errors.append(error)
                    interrupted.set()
                    return
                with lock:
                    finished += min(size, stop - first)
                    lock.notify()

        pool = [threading.Thread(target=work, daemon=True) for _ in range(workers)]
        for thread in pool:
            thread.start()
        try:
            while any(thread.is_alive() for thread in pool):
                with lock:
                    lock.wait(timeout=0.1)
                    done = finished
                report(done)
        except BaseException:
            interrupted.set()
            raise
        if errors:
            raise errors[0]
        report(finished)
        # Every pass that was begun was finished, and they are begun in order: what was done is a prefix.
        return finished


@contextmanager
def _interruptible() -> Iterator[threading.Event]:
    """An event that the first Ctrl-C sets; a second one raises KeyboardInterrupt. Signals reach the main thread
    only."""
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread():
        yield interrupted
        return

    first = 0.0

    def handle(number: int, frame: object) -> None:
        nonlocal first
        # Some programs send one interrupt twice, to a process and to its group; a person needs a moment to insist.
        if interrupted.is_set() and time.monotonic() > first + 1.0:
            raise KeyboardInterrupt
        if not interrupted.is_set():
            first = time.monotonic()
        interrupted.set()

    before = signal.signal(signal.SIGINT, handle)
    try:
        yield interrupted
    finally:
        signal.signal(signal.SIGINT, before)


def provenance(device: Any) -> dict[str, Any]:
    """What made a result: versions, device, machine, date."""
    import warp as wp

    import spadwarp

    return {
        "spadwarp": spadwarp.__version__,
        "warp": wp.__version__,
        "numpy": np.__version__,
        "python": platform.python_version(),
        "device": device.alias,
        "device_name": device.name if device.is_cuda else platform.processor() or platform.machine(),
        "date": datetime.datetime.now(datetime.UTC).isoformat(timespec="seconds"),
    }


def _check_range(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ConfigError(f"{name} = {value} is outside [{low}, {high}]")
