"""Commands of `spadwarp`, in this process or in one of their own."""

import json
import os
import subprocess
import sys
from pathlib import Path

from typer.testing import CliRunner

from spadwarp.cli import app

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (ROOT, ROOT / "kernels")))}
FILES = {"result.h5", "scene.toml", "depth.exr", "truth.exr"}  # of a run without pictures
PICTURES = {"depth.png", "intensity.png", "histogram.png", "truth.png"}
DEVICE = ("--device", "cpu")


def run(*arguments, code=0):
    """One command in this process; its result after its exit code was looked at."""
    outcome = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert outcome.exit_code == code, outcome.output
    return outcome


def start(*arguments, module="spadwarp"):
    """A module, the command line if none is named, in a process of its own."""
    command = [sys.executable, "-m", module, *map(str, arguments)]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, env=ENVIRONMENT)


def tables(path):
    return json.loads(Path(path).read_text())
