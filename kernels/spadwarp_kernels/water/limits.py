"""Where photons may be: the water's box and the limits that end a history."""

import warp as wp

from .boundary import Boundary

__all__ = ["Limits", "exit_distance"]

# Where a history may leave, in the order of `exit_face`.
EXIT_FACES = (
    "lateral_limit",
    "exit_x_low",
    "exit_x_high",
    "exit_y_low",
    "exit_y_high",
    "exit_z_low",
    "exit_z_high",
)


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


def ready_limits(limits: Limits) -> Limits:
    """A copy for a kernel, whose cut-off is above 0, so that it takes a weight of 0 as well."""
    copy = Limits()
    for name in Limits.vars:
        setattr(copy, name, getattr(limits, name))
    copy.weight_cutoff = max(limits.weight_cutoff, _LEAST_WEIGHT)
    return copy


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
def _to_faces(limits: Limits, x: wp.vec3, u: wp.vec3) -> float:
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
def _first_face(limits: Limits, to_sides: float, x: wp.vec3, u: wp.vec3) -> int:
    return _first_exit(limits, to_sides, x, u).face


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
def to_next_face(limits: Limits, x: wp.vec3, u: wp.vec3) -> float:
    """Distance [m] from x along u to a face of the domain; both in its own axes."""
    return _to_faces(limits, x, u)


@wp.func
def next_face(limits: Limits, x: wp.vec3, u: wp.vec3) -> int:
    """Index into EXIT_FACES of the face of `to_next_face`; 0: there is none."""
    return _first_face(limits, 9.0e29, x, u)


@wp.func
def exit_distance(limits: Limits, x: wp.vec3, u: wp.vec3) -> float:
    """Distance [m] along u at which the ray leaves the domain or the lateral limit."""
    return wp.min(_to_sides(limits, x, u), _to_faces(limits, x, u))


@wp.func
def exit_face(limits: Limits, x: wp.vec3, u: wp.vec3) -> int:
    """Index into EXIT_FACES of what a ray from x along u meets first: a face of the domain, else the lateral limit."""
    return _first_face(limits, _to_sides(limits, x, u), x, u)


@wp.func
def exit_distance_rotated(limits: Limits, x: wp.vec3, u: wp.vec3) -> float:
    """As `exit_distance`, for a domain with axes of its own; the lateral limit keeps to the frame of the flight."""
    return wp.min(_to_sides(limits, x, u), _to_faces(limits, limits.rotation * x + limits.origin, limits.rotation * u))


@wp.func
def exit_face_rotated(limits: Limits, x: wp.vec3, u: wp.vec3) -> int:
    """As `exit_face`, for a domain with axes of its own; faces are named after them."""
    return _first_face(limits, _to_sides(limits, x, u), limits.rotation * x + limits.origin, limits.rotation * u)


@wp.func
def first_exit(limits: Limits, x: wp.vec3, u: wp.vec3) -> Exit:
    """`exit_distance` and `exit_face` at once."""
    return _first_exit(limits, _to_sides(limits, x, u), x, u)


@wp.func
def first_exit_rotated(limits: Limits, x: wp.vec3, u: wp.vec3) -> Exit:
    """`exit_distance_rotated` and `exit_face_rotated` at once."""
    return _first_exit(limits, _to_sides(limits, x, u), limits.rotation * x + limits.origin, limits.rotation * u)
