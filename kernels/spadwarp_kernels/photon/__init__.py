"""The lanes of a CUDA warp that carry the photons."""

from .lanes import BLOCK_SIZE, count_lanes

__all__ = [
    "BLOCK_SIZE",
    "count_lanes",
]
