"""cube60 on MCX-CL (pmcxcl, OpenCL: GPUs and CPUs) and on spadwarp, in one run."""

from _common import options, peer, skip, told
from _cube60 import device_of, measure, settings

if __name__ == "__main__":
    pmcxcl = peer("pmcxcl", "pip install pmcxcl (GPL, needs an OpenCL driver)")
    args = options("cube60 on MCX-CL and on spadwarp", photons=10**6)
    try:
        with told():
            found = pmcxcl.gpuinfo()
    except RuntimeError as error:
        skip(f"pmcxcl finds no OpenCL device ({error})")
    if not found:
        skip("pmcxcl finds no OpenCL device")
    number = device_of(found, args.device == "cpu")
    print(f"pmcxcl on {found[number - 1]['name']}")
    measure(pmcxcl, "pmcxcl", args, {**settings(args.photons), "gpuid": number})
