"""Who does the work: the devices of this host, or Ray's workers on one machine or many.

for job, value in run_jobs(work, jobs, device="cuda:all"): ...
for job, value in run_jobs(work, jobs, engine=Ray(address="auto")): ...

`work(job, worker)` is a function of a module (it is sent by name), and runs where the worker is. Which worker takes a
job is left to chance, so that a job must carry all that its value depends on: its seed above all.
"""

from __future__ import annotations

import signal
import threading
import time
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import Any, TypeVar

__all__ = ["Ray", "Worker", "interruptible", "run_jobs"]

Job = TypeVar("Job")
Value = TypeVar("Value")


@dataclass(frozen=True)
class Ray:
    """Workers of Ray, each a process with one GPU, or on machines without any with a share of the cores.

    Attributes:
        address: Of a running cluster, "auto" or "host:port"; None starts Ray on this machine alone, or takes the
            cluster that RAY_ADDRESS names or that this process is connected to.
        workers: How many; by default one for each GPU of the cluster, else one for each of its machines.
    """

    address: str | None = None
    workers: int | None = None


@dataclass(eq=False)
class Worker:
    """What a job is told about the place where it runs.

    Attributes:
        device: "cpu" or "cuda:0", ...; what `device=` takes.
        threads: CPU threads that are its own; None: as many as there are cores.
        stopped: Set when the run was interrupted. A job that began is waited for; a long one may end early.
        state: Kept from one job to the next on this worker.
    """

    device: str
    threads: int | None = None
    stopped: threading.Event = field(default_factory=threading.Event)
    state: dict[str, Any] = field(default_factory=dict)


def run_jobs(
    work: Callable[[Job, Worker], Value],
    jobs: Iterable[Job],
    *,
    engine: Ray | None = None,
    device: str | None = None,
    stopped: threading.Event | None = None,
    note: Callable[[str], None] | None = None,
) -> Iterator[tuple[Job, Value]]:
    """Runs independent jobs, one at a time on each device.

    Args:
        work: Called with a job and the `Worker` that runs it; defined at the top of a module.
        jobs: What can be pickled; taken one by one as workers become free.
        engine: None for the devices of this host, in this process for one device, else in a process for each.
        device: "cpu", "cuda:0", "cuda:all", "cuda:0,cuda:2"; by default the first GPU, else the CPU. With Ray "cpu" or
            "cuda", by default whichever the cluster has.
        stopped: Once set (see `interruptible`), no job is begun any more; what was begun is finished.
        note: Told what a person may want to know: how many workers there are, which were lost.

    Yields:
        Jobs with their values, in the order in which they end.

    Raises:
        DeviceError: There is no such device or cluster, or a job took four workers with it.
        Whatever `work` raises.
    """
    stopped = threading.Event() if stopped is None else stopped
    if engine is not None:
        from spadwarp.parallel.ray import run_on_ray

        yield from run_on_ray(work, jobs, engine=engine, device=device, stopped=stopped, note=note)
        return
    from spadwarp.device import pick_devices
    from spadwarp.parallel.local import run_here, run_in_processes

    devices = [one.alias for one in pick_devices(device)]
    if len(devices) == 1:
        yield from run_here(work, jobs, Worker(devices[0]), stopped)
    else:
        yield from run_in_processes(work, jobs, devices, stopped)


_handled = threading.Lock()


@contextmanager
def interruptible() -> Iterator[threading.Event]:
    """An event that Ctrl-C (or SIGTERM, as job schedulers send it) sets; a second one raises KeyboardInterrupt.

    Within another `interruptible`, and outside the main thread, which signals do not reach, nothing sets the event:
    what the outer one began is finished.
    """
    interrupted = threading.Event()
    if threading.current_thread() is not threading.main_thread() or not _handled.acquire(blocking=False):
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

    before = {number: signal.signal(number, handle) for number in (signal.SIGINT, signal.SIGTERM)}
    try:
        yield interrupted
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        _handled.release()
