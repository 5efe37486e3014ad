"""Passes of photons over the devices of this host: the cores of the CPU, one GPU, several."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.arrays import caller_tallies
from spadwarp.device import core_count, processor_name
from spadwarp.errors import ConfigError, DeviceError
from spadwarp.result.merge import Tallies
from spadwarp.result.photon_ids import Queue, Range, Ranges, count, joined
from spadwarp.result.result import COMPONENTS, Result, Truth
from spadwarp.scene import Scene

if TYPE_CHECKING:
    import warp as wp

    from spadwarp.mesh import TriangleMesh
    from spadwarp_kernels import Data, Model

# Photons in one launch: large enough to fill the device, small enough that progress is seen and Ctrl-C heard.
CPU_PASS = 1 << 16
CUDA_PASS = 1 << 26


@dataclass(frozen=True, eq=False)
class Plan:
    """What all who trace a run's photons must agree on; can be sent to other processes.

    Attributes:
        scene, mesh: What to simulate; the mesh from `spadwarp.mesh.targets.build_mesh`.
        seed: 64-bit.
        batch_size: Photons of a batch, for the error of every bin; 0: no batches.
        pass_size: Photons in one launch; None: what suits the device.
    """

    scene: Scene
    mesh: TriangleMesh | None
    seed: int
    batch_size: int = 0
    pass_size: int | None = None


class Lane:
    """A device with a model and tallies of its own.

    Attributes:
        threads: Passes at a time. On a CPU all of them add to one tally, with atomics of their own.
    """

    def __init__(
        self, model: Model, spec: Any, *, seed: int, threads: int = 1, batch_size: int = 0, tallies: Any = None
    ) -> None:
        import spadwarp_kernels as sk

        shape = (len(COMPONENTS), model.camera.height, model.camera.width, model.gate.bins)
        own = None if tallies is None else caller_tallies(tallies, shape=shape, device=model.device)
        self.model, self.spec, self.seed, self.threads = model, spec, seed, threads
        with device_errors(model.device):
            self.data: Data = sk.make_data(model, tally=None if batch_size else own, histogram=spec.estimator != "none")
            self.batches = sk.Batches(self.data.tally, len(COMPONENTS), total=own) if batch_size else None
            # Compiles, or loads from Warp's cache, before the clock of the passes starts.
            sk.load_transport_kernel(spec, model.device)
        self.accounts: list[tuple[dict[str, int], dict[str, int]]] = []
        self.batch: Range | None = None
        self.next_id = self.finished = 0

    def launch(self, first: int, stop: int) -> None:
        """One pass; back when its photons are done."""
        import warp as wp

        import spadwarp_kernels as sk

        with device_errors(self.model.device):
            sk.launch_transport(
                self.spec, self.model, self.data, seed=self.seed, first_id=first, photon_count=stop - first
            )
            wp.synchronize_device(self.model.device)

    def begin_batch(self, batch: Range) -> None:
        self.batch, self.next_id, self.finished = batch, batch[0], 0

    def close_batch(self) -> None:
        """Takes a batch whose photons are all done into the sums."""
        import spadwarp_kernels as sk

        assert self.batches is not None
        with device_errors(self.model.device):
            self.batches.close(self.data.tally)
            self.accounts.append(sk.read_ledger(self.data))
            self.data.ledger.zero_()

    def drop_batch(self) -> None:
        """Forgets a batch of which only some photons were done."""
        if self.batch is not None:
            self.data.tally.zero_()
            self.data.ledger.zero_()
            self.batch = None

    def sums(self) -> Tallies:
        """What this lane's photons have left, open batches aside; on the CPU in the lane's own memory."""
        import spadwarp_kernels as sk

        camera, gate = self.model.camera, self.model.gate
        shape = (camera.height, camera.width, gate.bins)
        with device_errors(self.model.device):
            if self.batches is None:
                tallies, second_moment, accounts = self.data.tally, None, [sk.read_ledger(self.data)]
            else:
                tallies, accounts = self.batches.total, self.accounts or [sk.read_ledger(self.data)]
                second_moment = np.stack([half.numpy().reshape(shape) for half in self.batches.second_moment])
            ledger, counters = (
                {name: sum(one[i][name] for one in accounts) for name in accounts[0][i]} for i in (0, 1)
            )
            return Tallies(tallies.numpy().reshape(len(COMPONENTS), *shape), ledger, counters, second_moment)

    def clear(self) -> None:
        """Begins the sums anew."""
        self.accounts.clear()
        arrays = [self.data.tally, self.data.ledger]
        if self.batches is not None:
            arrays += [self.batches.total, *self.batches.second_moment]
        for array in arrays:
            array.zero_()


class Tracer:
    """A run's photons on devices of this host.

    Args:
        plan: Of the run.
        devices: From `pick_devices`; photons are dealt out to them pass by pass, with batches batch by batch.
        threads: CPU threads in all; by default one a core. A GPU takes one.
        base: A result to whose sums are added.
        tallies: The caller's own, for one device.
    """

    def __init__(
        self,
        plan: Plan,
        devices: Sequence[wp.Device],
        *,
        threads: int | None = None,
        base: Result | None = None,
        tallies: Any = None,
    ) -> None:
        from spadwarp.transport.model import build_model, transport_spec

        self.plan, self.devices, self._base = plan, devices, base
        cuda = devices[0].is_cuda
        if any(device.is_cuda != cuda for device in devices):
            raise ConfigError("device: CPU and GPU round differently; their photons cannot make one run")
        if tallies is not None and len(devices) > 1:
            raise ConfigError(f"tallies go with one device, not with {len(devices)}")
        size = (CUDA_PASS if cuda else CPU_PASS) if plan.pass_size is None else plan.pass_size
        # One CPU thread walks a whole pass, and counts its events in 32 bits.
        check_range("pass_size", size, 1, CUDA_PASS if cuda else 1 << 20)
        threads = core_count() if threads is None else threads
        check_range("threads", threads, 1, 4096)
        self._pass_size = size
        copies = (2 + 2 / len(COMPONENTS) if plan.batch_size else 1) * max(map(devices.count, devices))
        began = time.perf_counter()
        models = []
        for device in devices:
            with device_errors(device):
                models.append(build_model(plan.scene, device, plan.mesh, copies=copies))
        built = time.perf_counter()
        spec = transport_spec(plan.scene, plan.mesh)
        share = max(1, threads // len(devices))
        self.lanes = [
            Lane(
                model,
                spec,
                seed=plan.seed,
                threads=1 if model.device.is_cuda else share,
                batch_size=plan.batch_size,
                tallies=tallies,
            )
            for model in models
        ]
        self.timing = {"setup": built - began, "compile": time.perf_counter() - built}

    def truth(self) -> Truth:
        from spadwarp.transport.model import trace_truth

        return trace_truth(self.plan.scene, self.lanes[0].model)

    def sums(self) -> Tallies:
        """What all photons traced so far have left, the lanes and the base added up.

        With one lane on the CPU and no base it is the lane's own memory.
        """
        total = self.lanes[0].sums()
        if self.devices[0].is_cpu and (len(self.lanes) > 1 or self._base is not None):
            total = Tallies.of(total)
        for lane in self.lanes[1:]:
            total.add(lane.sums())
        if self._base is not None:
            total.add(self._base)
        return total

    def clear(self) -> None:
        for lane in self.lanes:
            lane.clear()

    def about(self) -> dict[str, Any]:
        """The devices, for a result's provenance."""
        names = list(dict.fromkeys(map(processor_name, self.devices)))
        return {"device": ",".join(device.alias for device in self.devices), "device_name": ", ".join(names)}

    def trace(
        self,
        ranges: Ranges,
        *,
        stopped: threading.Event,
        report: Callable[[int], None] = lambda done: None,
        due: Callable[[], bool] = lambda: False,
        keep: Callable[[Ranges], None] = lambda done: None,
    ) -> Ranges:
        """Walks photons.

        Args:
            ranges: Their ids; with batches whole batches.
            stopped: Once set, ends after the passes that are under way; unfinished batches are forgotten.
            report: Called from this thread with the number of photons done, now and then.
            due: When it turns true, all lanes come to rest, and `keep` is called with the ids done: what `sums` then
                returns is theirs.
            keep: See `due`.

        Returns:
            The ids that were done: all, unless it was stopped.

        Raises:
            DeviceError: A device failed, or has no memory left.
        """
        waiting = Queue(ranges)
        done: list[Range] = []
        while waiting.left and not stopped.is_set():
            _Leg(self.lanes, waiting, done, stopped, self._pass_size, self.plan.batch_size).run(report, due)
            if waiting.left and due() and not stopped.is_set():
                keep(joined(done))
        return joined(done)


