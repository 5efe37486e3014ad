"""Calls in copies of this process."""

import os
import sys
import time

import pytest

from spadwarp.parallel import Forked

pytestmark = pytest.mark.fast


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
