"""Jobs on the devices of this host, or on Ray's workers on one machine or many."""

from spadwarp.parallel.forked import Forked
from spadwarp.parallel.jobs import run_jobs
from spadwarp.parallel.worker import Ray, Worker, interruptible

__all__ = ["Forked", "Ray", "Worker", "interruptible", "run_jobs"]
