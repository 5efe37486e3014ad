"""Damaged files, odd command lines and beginners' arguments end with an answer or an error in words."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from fuzz.isolation import run_isolated

RUN = Path(__file__).with_name("run.py")


pytestmark = pytest.mark.skipif(not hasattr(os, "fork"), reason="cases run in forked processes")


@pytest.mark.slow
def test_damaged_files_and_odd_commands(request, tmp_path):
    """`--fuzz N` runs N cases. Each is the same every time: `run.py 1 --first NUMBER` repeats one."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(filter(None, sys.path))}
    command = [sys.executable, str(RUN), str(request.config.getoption("--fuzz"))]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    print(done.stdout)
    assert done.returncode == 0, f"{done.stdout}\n{done.stderr[-6000:]}"


@pytest.mark.parametrize(
    ("call", "kind", "value"),
    [
        (lambda: 3, "done", 3),
        (lambda: 1 // 0, "traceback", "ZeroDivisionError"),
        (lambda: os.abort(), "crash", "SIGABRT"),
        (lambda: bytearray(4 << 30), "traceback", "MemoryError"),
        (lambda: os._exit(7), "crash", "exit 7"),
    ],
)
def test_the_harness_sees_how_a_call_ends(call, kind, value):
    outcome = run_isolated(call)
    assert (outcome.kind, outcome.value) == (kind, value), outcome


def test_the_harness_ends_what_hangs():
    assert run_isolated(lambda: os.read(os.pipe()[0], 1), patience=0.3).kind == "hang"
