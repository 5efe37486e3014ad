"""Workers that trace photons into tallies of their own: devices of this host, workers of Ray, a tracer of light."""

from __future__ import annotations

import functools
import itertools
import math
import queue
import threading
import time
import weakref
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ThreadPoolExecutor, wait
from contextlib import contextmanager
from dataclasses import replace
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import NDArray

import spadwarp_kernels as sk
from spadwarp.arrays import caller_tallies
from spadwarp.device import core_count, kernel_thread, pick_device, pick_devices, processor_name
from spadwarp.mesh import TriangleMesh
from spadwarp.parallel.workers import Event, Ray, RayWorkers, Worker
from spadwarp.result import FluxTallies, SignedTallies, Tallies, Truth
from spadwarp.result.photon_ids import IdQueue, Range, Ranges, count, joined, photons_per_position
from spadwarp.result.tallies import OVERFLOW, joined_moments, moments_of, total_of
from spadwarp.scene import Scene
from spadwarp.transport.model import MeshCache, build_model, trace_truth, transport_spec
from spadwarp.transport.plan import LARGEST_LAUNCH, LAUNCH_SIZE, Plan, RunOptions, make_plan
from spadwarp.values import ConfigError, DeviceError, SpadwarpError, address_space, check_integer

__all__ = ["ExpectedLight", "LightTracer", "prepare_kernels"]

# Photons of the first block of a worker of Ray, which shows how fast it is.
_FIRST_BLOCK = {"cpu": 1 << 14, "cuda": 1 << 24}


# Photons on one device


class _Histogram:
    """A tally on the device, `[voxel * parts]`, and its batches, if any; `total` may be the caller's."""

    def __init__(
        self, array: wp.array, components: int, *, batched: bool, signed: bool = False, total: wp.array | None = None
    ) -> None:
        self.array, self._signed = array, signed
        halved = not signed and components > 1
        self.batches = sk.Batches(array, components, total=total, signed=signed, halved=halved) if batched else None
        self.total: wp.array = array if self.batches is None else self.batches.total
        self.half: wp.array | None = None if self.batches is None else self.batches.half

    def has_overflowed(self) -> bool:
        if self.batches is not None:
            return self.batches.has_overflowed()
        return sk.has_overflowed(self.array, signed=self._signed)

    def take_over(self, other: _Histogram) -> None:
        if self.batches is not None and other.batches is not None:
            self.batches.add(other.batches)
        else:
            sk.add_tallies(self.array, other.array)

    def clear(self) -> None:
        arrays = [self.array]
        if self.batches is not None:
            arrays += [self.total, *self.batches.second_moment, *([] if self.half is None else [self.half])]
        for array in arrays:
            array.zero_()

    def second_moment(self, shape: Sequence[int]) -> NDArray[np.uint64] | None:
        """`[2, *shape]`, low and high halves; None without batches."""
        if self.batches is None:
            return None
        words = _host_memory((2, *shape), np.uint64)
        for word, held in zip(self.batches.second_moment, words, strict=True):
            wp.copy(wp.array(held.reshape(-1), dtype=wp.uint64, device="cpu", copy=False), word)
        wp.synchronize_device(self.array.device)
        return words


