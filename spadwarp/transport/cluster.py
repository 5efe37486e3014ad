"""A run's photons on Ray's workers."""

from __future__ import annotations

import functools
import threading
import time
from collections.abc import Callable
from typing import Any

from spadwarp.device import pick_device
from spadwarp.parallel import Ray, Worker
from spadwarp.parallel.ray import RayWorker, RayWorkers
from spadwarp.result.merge import Tallies
from spadwarp.result.photon_ids import Queue, Range, Ranges, count, joined
from spadwarp.result.result import COMPONENTS, Result, Truth
from spadwarp.transport.passes import Plan, Tracer

# Seconds that a block of photons takes: long beside the milliseconds of handing it out, short for who watches.
_BLOCK_SECONDS = 5.0
# Photons of a worker's first block, which tells how fast it is.
_FIRST_BLOCK = {"cpu": 1 << 14, "cuda": 1 << 24}


class ClusterTracer:
    """As `Tracer`, over a crew of Ray workers, for the length of a `with` block.

    A worker adds its blocks up where it is, since to hand over a cube can take longer than to trace a block, and hands
    its sums over when they are to be kept: each photon is then counted once. Blocks of a worker that was lost before
    run again.
    """

    def __init__(
        self,
        plan: Plan,
        engine: Ray,
        device: str | None = None,
        *,
        base: Result | None = None,
        note: Callable[[str], None] | None = None,
    ) -> None:
        camera, gate = plan.scene.camera, plan.scene.gate
        cubes = len(COMPONENTS) + (2 if plan.batch_size else 0)
        self._crew = RayWorkers(
            engine,
            device,
            prepare=functools.partial(_prepare, plan),
            value_bytes=8 * cubes * camera.width * camera.height * gate.bins,
            note=note,
        )
        self._unit = plan.batch_size or 1
        self._sums = None if base is None else Tallies.of(base)
        self._speed: dict[RayWorker, float] = {}
        self._about: dict[str, dict[str, Any]] = {}
        self.timing = {"setup": 0.0, "compile": 0.0}

    def __enter__(self) -> ClusterTracer:
        began = time.perf_counter()
        self._crew.__enter__()
        self._first = _FIRST_BLOCK["cuda" if self._crew.cuda else "cpu"]
        self.timing["setup"] = time.perf_counter() - began
        return self

    def __exit__(self, *error: object) -> None:
        self._crew.__exit__(*error)

    def truth(self) -> Truth:
        """By the first worker that has joined, which also waits for it."""
        began = time.perf_counter()
        while not self._crew.idle:
            self._wait()
        self.timing["compile"] = time.perf_counter() - began
        self._crew.send(self._crew.idle[0], _truth)
        while True:
            for kind, _, value in self._wait():
                if kind == "returned":
                    return value
                if kind == "lost":
                    return self.truth()

    def sums(self) -> Tallies:
        assert self._sums is not None
        return self._sums

    def about(self) -> dict[str, Any]:
        """The workers, for a result's provenance."""
        names = sorted({about["device_name"] for about in self._about.values()})
        count = len(self._crew.workers)
        return {
            "device": f"{count} Ray worker{'s' * (count != 1)}",
            "device_name": ", ".join(names),
            "workers": list(self._about.values()),
        }

    def trace(
        self,
        ranges: Ranges,
        *,
        stopped: threading.Event,
        report: Callable[[int], None] = lambda done: None,
        due: Callable[[], bool] = lambda: False,
        keep: Callable[[Ranges], None] = lambda done: None,
    ) -> Ranges:
        """As `Tracer.trace`. When `due` turns true, workers hand over one by one while the others go on."""
        crew, waiting = self._crew, Queue(ranges)
        done: list[Range] = []  # and in the sums
        held: dict[RayWorker, list[Range]] = {}  # done, in the worker's own sums
        running: dict[RayWorker, Range | None] = {}  # None: the worker hands its sums over
        handing_over: set[RayWorker] | None = None  # from `due` to `keep`
        told = False
        while True:
            if stopped.is_set() and not told:
                crew.stop()
                told = True
            over = stopped.is_set() or not (waiting.left or any(running.values()))
            if handing_over is None and not over and due():
                handing_over = {member for member in crew.workers if held.get(member) or running.get(member)}
            for member in crew.idle:
                if held.get(member) and (over or member in (handing_over or ())):
                    running[member] = None
                    crew.send(member, _hand_over)
                elif not stopped.is_set() and (block := waiting.take(self._size(member, waiting.left))):
                    running[member] = block
                    crew.send(member, _trace, block)
            if over and not running:
                return joined(done)
            for kind, member, value in self._wait():
                if member not in running:  # it has joined, or was lost before
                    continue
                block = running.pop(member)
                if kind == "lost":
                    waiting.put_back([*held.pop(member, []), *([block] if block else [])])
                elif block is None:
                    self._add(value)
                    done += held.pop(member)
                else:
                    walked, seconds = value
                    held.setdefault(member, []).extend(walked)
                    self._speed[member] = count(walked) / seconds if seconds else 0.0
                if kind == "lost" or block is None:
                    (handing_over or set()).discard(member)
                report(count(done) + sum(count(ids) for ids in held.values()))
            if handing_over is not None and not handing_over:
                handing_over = None
                if done and not stopped.is_set():
                    keep(joined(done))

    def _size(self, member: RayWorker, left: int) -> int:
        """Photons of the next block: some seconds, smaller towards the end so that all end together."""
        workers = len(self._crew.workers)
        fair = left // (2 * workers) if workers > 1 else left
        size = max(self._first, min(int(self._speed.get(member, 0.0) * _BLOCK_SECONDS), fair))
        return max(1, size // self._unit) * self._unit

    def _add(self, value: Tallies) -> None:
        if self._sums is None:
            self._sums = Tallies.of(value)  # Ray's own arrays are read-only
        else:
            self._sums.add(value)

    def _wait(self) -> list[tuple[str, RayWorker, Any]]:
        events = self._crew.wait(0.2)
        for event in events:
            if event.kind == "joined":
                assert event.worker.metadata is not None
                self._about[f"{event.worker.metadata['host']} {event.worker.metadata['pid']}"] = event.worker.metadata
        return [(event.kind, event.worker, event.value) for event in events]


# What a worker does


def _prepare(plan: Plan, worker: Worker) -> None:
    worker.state["tracer"] = Tracer(plan, [pick_device(worker.device)], threads=worker.threads)


def _truth(worker: Worker) -> Truth:
    return worker.state["tracer"].truth()


def _trace(block: Range, worker: Worker) -> tuple[Ranges, float]:
    """Walks a block, or what of it is done when the run is stopped; returns the ids and the seconds it took."""
    began = time.perf_counter()
    done = worker.state["tracer"].trace((block,), stopped=worker.stopped)
    return done, time.perf_counter() - began


def _hand_over(worker: Worker) -> Tallies:
    tracer = worker.state["tracer"]
    sums = Tallies.of(tracer.sums()) if worker.device == "cpu" else tracer.sums()
    tracer.clear()
    return sums
