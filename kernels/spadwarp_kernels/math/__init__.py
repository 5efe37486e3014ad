"""Directions and bits."""

from .bits import bits_of, from_bits
from .rotations import cos_sin_turn, cotangent, one_minus_cosine, orthonormal_basis, rotate_direction, snap_direction

__all__ = [
    "bits_of",
    "cos_sin_turn",
    "cotangent",
    "from_bits",
    "one_minus_cosine",
    "orthonormal_basis",
    "rotate_direction",
    "snap_direction",
]
