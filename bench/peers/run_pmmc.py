"""cube60 on MMC (pmmc: tetrahedra, OpenCL or CUDA) and on spadwarp, in one run."""

import os
import sys
from itertools import permutations
from typing import Any

import numpy as np
from _common import options, peer
from _cube60 import measure, opencl_device


def cube(side: float) -> tuple[np.ndarray, np.ndarray]:
    """A cube as six tetrahedra (Kuhn's): nodes [8, 3] and 1-based elements [6, 4] of positive volume."""
    nodes = np.array([[x, y, z] for x in (0.0, side) for y in (0.0, side) for z in (0.0, side)])
    elements = []
    for order in permutations(range(3)):
        corners = np.cumsum(np.vstack([np.zeros(3, int), np.eye(3, dtype=int)[list(order)]]), axis=0)
        element = corners @ [4, 2, 1]
        if np.linalg.det(nodes[element[1:]] - nodes[element[0]]) < 0:
            element[[2, 3]] = element[[3, 2]]
        elements.append(element + 1)
    return nodes, np.array(elements)


def settings(photons: int) -> dict[str, Any]:
    """Lengths in mm. The source stands a little inside the cube: MMC has to find the tetrahedron that holds it."""
    nodes, elements = cube(60.0)
    return {
        "nphoton": photons,
        "node": nodes,
        "elem": elements,
        "elemprop": np.ones(len(elements), int),
        "prop": [[0.0, 0.0, 1.0, 1.0], [0.005, 1.0, 0.01, 1.37]],
        "srcpos": [29.0, 29.1, 0.001],
        "srcdir": [0.0, 0.0, 1.0],
        "tstart": 0.0,
        "tend": 5e-9,
        "tstep": 5e-9,
        "isreflect": 0,
        "issavedet": 0,
        "seed": 29012392,
    }


if __name__ == "__main__":
    pmmc = peer("pmmc", "pip install pmmc (GPL, needs an OpenCL driver or an NVIDIA GPU)")
    args = options("cube60 on MMC and on spadwarp", photons=10**6)
    number = opencl_device(pmmc, "pmmc", args.device == "cpu")
    measure(pmmc, "pmmc", args, {**settings(args.photons), "gpuid": number})
    # MMC prints its own report when the process ends; the numbers above are complete without it.
    sys.stdout.flush()
    os.dup2(os.open(os.devnull, os.O_WRONLY), 1)
