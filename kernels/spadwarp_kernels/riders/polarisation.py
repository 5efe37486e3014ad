"""Stokes vectors, and how scattering turns them.

A Stokes vector (I, Q, U, V) belongs to a unit direction u and to a reference direction across it. Here the reference is
always the first vector e1 of `orthonormal_basis(u)`, so that a photon carries no more than the four numbers. With
e2 = e1 x u: Q = <E1^2> - <E2^2>, U = 2 <E1 E2>; V > 0 is right circular, clockwise for who looks towards the source
(Bohren & Huffman 1983, section 2.11, with e1 for the parallel and e2 for the perpendicular direction). A reference that
is turned by an angle a from e1 towards e2 gives Q' = Q cos 2a + U sin 2a and U' = -Q sin 2a + U cos 2a.
"""

from collections.abc import Callable, Sequence
from typing import Any

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from spadwarp_kernels.base.arguments import ArgumentError, check_device, check_items, check_number, check_numbers
from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.rotations import one_minus_cosine, orthonormal_basis, set_apart
from spadwarp_kernels.optics.camera import Camera
from spadwarp_kernels.optics.laser import Laser, Scan, beam_frame
from spadwarp_kernels.optics.port import Port, PortKind
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import PhotonState
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.reflectance import face_reflectance, ggx_brdf, lambert_brdf, pattern_reflectance
from spadwarp_kernels.surface.triangle import face_in, face_normal
from spadwarp_kernels.tally.tally import Contribution

__all__ = ["MATRIX_POINTS", "MOST_CHANNELS", "Polarisation", "make_polarisation", "matrix_cosines"]


@wp.struct
class Elements:
    """A scattering matrix at one angle, over its own m11 (Bohren & Huffman 1983, eq 4.77).

    I' = I + m12 Q, Q' = m12 I + m22 Q, U' = m33 U + m34 V, V' = -m34 U + m44 V, with respect to the plane of
    scattering: before and after, e1 is the direction in which the scattering angle grows.
    """

    m12: float
    m22: float
    m33: float
    m34: float
    m44: float


@wp.func
def table_elements(first: wp.array(dtype=wp.vec4), last: wp.array(dtype=float), t: float) -> Elements:
    """Of tables at `matrix_cosines`, for t = 1 - cos(theta) in [0, 2]; linear in between."""
    steps = first.shape[0] - 1
    position = 0.5 * float(steps) * wp.sqrt(wp.min(t, 2.0 - t))
    position = wp.where(t < 1.0, position, float(steps) - position)
    k = wp.min(int(position), steps - 1)
    part = position - float(k)
    a = first[k] + part * (first[k + 1] - first[k])
    m = Elements()
    m.m12 = a[0]
    m.m22 = a[1]
    m.m33 = a[2]
    m.m34 = a[3]
    m.m44 = last[k] + part * (last[k + 1] - last[k])
    return m


@wp.func
def _double_angle(h: wp.vec3, u: wp.vec3) -> wp.vec2:
    """Cosine and sine of twice the angle from u's reference direction to the part of h across u."""
    b1, b2 = orthonormal_basis(u)
    c = wp.dot(h, b1)
    s = -wp.dot(h, b2)
    square = c * c + s * s
    double = wp.vec2(1.0, 0.0)
    if square > 1.0e-30:
        double = wp.vec2((c - s) * (c + s) / square, 2.0 * c * s / square)
    return double


@wp.func
def in_plane(u: wp.vec3, v: wp.vec3) -> wp.vec3:
    """A vector in the plane of two unit vectors that no rounding turns out of it: the shorter one of their difference
    and their sum. One vector for the angles before and after, whose errors cancel then in what is nearly forward or
    backward."""
    return wp.where(wp.dot(u, v) > 0.0, v - u, v + u)


