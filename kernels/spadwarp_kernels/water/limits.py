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
from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import ArgumentError, check_device, check_integer, check_items, check_number

__all__ = ["Boundary", "Limits", "make_boundary"]


@wp.struct
class Boundary:
    """How the faces of the domain reflect, made by `make_boundary`.

    Attributes:
        low, high: Phase index outside over that of the water, by axis; 0 where all light leaves.
        images: Numbers of reflections across each axis, signed by the last face, of the ways that next events take
            beside the straight one.
        max_reflections: Reflections of the longest of them.
    """

    low: wp.vec3
    high: wp.vec3
    images: wp.array[wp.vec3i]
    max_reflections: int


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
def _image_coordinate(x: float, low: float, high: float, number: int) -> float:
    """A coordinate as it is in the cell of a number; a face without its opposite is met once."""
    if number % 2 == 0:
        return x + float(number) * (high - low)
    if number > 0:
        return 2.0 * high - x + float(number - 1) * (high - low)
    return 2.0 * low - x + float(number + 1) * (high - low)


@wp.func
def image_point(lower: wp.vec3, upper: wp.vec3, image: wp.vec3i, x: wp.vec3) -> wp.vec3:
    """Where a point of the domain [m] is seen after the reflections of an image."""
    return wp.vec3(
        _image_coordinate(x[0], lower[0], upper[0], image[0]),
        _image_coordinate(x[1], lower[1], upper[1], image[1]),
        _image_coordinate(x[2], lower[2], upper[2], image[2]),
    )


@wp.func
def _turned(u: float, number: int) -> float:
    return wp.where(number % 2 == 0, u, -u)


@wp.func
def image_direction(image: wp.vec3i, u: wp.vec3) -> wp.vec3:
    """A direction at the point as it is at its image, and the other way round."""
    return wp.vec3(_turned(u[0], image[0]), _turned(u[1], image[1]), _turned(u[2], image[2]))


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


def _checked_faces(low: Any, high: Any, max_reflections: Any) -> tuple[list[float], list[float], int]:
    found = {}
    for name, indices in (("low", low), ("high", high)):
        items = check_items(name, indices)
        if len(items) != 3:
            raise ArgumentError(f"{name} = {indices!r} is not three numbers")
        found[name] = [
            check_number(f"{name}, {axis},", one, "[0, 1e9]") for axis, one in zip("xyz", items, strict=True)
        ]
    return found["low"], found["high"], check_integer("max_reflections", max_reflections, 0, 8)


def reflection_images(low: Sequence[float], high: Sequence[float], max_reflections: int) -> list[tuple[int, int, int]]:
    """All chains of at most so many reflections as the numbers of `Boundary.images`, those of few reflections first.

    Args:
        low, high: See `Boundary`.
        max_reflections: 0 ... 8.

    Raises:
        ArgumentError: A number out of range.
    """
    low, high, max_reflections = _checked_faces(low, high, max_reflections)
    numbers = [
        [
            k
            for k in range(-max_reflections, max_reflections + 1)
            if k == 0 or (abs(k) == 1 and (a, b)[k > 0] > 0) or (abs(k) > 1 and a > 0 and b > 0)
        ]
        for a, b in zip(low, high, strict=True)
    ]
    found = [(x, y, z) for x, y, z in itertools.product(*numbers) if 0 < abs(x) + abs(y) + abs(z) <= max_reflections]
    return sorted(found, key=lambda image: (sum(map(abs, image)), image))


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
    low, high, max_reflections = _checked_faces(low, high, max_reflections)
    if not any((*low, *high)):
        raise ArgumentError("low and high: all faces let all light out; such a spec is not `reflecting`")
    boundary = Boundary()
    boundary.low, boundary.high = wp.vec3(*low), wp.vec3(*high)
    images = reflection_images(low, high, max_reflections)
    boundary.images = wp.array(images, dtype=wp.vec3i, device=check_device("device", device), shape=len(images))
    boundary.max_reflections = max_reflections
    return boundary


# ---- The box and the limits.


