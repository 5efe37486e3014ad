"""cube60 on MCX-CL (pmcxcl, OpenCL: GPUs and CPUs) and on spadwarp, in one run."""

from _common import options, peer
from _cube60 import CPU_OPTIONS, measure, opencl_device, settings

if __name__ == "__main__":
    pmcxcl = peer("pmcxcl", "pip install pmcxcl (GPL, needs an OpenCL driver)")
    args = options("cube60 on MCX-CL and on spadwarp", photons=10**6)
    cpu = args.device == "cpu"
    chosen = {"gpuid": opencl_device(pmcxcl, "pmcxcl", cpu), **(CPU_OPTIONS if cpu else {})}
    measure(pmcxcl, "pmcxcl", args, {**settings(args.photons), **chosen})
