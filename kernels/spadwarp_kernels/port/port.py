"""A port between camera or laser and the water: layers of air and glass that bend light; and the ways through it."""

import warp as wp


@wp.struct
class Port:
    """What is between the air inside a housing and the water, in the frame of the camera; made by `make_flat_port` or
    `make_dome_port`.

    A flat window is all space between the planes x·normal = distance and distance + thickness, a dome all between the
    spheres of radius and radius + thickness about its centre. With a thickness of 0 there is none, as at a calm
    surface.

    Attributes:
        normal: Unit vector into the water (flat).
        distance: To the inner face from the origin along the normal [m] (flat).
        centre: Of the spheres [m] (dome).
        radius: Of the inner sphere [m] (dome).
        thickness: Of the window [m].
        index: Phase index of what is inside, of the window, of the water.
        delay: Group index over that of the water, of what is inside and of the window.
        glass_slope, water_slope: Bounds of the tangent that a ray makes with the normal in the window and in the water,
            over that inside, among the rays of a view: (least, largest) (flat).
        turn: Bound of the sine of the angle by which a ray of the view is bent (dome).
        aside: Bound of a ray's distance from the centre, in the water [m] (dome).
        early, late: The way through the port takes at most this much less, and more, than the straight line in water
            [m of water].
    """

    normal: wp.vec3
    distance: float
    centre: wp.vec3
    radius: float
    thickness: float
    index: wp.vec3
    delay: wp.vec2
    glass_slope: wp.vec2
    water_slope: wp.vec2
    turn: float
    aside: float
    early: float
    late: float


@wp.struct
class Connection:
    """The one way of light from a point in the water to a point inside.

    Attributes:
        to_port: Unit direction in the water.
        inside: Unit direction in which it arrives.
        exit: Where it leaves the water [m].
        water: Length of its way in the water [m].
        path: Length in water that takes as long as the whole way [m].
        transmission: Fraction of unpolarised light that gets through.
        density: Solid angle at the point in the water over the area that its light covers inside, across the ray
            [sr/m^2]; 0: there is no such way. 1/r^2 where all indices are equal.
    """

    to_port: wp.vec3
    inside: wp.vec3
    exit: wp.vec3
    water: float
    path: float
    transmission: float
    density: float


@wp.struct
class Passage:
    """A ray that has gone through a port.

    Attributes:
        x: Where it leaves the port [m]; of a ray from the water, where it meets the plane z = 0 inside.
        u: Its unit direction there.
        water: Length of its way in the water up to the port [m]; negative if the ray began behind that.
        path: Length in water that takes as long as the way behind that [m].
        transmission: Fraction of unpolarised light that gets through; 0: none.
    """

    x: wp.vec3
    u: wp.vec3
    water: float
    path: float
    transmission: float


@wp.func
def transmission(n: wp.vec4, q: wp.vec4) -> float:
    """Fraction of unpolarised light that two interfaces let through: half the sum of the products of both
    polarisations. Light that a window reflects inside is left out.

    Args:
        n: Phase indices: before and behind the first interface, before and behind the second.
        q: The same times the cosine to the normal there.
    """
    s1 = q[0] + q[1]
    s2 = q[2] + q[3]
    first = 4.0 * q[0] * q[1]
    second = 4.0 * q[2] * q[3]
    # cos/n in place of n cos gives the other polarisation.
    p1 = q[0] * n[1] / n[0] + q[1] * n[0] / n[1]
    p2 = q[2] * n[3] / n[2] + q[3] * n[2] / n[3]
    return 0.5 * first * second * (1.0 / (s1 * s1 * s2 * s2) + 1.0 / (p1 * p1 * p2 * p2))


@wp.func
def refracted(u: wp.vec3, normal: wp.vec3, ratio: float) -> wp.vec3:
    """The direction u behind an interface, for the ratio of the index before it to that behind it; the zero vector
    where all light is reflected. The normal is on either side."""
    cosine = wp.dot(u, normal)
    across = u - cosine * normal
    rest = 1.0 - ratio * ratio * wp.dot(across, across)
    if rest <= 0.0:
        return wp.vec3(0.0)
    return ratio * across + (wp.sign(cosine) * wp.sqrt(rest)) * normal
