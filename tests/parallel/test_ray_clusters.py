"""Ray over two nodes, one of which is lost, and Ray that spadwarp starts on this machine."""

import contextlib
import os
import subprocess
import sys
import warnings

import numpy as np
import pytest

import spadwarp
from helpers.cli import ENVIRONMENT, ROOT
from helpers.scenes import scene
from spadwarp.parallel.workers import Ray, RayWorkers

STRANGER = """
import sys
import ray

try:
    ray.init(address=sys.argv[1], log_to_driver=False, logging_level=40)
    print("connected")
except ConnectionError:
    print("refused")
"""

NODE = {"num_cpus": 1, "num_gpus": 0, "object_store_memory": 100 << 20}


@pytest.mark.slow
@pytest.mark.skipif(os.name != "posix", reason="removes a node by a signal")
def test_a_lost_node_costs_no_bit_and_nobody_connects_without_the_token():
    """In a process of its own: that of the tests has its own Ray."""
    pytest.importorskip("ray")
    path = os.pathsep.join([ENVIRONMENT["PYTHONPATH"], str(ROOT / "tests")])
    options = {"env": {**ENVIRONMENT, "PYTHONPATH": path}, "capture_output": True, "text": True, "timeout": 400}
    process = subprocess.run([sys.executable, "-W", "ignore", __file__], **options)
    assert process.stdout.split("\n")[:-1] == ["same bits", "refused"], process.stdout + process.stderr[-3000:]


def lose_a_node():
    from ray.cluster_utils import Cluster

    cluster = Cluster(initialize_head=True, head_node_args=NODE)
    second = cluster.add_node(**NODE)
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
    with contextlib.redirect_stdout(sys.stderr):  # Ray reports the lost node there
        found = spadwarp.simulate(scene(), **run, engine=Ray(cluster.address, workers=2), progress=progress)
    cluster.shutdown()
    alone = spadwarp.simulate(scene(), **run, device="cpu")
    assert removed and any(remark.startswith("lost the worker") for remark in remarks), remarks
    assert np.array_equal(found.tallies, alone.tallies) and found.energy_balance == alone.energy_balance
    assert not found.partial and found.photons == run["photons"]
    print("same bits")


def meet_a_stranger():
    import ray

    with RayWorkers(Ray(workers=1), "cpu") as workers:
        while not workers.idle:
            workers.wait(0.5)
        stranger = [sys.executable, "-c", STRANGER, ray.get_runtime_context().gcs_address]
        environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_")}  # no token
        environment["RAY_NUM_REDIS_GET_RETRIES"] = "2"  # attempts, one a second
        print(subprocess.run(stranger, env=environment, capture_output=True, text=True).stdout, end="")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    lose_a_node()
    meet_a_stranger()
