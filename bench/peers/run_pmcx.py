"""cube60 on MCX (pmcx, CUDA) and on spadwarp, in one run on one card."""

from _common import options, peer, skip
from _cube60 import measure, settings

if __name__ == "__main__":
    pmcx = peer("pmcx", "pip install pmcx (GPL, needs an NVIDIA GPU)")
    args = options("cube60 on MCX and on spadwarp", photons=10**8)
    try:
        found = pmcx.gpuinfo()
    except RuntimeError:  # without a driver
        found = []
    if not found:
        skip("pmcx sees no NVIDIA GPU")
    measure(pmcx, "pmcx", args, {**settings(args.photons), "gpuid": 1})