class _Leg:
    """Passes until there are none left or it is time to rest; then every lane is at rest, and `done` has the ids."""

    def __init__(
        self,
        lanes: Sequence[Lane],
        waiting: Queue,
        done: list[Range],
        stopped: threading.Event,
        pass_size: int,
        batch_size: int,
    ) -> None:
        self._lanes, self._waiting, self._done, self._stopped = lanes, waiting, done, stopped
        self._pass_size, self._batch_size = pass_size, batch_size
        self._workers = [lane for lane in lanes for _ in range(lane.threads)]
        self._lock = threading.Condition()  # of the ids, and of the lanes' batches
        self._resting, self._failed = threading.Event(), threading.Event()
        # From the workers: photons done, and at the end None or what went wrong.
        self._events: queue.SimpleQueue[BaseException | int | None] = queue.SimpleQueue()

    def run(self, report: Callable[[int], None], due: Callable[[], bool]) -> None:
        walked, left = count(self._done), len(self._workers)
        failure: BaseException | None = None
        for lane in self._workers:
            threading.Thread(target=self._work, args=(lane,), daemon=True).start()
        try:
            while left:
                # Woken now and then: a signal that arrives while a lock is awaited is heard only afterwards.
                try:
                    event = self._events.get(timeout=0.1)
                except queue.Empty:
                    event = 0
                if isinstance(event, int):
                    walked += event
                    report(walked)
                else:
                    left -= 1
                    failure = failure or event
                if due():
                    self._resting.set()
        except BaseException:
            self._failed.set()
            raise
        if failure is not None:
            raise failure
        for lane in self._lanes:
            lane.drop_batch()

    def _work(self, lane: Lane) -> None:
        """A thread: one pass after the other."""
        try:
            while True:
                with self._lock:
                    span = self._next_pass(lane) if self._batch_size == 0 else self._next_of_batch(lane)
                if span is None:
                    break
                lane.launch(*span)
                if self._batch_size:
                    self._finish(lane, span)
                else:
                    with self._lock:
                        self._done.append(span)
                self._events.put(span[1] - span[0])
            self._events.put(None)
        except BaseException as error:
            self._failed.set()
            self._events.put(error)
        finally:
            with self._lock:
                self._lock.notify_all()

    def _next_pass(self, lane: Lane) -> Range | None:
        if self._resting.is_set() or self._stopped.is_set() or self._failed.is_set():
            return None
        workers = len(self._workers)
        # Smaller towards the end, so that all end at about the same time.
        fair = self._waiting.left // (2 * workers) if workers > 1 else self._pass_size
        return self._waiting.take(min(self._pass_size, max(fair, self._pass_size // 16, 1)))

    def _next_of_batch(self, lane: Lane) -> Range | None:
        """A pass of the lane's batch, which is finished before the lane rests."""
        while not (self._stopped.is_set() or self._failed.is_set()):
            if lane.batch is None:
                batch = None if self._resting.is_set() else self._waiting.take(self._batch_size)
                if batch is None:
                    return None
                lane.begin_batch(batch)
            assert lane.batch is not None
            first = lane.next_id
            if first < lane.batch[1]:
                lane.next_id = min(first + self._pass_size, lane.batch[1])
                return first, lane.next_id
            self._lock.wait()  # for the lane's other threads, who walk the rest of its batch
        return None

    def _finish(self, lane: Lane, span: Range) -> None:
        """The last pass of a batch closes it."""
        assert lane.batch is not None
        with self._lock:
            lane.finished += span[1] - span[0]
            whole = lane.finished == lane.batch[1] - lane.batch[0]
        if whole:
            lane.close_batch()
        with self._lock:
            if whole:
                self._done.append(lane.batch)
                lane.batch = None
            self._lock.notify_all()


@contextmanager
def device_errors(device: wp.Device) -> Iterator[None]:
    """What Warp reports of a device, as an error that names it."""
    try:
        yield
    except RuntimeError as error:
        short = "allocate" in str(error) or "out of memory" in str(error)
        what = "has too little memory left" if short else "failed"
        raise DeviceError(f"{device.alias} {what}: {error}") from error


def check_range(name: str, value: int, low: int, high: int) -> None:
    if not low <= value <= high:
        raise ConfigError(f"{name} = {value} is outside [{low}, {high}]")
