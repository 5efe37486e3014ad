"""Processes that make one dataset at the same time: each shard is made once, and nothing is lost."""

import os
import shutil
import signal
from contextlib import ExitStack

import pytest

from helpers.datasets import checksums, make, making
from spadwarp.dataset import verify_dataset
from spadwarp.io.paths import lock


def test_a_shard_that_another_process_makes_is_waited_for(small, whole, tmp_path, monkeypatch):
    two = tmp_path / "two"
    make(small, two, part=(2, 2))
    other = ExitStack()
    other.enter_context(lock(two / "shards" / "00000.lock"))

    def finish(_seconds):
        """What the other process does in the meantime."""
        for name in ("frames-00000.h5", "scenes/scenes-00000.h5", "shards/00000.json"):
            shutil.copy2(whole / name, two / name)
        other.close()

    monkeypatch.setattr("time.sleep", finish)
    make(small, two)
    frames = "frames-00000.h5"
    assert (two / frames).stat().st_mtime_ns == (whole / frames).stat().st_mtime_ns  # not made twice
    assert checksums(two) == checksums(whole) and not verify_dataset(two)


def test_an_interrupt_ends_the_wait(small, tmp_path, monkeypatch):
    place = tmp_path / "data"
    make(small, place, part=(2, 2))
    monkeypatch.setattr("time.sleep", lambda _seconds: signal.raise_signal(signal.SIGINT))
    with lock(place / "shards" / "00000.lock"), pytest.raises(KeyboardInterrupt):
        make(small, place)
    assert not (place / "frames-00000.h5").exists()


@pytest.mark.slow
@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_processes_that_share_a_file_system_make_one_dataset(small, whole, tmp_path, monkeypatch):
    """Calls for the whole and for parts of it, whose processes have the same numbers, as those of containers have."""
    out = tmp_path / "data"
    monkeypatch.setattr("os.getpid", lambda: 1)
    with ExitStack() as stack:
        processes = [stack.enter_context(making(small, out, part=part)) for part in ((1, 1), (1, 1), (2, 2))]
        for process in processes:
            process.join(timeout=120)
        assert [process.exitcode for process in processes] == [0, 0, 0]
    assert checksums(out) == checksums(whole) and not list(out.rglob(".*"))
