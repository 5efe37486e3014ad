"""The pulsed laser: where photons start and where they go."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import fill
from spadwarp_kernels.base.philox import STREAM_EMISSION, random_block, u01, u01_fine, u01_open
from spadwarp_kernels.base.rotations import cos_sin_turn, orthonormal_basis, rotate_direction

from .port import Port, PortKind

__all__ = ["LASER_PROFILES", "Laser", "Scan", "emit_photon", "make_laser", "make_sun", "profile_tables"]

LASER_PROFILES = ("uniform_cone", "gaussian", "collimated")


@wp.struct
class Laser:
    """A laser in camera coordinates."""

    position: wp.vec3  # centre of the exit pupil [m]
    axis: wp.vec3  # unit vector of the beam
    profile: int  # index into LASER_PROFILES
    spread: float  # 1 - cos of the half angle, in [0, 2] (uniform cone); part of the light that the sky has (sun)
    tan2: float  # tan^2 of the half angle at which the irradiance is 1/e^2 of that on the axis (gaussian)
    radius: float  # beam radius at the exit [m] (collimated; 0 is a pencil beam)
    rows: wp.array[float]
    """Distribution functions of a measured profile, see `profile_tables`; this and what follows is read by
    `emit_measured` alone."""
    columns: wp.array2d[float]  # likewise
    extent: wp.vec2  # tangents of the profile's half width and half height
    down: wp.vec3  # unit vector into the water, about which the sky is even; this and the next are read by `emit_sun`
    patch: wp.spatial_vector  # edges of the parallelogram over which light is emitted [m]
    port: Port
    """What is between the laser and the water, in the frame of the camera, see `make_flat_port`; read by specs with a
    port of the laser alone."""


def make_laser(
    profile: str,
    *,
    half_angle: float | None = None,
    radius: float | None = None,
    position: Sequence[float] = (0.0, 0.0, 0.0),
    axis: Sequence[float] = (0.0, 0.0, 1.0),
) -> Laser:
    """A laser of one of LASER_PROFILES, in camera coordinates.

    Args:
        profile: "uniform_cone", "gaussian" or "collimated".
        half_angle: Of the cone [rad], up to π, or at which a gaussian beam has 1/e^2 of its irradiance, below π / 2.
        radius: Of a collimated beam [m]; 0 is a pencil beam.
        position: Of its exit pupil [m].
        axis: Of the beam, of any length but 0.

    Raises:
        ArgumentError: A number out of range, or one that the profile does not have.
    """
    check.choice("profile", profile, LASER_PROFILES)
    needed, other = ("radius", half_angle) if profile == "collimated" else ("half_angle", radius)
    value = {"radius": radius, "half_angle": half_angle}[needed]
    if value is None or other is not None:
        raise ArgumentError(f"profile = {profile!r} needs {needed}, and that alone")
    interval = {"uniform_cone": "(0, 3.1416]", "gaussian": "(0, 1.57]", "collimated": "[0, inf)"}[profile]
    value = check.number(needed, value, interval)
    check.vector("position", position)
    check.vector("axis", axis)
    length = math.hypot(*axis)
    check.number("length of axis", length, "(0, inf)")
    laser = fill(Laser(), position=position, axis=[x / length for x in axis], profile=LASER_PROFILES.index(profile))
    if profile == "collimated":
        return fill(laser, radius=value)
    if profile == "gaussian":
        return fill(laser, tan2=math.tan(value) ** 2)
    return fill(laser, spread=2.0 * math.sin(0.5 * min(value, math.pi)) ** 2)


@wp.func
def emit_photon(laser: Laser, axis: wp.vec3, seed: wp.uint64, id: wp.uint64):
    """Start position [m] and unit direction of photon `id` from a laser turned to an axis of its own; no measured
    profile.

    Uniform cone: uniform in solid angle. Gaussian: irradiance exp(-2 tan^2(a)/tan^2(theta)) on a plane across the axis.
    Collimated: uniform over a disc of the given radius.
    """
    block = random_block(seed, id, wp.uint32(0), STREAM_EMISSION)
    xi = u01_fine(block[0])
    azimuth = u01(block[1])
    position = laser.position
    direction = axis
    if laser.profile == 0:
        direction = rotate_direction(axis, laser.spread * xi, azimuth)
    elif laser.profile == 1:
        # tan^2 is exponential; 1 - cos from tan^2 without cancellation: tan^2/((1 + s) s), s = sqrt(1 + tan^2).
        tan2 = -0.5 * laser.tan2 * wp.log(u01_open(block[0]))
        s = wp.sqrt(1.0 + tan2)
        direction = rotate_direction(axis, tan2 / ((1.0 + s) * s), azimuth)
    else:
        b1, b2 = orthonormal_basis(axis)
        r = laser.radius * wp.sqrt(xi)
        turn = cos_sin_turn(azimuth)
        position = laser.position + (r * turn[0]) * b1 + (r * turn[1]) * b2
    return position, direction


def profile_tables(image: ArrayLike) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Distribution functions from which `emit_measured` draws a pixel of a beam profile.

    Args:
        image: Irradiance on a plane across the beam, `[H, W]`, any unit, >= 0, finite, not all 0.

    Returns:
        float32 `[H]`, the part of the power in the rows up to each; float32 `[H, W]`, the same along each row. The last
        entries are 1.

    Raises:
        ArgumentError: Another shape, or values that cannot be.
    """
    power = check.numbers("profile", image, (None, None), "[0, inf)")
    if not power.any():
        raise ArgumentError("profile: one value above 0 is needed")
    power = power / power.max()
    rows = np.cumsum(power.sum(axis=1))
    columns = np.cumsum(power, axis=1)
    total = columns[:, -1:]
    columns = np.divide(columns, total, out=np.ones_like(columns), where=total > 0)
    return (rows / rows[-1]).astype(np.float32), columns.astype(np.float32)


