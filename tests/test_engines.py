"""Promises of `run_jobs`: every job is done once, wherever it runs, whatever happens to its worker."""

import os
import signal
import sys

import numpy as np
import pytest

import engine_jobs
import spadwarp
from scenes import scene
from spadwarp.engines import Ray, interruptible, run_jobs

ENGINES = {"here": {"device": "cpu"}, "processes": {"device": "cpu,cpu"}, "ray": {"engine": Ray(workers=2)}}


@pytest.fixture(scope="module")
def cluster():
    """Two cores of Ray for all tests of this file."""
    ray = pytest.importorskip("ray")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("PYTHONPATH", os.pathsep.join(sys.path))
        ray.init(num_cpus=2, include_dashboard=False, log_to_driver=False, object_store_memory=100 << 20)
        yield
        ray.shutdown()


@pytest.mark.parametrize("engine", ENGINES)
def test_every_job_is_done_once_and_workers_keep_their_state(engine, cluster):
    done = dict(run_jobs(engine_jobs.square, range(20), **ENGINES[engine]))
    assert {job: value[0] for job, value in done.items()} == {job: job**2 for job in range(20)}
    counts = {}
    for _, pid, count in done.values():
        counts[pid] = max(count, counts.get(pid, 0))
    assert sum(counts.values()) == 20
    assert len(counts) == 1 if engine == "here" else len(counts) <= 2


@pytest.mark.parametrize("engine", ENGINES)
def test_an_error_of_a_job_is_raised_as_it_is(engine, cluster):
    with pytest.raises(ValueError, match="job 0 is wrong"):
        list(run_jobs(engine_jobs.fails, [0], **ENGINES[engine]))


def test_a_job_whose_worker_was_killed_runs_again(cluster, tmp_path):
    notes = []
    jobs = [(number, str(tmp_path)) for number in range(7)]
    done = dict(run_jobs(engine_jobs.dies_once, jobs, engine=Ray(workers=2), note=notes.append))
    assert done == {job: job[0] ** 2 for job in jobs}
    assert sum(note.startswith("lost the worker") for note in notes) == 3


def test_a_job_that_kills_every_worker_is_given_up(cluster):
    with pytest.raises(spadwarp.DeviceError, match="took 4 workers with it"):
        list(run_jobs(engine_jobs.always_dies, [0], engine=Ray(workers=1)))
    with pytest.raises(spadwarp.DeviceError, match="killed"):
        list(run_jobs(engine_jobs.always_dies, [0], device="cpu,cpu"))


@pytest.mark.parametrize("engine", ENGINES)
def test_after_an_interrupt_no_job_is_begun_and_those_begun_are_finished(engine, cluster):
    begun = []

    def jobs():
        for job in range(1000):
            begun.append(job)
            if job == 5:
                signal.raise_signal(signal.SIGTERM)
            yield job

    with interruptible() as stopped:
        done = [job for job, _ in run_jobs(engine_jobs.square, jobs(), stopped=stopped, **ENGINES[engine])]
    assert stopped.is_set()
    assert sorted(done) == begun and 5 <= len(begun) <= 7


def test_simulations_do_not_depend_on_who_runs_them(cluster):
    for engine in ENGINES.values():
        for seed, tallies in run_jobs(engine_jobs.shots, [3, 4], **engine):
            np.testing.assert_array_equal(
                tallies, spadwarp.simulate(scene(), photons=2000, seed=seed, device="cpu").tallies
            )
