"""Independent jobs on the devices of this host, or on Ray's workers on one machine or many.

for job, value in run_jobs(work, jobs, device="cuda:all"): ...
for job, value in run_jobs(work, jobs, engine=Ray(address="auto")): ...

`work(job, worker)` is a function of a module, which is sent by name and runs where the worker is. Which worker runs a
job is not defined, so that a job must hold all that its value depends on, its seed above all.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable, Iterator
from typing import TypeVar

from spadwarp.device import pick_devices
from spadwarp.parallel.local import run_here, run_in_processes
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
    if len(devices) == 1:
        yield from run_here(work, jobs, Worker(devices[0]), stopped)
    else:
        yield from run_in_processes(work, jobs, devices, stopped)
