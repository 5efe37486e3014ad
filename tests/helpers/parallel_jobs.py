"""Jobs for tests of the engines, in a module that worker processes can import."""

import os
import signal
from pathlib import Path


def square(job, worker):
    assert worker.device == "cpu"
    worker.state["done"] = worker.state.get("done", 0) + 1
    return job**2, os.getpid(), worker.state["done"]


def dies_once(job, worker):
    """Kills its worker when it is run for the first time."""
    number, folder = job
    mark = Path(folder) / str(number)
    if number % 3 == 0 and not mark.exists():
        mark.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number**2


def always_dies(job, worker):
    os.kill(os.getpid(), signal.SIGKILL)


def fails(job, worker):
    raise ValueError(f"job {job} is wrong")


def shots(job, worker):
    """A small simulation of the job's seed."""
    import spadwarp
    from helpers.scenes import scene

    return spadwarp.simulate(
        scene(), photons=2000, seed=job, device=worker.device, run=spadwarp.RunOptions(threads=1)
    ).tallies
