"""The command line. A command is a function in one of these files, hung on `app`; importing the file adds it.

Commands use the public API only, and load what is heavy when they run: `spadwarp --help` answers at once.
"""

from spadwarp.cli import bench, dataset, denoise, doctor, exports, inspect, look, plan, reduce, runs, simulate
from spadwarp.cli._app import app, main

__all__ = [
    "app",
    "bench",
    "dataset",
    "denoise",
    "doctor",
    "exports",
    "inspect",
    "look",
    "main",
    "plan",
    "reduce",
    "runs",
    "simulate",
]
