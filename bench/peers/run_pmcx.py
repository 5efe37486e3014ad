"""cube60 on MCX (pmcx, CUDA) and on spadwarp, in one run on one card."""

from _common import peer, skip
from _cube60 import measure

if __name__ == "__main__":
    pmcx = peer("pmcx", "pip install pmcx (GPL, needs an NVIDIA GPU)")
    try:
        found = pmcx.gpuinfo()
    except RuntimeError:  # without a driver
        found = []
    if not found:
        skip("pmcx sees no NVIDIA GPU")
    measure(pmcx, "pmcx", photons=10**8)