@wp.func
def beam_frame(axis: wp.vec3):
    """Right and down of a beam's profile: as the camera's x and y for a beam along z, right always level with x-z."""
    right = wp.vec3(axis[2], 0.0, -axis[0])
    level = wp.length(right)
    right = wp.where(level > 1.0e-6, right / wp.max(level, 1.0e-6), wp.vec3(1.0, 0.0, 0.0))
    return right, wp.cross(axis, right)


@wp.func
def first_above(table: wp.array[float], u: float) -> int:
    """Index of the first entry above u of a rising table, of the last if there is none."""
    low = int(0)
    high = int(table.shape[0] - 1)
    while low < high:
        middle = (low + high) / 2
        if table[middle] > u:
            high = middle
        else:
            low = middle + 1
    return low


@wp.func
def emit_measured(laser: Laser, axis: wp.vec3, seed: wp.uint64, id: wp.uint64):
    """Start position [m] and unit direction of photon `id` from a laser with a measured profile, the irradiance across
    the axis: a pixel is drawn by its power and a point evenly in it."""
    block = random_block(seed, id, wp.uint32(0), STREAM_EMISSION)
    row = first_above(laser.rows, u01(block[0]))
    column = first_above(laser.columns[row], u01(block[1]))
    x = 2.0 * (float(column) + u01(block[2])) / float(laser.columns.shape[1]) - 1.0
    y = 2.0 * (float(row) + u01(block[3])) / float(laser.columns.shape[0]) - 1.0
    right, down = beam_frame(axis)
    return laser.position, wp.normalize(axis + (x * laser.extent[0]) * right + (y * laser.extent[1]) * down)


# ---- Sun and sky above a sea.


# Height of the emission above the surface, relative to its distance from the origin, and at least [m]: in single
# precision it is above.
_ABOVE = 1e-5


def make_sun(
    direction: Sequence[float],
    *,
    down: Sequence[float],
    distance: float,
    sky: float = 0.0,
    patch: Sequence[Sequence[float]] = ((0.0, 0.0, 0.0), (0.0, 0.0, 0.0)),
    crest: float = 0.0,
) -> Laser:
    """The light of sun and sky above the surface of a sea, of a spec with `sun`.

    An emitted photon stands for the irradiance on the mean plane, in the air. All are emitted at one point: in water
    that is the same along the surface a plane anywhere gets from it what a unit of its area gets from a beam without
    bounds. Over waves they come from a patch, which two edges span [m], as of their period.

    `direction`: in which the sun's light goes in the air, of any length; `down`: unit vector into the water;
    `distance` of the mean plane from the origin along it [m]; `sky`: part of the irradiance, in [0, 1], of a sky of
    even radiance; `crest`: height of the highest wave above the mean plane [m]. Raises `ArgumentError`, also for a sun
    below the horizon.
    """
    check.vector("down", down, unit=True)
    height = max(_ABOVE, _ABOVE * abs(check.number("distance", distance, "(-inf, inf)")))
    height += check.number("crest", crest, "[0, inf)")
    position = (distance - height) * check.numbers("down", down, (3,))
    laser = make_laser("collimated", radius=0.0, axis=direction, position=position)
    spread = check.number("sky", sky, "[0, 1]")
    fill(laser, down=down, patch=check.numbers("patch", patch, (2, 3)).ravel(), spread=spread)
    check.number("cosine of direction to down", float(wp.dot(laser.axis, laser.down)), "(0, 1.000001]")
    return laser


