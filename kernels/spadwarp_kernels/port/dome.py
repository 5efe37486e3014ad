"""A dome port: a spherical window.

A ray keeps index times distance from the centre, p = n b, in all layers. From a point at the distance d from the centre
it starts at the angle i to the radius and is seen from the centre, where it has got to the radius r, at the angle
beta(i) = i - asin(p/(n_0 R_1)) + asin(p/(n_1 R_1)) - asin(p/(n_1 R_2)) + asin(p/(n_w R_2)) - asin(p/(n_w r)).
"""

import warp as wp

from .port import Connection, Passage, Port, refracted, transmission

# After a step of this size, relative to the angle, the error of Newton's method is its square.
_STEPS = wp.constant(12)
_LAST_STEP = wp.constant(1.0e-4)


@wp.func
def _turn(p: float, x: float) -> wp.vec2:
    """asin(p/x) and its derivative by p."""
    s = p / x
    return wp.vec2(wp.asin(s), 1.0 / (x * wp.sqrt(wp.max(1.0 - s * s, 1.0e-12))))


@wp.func
def _chord(r: float, b: float) -> float:
    """Half the chord of a circle at the distance b from its centre [m]."""
    return wp.sqrt(wp.max((r - b) * (r + b), 0.0))


@wp.func
def _cosines(port: Port, p: float) -> wp.vec4:
    """Index times cosine at the interfaces, of a ray of index times distance p [m]."""
    n = port.index
    inner = port.radius
    outer = port.radius + port.thickness
    b = p / n[1]
    return wp.vec4(
        n[0] * _chord(inner, p / n[0]) / inner,
        n[1] * _chord(inner, b) / inner,
        n[1] * _chord(outer, b) / outer,
        n[2] * _chord(outer, p / n[2]) / outer,
    )


@wp.func
def cosines_dome(port: Port, x: wp.vec3, u: wp.vec3) -> wp.vec4:
    """Index times cosine at the interfaces of the ray through x in the water along u."""
    return _cosines(port, port.index[2] * wp.length(wp.cross(x - port.centre, u)))


@wp.func
def _transmission(port: Port, p: float) -> float:
    """That of a ray of index times distance p [m]."""
    n = port.index
    return transmission(wp.vec4(n[0], n[1], n[1], n[2]), _cosines(port, p))


@wp.func
def connect_dome(port: Port, x: wp.vec3, o: wp.vec3) -> Connection:
    """The way from x in the water to o inside."""
    c = Connection()
    n = port.index
    inner = port.radius
    outer = port.radius + port.thickness
    y = x - port.centre
    r = wp.length(y)
    z = o - port.centre
    d = wp.length(z)
    if r <= outer or d >= inner:
        return c
    to_x = y / r
    e = to_x
    if d > 1.0e-9:
        e = z / d
    cosine = wp.dot(e, to_x)
    if cosine < 0.0:  # the axis through o and the centre, on the side of x, where no angle is near pi
        e = -e
        d = -d
        cosine = -cosine
    aside = wp.cross(e, to_x)
    sine = wp.length(aside)
    beta = wp.atan2(sine, cosine)
    i = wp.atan2(r * sine, r * cosine - d)
    slope = float(1.0)
    for _ in range(_STEPS):
        p = n[0] * d * wp.sin(i)
        t0 = _turn(p, n[0] * inner)
        t1 = _turn(p, n[1] * inner)
        t2 = _turn(p, n[1] * outer)
        t3 = _turn(p, n[2] * outer)
        t4 = _turn(p, n[2] * r)
        bend = (t1 - t0) + (t3 - t2) - t4
        slope = 1.0 + n[0] * d * wp.cos(i) * bend[1]
        step = (beta - i - bend[0]) / slope
        i += step
        if wp.abs(step) <= _LAST_STEP * i:
            break
    sin_i = wp.sin(i)
    cos_i = wp.cos(i)
    p = n[0] * d * sin_i
    toward = (to_x - cosine * e) / wp.max(sine, 1.0e-20)
    heading = beta + wp.asin(p / (n[2] * r))
    c.to_port = -wp.cos(heading) * e - wp.sin(heading) * toward
    c.inside = -cos_i * e - sin_i * toward
    air = _chord(inner, p / n[0]) - d * cos_i
    glass = _chord(outer, p / n[1]) - _chord(inner, p / n[1])
    water_out = _chord(r, p / n[2])
    c.water = water_out - _chord(outer, p / n[2])
    c.exit = x + c.water * c.to_port
    c.path = c.water + port.delay[0] * air + port.delay[1] * glass
    c.transmission = _transmission(port, p)
    # sin(alpha) |d alpha/d beta|/(d^2 sin(beta) |cos i|) with alpha = asin(p/(n_w r)) put in.
    spread = 1.0 / slope
    if sine > 1.0e-12:
        spread = sin_i / sine
    c.density = n[0] * n[0] * spread / (n[2] * n[2] * r * water_out * wp.abs(slope))
    return c


