"""Independent jobs on the devices of this host, or on Ray's workers on one machine or many.

for job, value in run_jobs(work, jobs, device="cuda:all"): ...
for job, value in run_jobs(work, jobs, engine=Ray(address="auto")): ...

`work(job, worker)` is a function of a module, which is sent by name and runs where the worker is. Which worker runs a
job is not defined, so that a job must hold all that its value depends on, its seed above all.
"""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from itertools import islice
from typing import Any, TypeVar

from spadwarp.device import core_count, pick_devices
from spadwarp.errors import DeviceError
from spadwarp.parallel.ray import run_on_ray
from spadwarp.parallel.worker import Ray, Worker

__all__ = ["run_jobs"]

Job = TypeVar("Job")
Value = TypeVar("Value")


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
        stopped: Once set (see `interruptible`), no further job begins; those that have begun are finished.
        note: Called with remarks: which workers have joined, which were lost.

    Yields:
        Jobs with their values, in the order in which they end.

    Raises:
        DeviceError: There is no such device or cluster, or four workers were lost while they ran one job.
        Whatever `work` raises.
    """
    stopped = threading.Event() if stopped is None else stopped
    if engine is not None:
        yield from run_on_ray(work, jobs, engine=engine, device=device, stopped=stopped, note=note)
        return
    devices = [found.alias for found in pick_devices(device)]
    if len(devices) > 1:
        yield from _run_in_processes(work, jobs, devices, stopped)
        return
    worker = Worker(devices[0], stopped=stopped)
    for job in _until(stopped, jobs):
        yield job, work(job, worker)


def _until(stopped: threading.Event, jobs: Iterable[Job]) -> Iterator[Job]:
    """The jobs, of which none is taken any more once the event is set."""
    queue = iter(jobs)
    while not stopped.is_set():
        try:
            job = next(queue)
        except StopIteration:
            return
        yield job


def _run_in_processes(
    work: Callable[[Job, Worker], Value], jobs: Iterable[Job], devices: Sequence[str], stopped: threading.Event
) -> Iterator[tuple[Job, Value]]:
    """A process for each device: Warp loads kernels in one thread, and jobs hold Python's lock between launches."""
    context = multiprocessing.get_context("spawn")
    slots = context.SimpleQueue()
    for device in devices:
        slots.put((device, max(1, core_count() // len(devices)) if device == "cpu" else None))
    ended = context.Event()
    queue = _until(stopped, jobs)
    running: dict[Future[Value], Job] = {}
    pool = ProcessPoolExecutor(len(devices), mp_context=context, initializer=_begin, initargs=(slots, ended))
    try:
        while True:
            if stopped.is_set():
                ended.set()
            for job in islice(queue, len(devices) - len(running)):
                running[pool.submit(_run, work, job)] = job
            if not running:
                return
            # With a timeout: Python handles a signal only when the wait for a lock ends.
            for future in wait(running, timeout=0.2, return_when=FIRST_COMPLETED).done:
                yield running.pop(future), future.result()
    except BrokenProcessPool as error:
        raise DeviceError(
            f"a process on one of {', '.join(devices)} was killed, perhaps because memory ran out"
        ) from error
    finally:
        ended.set()
        pool.shutdown(cancel_futures=True)


_worker: Worker


def _begin(slots: Any, ended: Any) -> None:
    """Run first in a new process, which ignores Ctrl-C and SIGTERM and ends when the process that started it does."""
    global _worker
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, signal.SIG_IGN)
    threading.Thread(target=_end_with_parent, daemon=True).start()
    device, threads = slots.get()
    _worker = Worker(device, threads, ended)


def _run(work: Callable[[Job, Worker], Value], job: Job) -> Value:
    return work(job, _worker)


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    multiprocessing.connection.wait([parent.sentinel])
    os._exit(1)