@wp.struct
class Limits:
    """Limits of a history; 1e30 stands for none.

    Attributes:
        lower, upper: The domain [m]; a flight that reaches a face leaves and is tallied by face, or is reflected.
        rotation, origin: The domain's own axes: x lies at rotation x + origin in them. Read by `..._rotated` alone, the
            others take lower and upper as they stand in the frame of the flight.
        lateral: A history ends where |x| or |y| reaches this [m].
        max_path: Geometric path [m].
        weight_cutoff: A history ends after an event that leaves its analog weight below this.
        max_collisions: A history has at most this many events, surfaces included. Every estimator scores the light of
            the last event, also of one below the cut-off.
        boundary: Of a reflecting spec: what the faces reflect.
    """

    lower: wp.vec3
    upper: wp.vec3
    rotation: wp.mat33
    origin: wp.vec3
    lateral: float
    max_path: float
    weight_cutoff: float
    max_collisions: int
    boundary: Boundary


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


@wp.func
def _to_sides(limits: Limits, x: wp.vec3, u: wp.vec3) -> float:
    return wp.min(
        _to_plane(x[0], u[0], -limits.lateral, limits.lateral), _to_plane(x[1], u[1], -limits.lateral, limits.lateral)
    )


@wp.func
def to_next_face(limits: Limits, x: wp.vec3, u: wp.vec3) -> float:
    """Distance [m] from x along u to a face of the domain; both in its own axes."""
    return wp.min(
        _to_plane(x[0], u[0], limits.lower[0], limits.upper[0]),
        wp.min(
            _to_plane(x[1], u[1], limits.lower[1], limits.upper[1]),
            _to_plane(x[2], u[2], limits.lower[2], limits.upper[2]),
        ),
    )


@wp.struct
class Exit:
    """Where a ray leaves the domain: distance [m], and index into EXIT_FACES, 0 for the lateral limit."""

    distance: float
    face: int


@wp.func
def _first_exit(limits: Limits, to_sides: float, x: wp.vec3, u: wp.vec3) -> Exit:
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


@wp.func
def _outside_sides(limits: Limits, x: wp.vec3) -> bool:
    return wp.abs(x[0]) > limits.lateral or wp.abs(x[1]) > limits.lateral


@wp.func
def _outside_faces(limits: Limits, x: wp.vec3) -> bool:
    low = x[0] < limits.lower[0] or x[1] < limits.lower[1] or x[2] < limits.lower[2]
    return low or x[0] > limits.upper[0] or x[1] > limits.upper[1] or x[2] > limits.upper[2]


@wp.func
def is_outside(limits: Limits, x: wp.vec3) -> bool:
    """Whether x lies outside the domain or beyond the lateral limit."""
    return _outside_sides(limits, x) or _outside_faces(limits, x)


@wp.func
def is_outside_rotated(limits: Limits, x: wp.vec3) -> bool:
    """As `is_outside`, for a domain with axes of its own."""
    return _outside_sides(limits, x) or _outside_faces(limits, limits.rotation * x + limits.origin)


@wp.func
def next_face(limits: Limits, x: wp.vec3, u: wp.vec3) -> int:
    """Index into EXIT_FACES of the face of `to_next_face`; 0: there is none."""
    return _first_exit(limits, 9.0e29, x, u).face


@wp.func
def first_exit(limits: Limits, x: wp.vec3, u: wp.vec3) -> Exit:
    """`exit_distance` and `exit_face` at once."""
    return _first_exit(limits, _to_sides(limits, x, u), x, u)


@wp.func
def first_exit_rotated(limits: Limits, x: wp.vec3, u: wp.vec3) -> Exit:
    """`exit_distance_rotated` and `exit_face_rotated` at once."""
    return _first_exit(limits, _to_sides(limits, x, u), limits.rotation * x + limits.origin, limits.rotation * u)


@wp.func
def exit_distance(limits: Limits, x: wp.vec3, u: wp.vec3) -> float:
    """Distance [m] along u at which the ray leaves the domain or the lateral limit."""
    return wp.min(_to_sides(limits, x, u), to_next_face(limits, x, u))


@wp.func
def exit_face(limits: Limits, x: wp.vec3, u: wp.vec3) -> int:
    """Index into EXIT_FACES of what a ray from x along u meets first: a face of the domain, else the lateral limit."""
    return first_exit(limits, x, u).face


@wp.func
def exit_distance_rotated(limits: Limits, x: wp.vec3, u: wp.vec3) -> float:
    """As `exit_distance`, for a domain with axes of its own; the lateral limit keeps to the frame of the flight."""
    return wp.min(
        _to_sides(limits, x, u), to_next_face(limits, limits.rotation * x + limits.origin, limits.rotation * u)
    )


@wp.func
def exit_face_rotated(limits: Limits, x: wp.vec3, u: wp.vec3) -> int:
    """As `exit_face`, for a domain with axes of its own; faces are named after them."""
    return first_exit_rotated(limits, x, u).face
