"""Where photons may be: the box of the water, the limits that end a history, and faces that reflect light as the
boundary of two media does.

Faces have the numbers of EXIT_FACES: 1 ... 6 for x_low ... z_high; directions and points are in the domain's own axes.
A chain of reflections between parallel faces alternates, and one of all faces is given by three integers: how many
there are across x, y and z, with the sign of the face that light meets last. With mirror images of the domain beside
each other, such a way is a straight line from the image of its point in the cell of that number, whatever the order in
which it meets the faces, and crosses each on the face.
"""

import itertools
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import fill

__all__ = ["Boundary", "Limits", "make_boundary"]


@wp.struct
class Boundary:
    """How the faces of the domain reflect, made by `make_boundary`."""

    low: wp.vec3  # phase index outside over that of the water, by axis; 0 where all light leaves
    high: wp.vec3  # likewise
    images: wp.array[wp.vec3i]
    """Numbers of reflections across each axis, signed by the last face, of the ways that next events take beside the
    straight one."""
    max_reflections: int  # reflections of the longest of them


@wp.func
def fresnel_reflectance(cosine: float, index: float) -> float:
    """Fraction of unpolarised light that a boundary reflects, for the cosine in [0, 1] to its normal and the index
    behind it over that before it; 1 beyond the critical angle."""
    behind2 = index * index - (1.0 - cosine * cosine)
    if behind2 <= 0.0:
        return 1.0
    behind = wp.sqrt(behind2)  # index times the cosine behind
    s = (cosine - behind) / (cosine + behind)
    # Both sides over the index squared, which may be very large.
    along = behind / index
    p = (cosine - along / index) / (cosine + along / index)
    return 0.5 * (s * s + p * p)


@wp.func
def face_index(boundary: Boundary, face: int) -> float:
    """Index outside a face over that of the water; 0 where it lets all light out, as does face 0."""
    index = float(0.0)
    if face > 0:
        axis = (face - 1) // 2
        index = wp.where(face % 2 == 0, boundary.high[axis], boundary.low[axis])
    return index


@wp.func
def flipped(u: wp.vec3, axis: int) -> wp.vec3:
    """u with the sign of one component changed."""
    v = wp.vec3(u[0], u[1], u[2])
    v[axis] = -v[axis]
    return v


@wp.func
def image_point(lower: wp.vec3, upper: wp.vec3, image: wp.vec3i, x: wp.vec3) -> wp.vec3:
    """Where a point of the domain [m] is seen after the reflections of an image."""
    seen = wp.vec3()
    for i in range(3):
        number = image[i]
        size = upper[i] - lower[i]
        if number % 2 == 0:
            seen[i] = x[i] + float(number) * size
        elif number > 0:
            seen[i] = 2.0 * upper[i] - x[i] + float(number - 1) * size
        else:  # a face without its opposite is met once
            seen[i] = 2.0 * lower[i] - x[i] + float(number + 1) * size
    return seen


@wp.func
def image_direction(image: wp.vec3i, u: wp.vec3) -> wp.vec3:
    """A direction at the point as it is at its image, and the other way round."""
    v = wp.vec3()
    for i in range(3):
        v[i] = wp.where(image[i] % 2 == 0, u[i], -u[i])
    return v


@wp.func
def reflections_of(image: wp.vec3i) -> int:
    """How many reflections an image has."""
    return wp.abs(image[0]) + wp.abs(image[1]) + wp.abs(image[2])


@wp.func
def _power(x: float, exponent: int) -> float:
    product = float(1.0)
    for _i in range(exponent):
        product *= x
    return product


