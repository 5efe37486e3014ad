"""The scattering medium and the free flight through it."""

import math

import numpy as np
import warp as wp

from spadwarp_kernels.base.rotations import OFF_AXIS
from spadwarp_kernels.base.tables import DensityTables

__all__ = ["Medium", "free_path"]


@wp.struct
class Medium:
    """One water: all there is, or with `Layers` what they share.

    Attributes:
        extinction: c = a + b [1/m], >= 0; 0 is vacuum.
        albedo: Single-scattering albedo b/c in [0, 1]; with random_albedo, the upper end of the uniform draw.
        anisotropy: Mean cosine g of the Henyey-Greenstein phase function, in (-1, 1).
        axis_threshold: |u_z| from which a scattering takes u for the z axis (the near-axis rule), in (0, 1]; 1
            switches it off, and functions of your own that the transport kernel calls then see 2.
        per_bit: -ln(2)/c [m], 0 in vacuum; filled by `launch_transport`.
        phase: Of the phase function TABULATED, from `make_phase_tables`; left alone otherwise.
    """

    extinction: float
    albedo: float
    anisotropy: float
    axis_threshold: float
    per_bit: float
    phase: DensityTables


def ready_medium(medium: Medium) -> Medium:
    """A copy for a kernel: a threshold of 1 is OFF_AXIS, and `per_bit` is filled."""
    copy = Medium()
    for name in Medium.vars:
        setattr(copy, name, getattr(medium, name))
    copy.axis_threshold = medium.axis_threshold if np.float32(medium.axis_threshold) < 1.0 else OFF_AXIS
    copy.per_bit = -math.log(2.0) / medium.extinction if medium.extinction > 0.0 else 0.0
    return copy


@wp.func
def free_path(xi: float, extinction: float) -> float:
    """Free flight [m] = -ln(xi)/c for uniform xi in (0, 1], from `u01_tail` (eq 12, 13); its mean is 1/c. Infinite
    (1e30) in vacuum."""
    if extinction <= 0.0:
        return 1.0e30
    return -wp.log(xi) / extinction


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return medium.per_bit < 0.0f ? __log2f(xi) * medium.per_bit : 1.0e30f;
#else
    return medium.extinction > 0.0f ? -wp::log(xi) / medium.extinction : 1.0e30f;
#endif
""")
def ready_free_path(xi: float, medium: Medium) -> float:
    """`free_path` in a medium from `ready_medium`."""
    ...