@wp.func
def emit_sun(laser: Laser, axis: wp.vec3, seed: wp.uint64, id: wp.uint64):
    """Start position [m] and unit direction of photon `id` in the air, by the share of its direction in the
    irradiance."""
    block = random_block(seed, id, wp.uint32(0), STREAM_EMISSION)
    direction = axis
    if u01(block[2]) < laser.spread:
        direction = rotate_direction(laser.down, 1.0 - wp.sqrt(u01_open(block[0])), u01(block[1]))
    a = float(block[3] >> wp.uint32(16)) / 65536.0
    b = float(block[3] & wp.uint32(0xFFFF)) / 65536.0
    return laser.position + a * wp.spatial_top(laser.patch) + b * wp.spatial_bottom(laser.patch), direction


# ---- Positions that beam and pixel, or laser and camera, visit together.


@wp.struct
class Scan:
    """Positions that laser and pixel visit together: photon id belongs to position id mod `count`."""

    count: int  # number of positions; position i is scored into pixel i, or the row i of a receiver's pixels
    axis: wp.array[wp.vec3]  # unit vector of the beam at each
    view: wp.array[wp.vec4]
    """Tangents (left, top, right, bottom) of what each position's pixel sees; a box that holds it."""
    pose: wp.array[wp.transform]
    """From the frame of camera and laser at each shot to the frame of all else. With the lens `SCANNED`, which reads
    this alone: `Laser.axis` and `Camera.view` are those of every shot."""


class Pose(NamedTuple):
    """Into the frame of camera and laser at a position of the scan, and out of it: Warp functions
    ``(scan, target, vec3) -> vec3`` of points [m] and of directions. Where nothing moves they change nothing."""

    point_in: wp.Function
    turn_in: wp.Function
    point_out: wp.Function
    turn_out: wp.Function


@memoised
def make_pose(moves: bool) -> Pose:
    """Of positions with a pose each, or of none."""

    @wp.func
    def point_in(scan: Scan, target: int, x: wp.vec3) -> wp.vec3:
        return wp.transform_point(wp.transform_inverse(scan.pose[target]), x) if wp.static(moves) else x

    @wp.func
    def turn_in(scan: Scan, target: int, u: wp.vec3) -> wp.vec3:
        return wp.quat_rotate_inv(wp.transform_get_rotation(scan.pose[target]), u) if wp.static(moves) else u

    @wp.func
    def point_out(scan: Scan, target: int, x: wp.vec3) -> wp.vec3:
        return wp.transform_point(scan.pose[target], x) if wp.static(moves) else x

    @wp.func
    def turn_out(scan: Scan, target: int, u: wp.vec3) -> wp.vec3:
        return wp.normalize(wp.transform_vector(scan.pose[target], u)) if wp.static(moves) else u

    return Pose(point_in, turn_in, point_out, turn_out)


class Beam(NamedTuple):
    """How photons start, as Warp functions."""

    emit: wp.Function
    """``(laser, scan, seed, id) -> spatial_vector``: start [m], then unit direction, in the frame of the camera."""
    axis: wp.Function  # ``(laser, scan, target) -> vec3``, the beam's, for a position of the scan
    port: PortKind | None  # what is between the laser and the water
    scans: bool
    pose: Pose


@memoised
def make_beam(measured: bool, port: PortKind | None, scans: bool, moves: bool = False, sun: bool = False) -> Beam:
    """The beam of a spec."""
    emit_from = emit_sun if sun else emit_measured if measured else emit_photon

    @wp.func
    def axis(laser: Laser, scan: Scan, target: int) -> wp.vec3:
        return scan.axis[target] if wp.static(scans and not moves) else laser.axis

    @wp.func
    def emit(laser: Laser, scan: Scan, seed: wp.uint64, id: wp.uint64) -> wp.spatial_vector:
        target = int(-1)
        if wp.static(scans):
            target = int(id % wp.uint64(scan.count))
        start, heading = emit_from(laser, axis(laser, scan, target), seed, id)
        return wp.spatial_vector(start, heading)

    return Beam(emit, axis, port, scans, make_pose(moves))
