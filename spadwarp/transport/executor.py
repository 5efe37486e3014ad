"""The loop that hands a run's photons to workers, whether devices of this host or workers of Ray."""

from __future__ import annotations

import threading
from collections.abc import Callable, Sequence
from typing import Any, Protocol

from spadwarp.parallel.worker import Event
from spadwarp.result import Tallies, Truth
from spadwarp.result.photon_ids import IdQueue, Range, Ranges, count, joined

# Seconds that a block of photons takes: long beside the milliseconds of handing it out, short beside a checkpoint's.
_BLOCK_SECONDS = 5.0


class Workers(Protocol):
    """A back end: workers that trace blocks into tallies of their own.

    Attributes:
        first_block: Photons of a worker's first block, which shows how fast it is.
        must_rest: Whether `tallies` changes while any of them traces.
        timing: Seconds of "setup" and "compile"; of "truth" where it was traced with them.
    """

    first_block: int
    must_rest: bool
    timing: dict[str, float]

    @property
    def workers(self) -> Sequence[Any]: ...
    @property
    def idle(self) -> Sequence[Any]: ...
    def trace(self, worker: Any, block: Range) -> None:
        """Lets an idle worker begin a block."""

    def collect(self, worker: Any) -> None:
        """Lets an idle worker begin to hand its tallies over."""

    def stop(self) -> None:
        """Ends blocks early."""

    def wait(self) -> list[Event]:
        """Events, after a fraction of a second at most. Raises the error of a worker.

        "progress": more photons of a worker's block are done (value: their number). "traced": its block is done, or was
        stopped (value: ids done, seconds). "collected": its tallies are in `tallies`. "lost": its block and its tallies
        are gone, and another worker replaces it.
        """

    def truth(self) -> Truth:
        """Truth maps by one of the workers."""

    def tallies(self) -> Tallies:
        """Those of all photons that were collected; the arrays may be a worker's own."""

    def metadata(self) -> dict[str, Any]:
        """The devices, for a result's provenance."""


class Executor:
    """Photons that each count once: blocks of workers that were lost run again.

    Args:
        workers: The back end.
        ids: What to trace, none of it done before.
        unit: Photons that stay together: of a batch, or 1.
    """

    def __init__(self, workers: Workers, ids: Ranges, *, unit: int) -> None:
        self._workers, self._waiting, self._unit = workers, IdQueue(ids), unit
        self._done: list[Range] = []  # in `workers.tallies()`
        self._held: dict[Any, list[Range]] = {}  # done, in the tallies of the worker
        self._running: dict[Any, Range | None] = {}  # None: it hands its tallies over
        self._progress: dict[Any, int] = {}  # photons of a running block that are done
        self._speed: dict[Any, float] = {}
        self._collecting: set[Any] | None = None  # workers that have yet to hand over, while a checkpoint is due

    def run(
        self,
        *,
        stopped: threading.Event,
        report: Callable[[int], None],
        checkpoint_due: Callable[[], bool],
        checkpoint: Callable[[Ranges], None],
    ) -> Ranges:
        """Traces the photons.

        Args:
            stopped: Once set, blocks end early and nothing new begins.
            report: Called from this thread with the number of photons done, now and then.
            checkpoint_due: When it turns true, the workers' tallies are collected.
            checkpoint: Called then with the ids done, at a moment when `workers.tallies()` holds just these.

        Returns:
            The ids that were done and collected: all, unless it was stopped.

        Raises:
            DeviceError: A device failed, or has no memory left.
        """
        stop_sent = False
        try:
            while True:
                if stopped.is_set() and not stop_sent:
                    self._workers.stop()
                    stop_sent = True
                ending = stop_sent or not (self._waiting.left or any(self._running.values()))
                if self._collecting is None and not ending and checkpoint_due():
                    # None again if no worker has done or begun anything yet.
                    self._collecting = {*self._held, *self._running} or None
                self._assign(ending, stop_sent)
                if ending and not self._running:
                    return joined(self._done)
                for event in self._workers.wait():
                    self._take(event)
                report(self._photons())
                if self._collecting is not None and not self._collecting:
                    self._collecting = None
                    if self._done and not stopped.is_set() and (self._waiting.left or any(self._running.values())):
                        checkpoint(joined(self._done))
        except BaseException:
            self._workers.stop()
            raise

    def _assign(self, ending: bool, stopped: bool) -> None:
        """Gives every idle worker something to do."""
        for worker in self._workers.idle:
            if self._held.get(worker) and (ending or worker in (self._collecting or ())):
                self._running[worker] = None
                self._workers.collect(worker)
            elif stopped or (self._collecting is not None and self._workers.must_rest):
                continue
            elif block := self._waiting.take(self._size(worker)):
                self._running[worker] = block
                self._workers.trace(worker, block)

    def _size(self, worker: Any) -> int:
        """Photons of the next block: some seconds, fewer towards the end so that all workers end together."""
        first, workers = self._workers.first_block, len(self._workers.workers)
        size = int(self._speed[worker] * _BLOCK_SECONDS) if worker in self._speed else first
        if workers > 1:
            size = min(size, max(self._waiting.left // (2 * workers), first // 16))
        return max(1, size // self._unit) * self._unit

    def _take(self, event: Event) -> None:
        worker = event.worker
        if event.kind == "progress":
            self._progress[worker] = self._progress.get(worker, 0) + event.value
            return
        if worker not in self._running:  # it was lost before it joined
            return
        block = self._running.pop(worker)
        self._progress.pop(worker, None)
        if event.kind == "traced":
            ids, seconds = event.value
            self._held.setdefault(worker, []).extend(ids)
            if seconds > 0:
                self._speed[worker] = count(ids) / seconds
            return
        if event.kind == "collected":
            self._done += self._held.pop(worker)
        else:
            self._waiting.put_back([*self._held.pop(worker, []), *([block] if block else [])])
        if self._collecting is not None:
            self._collecting.discard(worker)

    def _photons(self) -> int:
        held = sum(count(ids) for ids in self._held.values())
        return count(self._done) + held + sum(self._progress.values())
