"""Devices of this host as workers: the cores of the CPU, one GPU, several."""

from __future__ import annotations

import queue
import threading
import time
from collections.abc import Sequence
from typing import Any

import warp as wp

from spadwarp.device import core_count, processor_name
from spadwarp.errors import ConfigError
from spadwarp.limits import check_integer
from spadwarp.result import COMPONENTS, Tallies, Truth
from spadwarp.result.photon_ids import Range, count
from spadwarp.transport.device_worker import DeviceWorker, device_errors
from spadwarp.transport.executor import Event
from spadwarp.transport.loading import load_transport_kernel
from spadwarp.transport.model import build_model, transport_spec
from spadwarp.transport.plan import LARGEST_LAUNCH, LAUNCH_SIZE, Plan
from spadwarp.transport.truth import trace_truth

__all__ = ["LocalWorkers"]


class LocalWorkers:
    """Workers of this process, one a device, each with a thread of Python for the length of a block.

    Args:
        plan: Of the run.
        devices: From `spadwarp.device.pick_devices`.
        threads: CPU threads in all; by default one a core. A GPU takes one.
        tallies: The caller's own, for one device.
        kept: Meshes of earlier runs, as `build_model` takes them.

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
        kept: Any = None,
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
        threads = core_count() if threads is None else check_integer("threads", threads, "[1, 4096]")
        threads = 1 if kind == "cuda" else max(1, threads // len(devices))
        self._devices = devices
        copies = (2 + 2 / len(COMPONENTS) if plan.batch_size else 1) * max(map(devices.count, devices))
        began = time.perf_counter()
        models = []
        spec = transport_spec(plan.scene, plan.mesh, derivatives=plan.derivatives)
        choices: dict[str, Any] = {"copies": copies, "scale": plan.scale, "kept": kept, "derivatives": plan.derivatives}
        finish_loading = load_transport_kernel(spec, devices)
        for device in devices:
            with device_errors(device):
                models.append(build_model(plan.scene, device, plan.mesh, **choices))
        built = time.perf_counter()
        with device_errors(devices[0]):
            self._truth = trace_truth(plan.scene, models[0])
            traced = time.perf_counter()
            finish_loading()
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
