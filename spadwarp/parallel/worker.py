"""Who runs the jobs, and the signals that interrupt them."""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from spadwarp.values import ArgumentError, check_integer, shown

__all__ = ["Ray", "Worker", "interruptible"]


@dataclass(frozen=True)
class Ray:
    """Workers of Ray, each a process with one GPU or, on machines without GPUs, with a share of the cores."""

    address: str | None = None
    """Of a running cluster, "auto" or "host:port"; None takes the cluster that RAY_ADDRESS names or that this process
    is connected to, else starts Ray on this machine alone."""
    workers: int | None = None
    """How many; by default one for each GPU of the cluster, else one for each of its machines."""

    def __post_init__(self) -> None:
        if not isinstance(self.address, str | None):
            raise ArgumentError(f"address = {shown(self.address)} is not text such as 'auto' or 'host:6379'")
        if self.workers is not None:
            object.__setattr__(self, "workers", check_integer("workers", self.workers, "[1, 100000]"))


@dataclass(eq=False)
class Worker:
    """The process and device that run a job."""

    device: str  # "cpu" or "cuda:0", ...; what `device=` takes
    threads: int | None = None  # CPU threads that it may use; None: as many as there are cores
    stopped: threading.Event = field(default_factory=threading.Event)
    """Set when the run was interrupted. A job that has begun is waited for; a long one may end early."""
    state: dict[str, Any] = field(default_factory=dict)  # kept from one job to the next on this worker


class Event(NamedTuple):
    """Something that a worker did; see `RayWorkers.wait`."""

    kind: str
    worker: Any
    value: Any = None


_handled = threading.Lock()


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """An event that Ctrl-C, or SIGTERM as job schedulers send it, sets; a second signal raises KeyboardInterrupt.

    Within another `interruptible`, and outside the main thread, which alone receives signals, nothing sets the event:
    the outer block decides.
    """
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread() or not _handled.acquire(blocking=False):
        yield interrupted
        return

    first = 0.0

    def handle(number: int, frame: object) -> None:
        nonlocal first
        # Some programs send one interrupt twice, to a process and to its group: a second one counts after 1 s.
        if interrupted.is_set() and time.monotonic() > first + 1.0:
            raise KeyboardInterrupt
        if not interrupted.is_set():
            first = time.monotonic()
        interrupted.set()

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _handled.release()
