"""Stokes vectors, and how scattering turns them.

A Stokes vector (I, Q, U, V) belongs to a unit direction u and to a reference direction across it. Here the reference is
always the first vector e1 of `orthonormal_basis(u)`, so that a photon carries no more than the four numbers. With
e2 = e1 x u: Q = <E1^2> - <E2^2>, U = 2 <E1 E2>; V > 0 is right circular, clockwise for who looks towards the source
(Bohren & Huffman 1983, section 2.11, with e1 for the parallel and e2 for the perpendicular direction). A reference that
is turned by an angle a from e1 towards e2 gives Q' = Q cos 2a + U sin 2a and U' = -Q sin 2a + U cos 2a.
"""

import warp as wp

from spadwarp_kernels.math.rotations import orthonormal_basis


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
