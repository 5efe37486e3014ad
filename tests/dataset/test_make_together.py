"""Processes that make one dataset at the same time: each shard is made once, and nothing is lost."""

import shutil
import subprocess
import sys
import threading
from contextlib import ExitStack

import pytest

from helpers.cli import ENVIRONMENT
from helpers.datasets import checksums, make, recipe, written
from spadwarp.dataset import make as making
from spadwarp.dataset import verify_dataset
from spadwarp.io.paths import lock

SMALL = {"frames.per_scene": 1}
MAKE = """
import sys, spadwarp
part = tuple(map(int, sys.argv[3].split("/")))
spadwarp.dataset.make_dataset(spadwarp.dataset.load_recipe(sys.argv[1]), sys.argv[2], device="cpu", part=part)
"""


def test_a_shard_that_another_process_makes_is_waited_for(tmp_path, monkeypatch):
    one, two, small = tmp_path / "one", tmp_path / "two", recipe(**SMALL)
    make(small, one)
    make(small, two, part=(2, 2))
    other = ExitStack()
    other.enter_context(lock(two / "shards" / "00000.lock"))

    def finish(_seconds):
        """What the other process does in the meantime."""
        for name in ("frames-00000.h5", "scenes/scenes-00000.h5", "shards/00000.json"):
            shutil.copy(one / name, two / name)
        other.close()

    made, write_shard = [], making.write_shard
    monkeypatch.setattr("time.sleep", finish)
    monkeypatch.setattr(
        making,
        "write_shard",
        lambda plan, shard, *a, **k: made.append(shard.index) or write_shard(plan, shard, *a, **k),
    )
    make(small, two)
    assert made == [2, 4]
    assert checksums(two) == checksums(one) and not verify_dataset(two)


def test_an_interrupt_ends_the_wait(tmp_path):
    small, place = recipe(**SMALL), tmp_path / "data"
    make(small, place, part=(2, 2))
    stopped = threading.Event()
    stopped.set()
    with lock(place / "shards" / "00000.lock"):
        job = making._Job(small, place, 0)
        assert making._make_shard(job, making.Worker("cpu", stopped=stopped)) == 0
    assert not (place / "frames-00000.h5").exists()


def containers():
    """The start of a command that gives it numbers of processes of its own, as a container has; none if not allowed."""
    command = ("unshare", "--pid", "--fork")
    try:
        subprocess.run([*command, "true"], check=True, capture_output=True, timeout=10)
    except (OSError, subprocess.SubprocessError):
        return ()
    return command


@pytest.mark.slow
def test_containers_that_share_a_file_system_make_one_dataset(tmp_path):
    """Calls for the whole and for parts of it, whose processes have the same numbers."""
    small, out, start = recipe(**SMALL), tmp_path / "data", containers()
    command = [*start, sys.executable, "-c", MAKE, str(written(small, tmp_path)), str(out)]
    processes = [
        subprocess.Popen([*command, part], env=ENVIRONMENT, stderr=subprocess.PIPE, text=True)
        for part in ("1/1", "1/1", "2/2")
    ]
    assert [(process.communicate(timeout=300)[1], process.returncode) for process in processes] == [("", 0)] * 3
    make(small, tmp_path / "alone")
    assert checksums(out) == checksums(tmp_path / "alone") and not list(out.rglob(".*"))
