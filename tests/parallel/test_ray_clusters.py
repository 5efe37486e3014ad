"""Ray that spadwarp starts on this machine, and Ray over two nodes, one of which is lost."""

import os
import subprocess
import sys
import warnings

import numpy as np
import pytest

import spadwarp
from helpers.cli import ENVIRONMENT, ROOT
from helpers.scenes import scene
from spadwarp.parallel import Ray

pytestmark = [pytest.mark.slow, pytest.mark.skipif(os.name != "posix", reason="removes a node by a signal")]

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


def output_of(*command):
    """Of a Python process of its own."""
    pytest.importorskip("ray")
    path = os.pathsep.join([ENVIRONMENT["PYTHONPATH"], str(ROOT / "tests")])
    options = {"env": {**ENVIRONMENT, "PYTHONPATH": path}, "capture_output": True, "text": True, "timeout": 400}
    process = subprocess.run([sys.executable, "-W", "ignore", *command], **options)
    assert process.returncode == 0, process.stderr[-3000:]
    return process.stdout


def test_nobody_connects_to_it_without_its_token():
    assert output_of("-c", HOST, STRANGER).split() == ["joined", "refused"]


def test_a_run_that_loses_a_node_has_the_bits_of_a_local_one():
    assert "same bits" in output_of(__file__)


def main():
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "object_store_memory": 100 << 20})
    second = cluster.add_node(num_cpus=1, object_store_memory=100 << 20)
    cluster.wait_for_nodes()
    remarks, removed = [], []

    def progress(stage, done, total):
        if stage != "trace":
            remarks.append(stage)
        joined = sum(remark.startswith("worker ") for remark in remarks)
        if not removed and joined == 2 and 0 < done < total:
            removed.append(done)
            cluster.remove_node(second, allow_graceful=False)

    run = {"photons": 1_500_000, "seed": 5}
    found = spadwarp.simulate(scene(), **run, engine=Ray(cluster.address, workers=2), progress=progress)
    cluster.shutdown()
    alone = spadwarp.simulate(scene(), **run, device="cpu")
    assert removed, remarks
    assert any(remark.startswith("lost the worker") for remark in remarks), remarks
    assert np.array_equal(found.tallies, alone.tallies) and found.energy_balance == alone.energy_balance
    assert not found.partial and found.photons == run["photons"]
    print("same bits")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    main()
