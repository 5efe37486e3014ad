"""Promises of the engines: every job is done once, wherever it runs, whatever happens to its worker; a run over Ray
has the bits of a run without."""

import os
import random
import re
import signal
import sys
import time

import numpy as np
import pytest

import spadwarp
from helpers import parallel_jobs
from helpers.cli import run
from helpers.datasets import checksums, recipe
from helpers.runs import PHOTONS, RUN, same
from helpers.scenes import scene
from spadwarp import RunOptions, simulate
from spadwarp.parallel import Forked, Ray, interruptible, run_jobs

ENGINES = {"here": {"device": "cpu"}, "processes": {"device": "cpu,cpu"}, "ray": {"engine": Ray(workers=2)}}


@pytest.fixture(params=["here", "processes", pytest.param("ray", marks=pytest.mark.slow)])
def options(request):
    """Of `run_jobs`, for each engine."""
    if request.param == "ray":
        request.getfixturevalue("cluster")
    return ENGINES[request.param]


def test_every_job_is_done_once_and_workers_keep_their_state(options):
    done = dict(run_jobs(parallel_jobs.square, range(20), **options))
    assert {job: value[0] for job, value in done.items()} == {job: job**2 for job in range(20)}
    counts = {}
    for _, pid, count in done.values():
        counts[pid] = max(count, counts.get(pid, 0))
    assert sum(counts.values()) == 20
    assert len(counts) <= 2


def test_an_error_of_a_job_is_raised_as_it_is(options):
    with pytest.raises(ValueError, match="job 0 is wrong"):
        list(run_jobs(parallel_jobs.fails, [0], **options))


@pytest.mark.slow
def test_a_job_whose_worker_was_killed_runs_again(cluster, tmp_path):
    notes = []
    jobs = [(number, str(tmp_path)) for number in range(7)]
    done = dict(run_jobs(parallel_jobs.dies_once, jobs, engine=Ray(workers=2), note=notes.append))
    assert done == {job: job[0] ** 2 for job in jobs}
    assert sum(note.startswith("lost the worker") for note in notes) == 3


@pytest.mark.slow
def test_a_job_that_kills_every_worker_is_given_up(cluster):
    with pytest.raises(spadwarp.DeviceError, match="4 workers were lost"):
        list(run_jobs(parallel_jobs.always_dies, [0], engine=Ray(workers=1)))
    with pytest.raises(spadwarp.DeviceError, match="killed"):
        list(run_jobs(parallel_jobs.always_dies, [0], device="cpu,cpu"))


def test_after_an_interrupt_no_job_is_begun_and_those_begun_are_finished(options):
    begun = []

    def jobs():
        for job in range(1000):
            begun.append(job)
            if job == 5:
                signal.raise_signal(signal.SIGTERM)
            yield job

    with interruptible() as stopped:
        done = [job for job, _ in run_jobs(parallel_jobs.square, jobs(), stopped=stopped, **options)]
    assert stopped.is_set()
    assert sorted(done) == begun and 5 <= len(begun) <= 7


@pytest.mark.slow
def test_simulations_do_not_depend_on_who_runs_them():
    ((_, tallies),) = run_jobs(parallel_jobs.shots, [3], **ENGINES["processes"])
    np.testing.assert_array_equal(tallies, simulate(scene(), photons=2000, seed=3, device="cpu").tallies)


# Runs over Ray


class Killer:
    """Kills one of the workers that have joined, with each of so many reports of progress."""

    def __init__(self, kills, seed):
        self.left, self.random, self.pids, self.remarks = kills, random.Random(seed), [], []

    def __call__(self, stage, done, total):
        if stage != "trace":
            self.remarks.append(stage)
            if found := re.match(r"worker .*process (\d+)$", stage):
                self.pids.append(int(found[1]))
        elif self.left and 0 < done < total and self.pids:
            self.left -= 1
            pid = self.pids.pop(self.random.randrange(len(self.pids)))
            os.kill(pid, signal.SIGKILL)

    @property
    def lost(self):
        return sum(remark.startswith("lost the worker") for remark in self.remarks)


@pytest.mark.slow
def test_a_run_whose_workers_are_killed_has_the_bits_of_a_local_one(cluster, whole, tmp_path):
    killer, kept = Killer(2, seed=2), tmp_path / "checkpoint.h5"
    options = {"run": RunOptions(checkpoint=kept, checkpoint_every=0.0)}
    run = simulate(scene(), **RUN, engine=Ray(workers=2), progress=killer, **options)
    same(run, whole)
    assert killer.lost == 2
    assert 3 <= len(run.provenance["workers"]) <= 4 and run.provenance["device"] == "2 Ray workers"
    # The checkpoint is consistent, whatever was lost, and can be resumed.
    kept = spadwarp.load(kept)
    assert kept.partial and 0 < kept.photons < PHOTONS and kept.energy_report()["exact"]
    same(simulate(scene(), device="cpu", run=RunOptions(resume=kept)), whole)


