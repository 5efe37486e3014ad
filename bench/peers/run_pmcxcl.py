"""cube60 on MCX-CL (pmcxcl, OpenCL: GPUs and CPUs) and on spadwarp, in one run."""

from _common import peer, skip
from _cube60 import measure

if __name__ == "__main__":
    pmcxcl = peer("pmcxcl", "pip install pmcxcl (GPL, needs an OpenCL driver)")
    try:
        found = pmcxcl.gpuinfo()
    except RuntimeError as error:
        skip(f"pmcxcl finds no OpenCL device ({error})")
    if not found:
        skip("pmcxcl finds no OpenCL device")
    print(f"pmcxcl on {found[0]['name']}")
    measure(pmcxcl, "pmcxcl", photons=10**6)
