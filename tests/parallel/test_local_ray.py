"""A Ray that spadwarp starts on this machine."""

import subprocess
import sys

import pytest

from helpers.cli import ENVIRONMENT

HOST = """
import os, subprocess, sys
import ray
from spadwarp.parallel import Ray
from spadwarp.parallel.ray import RayWorkers

with RayWorkers(Ray(workers=1), "cpu") as workers:
    while not workers.idle:
        workers.wait(0.5)
    stranger = [sys.executable, "-c", sys.argv[1], ray.get_runtime_context().gcs_address]
    environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}  # without token
    environment["RAY_NUM_REDIS_GET_RETRIES"] = "2"  # attempts, one a second
    print("joined", subprocess.run(stranger, env=environment, capture_output=True, text=True).stdout)
"""
STRANGER = """
import sys
import ray

try:
    ray.init(address=sys.argv[1], log_to_driver=False, logging_level=40)
    print("connected")
except ConnectionError:
    print("refused")
"""


@pytest.mark.slow
def test_nobody_connects_to_it_without_its_token():
    pytest.importorskip("ray")
    command = [sys.executable, "-W", "ignore", "-c", HOST, STRANGER]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=True, timeout=240)
    assert done.stdout.split() == ["joined", "refused"]
