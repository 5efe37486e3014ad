"""The Lambertian surface: its reflectance distribution, and directions drawn from it."""

import warp as wp

from spadwarp_kernels.math.rotations import rotate_direction

_INV_PI = wp.constant(0.3183098861837907)


@wp.func
def lambert_brdf(reflectance: float) -> float:
    """Lambertian f = reflectance/pi [1/sr]; times cos(theta_out) it is the density per steradian of the reflected
    weight."""
    return reflectance * _INV_PI


@wp.func
def sample_cosine_law(xi: float) -> float:
    """t = 1 - cos(theta) of the angle to the normal, drawn from cos(theta)/pi [1/sr], for uniform xi in [0, 1)."""
    return xi / (1.0 + wp.sqrt(1.0 - xi))


@wp.func
def sample_lambert(normal: wp.vec3, xi1: float, xi2: float) -> wp.vec3:
    """A unit vector about the unit normal with density cos(theta)/pi, for uniform xi1, xi2 in [0, 1)."""
    return rotate_direction(normal, sample_cosine_law(xi1), xi2)
