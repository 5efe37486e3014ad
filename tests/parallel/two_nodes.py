"""A run on two nodes of a Ray cluster, one of which is removed in the middle; for a process of its own."""

import sys
import warnings

import numpy as np
from ray.cluster_utils import Cluster

import spadwarp
from helpers.scenes import scene
from spadwarp.parallel import Ray

RUN = {"photons": 1_500_000, "seed": 5}


def main():
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

    found = spadwarp.simulate(scene(), **RUN, engine=Ray(cluster.address, workers=2), progress=progress)
    cluster.shutdown()
    alone = spadwarp.simulate(scene(), **RUN, device="cpu")
    assert removed, remarks
    assert any(remark.startswith("lost the worker") for remark in remarks), remarks
    assert np.array_equal(found.tallies, alone.tallies) and found.energy_balance == alone.energy_balance
    assert not found.partial and found.photons == RUN["photons"]
    print("same bits")


if __name__ == "__main__":
    warnings.simplefilter("ignore")
    sys.exit(main())
