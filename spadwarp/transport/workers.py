"""Workers that trace photons into tallies of their own: devices of this host, and workers of Ray."""

from __future__ import annotations

import functools
import os
import queue
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import NDArray

import spadwarp_kernels as sk
from spadwarp.arrays import caller_tallies
from spadwarp.device import core_count, pick_device, pick_devices, processor_name
from spadwarp.errors import ConfigError, DeviceError, SpadwarpError, address_space, kernel_errors
from spadwarp.limits import check_integer
from spadwarp.parallel import Ray, Worker
from spadwarp.parallel.ray import RayWorker, RayWorkers
from spadwarp.parallel.worker import Event
from spadwarp.result import COMPONENTS, SignedTallies, Tallies, Truth
from spadwarp.result.photon_ids import IdQueue, Range, Ranges, count, joined
from spadwarp.result.tallies import OVERFLOW, added, joined_moments, moments_of, total_of
from spadwarp.transport.model import MeshCache, build_model, trace_truth, transport_spec
from spadwarp.transport.plan import LARGEST_LAUNCH, LAUNCH_SIZE, Plan

__all__ = ["prepare_kernels"]

# Photons of the first block of a worker of Ray, which shows how fast it is.
_FIRST_BLOCK = {"cpu": 1 << 14, "cuda": 1 << 24}


# Photons on one device


@dataclass
class _DeviceTally:
    """A tally on the device, `[voxel * parts]`, and where there are any its batches."""

    array: wp.array
    parts: int
    signed: bool
    batches: sk.Batches | None

    @property
    def total(self) -> wp.array:
        return self.array if self.batches is None else self.batches.total

    def has_overflowed(self) -> bool:
        if self.batches is not None:
            return self.batches.has_overflowed()
        return sk.has_overflowed(self.array, signed=self.signed)

    def take_over(self, other: _DeviceTally) -> None:
        if self.batches is not None and other.batches is not None:
            self.batches.add(other.batches)
        else:
            sk.add_tallies(self.array, other.array)

    def clear(self) -> None:
        self.array.zero_()
        if self.batches is not None:
            for array in (self.batches.total, *self.batches.second_moment):
                array.zero_()

    def second_moment(self, shape: Sequence[int]) -> NDArray[np.uint64] | None:
        """`[2, *shape]`, low and high halves; None without batches."""
        if self.batches is None:
            return None
        return np.stack([half.numpy().reshape(shape) for half in self.batches.second_moment])