class DeviceWorker:
    """A device with a model and tallies of its own, or the caller's.

    Its threads launch at a time; on a CPU all of them add to one tally, with atomics of their own. A batch has
    `batch_size` photons, the first and last of a run fewer; 0: no batches. `signed` names the spec's derivatives, or
    else its channels.
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
        signed: tuple[str, ...] = (),
        tallies: Any = None,
    ) -> None:
        self._names = model.components
        self._shape = (len(self._names), model.camera.height, model.camera.width, model.gate.bins)
        total = None if tallies is None else caller_tallies(tallies, shape=self._shape, device=model.device)
        self.model, self._spec, self._seed, self._signed = model, spec, seed, signed
        self._threads, self._launch_size, self._batch_size = threads, launch_size, batch_size
        components, batched = len(self._names), batch_size > 0
        with device_errors(model.device):
            own = None if batched else total
            self.data = sk.make_data(model, tally=own, histogram=not spec.records, derivatives=len(signed))
            self._histograms = [_Histogram(self.data.tally, components, batched=batched, total=total)]
            if self.data.gradients is not None:
                self._histograms.append(_Histogram(self.data.gradients, components, batched=batched, signed=True))
            if self.data.flux is not None:
                self._histograms.append(_Histogram(self.data.flux, 1, batched=batched))
            # Compiles, or loads from Warp's cache, before the time of the launches is taken.
            sk.load_transport_kernel(spec, model.device)
        self._closed = list[Tallies]()  # what closed batches left beside their arrays
        self._unread = list[tuple[int, bool]]()  # batches closed on the device: photons, and whether in the half
        self._running = deque[tuple[int, wp.Event]]()  # launches on a GPU: photons, and their end

    def _wait(self, report: Callable[[int], None], ahead: int = 0) -> None:
        """Reports launches on a GPU as they end, until so many are under way."""
        while len(self._running) > ahead:
            photons, end = self._running.popleft()
            wp.synchronize_event(end)
            report(photons)

    def trace(
        self, block: Range, *, stopped: threading.Event, report: Callable[[int], None] = lambda photons: None
    ) -> Ranges:
        """Traces photons; returns the ids that were done before `stopped` was set.

        `report` gets the photons of each launch, from the thread that ran it.
        """
        done, size, device = list[Range](), self._batch_size or block[1], self.model.device
        edges = [block[0], *range((block[0] // size + 1) * size, block[1], size), block[1]]
        most = min(self._launch_size, size, block[1] - block[0])

        def run(span: Range) -> Ranges:
            first, stop = span
            if stopped.is_set():
                return ()
            launch(first, stop - first)
            if device.is_cuda:  # where it may still be under way
                self._running.append((stop - first, device.stream.record_event()))
                self._wait(report, ahead=1)
            else:
                report(stop - first)
            return (span,)

        # What fails cancels what has not begun.
        with device_errors(device), ThreadPoolExecutor(self._threads) as pool:
            launch = sk.prepare_transport(self._spec, self.model, self.data, seed=self._seed, photon_count=most)
            run_all = pool.map if self._threads > 1 else map
            for part in itertools.pairwise(edges):
                traced = joined(itertools.chain(*run_all(run, self._spans(part))))
                if self._batch_size and traced:
                    self._close_batch(traced)
                done += traced
                if stopped.is_set():
                    break
            self._wait(report)
            self._read_closed()
            self._check_overflow()
        return joined(done)

    def _spans(self, ids: Range) -> Iterator[Range]:
        """Of launches: shorter ones towards the end so that all threads end at about the same time."""
        waiting, parts = IdQueue([ids]), 2 * self._threads if self._threads > 1 else 1
        while span := waiting.take(min(self._launch_size, max(waiting.left // parts, self._launch_size // 16, 1))):
            yield span

    def _check_overflow(self) -> None:
        """After every block of photons, long before an integer could wrap around and look right again."""
        if any(histogram.has_overflowed() for histogram in self._histograms):
            raise SpadwarpError(OVERFLOW)

    def _close_batch(self, ids: Ranges) -> None:
        """Adds a batch of these photons to the totals."""
        photons, size = count(ids), self._batch_size
        in_half = ids[0][0] // size % 2 == 0
        for histogram in self._histograms:
            assert histogram.batches is not None
            histogram.batches.close(histogram.array, in_half=in_half, part=photons / size, threads=self._threads)
        self._unread.append((photons, in_half))
        if len(self._unread) == sk.Batches.MOST_SUMS:
            self._read_closed()

    def _read_closed(self) -> None:
        """Adds up what batches left beside their arrays: few at a time, since a GPU is waited for."""
        if not self._unread:
            return
        assert self._histograms[0].batches is not None
        unread, sums = self._unread, self._histograms[0].batches.take_sums()
        each = [moments_of(self._names, s, n, self._batch_size) for s, (n, _) in zip(sums, unread, strict=True)]
        half = sum(photons for photons, in_half in unread if in_half)
        read = self._counted(batches=len(unread), half_photons=half, batch_moments=joined_moments(*each))
        self._closed.append(read)
        self.data.ledger.zero_()
        self._unread = []

    def _counted(self, **of_batches: Any) -> Tallies:
        """What stands in the ledger; without arrays."""
        balance, counters = sk.read_ledger(self.data)
        return Tallies(tallies=np.zeros(0, np.int64), energy_balance=balance, counters=counters, **of_batches)

    def take_over(self, other: DeviceWorker) -> None:
        """Moves the tallies of another worker of the same run here; both must rest."""
        with device_errors(self.model.device):
            for mine, more in zip(self._histograms, other._histograms, strict=True):
                mine.take_over(more)
            sk.add_tallies(self.data.ledger, other.data.ledger)
            self._closed += other._closed
            self._check_overflow()
            other.clear()

    def tallies(self) -> Tallies:
        """Those of all photons traced here, open batches aside; on the CPU in the memory of this worker."""
        with device_errors(self.model.device):
            counted = total_of(*(self._closed or [self._counted()]))
            balance, histogram, last = dict(counted.energy_balance), self._histograms[0], self._histograms[-1]
            flux = None if self.data.flux is None else last.total
            if self._spec.lines and not (self._spec.layered or self.model.lines.elastic[0]):
                balance = self._with_shifted(balance)
            return replace(
                counted,
                tallies=_on_host(histogram.total).reshape(self._shape),
                energy_balance=balance,
                half=None if histogram.half is None else _on_host(histogram.half).reshape(self._shape),
                second_moment=histogram.second_moment(self._shape[1:]),
                signed_tallies=self._signed_tallies(),
                flux_tallies=None if flux is None else FluxTallies(_on_host(flux), last.second_moment(flux.shape)),
            )

    def _signed_tallies(self) -> SignedTallies | None:
        """The device has the derivatives or channels of a voxel side by side, the result an array for each."""
        if not self._signed:
            return None
        histogram, shape = self._histograms[1], (*self._shape, len(self._signed))
        values, moments = histogram.total.numpy().reshape(shape), histogram.second_moment(shape[1:])
        moments = None if moments is None else np.ascontiguousarray(np.moveaxis(moments, -1, 1))
        group: Any = "channels" if self._spec.channels else "derivatives"
        return SignedTallies(group, self._signed, np.moveaxis(values, -1, 0), self.signed_units, moments)

    def _with_shifted(self, energy_balance: dict[str, int]) -> dict[str, int]:
        """Of what the water has absorbed, the part that is scattered inelastically in entries of its own: at every
        collision in one water it is the same."""
        medium, balance, source = self.model.medium, energy_balance, self.model.lines.source.numpy()[0]
        absorption, lost = medium.extinction * (1.0 - medium.albedo), balance["absorbed_water"]
        for k, name in enumerate(self._signed):
            balance[name] = round(lost * min(float(source[k]) / absorption, 1.0))
            balance["absorbed_water"] -= balance[name]
        return balance

    @property
    def signed_units(self) -> tuple[float, ...]:
        """Of the tallies of each derivative or channel [fraction of an emitted photon, per unit of the parameter],
        powers of two."""
        found, spec = self.model.derivatives, self._spec
        scales = [found.scale[p] for p in range(len(spec.derivatives) + spec.channels)]
        for kind in range(len(spec.blocks)):
            scales += [found.blocks.scale[kind]] * found.blocks.count
        return tuple(1.0 / float(scale) for scale in scales)

    def clear(self) -> None:
        """Empties the tallies."""
        self._closed = []
        self.data.ledger.zero_()
        for histogram in self._histograms:
            histogram.clear()


def _on_host(array: wp.array) -> NDArray[Any]:
    """A copy of an array of a GPU in memory of NumPy, which asks Linux for pages of 2 MiB; on a CPU the array's own.

    97 MiB of an H200 are there in 31 ms, those of `array.numpy()` in 72 ms, most of it for new pages: in memory that
    was used before they are in 7 ms.
    """
    device: Any = array.device
    if not device.is_cuda:
        return np.asarray(array.numpy())
    held = _host_memory(array.shape, wp.dtype_to_numpy(array.dtype))
    wp.copy(wp.array(held, dtype=array.dtype, device="cpu", copy=False), array)
    wp.synchronize_device(device)
    return held


# Memory of arrays that are gone, oldest first, and its bytes at most: a GPU fills it much faster than new pages.
_free = dict[int, NDArray[np.uint8]]()
_MOST_FREE = 1 << 29


class _Lent:
    """The base of an array of NumPy in memory that is free again when the last view of it is gone."""

    def __init__(self, memory: NDArray[np.uint8]) -> None:
        self.__array_interface__ = memory.__array_interface__
        weakref.finalize(self, _give_back, memory).atexit = False


def _give_back(memory: NDArray[np.uint8]) -> None:
    _free[id(memory)] = memory
    while sum(each.nbytes for each in list(_free.values())) > _MOST_FREE:
        _free.pop(next(iter(_free)), None)


def _host_memory(shape: Sequence[int], dtype: Any) -> NDArray[Any]:
    """As `np.empty`, in memory that was used before if some is free; any thread may give it back meanwhile."""
    size = math.prod(shape) * np.dtype(dtype).itemsize
    fitting = (_free.pop(key, None) for key, each in list(_free.items()) if each.nbytes == size)
    memory = next((each for each in fitting if each is not None), None)
    held = _Lent(np.empty(size, np.uint8) if memory is None else memory)
    return np.asarray(held).view(dtype).reshape(shape)


@contextmanager
def device_errors(device: wp.Device) -> Iterator[None]:
    """Turns an error of Warp into a `DeviceError` that names the device."""
    try:
        yield
    except RuntimeError as error:
        short = "allocate" in str(error) or "out of memory" in str(error)
        problem = "has too little memory left" if short else "failed"
        raise DeviceError(f"{device.alias} {problem}: {error}") from error


# Kernels, compiled or loaded from Warp's cache in a thread of their own beside the rest of a run. On CPUs alone: with
# CUDA, Warp ends the process now and then where one thread builds a mesh while another loads a module
# (https://github.com/NVIDIA/warp/issues/1491).


def _load_beside(spec: Any, devices: Sequence[wp.Device]) -> list[Any]:
    # Where memory is limited, two threads that compile may be too many.
    possible = address_space() is None and not any(device.is_cuda for device in devices)
    return [kernel_thread().submit(sk.load_transport_kernel, spec, item) for item in devices if possible]


def prepare_kernels(
    scene: Scene, mesh: TriangleMesh | None, device: str | None = None, *, derivatives: Sequence[str] = ()
) -> None:
    """Begins to load the transport kernel of a run on CPUs, which takes longest where it must be compiled; returns at
    once. What fails here fails again in the run.

    `mesh`: that of `spadwarp.mesh.build_mesh`; `device`, `derivatives` (full names): as for `simulate`. Raises
    `DeviceError` for a device that does not exist.
    """
    _load_beside(transport_spec(scene, mesh, derivatives=derivatives), pick_devices(device))


# Devices of this host


class LocalWorkers:
    """Workers of this process, one a device, each with a thread of Python.

    A worker's first block, of `first_block` photons, shows how fast it is; `must_rest`: `tallies` changes while any
    traces. `threads` are those of the CPU in all, by default one a core; a GPU takes one. Callers shut `pool` down.

    Raises `ConfigError`: CPU and GPU together, caller's tallies with several devices, or a number out of range;
    `DeviceError`: a device failed, or has too little memory.
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
            size = min(size, max(1, plan.photons))
        threads = 1 if kind == "cuda" else max(1, (threads or core_count()) // len(devices))
        copies = (3 + 2 / len(plan.scene.components) if plan.batch_size else 1) * max(map(devices.count, devices))
        choices: Any = {"copies": copies, "scale": plan.scale, "mesh_cache": mesh_cache}
        began = time.perf_counter()
        spec = transport_spec(plan.scene, plan.mesh, derivatives=plan.derivatives)
        # On GPUs `DeviceWorker` loads the kernel, which may be another one for a large histogram.
        loading = _load_beside(spec, devices)
        models = []
        for device in devices:
            with device_errors(device):
                models.append(build_model(plan.scene, device, plan.mesh, derivatives=plan.derivatives, **choices))
        built = time.perf_counter()
        with device_errors(devices[0]):
            self.truth = trace_truth(plan.scene, models[0])
            traced = time.perf_counter()
            for kernel in loading:
                kernel.result()
        settings: Any = {"seed": plan.seed, "launch_size": size, "threads": threads, "batch_size": plan.batch_size}
        signed = plan.derivatives or plan.scene.tallied_channels
        self.tracers = [DeviceWorker(model, spec, signed=signed, tallies=tallies, **settings) for model in models]
        self.timing = {"setup": built - began, "compile": time.perf_counter() - traced, "truth": traced - built}
        self.first_block = threads * size
        self._devices, self._stopped = devices, threading.Event()
        self.pool, self._pending = ThreadPoolExecutor(len(devices)), dict[Future[Any], Worker]()
        self._reported: queue.SimpleQueue[Event] = queue.SimpleQueue()
        self.workers = [Worker(device.alias, threads, self._stopped) for device in devices]
        for worker, tracer in zip(self.workers, self.tracers, strict=True):
            worker.state["tracer"] = tracer
            worker.state["report"] = lambda n, who=worker: self._reported.put(Event("progress", who, n))

    @property
    def idle(self) -> list[Worker]:
        busy = self._pending.values()
        return [worker for worker in self.workers if worker not in busy]

    def send(self, worker: Worker, work: Callable[..., Any], *arguments: Any) -> None:
        """Lets an idle worker run `work(*arguments, worker)`."""
        self._pending[self.pool.submit(work, *arguments, worker)] = worker

    def collect(self, worker: Worker) -> None:
        """Tallies stay where they are: `tallies` adds them up when all workers rest."""
        self.send(worker, lambda worker: None)

    def stop(self) -> None:
        self._stopped.set()

    def wait(self) -> list[Event]:
        """As `RayWorkers.wait`, and "progress": more photons of a worker's block are done."""
        # With a timeout: Python handles a signal only when the wait for a lock ends.
        done = wait(self._pending, timeout=0.1, return_when=FIRST_COMPLETED).done
        if any(future.exception() for future in done):
            self.stop()
            wait(self._pending)  # until all rest
        events = [self._reported.get() for _ in range(self._reported.qsize())]
        return events + [Event("returned", self._pending.pop(future), future.result()) for future in done]

    def tallies(self) -> Tallies:
        """Those of all devices, added up on the first; on CPUs in its own memory."""
        first, *others = self.tracers
        for other in others:
            first.take_over(other)
        return first.tallies()

    def metadata(self) -> dict[str, Any]:
        """The devices, for a result's provenance."""
        names = list(dict.fromkeys(map(processor_name, self._devices)))
        return {"device": ",".join(device.alias for device in self._devices), "device_name": ", ".join(names)}


# Ray


class ClusterWorkers(RayWorkers):
    """Workers of Ray for the length of a `with` block, on this machine or many; as `LocalWorkers`.

    A worker adds its blocks up where it is, since a histogram can take longer to send than a block to trace, and hands
    its tallies over for a checkpoint or at the end, while the others continue.
    """

    must_rest = False

    def __init__(
        self, plan: Plan, engine: Ray, device: str | None = None, *, note: Callable[[str], None] | None = None
    ) -> None:
        camera = plan.scene.camera
        voxels = camera.width * camera.height * plan.scene.gate.bins
        histograms = 1 + len(plan.derivatives) + len(plan.scene.tallied_channels)
        components = len(plan.scene.components)
        size = 8 * (components + (2 + components if plan.batch_size else 0)) * histograms * voxels
        size += 24 * sum(section.size for section in plan.scene.flux)
        super().__init__(engine, device, prepare=functools.partial(_prepare, plan), value_bytes=size, note=note)
        self._total: Tallies | None = None
        began = time.perf_counter()
        self.truth = trace_truth(plan.scene, build_model(plan.scene, pick_device("cpu"), plan.mesh, camera=False))
        self.timing = {"truth": time.perf_counter() - began}

    def __enter__(self) -> ClusterWorkers:
        began = time.perf_counter()
        super().__enter__()
        self.first_block = _FIRST_BLOCK["cuda" if self.cuda else "cpu"]
        started = time.perf_counter()
        try:
            while not self.idle:  # until a worker has joined
                self.wait()
        except BaseException:
            self.__exit__()
            raise
        self.timing |= {"setup": started - began, "compile": time.perf_counter() - started}
        return self

    def collect(self, worker: Any) -> None:
        """Lets an idle worker begin to hand its tallies over."""
        self.send(worker, _collect)

    def wait(self, timeout: float = 0.2) -> list[Event]:
        events = super().wait(timeout)
        for event in events:
            if isinstance(event.value, Tallies):
                self._total = total_of(*([] if self._total is None else [self._total]), event.value)
        return events

    def tallies(self) -> Tallies:
        """Those of all photons that were collected."""
        assert self._total is not None
        return self._total

    def metadata(self) -> dict[str, Any]:
        """The workers, for a result's provenance."""
        names, workers = sorted({worker["device_name"] for worker in self.joined}), len(self.workers)
        device = f"{workers} Ray worker{'s' * (workers != 1)}"
        return {"device": device, "device_name": ", ".join(names), "workers": list(self.joined)}


# What a worker runs


def _prepare(plan: Plan, worker: Worker) -> None:
    """Run first by a worker of Ray, which then has the device of `LocalWorkers`."""
    local = LocalWorkers(plan, [pick_device(worker.device)], threads=worker.threads)
    worker.state |= {"tracer": local.tracers[0], "report": lambda photons: None}


def trace_block(block: Range, worker: Worker) -> tuple[Ranges, float]:
    """Traces a block; returns the ids done, fewer if it was stopped, and the seconds it took."""
    began = time.perf_counter()
    done = worker.state["tracer"].trace(block, stopped=worker.stopped, report=worker.state["report"])
    return done, time.perf_counter() - began


def _collect(worker: Worker) -> Tallies:
    tracer = worker.state["tracer"]
    tallies = total_of(tracer.tallies()) if worker.device == "cpu" else tracer.tallies()
    tracer.clear()
    return tallies


# Light that stays on its device, for programs that render a scene again and again


class ExpectedLight(NamedTuple):
    """Expected detections per pulse, Warp float32 `[pixel, bin]`; of all light, and of the targets' alone, or None."""

    total: Any
    target: Any


class LightTracer:
    """Traces photons of one scene on one device, part after part, without copies to the host.

    Args:
        scene: What to trace.
        photons: Of a part at most.
        seed: 64 bits.
        device: As in `simulate`; the first of several.
        derivatives: Names, as in `simulate`.
        separate_targets: Whether the light of the targets alone is wanted, too.
        mesh_cache: As in `simulate`.
        tally: That of another tracer of as many pixels and bins, to save memory: a call empties it.

    Raises what `simulate` raises.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        photons: int,
        seed: int,
        device: str | None = None,
        derivatives: Sequence[str] = (),
        separate_targets: bool = False,
        mesh_cache: dict[str, Any] | None = None,
        tally: Any = None,
    ) -> None:
        if channels := scene.tallied_channels:
            text = f"a fit models all light, and knows no channels such as {channels[0]!r}"
            raise ConfigError(text, source=scene.source)
        names = derivatives or None
        plan = make_plan(scene, RunOptions(), photons=photons, seed=seed, derivatives=names, batches=False)
        workers = LocalWorkers(plan, pick_devices(device)[:1], tallies=tally, mesh_cache=mesh_cache)
        self._scene, self._separate_targets, self._unit = scene, separate_targets, 1.0 / plan.scale
        self._names, self._worker = plan.derivatives, workers.tracers[0]
        self.truth: Truth = workers.truth

    @property
    def tally(self) -> Any:
        """Warp int64, of the photons traced last."""
        return self._worker.data.tally

    def __call__(self, first: int, photons: int) -> tuple[ExpectedLight, dict[str, ExpectedLight]]:
        """Light of the photons `first` … `first + photons`, and its derivatives by name with the same photons."""
        worker = self._worker
        worker.clear()
        worker.trace((first, first + photons), stopped=threading.Event())
        scene, data, names = self._scene, worker.data, self._names
        per_photon = scene.detectable_photons_per_pulse
        value = per_photon / photons_per_position(scene, ((first, first + photons),)).reshape(-1)
        slopes = {
            name: self._light(data.gradients, value * unit, len(names), p)
            for p, (name, unit) in enumerate(zip(names, worker.signed_units, strict=True))
        }
        return self._light(data.tally, value * self._unit, 1, 0), slopes

    def _light(self, tally: Any, value: Any, parameters: int, parameter: int) -> ExpectedLight:
        scale: Any = wp.array(np.asarray(value, np.float64), dtype=wp.float64, device=tally.device)
        which: Any = {"bins": self._scene.gate.bins, "parameters": parameters, "parameter": parameter}
        target = sk.tally_rates(tally, scale, components=2, **which) if self._separate_targets else None
        return ExpectedLight(sk.tally_rates(tally, scale, **which), target)
