"""Workers of Ray, on this machine or many."""

from __future__ import annotations

import functools
import time
from collections.abc import Callable
from typing import Any

from spadwarp.device import pick_device
from spadwarp.parallel import Ray, Worker
from spadwarp.parallel.ray import RayWorker, RayWorkers
from spadwarp.result import COMPONENTS, Tallies, Truth
from spadwarp.result.photon_ids import Range, Ranges
from spadwarp.transport.executor import Event
from spadwarp.transport.plan import Plan

__all__ = ["ClusterWorkers"]

# Photons of a worker's first block, which shows how fast it is.
_FIRST_BLOCK = {"cpu": 1 << 14, "cuda": 1 << 24}


class ClusterWorkers:
    """Workers of Ray for the length of a `with` block.

    A worker adds its blocks up where it is, since a histogram can take longer to send than a block to trace, and hands
    its tallies over when they are to be kept, while the others continue.

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
                self._add(event.value)
                events.append(Event("collected", event.worker))
            else:
                events.append(Event("traced", event.worker, event.value))
        return events

    def _add(self, tallies: Tallies) -> None:
        if self._total is None:
            self._total = Tallies.of(tallies)  # Ray's own arrays are read-only
        else:
            self._total.add(tallies)

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


# What a worker does


def _prepare(plan: Plan, worker: Worker) -> None:
    from spadwarp.transport.local_workers import LocalWorkers

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
    tallies = Tallies.of(device_worker.tallies()) if worker.device == "cpu" else device_worker.tallies()
    device_worker.clear()
    return tallies
