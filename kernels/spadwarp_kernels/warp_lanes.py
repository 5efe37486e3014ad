"""The lanes of a CUDA warp; on the CPU a warp has one lane."""

import warp as wp


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __popc(__ballot_sync(0xffffffffu, condition));
#else
    return condition ? 32 : 0;
#endif
""")
def count_lanes(condition: bool) -> int:
    """Number of lanes, out of 32, in which the condition holds; every lane of the warp must take part, and all meet
    here."""
    ...
