"""Jobs on this host: in this process on one device, or in a process for each of several."""

from __future__ import annotations

import multiprocessing
import multiprocessing.connection
import os
import signal
import threading
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from typing import Any, TypeVar

from spadwarp.device import core_count
from spadwarp.errors import DeviceError
from spadwarp.parallel.worker import Worker

Job = TypeVar("Job")
Value = TypeVar("Value")


def run_here(
    work: Callable[[Job, Worker], Value], jobs: Iterable[Job], worker: Worker, stopped: threading.Event
) -> Iterator[tuple[Job, Value]]:
    """One job after the other, in this thread."""
    worker.stopped = stopped
    queue = iter(jobs)
    while not stopped.is_set():
        try:
            job = next(queue)
        except StopIteration:
            return
        yield job, work(job, worker)


def run_in_processes(
    work: Callable[[Job, Worker], Value], jobs: Iterable[Job], devices: Sequence[str], stopped: threading.Event
) -> Iterator[tuple[Job, Value]]:
    """A process for each device: Warp loads kernels in one thread, and jobs hold Python's lock between launches."""
    context = multiprocessing.get_context("spawn")
    slots = context.SimpleQueue()
    for device in devices:
        slots.put((device, max(1, core_count() // len(devices)) if device == "cpu" else None))
    ended = context.Event()
    queue = iter(jobs)
    running: dict[Future[Value], Job] = {}
    pool = ProcessPoolExecutor(len(devices), mp_context=context, initializer=_begin, initargs=(slots, ended))
    try:
        while True:
            if stopped.is_set():
                ended.set()
            while len(running) < len(devices) and not stopped.is_set():
                try:
                    job = next(queue)
                except StopIteration:
                    break
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
