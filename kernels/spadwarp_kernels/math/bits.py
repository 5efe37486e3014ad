"""The bits of floats as integers, and back."""

import warp as wp


@wp.func_native("""
    union { float number; int bits; } both;
    both.number = number;
    return both.bits;
""")
def bits_of(number: float) -> int:
    """The int32 with the bits of a float32."""
    ...


@wp.func_native("""
    union { float number; int bits; } both;
    both.bits = bits;
    return both.number;
""")
def from_bits(bits: int) -> float:
    """The float32 with the bits of an int32; to be moved and not to be computed with."""
    ...
