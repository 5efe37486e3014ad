"""Arguments of a kernel that its threads read again and again."""

import warp as wp


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // Plus 0 in a launch along one axis, which the compiler does not know.
    return word + (gridDim.y - 1u);
#else
    return word;
#endif
""")
def held_word(word: wp.uint32) -> wp.uint32:
    """The word, in a register that the warp shares from here on: else a compiler for CUDA reads an argument anew by an
    instruction wherever it is used."""
    ...
