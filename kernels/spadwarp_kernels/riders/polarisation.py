"""Stokes vectors, and how scattering turns them.

A Stokes vector (I, Q, U, V) belongs to a unit direction u and to a reference direction across it. Here the reference is
always the first vector e1 of `orthonormal_basis(u)`, so that a photon carries no more than the four numbers. With
e2 = e1 x u: Q = <E1^2> - <E2^2>, U = 2 <E1 E2>; V > 0 is right circular, clockwise for who looks towards the source
(Bohren & Huffman 1983, section 2.11, with e1 for the parallel and e2 for the perpendicular direction). A reference that
is turned by an angle a from e1 towards e2 gives Q' = Q cos 2a + U sin 2a and U' = -Q sin 2a + U cos 2a.
"""

import warp as wp

from spadwarp_kernels.base.rotations import one_minus_cosine, orthonormal_basis, set_apart
from spadwarp_kernels.optics.laser import beam_frame
from spadwarp_kernels.optics.port import Port, PortKind
from spadwarp_kernels.optics.sea import FACETS, Sea
from spadwarp_kernels.photon.spec import TransportSpec
from spadwarp_kernels.photon.state import SEA_SLOT, Carried, CarriedRef, Contribution, WorldRef
from spadwarp_kernels.surface.triangle import face_in

from .rider import NOTHING, Rider


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
def table_elements(first: wp.array[wp.vec4], last: wp.array[float], t: float) -> Elements:
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


@wp.func
def passage_elements(sea: Sea, u: wp.vec3, v: wp.vec3) -> Elements:
    """Of the facet of the surface of a sea that reflects u to v or, on the other side of it, refracts it."""
    climb = wp.dot(u, sea.normal)
    ratio = wp.where(climb < 0.0, sea.index, 1.0 / sea.index)  # behind over before
    if climb * wp.dot(v, sea.normal) < 0.0:
        return facet_elements(u, v, ratio)
    m = wp.normalize(u - ratio * v)
    before = wp.abs(wp.dot(u, m))
    return window_elements(wp.vec4(1.0, 1.0, 1.0, ratio), wp.vec4(before, before, before, ratio * wp.abs(wp.dot(v, m))))


def make_port_elements(kind: PortKind | None) -> wp.Function | None:
    """The Warp function ``(port, x, u) -> Elements`` of the ray through x in the water along u; None without a port."""
    if kind is None:
        return None
    cosines = kind.cosines

    @wp.func
    def port_elements(port: Port, x: wp.vec3, u: wp.vec3) -> Elements:
        n = port.index
        return window_elements(wp.vec4(n[0], n[1], n[1], n[2]), cosines(port, x, u))

    return port_elements


# ---- The light of a photon, from the laser to the receiver.


def make_polarisation_rider(spec: TransportSpec) -> Rider:
    """The Stokes vector of a polarised spec."""
    return NOTHING._replace(
        begin=_make_begin(spec), event=_make_event(spec), mirror=_mirror, deliver=_make_deliver(spec)
    )


def _make_begin(spec: TransportSpec) -> wp.Function:
    """A beam's field on its axis is turned to the direction of each photon by the smallest rotation."""
    elements, has_port = make_port_elements(spec.beam.port), spec.beam.port is not None

    @wp.func
    def begin(c: CarriedRef, world: WorldRef, target: int, emitted: wp.spatial_vector, x: wp.vec3, u: wp.vec3):
        axis = set_apart(spec.beam.axis(world.laser, world.scan, target))
        right, _down = beam_frame(axis)
        heading = set_apart(wp.spatial_bottom(emitted))
        stokes = transport_stokes(stokes_from(world.polarisation.laser, right, axis), axis, heading)
        if wp.static(has_port):
            leaving = set_apart(u)
            stokes = turn_stokes(stokes, heading, leaving, elements(world.laser.port, set_apart(x), leaving))
        c.stokes = stokes

    return begin


def _make_event(spec: TransportSpec) -> wp.Function:
    """Water multiplies by L M L/m11. A Lambertian surface depolarises; a specular lobe has Fresnel's matrix of the
    facet between u and v, over its m11; both in proportion to what they send to v. So has a facet of a sea's surface.
    """
    sea, surface = spec.sight.sea is not None, spec.sight.sea or FACETS

    @wp.func
    def on_a_face(stokes: wp.vec4, world: WorldRef, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3) -> wp.vec4:
        left = wp.vec4(stokes[0], 0.0, 0.0, 0.0)
        if wp.static(spec.faces.specular):
            index = world.polarisation.facet_index[face_in(world.surfaces.order, slot)]
            turned = turn_stokes(stokes, u, v, facet_elements(u, v, index))
            left += spec.faces.shares(world.surfaces, slot, x, u, v)[1] * (turned - left)
        return left

    @wp.func
    def event(c: CarriedRef, world: WorldRef, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3):
        before, after = set_apart(u), set_apart(v)
        if slot >= 0:
            c.stokes = on_a_face(c.stokes, world, slot, set_apart(x), before, after)
        elif wp.static(sea) and slot == SEA_SLOT:
            c.stokes = turn_stokes(c.stokes, before, after, passage_elements(surface.at(world.sea, x), before, after))
        else:
            m = table_elements(world.polarisation.first, world.polarisation.last, one_minus_cosine(before, after))
            c.stokes = turn_stokes(c.stokes, before, after, m)

    return event


@wp.func
def _mirror(c: CarriedRef, u: wp.vec3, v: wp.vec3, index: float):
    before, after = set_apart(u), set_apart(v)
    cosine = wp.sqrt(0.5 * wp.max(1.0 - wp.dot(before, after), 0.0))
    c.stokes = turn_stokes(c.stokes, before, after, fresnel_elements(wp.min(cosine, 1.0), index))


def _make_deliver(spec: TransportSpec) -> wp.Function:
    """What a port does to the light, and what the receiver takes of it: with respect to the image's x, to which the
    lens turns all light by the smallest rotation to the optical axis."""
    elements, has_port = make_port_elements(spec.sight.port), spec.sight.port is not None

    @wp.func
    def deliver(k: wp.ref[Contribution], c: Carried, world: WorldRef, end: wp.vec3, u: wp.vec3, inside: wp.vec3):
        stokes = c.stokes
        if wp.static(has_port):
            before = set_apart(u)
            through = elements(world.camera.port, set_apart(end), before)
            stokes = turn_stokes(stokes, before, set_apart(inside), through)
        if wp.static(spec.channels > 0):
            stokes = transport_stokes(stokes, set_apart(inside), wp.vec3(0.0, 0.0, -1.0))
        k.value *= stokes[0]
        for channel in range(wp.static(spec.channels)):
            taken = wp.dot(world.polarisation.channels[channel], stokes)
            k.factors[channel] = taken / wp.max(stokes[0], 1.0e-30)

    return deliver