@pytest.mark.slow
def test_what_ray_says_of_a_lost_worker_is_not_among_the_results(cluster, tmp_path, monkeypatch):
    killer, file = Killer(1, seed=3), tmp_path / "scene.toml"
    file.write_text(scene().to_toml())
    monkeypatch.setattr(spadwarp.cli.simulate, "progress", lambda: killer)
    options = ("--ray", "start", "--workers", 2, "--photons", PHOTONS, "--set", "output.png=false")
    found = run("simulate", file, "--out", tmp_path / "out", *options)
    assert killer.lost == 1 and "died" in found.stderr and "died" not in found.stdout


@pytest.mark.slow
def test_a_run_can_be_resumed_over_ray(cluster, whole):
    parts = [simulate(scene(), **RUN, device="cpu", run=RunOptions(shard=(n, 5))) for n in (5, 1)]
    gaps = spadwarp.merge(parts)
    same(simulate(scene(), engine=Ray(workers=1), run=RunOptions(resume=gaps)), whole)
    assert gaps.photons < PHOTONS / 2  # untouched


@pytest.mark.slow
def test_the_stopping_rule_is_the_same_over_ray(cluster):
    options = {"photons": 2**20, "seed": 1, "relative_error": 0.1}
    same(simulate(scene(), **options, engine=Ray(workers=1)), simulate(scene(), **options, device="cpu"))


@pytest.mark.slow
def test_an_interrupted_run_over_ray_keeps_what_is_done(cluster, whole):
    def interrupt(stage, done, total):
        if stage == "trace" and done >= 10_000 and not fired:
            fired.append(done)
            signal.raise_signal(signal.SIGINT)

    fired = []
    part = simulate(scene(), photons=10**8, seed=5, engine=Ray(workers=2), progress=interrupt)
    assert part.partial and 10_000 <= part.photons < 10**8 and part.energy_report()["exact"]
    # The photons it has, whichever they are, are those of a local run.
    parts = [
        simulate(scene(), photons=stop - start, seed=5, device="cpu", run=RunOptions(first_photon=start))
        for start, stop in part.photon_ranges
    ]
    assert spadwarp.merge(parts).tallies.tobytes() == part.tallies.tobytes()


def test_workers_and_address_of_ray_are_checked():
    with pytest.raises(spadwarp.ArgumentError, match="workers = 0 is outside"):
        Ray(workers=0)
    with pytest.raises(spadwarp.ArgumentError, match="address = 5 is not text"):
        Ray(address=5)


@pytest.mark.slow
def test_devices_that_ray_does_not_have_are_refused(cluster):
    with pytest.raises(spadwarp.ConfigError, match="cuda:1"):
        simulate(scene(), **RUN, device="cuda:1", engine=Ray())
    with pytest.raises(spadwarp.DeviceError, match="no GPU"):
        simulate(scene(), **RUN, device="cuda", engine=Ray())


@pytest.mark.slow
def test_a_dataset_whose_worker_is_killed_has_the_files_of_a_local_one(cluster, tmp_path):
    small, killer = recipe(**{"frames.per_scene": 1}), Killer(1, seed=3)
    spadwarp.dataset.make_dataset(small, tmp_path / "here", device="cpu")

    def progress(stage, done, total):
        killer("trace" if stage == "frames" else stage, done, total)

    spadwarp.dataset.make_dataset(small, tmp_path / "ray", engine=Ray(workers=2), progress=progress)
    assert killer.lost == 1 and checksums(tmp_path / "ray") == checksums(tmp_path / "here")


# Calls in copies of this process


def test_calls_return_in_order_from_processes_of_their_own():
    held = list(range(100_000))
    calls = [lambda k=k: (k, len(held), os.getpid()) for k in range(3)]
    with Forked(calls) as forked:
        found = forked.results()
    assert [one[:2] for one in found] == [(k, 100_000) for k in range(3)]
    own = {one[2] for one in found}
    assert len(own) == 3 and os.getpid() not in own if sys.platform == "linux" else own == {os.getpid()}


def test_what_fails_in_a_copy_is_made_here():
    here = os.getpid()

    def only_here():
        return "here" if os.getpid() == here else os._exit(3)

    def fails():
        raise ValueError("as it says")

    with Forked([only_here]) as forked:
        assert forked.results() == ["here"]
    with Forked([fails]) as forked, pytest.raises(ValueError, match="as it says"):
        forked.results()


@pytest.mark.skipif(sys.platform != "linux", reason="calls are made here")
def test_none_outlives_its_context(tmp_path, monkeypatch):
    """Nor an interrupt while results are awaited, which is raised as it is."""

    def slow():
        time.sleep(0.5)
        (tmp_path / "late").touch()

    def interrupted(*_):
        raise KeyboardInterrupt

    with pytest.raises(RuntimeError, match="full"), Forked([slow]):
        raise RuntimeError("full")
    monkeypatch.setattr("multiprocessing.connection.Connection.poll", interrupted)
    with pytest.raises(KeyboardInterrupt), Forked([slow, slow]) as forked:
        forked.results()
    time.sleep(0.8)
    assert not (tmp_path / "late").exists()