@wp.func
def turn_stokes(stokes: wp.vec4, u: wp.vec3, v: wp.vec3, m: Elements) -> wp.vec4:
    """L(-b) M L(a)/m11 times the Stokes vector: light along u after it was turned to v. Its I keeps its bits where m12
    is 0."""
    h = in_plane(u, v)
    a = _double_angle(h, u)
    b = _double_angle(h, v)
    q = a[0] * stokes[1] + a[1] * stokes[2]
    w = a[0] * stokes[2] - a[1] * stokes[1]
    q1 = m.m12 * stokes[0] + m.m22 * q
    w1 = m.m33 * w + m.m34 * stokes[3]
    return wp.vec4(
        stokes[0] + m.m12 * q,
        b[0] * q1 - b[1] * w1,
        b[1] * q1 + b[0] * w1,
        m.m44 * stokes[3] - m.m34 * w,
    )


@wp.func
def transport_stokes(stokes: wp.vec4, u: wp.vec3, v: wp.vec3) -> wp.vec4:
    """The same light seen along v: its field is turned by the smallest rotation from u to v."""
    m = Elements()
    m.m22 = 1.0
    m.m33 = 1.0
    m.m44 = 1.0
    return turn_stokes(stokes, u, v, m)


@wp.func
def stokes_from(stokes: wp.vec4, right: wp.vec3, u: wp.vec3) -> wp.vec4:
    """A Stokes vector that is given with respect to a unit vector `right` across u."""
    a = _double_angle(right, u)
    return wp.vec4(stokes[0], a[0] * stokes[1] - a[1] * stokes[2], a[1] * stokes[1] + a[0] * stokes[2], stokes[3])


# ---- Fresnel's equations for polarised light: reflection by a smooth boundary, transmission through a window.


@wp.func
def fresnel_elements(cosine: float, index: float) -> Elements:
    """Of reflection, over the reflectance of unpolarised light, for the cosine in [0, 1] to the normal and the index
    behind the boundary over that before it."""
    m = Elements()
    m.m22 = 1.0
    n2 = index * index
    behind2 = n2 - (1.0 - cosine * cosine)
    if behind2 <= 0.0:
        # Beyond the critical angle both amplitudes have modulus 1, and differ in phase.
        k = wp.sqrt(-behind2)
        x = n2 * cosine * cosine + k * k
        y = k * cosine * (n2 - 1.0)
        square = wp.max(x * x + y * y, 1.0e-30)
        m.m33 = (x - y) * (x + y) / square
        m.m34 = 2.0 * x * y / square
    else:
        behind = wp.sqrt(behind2)
        along = behind / index
        s = (cosine - behind) / (cosine + behind)
        p = (cosine - along / index) / (cosine + along / index)
        square = wp.max(s * s + p * p, 1.0e-30)
        m.m12 = (p - s) * (p + s) / square
        m.m33 = 2.0 * s * p / square
    m.m44 = m.m33
    return m


@wp.func
def facet_elements(u: wp.vec3, v: wp.vec3, index: float) -> Elements:
    """Of the facet that reflects u to v."""
    return fresnel_elements(wp.sqrt(0.5 * wp.max(1.0 - wp.dot(u, v), 0.0)), index)


@wp.func
def window_elements(n: wp.vec4, q: wp.vec4) -> Elements:
    """Of transmission through two interfaces, over that of unpolarised light; arguments as of
    `spadwarp_kernels.port.transmission`."""
    # The amplitudes that get through are as 1/s and 1/p.
    s = (q[0] + q[1]) * (q[2] + q[3])
    p = (q[0] * n[1] / n[0] + q[1] * n[0] / n[1]) * (q[2] * n[3] / n[2] + q[3] * n[2] / n[3])
    square = s * s + p * p
    m = Elements()
    m.m12 = (s - p) * (s + p) / square
    m.m22 = 1.0
    m.m33 = 2.0 * s * p / square
    m.m44 = m.m33
    return m


