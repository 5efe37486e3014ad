"""The pulsed laser: where photons start and where they go."""

import warp as wp

from .direction import cos_sin_turn, orthonormal_basis, rotate_direction
from .philox import STREAM_EMISSION, random_block, u01, u01_fine

LASER_PROFILES = ("uniform_cone", "gaussian", "collimated")


@wp.struct
class Laser:
    """A laser in camera coordinates.

    Attributes:
        position: Centre of the exit pupil [m].
        axis: Unit vector of the beam.
        profile: Index into LASER_PROFILES.
        spread: 1 - cos of the half angle in [0, 2] (uniform cone), or tan^2 of the 1/e^2 half angle (gaussian).
        radius: Beam radius at the exit [m] (collimated; 0 is a pencil beam).
    """

    position: wp.vec3
    axis: wp.vec3
    profile: int
    spread: float
    radius: float


@wp.func
def emit_photon(laser: Laser, seed: wp.uint64, id: wp.uint64):
    """Start position [m] and unit direction of photon `id`.

    Uniform cone: uniform in solid angle. Gaussian: irradiance exp(-2 tan^2(a)/tan^2(theta)) on a plane across the axis.
    Collimated: uniform over a disc of the given radius.
    """
    block = random_block(seed, id, wp.uint32(0), STREAM_EMISSION)
    xi = u01_fine(block[0])
    azimuth = u01(block[1])
    position = laser.position
    direction = laser.axis
    if laser.profile == 0:
        direction = rotate_direction(laser.axis, laser.spread * xi, azimuth)
    elif laser.profile == 1:
        # tan^2 is exponential; 1 - cos from tan^2 without cancellation: tan^2/((1 + s) s), s = sqrt(1 + tan^2).
        tan2 = -0.5 * laser.spread * wp.log(1.0 - u01(block[0]))
        s = wp.sqrt(1.0 + tan2)
        direction = rotate_direction(laser.axis, tan2 / ((1.0 + s) * s), azimuth)
    else:
        b1, b2 = orthonormal_basis(laser.axis)
        r = laser.radius * wp.sqrt(xi)
        turn = cos_sin_turn(azimuth)
        position = laser.position + (r * turn[0]) * b1 + (r * turn[1]) * b2
    return position, direction
