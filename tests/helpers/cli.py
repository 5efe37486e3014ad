"""Commands of `spadwarp`, in this process or in one of their own."""

import contextlib
import json
import os
import subprocess
import sys
from pathlib import Path

from typer.testing import CliRunner

from spadwarp.cli import app

ROOT = Path(__file__).parents[2]
QUICK = Path(__file__).with_name("quick")
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (QUICK, ROOT, ROOT / "kernels")))}
FILES = {"result.h5", "scene.toml", "depth.exr", "truth.exr"}  # of a run without pictures
PICTURES = {"depth.png", "intensity.png", "histogram.png", "truth.png"}
DEVICE = ("--device", "cpu")


def run(*arguments, code=0):
    """One command in this process; its result after its exit code was looked at."""
    outcome = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert outcome.exit_code == code, outcome.output
    return outcome


_started = []


def start(*arguments, module="spadwarp"):
    """A module, the command line if none is named, in a process of its own."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    options = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True, "env": ENVIRONMENT}
    _started.append(subprocess.Popen(command, **options))
    return _started[-1]


def end_started():
    """Ends what still runs of them, for a test that failed."""
    while _started:
        with _started.pop() as process:
            process.kill()


@contextlib.contextmanager
def small_files(size):
    """A limit on the size of files stands for the full disk: writing beyond it fails in the middle of a file."""
    import resource

    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (size, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


def tables(path):
    return json.loads(Path(path).read_text())