@wp.func
def apparent_dome(port: Port, x: wp.vec3, o: wp.vec3, c: Connection) -> wp.vec3:
    """The point of the ray of a connection from x to o, if it goes straight on, that is nearest to o."""
    return x + wp.dot(o - x, c.to_port) * c.to_port


@wp.func
def apparent_centre_dome(port: Port) -> wp.vec3:
    """The lens's centre: from near the centre of a dome, rays hardly bend."""
    return wp.vec3(0.0)


@wp.func
def leave_dome(port: Port, x: wp.vec3, u: wp.vec3) -> Passage:
    """What comes of a ray from x in the water along u, up to the plane z = 0 inside; x may lie behind the port, on the
    ray as it goes straight on."""
    p = Passage()
    n = port.index
    inner = port.radius
    outer = port.radius + port.thickness
    y = x - port.centre
    to_middle = -wp.dot(y, u)
    b = wp.length(wp.cross(y, u))
    if b >= outer:
        return p
    water = to_middle - _chord(outer, b)
    first = y + water * u
    glass = refracted(u, wp.normalize(first), n[2] / n[1])
    b1 = b * n[2] / n[1]
    b0 = b * n[2] / n[0]
    if b1 >= inner or b0 >= inner:
        return p
    through = _chord(outer, b1) - _chord(inner, b1)
    second = first + through * glass
    p.u = refracted(glass, wp.normalize(second), n[1] / n[0])
    if p.u[2] >= 0.0:
        return p
    length = -(second[2] + port.centre[2]) / p.u[2]
    if length <= 0.0 or length >= 2.0 * _chord(inner, b0):
        return p
    p.water = water
    p.x = second + port.centre + length * p.u
    p.path = port.delay[0] * length + port.delay[1] * through
    p.transmission = _transmission(port, n[0] * b0)
    return p


@wp.func
def enter_dome(port: Port, x: wp.vec3, u: wp.vec3) -> Passage:
    """What comes of a ray from x inside along u, up to where it enters the water."""
    p = Passage()
    n = port.index
    inner = port.radius
    outer = port.radius + port.thickness
    y = x - port.centre
    b0 = wp.length(wp.cross(y, u))
    b1 = b0 * n[0] / n[1]
    b2 = b0 * n[0] / n[2]
    if wp.dot(y, y) >= inner * inner or b1 >= inner or b2 >= outer:
        return p
    length = _chord(inner, b0) - wp.dot(y, u)
    first = y + length * u
    glass = refracted(u, wp.normalize(first), n[0] / n[1])
    through = _chord(outer, b1) - _chord(inner, b1)
    second = first + through * glass
    p.x = second + port.centre
    p.u = refracted(glass, wp.normalize(second), n[1] / n[2])
    p.path = port.delay[0] * length + port.delay[1] * through
    p.transmission = _transmission(port, n[0] * b0)
    return p
