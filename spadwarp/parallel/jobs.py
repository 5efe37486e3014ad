"""Independent jobs on devices of this host or workers of Ray, and calls in copies of this process.

for job, value in run_jobs(work, jobs, device="cuda:all"): ...  # or engine=Ray(address="auto")

`work(job, worker)` is a function of a module, which is sent by name and runs where the worker is. Which worker runs a
job is not defined, so that a job must hold all that its value depends on, its seed above all.
"""

from __future__ import annotations

import gc
import multiprocessing
import multiprocessing.connection
import os
import signal
import sys
import threading
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from itertools import islice
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
from typing import Any, TypeVar

from spadwarp.device import core_count, pick_devices
from spadwarp.parallel.workers import RETRIES, Ray, RayWorkers, Worker
from spadwarp.values import DeviceError, address_space

__all__ = ["Forked", "run_jobs"]

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
    devices = [] if engine is not None else [found.alias for found in pick_devices(device)]
    if engine is not None:
        with RayWorkers(engine, device, note=note) as workers:
            yield from _run_on_ray(work, jobs, workers, stopped)
    elif len(devices) > 1:
        yield from _run_in_processes(work, jobs, devices, stopped)
    else:
        worker = Worker(devices[0], stopped=stopped)
        yield from ((job, work(job, worker)) for job in _until(stopped, jobs))


def _until(stopped: threading.Event, jobs: Iterable[Job]) -> Iterator[Job]:
    """The jobs, of which none is taken any more once the event is set."""
    if not stopped.is_set():
        for job in jobs:
            yield job
            if stopped.is_set():
                return


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
        text = f"a process on one of {', '.join(devices)} was killed, perhaps because memory ran out"
        raise DeviceError(text) from error
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


def _run_on_ray(
    work: Callable[[Job, Worker], Value], jobs: Iterable[Job], workers: RayWorkers, stopped: threading.Event
) -> Iterator[tuple[Job, Value]]:
    """A job whose worker was lost is run again."""
    queue = ((job, RETRIES) for job in _until(stopped, jobs))
    again, running = list[tuple[Job, int]](), dict[Any, tuple[Job, int]]()
    stop_sent = False
    while True:
        for worker in workers.idle if not stopped.is_set() else ():
            if (item := again.pop() if again else next(queue, None)) is None:
                break
            running[worker] = item
            workers.send(worker, work, item[0])
        if stopped.is_set() and not stop_sent:
            workers.stop()
            stop_sent = True
        if not running and (stopped.is_set() or workers.idle):
            return
        for event in workers.wait(0.2):
            if event.worker not in running:  # it has joined, or was lost before
                continue
            job, retries = running.pop(event.worker)
            if event.kind == "returned":
                yield job, event.value
            elif retries:
                again.append((job, retries - 1))
            else:
                raise DeviceError(f"a job is given up: {RETRIES + 1} workers were lost while they ran it")


# Calls in copies of this process, which cost no import and no transfer of what they read

_PATIENCE = 30.0  # seconds


class Forked:
    """Begins calls, each in a process of its own; a context, at whose end none of them runs any more.

    Where processes cannot be copied (not Linux, limited memory), or where one fails or takes half a minute, the call
    is made here, by `results`. Calls must not use a GPU, nor import what another thread may be importing; their results
    are pickled.
    """

    def __init__(self, calls: Sequence[Callable[[], Any]]) -> None:
        self._calls = calls
        possible = sys.platform == "linux" and address_space() is None
        self._running = [_fork(call) if possible else None for call in calls]

    def results(self) -> list[Any]:
        """Of all calls, in their order; waits for them. Raises what they raise."""
        end = time.monotonic() + _PATIENCE
        found = [None if copy is None else _result(copy[1], end) for copy in self._running]
        return [call() if item is None else item[0] for call, item in zip(self._calls, found, strict=True)]

    def __enter__(self) -> Forked:
        return self

    def __exit__(self, *_: object) -> None:
        for process, source in filter(None, self._running):
            source.close()
            process.kill()
            process.join()
        self._running = []


def _fork(call: Callable[[], Any]) -> tuple[BaseProcess, Connection] | None:
    """Process and the connection that its result comes from; None where there is no further process."""
    context = multiprocessing.get_context("fork")
    try:
        source, target = context.Pipe(duplex=False)
        process = context.Process(target=_send, args=(call, source, target), daemon=True)
        with target, warnings.catch_warnings():
            # Python warns of copies of a process with threads; the copy takes none of their locks.
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
    except OSError:
        return None
    return process, source


def _send(call: Callable[[], Any], source: Connection, target: Connection) -> None:
    gc.disable()  # arrays of a GPU that are garbage are the parent's to free
    source.close()
    with suppress(BaseException):  # where nothing is sent, the call is made again
        target.send((call(),))


def _result(source: Connection, end: float) -> tuple[Any] | None:
    """What the call returned; None if it failed, or not by then."""
    with suppress(EOFError, OSError):
        if source.poll(max(0.0, end - time.monotonic())):
            found: tuple[Any] = source.recv()
            return found
    return None