class DeviceWorker:
    """A device with a model and tallies of its own.

    Args:
        model: From `build_model`.
        spec: From `transport_spec`.
        seed: 64-bit.
        launch_size: Photons in one launch at most.
        threads: Launches at a time. On a CPU all of them add to one tally, with atomics of their own.
        batch_size: Photons of a batch, for the error of every bin; 0: no batches.
        tallies: The caller's own, to be filled.
        histogram: False: none is made, for records of photons without a camera.
        derivatives, channels: Names of those of the spec, which has one kind of them.
    """

    def __init__(
        self,
        model: sk.Model,
        spec: Any,
        *,
        seed: int,
        launch_size: int,
        threads: int = 1,
        batch_size: int = 0,
        tallies: Any = None,
        histogram: bool = True,
        derivatives: tuple[str, ...] = (),
        channels: tuple[str, ...] = (),
    ) -> None:
        camera, gate = model.camera, model.gate
        self._shape = (len(COMPONENTS), camera.height, camera.width, gate.bins)
        total = None if tallies is None else caller_tallies(tallies, shape=self._shape, device=model.device)
        self.model, self.threads, self.launch_size = model, threads, launch_size
        self._spec, self._seed, self._batch_size = spec, seed, batch_size
        self._derivatives, self._channels = derivatives, channels
        with device_errors(model.device):
            signed = len(derivatives) + len(channels)
            self.data = sk.make_data(
                model, tally=None if batch_size else total, histogram=histogram, derivatives=signed
            )
            batches = sk.Batches(self.data.tally, len(COMPONENTS), total=total) if batch_size else None
            self._tallies = [_DeviceTally(self.data.tally, 1, False, batches)]
            if self.data.gradients is not None:
                batches = sk.Batches(self.data.gradients, len(COMPONENTS), signed=True) if batch_size else None
                self._tallies.append(_DeviceTally(self.data.gradients, signed, True, batches))
            # Compiles, or loads from Warp's cache, before the time of the launches is taken.
            most = min(launch_size, batch_size or launch_size)
            sk.load_transport_kernel(spec, model.device, model=model, photon_count=most)
        self._counts: tuple[dict[str, int], ...] | None = None  # energy balance and counters of the batches
        self._moments: dict[str, int] = {}

    def launch(self, first: int, stop: int) -> None:
        """Traces the photons of one launch to their end."""
        self._wait(self._begin(first, stop))

    def _begin(self, first: int, stop: int) -> wp.Event | None:
        """Gives a launch to the device, for whose end `_wait` waits; on a CPU it has ended then."""
        device = self.model.device
        with device_errors(device):
            sk.launch_transport(
                self._spec, self.model, self.data, seed=self._seed, first_id=first, photon_count=stop - first
            )
            return device.stream.record_event() if device.is_cuda else None

    def _wait(self, end: wp.Event | None) -> None:
        if end is not None:
            with device_errors(self.model.device):
                wp.synchronize_event(end)

    def _launched(self, spans: Iterable[Range]) -> Iterator[Range]:
        """Traces a launch for each span and yields it when that has ended; a GPU has the next before."""
        ahead = 1 if self.model.device.is_cuda else 0
        running: list[tuple[Range, wp.Event | None]] = []
        for span in spans:
            running.append((span, self._begin(*span)))
            if len(running) > ahead:
                ended, end = running.pop(0)
                self._wait(end)
                yield ended
        for ended, end in running:
            self._wait(end)
            yield ended

    def trace(
        self, block: Range, *, stopped: threading.Event, report: Callable[[int], None] = lambda photons: None
    ) -> Ranges:
        """Traces photons; returns the ids that were done before `stopped` was set, with batches those of whole ones.

        Args:
            block: The ids; with batches whole batches.
            stopped: Once set, no further launch begins.
            report: Called with the photons of each launch, from the thread that ran it.
        """
        if not self._batch_size:
            traced = self._trace(block, stopped, report)
            self._check_overflow()
            return traced
        done: list[Range] = []
        for first in range(*block, self._batch_size):
            batch = first, first + self._batch_size
            if self._trace(batch, stopped, report) != (batch,):
                for array in (self.data.ledger, *(tally.array for tally in self._tallies)):
                    array.zero_()
                break
            self._close_batch()
            done.append(batch)
        self._check_overflow()
        return joined(done)

    def _check_overflow(self) -> None:
        """After every block of photons, long before an integer could wrap around and look right again."""
        with device_errors(self.model.device):
            overflowed = any(tally.has_overflowed() for tally in self._tallies)
        if overflowed:
            raise SpadwarpError(OVERFLOW)

    def _trace(self, ids: Range, stopped: threading.Event, report: Callable[[int], None]) -> Ranges:
        waiting, done, lock = IdQueue([ids]), list[Range](), threading.Lock()
        failures: list[BaseException] = []

        def spans() -> Iterator[Range]:
            while not (stopped.is_set() or failures):
                with lock:
                    span = waiting.take(self._size(waiting.left))
                if span is None:
                    return
                yield span

        def work() -> None:
            try:
                for span in self._launched(spans()):
                    with lock:
                        done.append(span)
                    report(span[1] - span[0])
            except BaseException as error:
                failures.append(error)

        helpers = [threading.Thread(target=work, daemon=True) for _ in range(self.threads - 1)]
        for thread in helpers:
            thread.start()
        work()
        for thread in helpers:
            thread.join()
        if failures:
            raise failures[0]
        return joined(done)

    def _size(self, left: int) -> int:
        """Photons of the next launch, fewer towards the end so that all threads end at about the same time."""
        share = left // (2 * self.threads) if self.threads > 1 else left
        return min(self.launch_size, max(share, self.launch_size // 16, 1))

    def _close_batch(self) -> None:
        """Adds a batch whose photons are all done to the totals."""
        with device_errors(self.model.device):
            for tally in self._tallies:
                assert tally.batches is not None
                tally.batches.close(tally.array, threads=self.threads)
            assert self._tallies[0].batches is not None
            moments = moments_of(COMPONENTS, self._tallies[0].batches.take_sums())
            counts = sk.read_ledger(self.data)
            self.data.ledger.zero_()
        self._add_counts(counts, moments)

    def _add_counts(self, counts: tuple[dict[str, int], ...], moments: dict[str, int]) -> None:
        """Of closed batches."""
        self._counts = counts if self._counts is None else tuple(map(added, self._counts, counts))
        self._moments = joined_moments(self._moments, moments) if self._moments else moments

    def take_over(self, other: DeviceWorker) -> None:
        """Moves the tallies of another worker of the same run here; both must rest."""
        with device_errors(self.model.device):
            for mine, more in zip(self._tallies, other._tallies, strict=True):
                mine.take_over(more)
            sk.add_tallies(self.data.ledger, other.data.ledger)
        if other._counts is not None:
            self._add_counts(other._counts, other._moments)
        self._check_overflow()
        other.clear()

    def tallies(self) -> Tallies:
        """Those of all photons traced here, open batches aside; on the CPU in the memory of this worker."""
        with device_errors(self.model.device):
            tally = self._tallies[0]
            energy_balance, counters = self._counts or sk.read_ledger(self.data)
            scales = [float(self.model.derivatives.scale[p]) for p in range(len(self._channels))]
            return Tallies(
                tallies=_on_host(tally.total, self.model.device).reshape(self._shape),
                energy_balance=energy_balance,
                counters=counters,
                second_moment=tally.second_moment(self._shape[1:]),
                batch_moments=dict(self._moments),
                derivative_tallies=self._signed_tallies(self._derivatives, self.derivative_units),
                channel_tallies=self._signed_tallies(self._channels, tuple(1.0 / scale for scale in scales)),
            )

    def _signed_tallies(self, names: tuple[str, ...], units: tuple[float, ...]) -> SignedTallies | None:
        """The device has the derivatives or channels of a voxel side by side, the result an array for each."""
        if not names:
            return None
        tally, shape = self._tallies[1], (*self._shape, len(names))
        values, moments = tally.total.numpy().reshape(shape), tally.second_moment(shape[1:])
        moments = None if moments is None else np.ascontiguousarray(np.moveaxis(moments, -1, 1))
        return SignedTallies(names, np.moveaxis(values, -1, 0), units, moments)

    @property
    def derivative_units(self) -> tuple[float, ...]:
        """Of each derivative's tallies [fraction of an emitted photon per unit of the parameter], powers of two."""
        found, spec = self.model.derivatives, self._spec
        scales = [found.scale[p] for p in range(len(spec.derivatives))]
        for kind in range(len(spec.blocks)):
            scales += [found.blocks.scale[kind]] * found.blocks.count
        return tuple(1.0 / float(scale) for scale in scales)

    def clear(self) -> None:
        """Empties the tallies."""
        self._counts, self._moments = None, {}
        self.data.ledger.zero_()
        for tally in self._tallies:
            tally.clear()


def _on_host(array: wp.array, device: wp.Device) -> NDArray[np.int64]:
    """A copy of an array of a GPU in memory of NumPy, which asks Linux for pages of 2 MiB; on a CPU the array's own.

    97 MiB of an H200 are there in 31 ms, those of `array.numpy()` in 72 ms, most of it for new pages: in memory that
    was used before they are in 7 ms.
    """
    if not device.is_cuda:
        return np.asarray(array.numpy())
    held = np.empty(array.shape, np.int64)
    wp.copy(wp.array(held, dtype=wp.int64, device="cpu", copy=False), array)
    wp.synchronize_device(device)
    return held


@contextmanager
def device_errors(device: wp.Device) -> Iterator[None]:
    """Turns an error of Warp into a `DeviceError` that names the device, and what kernels refuse into an
    `ArgumentError`."""
    try:
        with kernel_errors():
            yield
    except RuntimeError as error:
        short = "allocate" in str(error) or "out of memory" in str(error)
        problem = "has too little memory left" if short else "failed"
        raise DeviceError(f"{device.alias} {problem}: {error}") from error


# Kernels, compiled or loaded from Warp's cache in a thread of their own beside the rest of a run. On CPUs alone: with
# CUDA, Warp ends the process now and then where one thread builds a mesh while another loads a module
# (https://github.com/NVIDIA/warp/issues/1491).


@functools.cache
def _thread() -> ThreadPoolExecutor:
    # One for all runs: in each thread that compiles Warp first prepares its headers, 1.5 s on a CPU.
    return ThreadPoolExecutor(1, "spadwarp-kernels")


def _beside(devices: Sequence[wp.Device]) -> bool:
    # Where memory is limited, two threads that compile may be too many.
    return address_space() is None and not any(device.is_cuda for device in devices)


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_thread.cache_clear)  # a child has none of its parent's threads


def prepare_kernels(device: str | None = None) -> None:
    """Begins to load a kernel that all runs need, and with it the compiler; returns at once.

    A run that follows has its kernels sooner where they must be compiled. `device`: as for `simulate`. Raises
    `DeviceError` for one that does not exist.
    """
    devices = pick_devices(device)
    if _beside(devices):
        # What fails here fails again in the run.
        _thread().submit(lambda: [sk.has_overflowed(wp.zeros(1, dtype=wp.int64, device=item)) for item in devices])


# Devices of this host


class LocalWorkers:
    """Workers of this process, one a device, each with a thread of Python for the length of a block.

    Args:
        plan: Of the run.
        devices: From `spadwarp.device.pick_devices`.
        threads: CPU threads in all; by default one a core. A GPU takes one.
        tallies: The caller's own, for one device.
        mesh_cache: Meshes of earlier runs, as `build_model` takes them.

    Raises:
        ConfigError: CPU and GPU together, caller's tallies with several devices, or a number out of range.
        DeviceError: A device failed, or has too little memory.
    """

    must_rest = True

    def __init__(
        self,
        plan: Plan,
        devices: Sequence[wp.Device],
        *,
        threads: int | None = None,
        tallies: Any = None,
        mesh_cache: MeshCache | None = None,
    ) -> None:
        kind = "cuda" if devices[0].is_cuda else "cpu"
        if any(device.is_cuda != devices[0].is_cuda for device in devices):
            raise ConfigError("device: CPU and GPU round differently; their photons cannot be added up")
        if tallies is not None and len(devices) > 1:
            raise ConfigError(f"tallies go with one device, not with {len(devices)}")
        size = LAUNCH_SIZE[kind] if plan.launch_size is None else plan.launch_size
        size = check_integer("launch_size", size, f"[1, {LARGEST_LAUNCH[kind]}]")
        if kind == "cuda":  # a run of few photons needs no kernel of larger launches
            size = min(size, max(1, count([plan.ids])))
        threads = 1 if kind == "cuda" else max(1, (threads or core_count()) // len(devices))
        self._devices = devices
        copies = (2 + 2 / len(COMPONENTS) if plan.batch_size else 1) * max(map(devices.count, devices))
        began = time.perf_counter()
        spec = transport_spec(plan.scene, plan.mesh, derivatives=plan.derivatives)
        # On GPUs `DeviceWorker` loads the kernel, which may be another one for a large histogram.
        loading = [_thread().submit(sk.load_transport_kernel, spec, item) for item in devices if _beside(devices)]
        models = []
        for device in devices:
            with device_errors(device):
                model = build_model(
                    plan.scene,
                    device,
                    plan.mesh,
                    copies=copies,
                    scale=plan.scale,
                    mesh_cache=mesh_cache,
                    derivatives=plan.derivatives,
                )
                models.append(model)
        built = time.perf_counter()
        with device_errors(devices[0]):
            self._truth = trace_truth(plan.scene, models[0])
            traced = time.perf_counter()
            for kernel in loading:
                kernel.result()
        settings: dict[str, Any] = {
            "seed": plan.seed,
            "launch_size": size,
            "threads": threads,
            "batch_size": plan.batch_size,
            "derivatives": plan.derivatives,
            "channels": plan.scene.camera.tallied_channels,
        }
        self.workers = [DeviceWorker(model, spec, tallies=tallies, **settings) for model in models]
        self.timing = {"setup": built - began, "compile": time.perf_counter() - traced, "truth": traced - built}
        self.first_block = threads * size
        self._busy: set[DeviceWorker] = set()
        self._stopped = threading.Event()
        self._events: queue.SimpleQueue[Event | tuple[DeviceWorker, BaseException]] = queue.SimpleQueue()
        self._failure: BaseException | None = None

    @property
    def idle(self) -> list[DeviceWorker]:
        return [] if self._failure else [worker for worker in self.workers if worker not in self._busy]

    def trace(self, worker: DeviceWorker, block: Range) -> None:
        def work() -> None:
            began = time.perf_counter()
            try:
                done = worker.trace(
                    block,
                    stopped=self._stopped,
                    report=lambda photons: self._events.put(Event("progress", worker, photons)),
                )
                self._events.put(Event("traced", worker, (done, time.perf_counter() - began)))
            except BaseException as error:
                self._stopped.set()
                self._events.put((worker, error))

        self._busy.add(worker)
        threading.Thread(target=work, daemon=True).start()

    def collect(self, worker: DeviceWorker) -> None:
        """Tallies stay where they are: `tallies` adds them up when all workers rest."""
        self._busy.add(worker)
        self._events.put(Event("collected", worker))

    def stop(self) -> None:
        self._stopped.set()

    def wait(self) -> list[Event]:
        events: list[Event] = []
        try:
            # With a timeout: Python handles a signal only when the wait for a lock ends.
            event = self._events.get(timeout=0.1)
            while True:
                if not isinstance(event, Event):
                    self._failure = self._failure or event[1]
                    self._busy.discard(event[0])
                else:
                    events.append(event)
                    if event.kind != "progress":
                        self._busy.discard(event.worker)
                event = self._events.get_nowait()
        except queue.Empty:
            pass
        if self._failure is not None and not self._busy:
            raise self._failure
        return events

    def truth(self) -> Truth:
        return self._truth

    def tallies(self) -> Tallies:
        """Those of all devices, added up on the first; on CPUs in its own memory."""
        first, *others = self.workers
        for other in others:
            first.take_over(other)
        return first.tallies()

    def metadata(self) -> dict[str, Any]:
        names = list(dict.fromkeys(map(processor_name, self._devices)))
        return {"device": ",".join(device.alias for device in self._devices), "device_name": ", ".join(names)}


# Ray


class ClusterWorkers:
    """Workers of Ray for the length of a `with` block, on this machine or many.

    A worker adds its blocks up where it is, since a histogram can take longer to send than a block to trace, and hands
    its tallies over for a checkpoint or at the end, while the others continue.

    Args:
        plan: Of the run.
        engine: Which cluster, how many workers.
        device: "cpu" or "cuda"; None: GPUs if the cluster has any.
        note: Called with remarks: which workers have joined, which were lost.
    """

    must_rest = False

    def __init__(
        self, plan: Plan, engine: Ray, device: str | None = None, *, note: Callable[[str], None] | None = None
    ) -> None:
        camera, gate = plan.scene.camera, plan.scene.gate
        histograms = len(COMPONENTS) + (2 if plan.batch_size else 0)
        signed = len(plan.derivatives) + len(camera.tallied_channels)
        size = 8 * histograms * (1 + signed) * camera.width * camera.height * gate.bins
        prepare = functools.partial(_prepare, plan)
        self._ray = RayWorkers(engine, device, prepare=prepare, value_bytes=size, note=note)
        self._total: Tallies | None = None
        self._metadata: dict[str, dict[str, Any]] = {}
        self.timing = {"setup": 0.0, "compile": 0.0}

    def __enter__(self) -> ClusterWorkers:
        began = time.perf_counter()
        self._ray.__enter__()
        self.first_block = _FIRST_BLOCK["cuda" if self._ray.cuda else "cpu"]
        self.timing["setup"] = time.perf_counter() - began
        return self

    def __exit__(self, *error: object) -> None:
        self._ray.__exit__(*error)

    @property
    def workers(self) -> list[RayWorker]:
        return self._ray.workers

    @property
    def idle(self) -> list[RayWorker]:
        return self._ray.idle

    def trace(self, worker: RayWorker, block: Range) -> None:
        self._ray.send(worker, _trace, block)

    def collect(self, worker: RayWorker) -> None:
        self._ray.send(worker, _collect)

    def stop(self) -> None:
        self._ray.stop()

    def wait(self) -> list[Event]:
        events = []
        for event in self._ray.wait(0.2):
            if event.kind == "joined":
                assert event.worker.metadata is not None
                self._metadata["{host} {pid}".format_map(event.worker.metadata)] = event.worker.metadata
            elif event.kind == "lost":
                events.append(Event("lost", event.worker))
            elif isinstance(event.value, Tallies):
                self._total = total_of(*([] if self._total is None else [self._total]), event.value)
                events.append(Event("collected", event.worker))
            else:
                events.append(Event("traced", event.worker, event.value))
        return events

    def truth(self) -> Truth:
        """By the first worker that has joined, which also waits for it."""
        began = time.perf_counter()
        while not self.idle:
            self.wait()
        self.timing["compile"] = time.perf_counter() - began
        self._ray.send(self.idle[0], _truth)
        while True:
            for event in self.wait():
                if event.kind == "traced":
                    return event.value
                if event.kind == "lost":
                    return self.truth()

    def tallies(self) -> Tallies:
        assert self._total is not None
        return self._total

    def metadata(self) -> dict[str, Any]:
        names = sorted({worker["device_name"] for worker in self._metadata.values()})
        count = len(self.workers)
        return {
            "device": f"{count} Ray worker{'s' * (count != 1)}",
            "device_name": ", ".join(names),
            "workers": list(self._metadata.values()),
        }


def _prepare(plan: Plan, worker: Worker) -> None:
    """Run first by a worker of Ray, which then has the device of `LocalWorkers`."""
    worker.state["local"] = LocalWorkers(plan, [pick_device(worker.device)], threads=worker.threads)


def _truth(worker: Worker) -> Truth:
    return worker.state["local"].truth()


def _trace(block: Range, worker: Worker) -> tuple[Ranges, float]:
    """Traces a block; returns the ids done, fewer if it was stopped, and the seconds it took."""
    began = time.perf_counter()
    done = worker.state["local"].workers[0].trace(block, stopped=worker.stopped)
    return done, time.perf_counter() - began


def _collect(worker: Worker) -> Tallies:
    device_worker = worker.state["local"].workers[0]
    tallies = total_of(device_worker.tallies()) if worker.device == "cpu" else device_worker.tallies()
    device_worker.clear()
    return tallies