@wp.func
def image_reflectance(boundary: Boundary, image: wp.vec3i, u: wp.vec3) -> float:
    """The product of the reflectances on the way of an image in the unit direction u: across one axis, all angles of
    incidence are equal."""
    product = float(1.0)
    for axis in range(3):
        count = wp.abs(image[axis])
        if count > 0:
            last = wp.where(image[axis] > 0, boundary.high[axis], boundary.low[axis])
            other = wp.where(image[axis] > 0, boundary.low[axis], boundary.high[axis])
            cosine = wp.abs(u[axis])
            product *= _power(fresnel_reflectance(cosine, last), (count + 1) // 2)
            if count > 1:
                product *= _power(fresnel_reflectance(cosine, other), count // 2)
    return product


def make_boundary(
    low: Sequence[float], high: Sequence[float], *, max_reflections: int = 2, device: wp.DeviceLike = None
) -> Boundary:
    """Faces that reflect, of a `reflecting` spec.

    Args:
        low, high: Phase index outside the lower and the upper faces across x, y and z, over that of the water; 0 for a
            face that lets all light out, a very large number for a mirror.
        max_reflections: On the way from a scattering to the lens, 0 ... 8; more are left out. `analog` counts what it
            drops for this.

    Raises:
        ArgumentError: A number out of range, or all faces let light out.
    """
    sides = [check.numbers(name, one, (3,), "[0, 1e9]").tolist() for name, one in (("low", low), ("high", high))]
    most = check.integer("max_reflections", max_reflections, 0, 8)
    if not any(map(any, sides)):
        raise ArgumentError("low and high: all faces let all light out; such a spec is not `reflecting`")
    # A face without its opposite is met once. Ways of few reflections come first.
    numbers = [
        [k for k in range(-most, most + 1) if k == 0 or (pair[k > 0] > 0 and (abs(k) == 1 or min(pair) > 0))]
        for pair in zip(*sides, strict=True)
    ]
    chains = [chain for chain in itertools.product(*numbers) if 0 < sum(map(abs, chain)) <= most]
    images = sorted(chains, key=lambda chain: (sum(map(abs, chain)), chain))
    ways, device = np.reshape(images, (-1, 3)).astype(np.int32), check.device("device", device)
    return fill(Boundary(), device, low=sides[0], high=sides[1], images=ways, max_reflections=most)


# ---- The box and the limits.


@wp.struct
class Limits:
    """Limits of a history; 1e30 stands for none."""

    lower: wp.vec3  # the domain [m]; a flight that reaches a face leaves and is tallied by face, or is reflected
    upper: wp.vec3  # likewise
    rotation: wp.mat33
    """The domain's own axes: x lies at rotation x + origin in them. Read with `rotated_domain` alone, else lower and
    upper stand in the frame of the flight."""
    origin: wp.vec3  # likewise
    lateral: float  # a history ends where |x| or |y| reaches this [m]
    max_path: float  # geometric path [m]
    weight_cutoff: float  # a history ends after an event that leaves its analog weight below this
    max_collisions: int
    """A history has at most this many events, surfaces included. Every estimator scores the light of the last event,
    also of one below the cut-off."""
    boundary: Boundary  # of a reflecting spec: what the faces reflect


# Least normal float32: a weight below it is 0 to a GPU.
_LEAST_WEIGHT = 1.1754943508222875e-38


def ready_limits(copy: Limits, limits: Limits) -> None:
    """Readies a copy for a kernel: its cut-off is above 0, so that it takes a weight of 0 as well."""
    copy.weight_cutoff = max(limits.weight_cutoff, _LEAST_WEIGHT)


@wp.func
def _to_plane(x: float, u: float, lower: float, upper: float) -> float:
    # Selected rather than branched to: the lanes of a warp go either way.
    distance = wp.max((wp.where(u > 0.0, upper, lower) - x) / u, 0.0)
    return wp.where(u > 0.0 or u < 0.0, distance, 1.0e30)


@wp.struct
class Exit:
    """Where a ray leaves the domain: distance [m], and index into EXIT_FACES, 0 for the lateral limit."""

    distance: float
    face: int


@wp.func
def next_face(limits: Limits, to_sides: float, x: wp.vec3, u: wp.vec3) -> Exit:
    """The face that a ray meets, in the domain's own axes; face 0 where it comes to the distance `to_sides` before."""
    first = Exit()
    best = float(to_sides)
    face = int(0)
    for i in range(3):
        distance = _to_plane(x[i], u[i], limits.lower[i], limits.upper[i])
        if distance <= best:
            best = distance
            face = 1 + 2 * i + wp.where(u[i] > 0.0, 1, 0)
    first.distance = best
    first.face = face
    return first


class Domain(NamedTuple):
    """The domain's axes and where a flight leaves it, as Warp functions; lateral limits keep to the frame of the
    flight, as do points x and directions u."""

    point: wp.Function  # ``(limits, x) -> vec3``, x in the domain's axes
    point_back: wp.Function  # the inverse
    turn: wp.Function  # ``(limits, u) -> vec3``, u in the domain's axes
    turn_back: wp.Function  # the inverse
    is_outside: wp.Function  # ``(limits, x) -> bool``, outside the domain or beyond the lateral limit
    exit: wp.Function  # ``(limits, x, u) -> Exit``, of what a ray meets first
    within: wp.Function  # ``(limits, length, x, u) -> float``, the part of a flight in a bounded domain [m]
    bounded: bool
    rotated: bool
    reflects: bool


@memoised
def make_domain(bounded: bool, rotated: bool, reflects: bool) -> Domain:
    """The domain of a spec; `rotated`: it has axes of its own, `reflects`: its faces do."""

    @wp.func
    def point(limits: Limits, x: wp.vec3) -> wp.vec3:
        return limits.rotation * x + limits.origin if wp.static(rotated) else x

    @wp.func
    def point_back(limits: Limits, x: wp.vec3) -> wp.vec3:
        return wp.transpose(limits.rotation) * (x - limits.origin) if wp.static(rotated) else x

    @wp.func
    def turn(limits: Limits, u: wp.vec3) -> wp.vec3:
        return limits.rotation * u if wp.static(rotated) else u

    @wp.func
    def turn_back(limits: Limits, u: wp.vec3) -> wp.vec3:
        return wp.transpose(limits.rotation) * u if wp.static(rotated) else u

    @wp.func
    def outside_faces(limits: Limits, y: wp.vec3) -> bool:
        outside = bool(False)
        for i in range(3):
            outside = outside or y[i] < limits.lower[i] or y[i] > limits.upper[i]
        return outside

    @wp.func
    def is_outside(limits: Limits, x: wp.vec3) -> bool:
        aside = wp.abs(x[0]) > limits.lateral or wp.abs(x[1]) > limits.lateral
        return aside or outside_faces(limits, point(limits, x))

    @wp.func
    def to_sides(limits: Limits, x: wp.vec3, u: wp.vec3) -> float:
        aside = _to_plane(x[0], u[0], -limits.lateral, limits.lateral)
        return wp.min(aside, _to_plane(x[1], u[1], -limits.lateral, limits.lateral))

    @wp.func
    def exit(limits: Limits, x: wp.vec3, u: wp.vec3) -> Exit:
        return next_face(limits, to_sides(limits, x, u), point(limits, x), turn(limits, u))

    @wp.func
    def within(limits: Limits, length: float, x: wp.vec3, u: wp.vec3) -> float:
        return wp.min(length, exit(limits, x, u).distance) if wp.static(bounded) else length

    axes = (point, point_back, turn, turn_back)
    return Domain(*axes, is_outside, exit, within, bounded, rotated, reflects)