@memoised
def make_port_elements(port: PortKind | None) -> wp.Function | None:
    """The Warp function ``(port, x, u) -> Elements`` of the ray through x in the water along u; None without a port."""
    if port is None:
        return None
    cosines = port.cosines

    @wp.func
    def port_elements(port: Port, x: wp.vec3, u: wp.vec3) -> Elements:
        n = port.index
        return window_elements(wp.vec4(n[0], n[1], n[1], n[2]), cosines(port, x, u))

    return port_elements


# ---- What a receiver takes of the light that comes to the lens.


@memoised
def make_leave_water(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(camera, stokes, x, u, inside) -> vec4`` of light at x in the water along u that arrives at
    the lens along `inside`: what a port does to it."""
    has_port = spec.port is not None
    elements = make_port_elements(spec.port)

    @wp.func
    def leave_water(camera: Camera, stokes: wp.vec4, x: wp.vec3, u: wp.vec3, inside: wp.vec3) -> wp.vec4:
        if wp.static(has_port):
            before = set_apart(u)
            return turn_stokes(stokes, before, set_apart(inside), elements(camera.port, set_apart(x), before))
        return stokes

    return leave_water


@memoised
def make_receive(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(stokes, u) -> vec4`` of light that arrives at the lens along u: with respect to the image's
    x, to which the lens turns all light by the smallest rotation to the optical axis."""
    channels = spec.channels

    @wp.func
    def receive(stokes: wp.vec4, u: wp.vec3) -> wp.vec4:
        if wp.static(channels == 0):
            return stokes
        return transport_stokes(stokes, set_apart(u), wp.vec3(0.0, 0.0, -1.0))

    return receive


@memoised
def make_add_channels(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(contribution, polarisation, stokes) -> Contribution``: its value times I, and what the
    channels take, over that, as scores."""
    channels = spec.channels

    @wp.func
    def add_channels(c: Contribution, polarisation: Polarisation, stokes: wp.vec4) -> Contribution:
        c.value *= stokes[0]
        for k in range(wp.static(channels)):
            c.scores[k] = wp.dot(polarisation.channels[k], stokes) / wp.max(stokes[0], 1.0e-30)
        return c

    return add_channels


# ---- What polarised light depends on: the laser's state, the scattering matrix of the water, facets, and the receiver.


# Points of the tables of a scattering matrix; an odd number.
MATRIX_POINTS = 1025

MOST_CHANNELS = 3

Channels = wp.types.matrix(shape=(3, 4), dtype=float)


@wp.struct
class Polarisation:
    """Parameters of a polarised spec, made by `make_polarisation`.

    Attributes:
        laser: Stokes vector of the beam on its axis, I = 1, with respect to the right of `beam_frame`.
        first, last: Tables of m12, m22, m33, m34 and of m44 at `matrix_cosines`, see `Elements`.
        channels: A row for each channel of the receiver, whose product with the Stokes vector it takes; with respect to
            the image's x, so that U is light at 45 degrees from x towards y less that at 135.
        facet_index: Index of each face's specular facets over that of the water; empty without a specular lobe.
    """

    laser: wp.vec4
    first: wp.array(dtype=wp.vec4)
    last: wp.array(dtype=float)
    channels: Channels
    facet_index: wp.array(dtype=float)


def matrix_cosines() -> NDArray[np.float64]:
    """Cosines of the scattering angle at which a matrix is tabulated, `[MATRIX_POINTS]`: from forward, in equal steps
    of sin(theta/2), to 90 degrees, and on in equal steps of cos(theta/2) to backward; 0.16 degrees apart at both ends.
    """
    s = np.linspace(0.0, 1.0, (MATRIX_POINTS + 1) // 2)
    return np.concatenate([1.0 - s * s, (s * s - 1.0)[-2::-1]])


def make_polarisation(
    *,
    laser: Sequence[float] = (1.0, 0.0, 0.0, 0.0),
    matrix: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None,
    channels: Sequence[Sequence[float]] = (),
    facet_index: ArrayLike = (),
    device: wp.DeviceLike = None,
) -> Polarisation:
    """Parameters of polarised light, for `Model.polarisation`.

    Args:
        laser: Stokes vector of the emitted light, I = 1, see `Polarisation`.
        matrix: Of cosines `[n]` of the scattering angle; returns `[n, 5]`: m12, m22, m33, m34 and m44 over m11, see
            `Elements`. None: light keeps its polarisation as it is turned.
        channels: Up to MOST_CHANNELS rows of four numbers; as many as the spec has.
        facet_index: Of each face, > 0; one number for each, or nothing.

    Raises:
        ArgumentError: Numbers that no light and no matrix can have.
    """
    device = check_device("device", device)
    polarisation = Polarisation()
    polarisation.laser = wp.vec4(*check_stokes("laser", laser))
    cosines = matrix_cosines()
    table = np.tile([0.0, 1.0, 1.0, 0.0, 1.0], (cosines.size, 1))
    if not (matrix is None or callable(matrix)):
        raise ArgumentError(f"matrix = {matrix!r} is not a function of cosines")
    if matrix is not None:
        table = check_numbers("matrix", matrix(cosines))
    if table.shape != (cosines.size, 5):
        raise ArgumentError(f"matrix gives {table.shape} for {cosines.size} cosines; [cosines, 5] is needed")
    if not (np.isfinite(table).all() and np.abs(table).max() <= 1.0 + 1e-6):
        raise ArgumentError("matrix holds elements that are not finite or beyond m11: outside [-1, 1]")
    polarisation.first = wp.array(table[:, :4].astype(np.float32), dtype=wp.vec4, device=device)
    polarisation.last = wp.array(table[:, 4].astype(np.float32), dtype=float, device=device)
    given = [check_items(f"channels[{k}]", row) for k, row in enumerate(check_items("channels", channels))]
    if len(given) > MOST_CHANNELS or any(len(row) != 4 for row in given):
        raise ArgumentError(f"channels are not up to {MOST_CHANNELS} rows of 4 numbers")
    rows = np.zeros((MOST_CHANNELS, 4))
    for k, row in enumerate(given):
        rows[k] = [check_number(f"channels[{k}]", one, "[-1, 1]") for one in row]
    polarisation.channels = Channels(*rows.ravel().tolist())
    facets = np.ravel(check_numbers("facet_index", facet_index))
    if facets.size and not (np.isfinite(facets).all() and facets.min() > 0.0):
        raise ArgumentError("facet_index holds numbers outside (0, inf)")
    polarisation.facet_index = wp.array(facets.astype(np.float32), dtype=float, device=device)
    return polarisation


def check_stokes(name: str, stokes: Any) -> list[float]:
    """Four numbers of light with I = 1 that is polarised by 1 at most; raises `ArgumentError`."""
    found = check_numbers(name, stokes)
    if found.shape != (4,) or not np.isfinite(found).all() or found[0] != 1.0:
        raise ArgumentError(f"{name} = {stokes!r} is not a Stokes vector with I = 1")
    if float(np.linalg.norm(found[1:])) > 1.0 + 1e-6:
        raise ArgumentError(f"{name} = {stokes!r} is polarised by more than 1")
    return [float(value) for value in found]


# ---- What events do to a Stokes vector: scattering in the water, surfaces, faces of the domain.


@memoised
def make_event_stokes(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(stokes, polarisation, surfaces, slot, x, u, v) -> vec4`` of light that an event at x has
    turned from u to v, on the face of a slot of the mesh's tree or (-1) in the water.

    Water multiplies by L M L/m11. A Lambertian surface depolarises; a specular lobe has Fresnel's matrix of the facet
    between u and v, over its m11; both in proportion to what they send to v.
    """
    has_mesh, specular = spec.mesh, spec.specular
    reflectance_at = pattern_reflectance if spec.pattern else face_reflectance

    @wp.func
    def surface_stokes(
        stokes: wp.vec4, polarisation: Polarisation, surfaces: Surfaces, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3
    ) -> wp.vec4:
        left = wp.vec4(stokes[0], 0.0, 0.0, 0.0)
        if wp.static(specular):
            face = face_in(surfaces.order, slot)
            normal = face_normal(surfaces.faces, slot, u)
            lambert = lambert_brdf(reflectance_at(surfaces, face, x))
            lobe = surfaces.specular[face] * ggx_brdf(u, v, normal, surfaces.roughness[face])
            turned = turn_stokes(stokes, u, v, facet_elements(u, v, polarisation.facet_index[face]))
            left += (lobe / wp.max(lambert + lobe, 1.0e-30)) * (turned - left)
        return left

    @wp.func
    def event_stokes(
        stokes: wp.vec4, polarisation: Polarisation, surfaces: Surfaces, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3
    ) -> wp.vec4:
        before, after = set_apart(u), set_apart(v)
        if wp.static(has_mesh):
            if slot >= 0:
                return surface_stokes(stokes, polarisation, surfaces, slot, set_apart(x), before, after)
        m = table_elements(polarisation.first, polarisation.last, one_minus_cosine(before, after))
        return turn_stokes(stokes, before, after, m)

    return event_stokes


@memoised
def make_reflected_stokes() -> wp.Function:
    """The Warp function ``(stokes, u, v, index) -> vec4`` of light that a smooth boundary mirrors from u to v, for the
    index behind it over that of the water."""

    @wp.func
    def reflected_stokes(stokes: wp.vec4, u: wp.vec3, v: wp.vec3, index: float) -> wp.vec4:
        before, after = set_apart(u), set_apart(v)
        cosine = wp.sqrt(0.5 * wp.max(1.0 - wp.dot(before, after), 0.0))
        return turn_stokes(stokes, before, after, fresnel_elements(wp.min(cosine, 1.0), index))

    return reflected_stokes


# ---- The Stokes vector of a photon that enters the water.


@memoised
def make_first_stokes(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(polarisation, laser, scan, target, emitted, x, u) -> vec4`` of a photon that was emitted,
    see `make_emit`, and is in the water at x on its way along u.

    A beam's field on its axis is turned to the direction of each photon by the smallest rotation.
    """
    polarised, confocal, has_port = spec.polarised, spec.confocal, spec.laser_port is not None
    elements = make_port_elements(spec.laser_port)

    @wp.func
    def first_stokes(
        polarisation: Polarisation,
        laser: Laser,
        scan: Scan,
        target: int,
        emitted: wp.spatial_vector,
        x: wp.vec3,
        u: wp.vec3,
    ) -> wp.vec4:
        if wp.static(not polarised):
            return wp.vec4()
        axis = laser.axis
        if wp.static(confocal):
            axis = scan.axis[target]
        axis = set_apart(axis)
        right, _down = beam_frame(axis)
        heading = set_apart(wp.spatial_bottom(emitted))
        stokes = transport_stokes(stokes_from(polarisation.laser, right, axis), axis, heading)
        if wp.static(has_port):
            leaving = set_apart(u)
            stokes = turn_stokes(stokes, heading, leaving, elements(laser.port, set_apart(x), leaving))
        return stokes

    return first_stokes


# ---- The Stokes vector of a photon that enters the aperture itself.


@memoised
def make_crossing_stokes(spec: TransportSpec) -> wp.Function:
    """The Warp function ``(s, camera) -> vec4`` of a photon whose flight leads to the lens, see `make_receive`."""
    has_port, leave_water, receive = spec.port is not None, make_leave_water(spec), make_receive(spec)
    leave = None if spec.port is None else spec.port.leave

    @wp.func
    def crossing_stokes(s: PhotonState, camera: Camera) -> wp.vec4:
        inside = s.u
        if wp.static(has_port):
            inside = leave(camera.port, s.x, s.u).u
        return receive(leave_water(camera, s.stokes, s.x, s.u, inside), inside)

    return crossing_stokes
