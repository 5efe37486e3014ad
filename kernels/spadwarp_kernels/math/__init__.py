"""Directions, bits and memory; what is made once."""

from .bits import bits_of, from_bits
from .float64 import expm1, log1p, normal_cdf, one_minus_exp
from .memory import zeros
from .once import made_once
from .rotations import (
    cos_sin_turn,
    cotangent,
    one_minus_cosine,
    orthonormal_basis,
    rotate_direction,
    set_apart,
    snap_direction,
)

__all__ = [
    "bits_of",
    "cos_sin_turn",
    "cotangent",
    "expm1",
    "from_bits",
    "log1p",
    "made_once",
    "normal_cdf",
    "one_minus_cosine",
    "one_minus_exp",
    "orthonormal_basis",
    "rotate_direction",
    "set_apart",
    "snap_direction",
    "zeros",
]
