"""Directions: orthonormal bases, the direction update, the near-axis rule."""

import warp as wp

__all__ = ["one_minus_cosine", "rotate_direction"]


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // The hardware's sine and cosine, good to 4e-7 on (-pi, pi): far below the resolution of a float32 direction.
    float s, c;
    __sincosf(angle, &s, &c);
    return wp::vec2(c, s);
#else
    // Both at once, and without a branch on the quadrant: the polynomials and the bits of the C library's cosf and sinf
    // (ARM's optimized routines, in glibc since 2.28) for each multiple of 2^-25.
    const double phi = angle;
    const int quarter = static_cast<int>(phi * 0x1.45F306DC9C883p-1 + (phi < 0.0 ? -0.5 : 0.5));
    const double x = phi - quarter * 0x1.921FB54442D18p0, x2 = x * x, x3 = x * x2, x4 = x2 * x2;
    const double s = x + x3 * -0x1.555545995a603p-3
        + x3 * x2 * (0x1.1107605230bc4p-7 + x2 * -0x1.994eb3774cf24p-13);
    const double c = 1.0 + x2 * -0x1.ffffffd0c621cp-2 + x4 * 0x1.55553e1068f19p-5
        + x4 * x2 * (-0x1.6c087e89a359dp-10 + x2 * 0x1.99343027bf8c3p-16);
    const bool odd = quarter & 1;
    const double sign = quarter & 2 ? -1.0 : 1.0;
    return wp::vec2(static_cast<float>(sign * (odd ? -s : c)), static_cast<float>(sign * (odd ? c : s)));
#endif
""")
def _cos_sin(angle: float) -> wp.vec2:
    """(cos, sin) of an angle in [-pi, pi)."""
    ...


@wp.func
def cos_sin_turn(xi: float) -> wp.vec2:
    """(cos, sin) of a turn of 2 pi (xi - 1/2), xi in [0, 1): a uniform azimuth for uniform xi."""
    return _cos_sin(6.2831853 * (xi - 0.5))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return fmaf(static_cast<float>(word >> 8u), 3.7450704e-7f, -3.14159265f);
#else
    return 6.2831853f * (static_cast<float>(word >> 8u) * 5.9604644775390625e-08f - 0.5f);
#endif
""")
def _azimuth(word: wp.uint32) -> float: ...


@wp.func
def cos_sin_word(word: wp.uint32) -> wp.vec2:
    """`cos_sin_turn` of `u01(word)`."""
    return _cos_sin(_azimuth(word))


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    float s, c;
    sincospif(0.31830989f * angle, &s, &c);
    return c / s;
#else
    return wp::cos(angle) / wp::sin(angle);
#endif
""")
def cotangent(angle: float) -> float:
    """cot of an angle in (0, pi), to full precision also for tiny angles in a module with fast mathematics."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    // 0 in a launch along one axis, which the compiler does not know.
    const unsigned none = threadIdx.y;
    for (int i = 0; i < 3; ++i) v[i] = __uint_as_float(__float_as_uint(v[i]) ^ none);
#endif
    return v;
""")
def set_apart(v: wp.vec3) -> wp.vec3:
    """The same vector, of which a compiler for CUDA does not know that it is: what is computed from it shares no
    products with the rest of a kernel. Whether a product and a sum become one operation, which rounds once, depends on
    who else needs the product: more work in one place would change the last bits of another."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __uint_as_float((__float_as_uint(number) & 0x80000000u) | 0x3f800000u);
#else
    return wp::sign(number);
#endif
""")
def one_with_sign(number: float) -> float:
    """1 with the sign of a number, of either sign for 0."""
    ...


@wp.func
def inverse_of(d: float) -> float:
    """1/d, finite."""
    return 1.0 / wp.where(wp.abs(d) < 1.0e-18, 1.0e-18, d)


@wp.func
def inverse_direction(u: wp.vec3) -> wp.vec3:
    """1/u by components, finite."""
    return wp.vec3(inverse_of(u[0]), inverse_of(u[1]), inverse_of(u[2]))


@wp.func
def orthonormal_basis(n: wp.vec3):
    """Two unit vectors that complete the unit vector n to a right-handed basis (Duff et al. 2017)."""
    s = wp.where(n[2] < 0.0, -1.0, 1.0)
    a = -1.0 / (s + n[2])
    b = n[0] * n[1] * a
    # Times -1: Warp's unary minus is 0 - x, an addition, which no multiplication takes in.
    return wp.vec3(1.0 + s * n[0] * n[0] * a, s * b, (-1.0 * s) * n[0]), wp.vec3(b, s + n[1] * n[1] * a, -1.0 * n[1])


@wp.func
def rotate_direction(u: wp.vec3, t: float, xi: float) -> wp.vec3:
    """The unit vector at angle theta from u, t = 1 - cos(theta), at azimuth 2 pi xi, exact on an orthonormal basis;
    equal in distribution to eq 15 of Lu et al. 2024, which divides by zero along the axis."""
    return rotate_by(u, t, cos_sin_turn(xi))


@wp.func
def rotate_by(u: wp.vec3, t: float, turn: wp.vec2) -> wp.vec3:
    """`rotate_direction` for (cos, sin) of an azimuth."""
    sin_theta = wp.sqrt(wp.max(t * (2.0 - t), 0.0))
    # (1 - t) u + a b1 + b b2 of `orthonormal_basis`, of which the two last have common factors.
    a = sin_theta * turn[0]
    b = sin_theta * turn[1]
    s = one_with_sign(u[2])
    down = s * u[0] * a + u[1] * b
    along = (1.0 - t) - down / (s + u[2])
    v = wp.vec3(u[0] * along + a, u[1] * along + s * b, u[2] * (1.0 - t) - down)
    # One Newton step of the inverse square root keeps |v| = 1 over any number of events.
    return v * (1.5 - 0.5 * wp.dot(v, v))


# A threshold that no |u_z| reaches, with its rounding.
OFF_AXIS = wp.constant(2.0)


@wp.func
def snap_from(u: wp.vec3, least: float) -> wp.vec3:
    """The near-axis rule (Lu et al. 2024, eq 16): the z axis with u's sign where |u_z| >= least, else u. A scattering
    takes it as its incoming direction, in the density and as the axis of what is sampled; the flight keeps u. 0.9998
    drops up to 1.15 degrees of tilt, OFF_AXIS switches the rule off."""
    if wp.abs(u[2]) >= least:
        return wp.vec3(0.0, 0.0, one_with_sign(u[2]))
    return u


@wp.func
def one_minus_cosine(u: wp.vec3, v: wp.vec3) -> float:
    """1 - cos of the angle between two unit vectors, as |u - v|^2/2: exact for small angles, in [0, 2]."""
    d = u - v
    return wp.min(0.5 * wp.dot(d, d), 2.0)
