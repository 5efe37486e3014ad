"""A flat port: a plane window, or a calm surface without one.

Snell's invariant k = n sin(theta) is the same in all layers. It is written in t = k/sqrt(m^2 - k^2), m the least index,
in which no difference cancels: tan(theta_i) = m t/sqrt(n_i^2 + (n_i^2 - m^2) t^2).
"""

import warp as wp

from .port import Connection, Passage, Port, transmission

# Newton's method rises monotonically to the one root: 3 steps at 15 degrees in air, 5 at 63; beyond the critical angle,
# where nearly all of the way is in a thin layer of air, up to about 12. After a step of this size, relative to t, the
# error is its square.
_STEPS = wp.constant(16)
_LAST_STEP = wp.constant(1.0e-4)


@wp.func
def snell_tangent(h: wp.vec3, n: wp.vec3, aside: float) -> float:
    """t of the ray that gets `aside` [m] on its way through layers of thicknesses h [m] >= 0 and indices n."""
    m = wp.min(n[0], wp.min(n[1], n[2]))
    n2 = wp.cw_mul(n, n)
    e = wp.vec3((n[0] - m) * (n[0] + m), (n[1] - m) * (n[1] + m), (n[2] - m) * (n[2] + m))
    t = aside / (m * (h[0] / n[0] + h[1] / n[1] + h[2] / n[2]))
    for _ in range(_STEPS):
        t2 = t * t
        value = float(0.0)
        slope = float(0.0)
        for i in range(3):
            root = 1.0 / wp.sqrt(n2[i] + e[i] * t2)
            value += h[i] * root
            slope += h[i] * n2[i] * root * root * root
        step = (aside / m - t * value) / slope
        t += step
        if wp.abs(step) <= _LAST_STEP * t:
            break
    return t


@wp.func
def connect_flat(port: Port, x: wp.vec3, o: wp.vec3) -> Connection:
    """The way from x in the water to o inside."""
    c = Connection()
    y = x - o
    along = wp.dot(y, port.normal)
    inside = port.distance - wp.dot(o, port.normal)
    h = wp.vec3(inside, port.thickness, along - inside - port.thickness)
    if h[0] <= 0.0 or h[2] <= 0.0:
        return c
    across = y - along * port.normal
    aside = wp.length(across)
    across = across / wp.max(aside, 1.0e-30)
    n = port.index
    m = wp.min(n[0], wp.min(n[1], n[2]))
    t = snell_tangent(h, n, aside)
    cos_m = 1.0 / wp.sqrt(1.0 + t * t)
    k = m * t * cos_m
    q = wp.vec3()  # n cos(theta)
    for i in range(3):
        q[i] = cos_m * wp.sqrt(n[i] * n[i] + (n[i] - m) * (n[i] + m) * t * t)
    c.to_port = -(k / n[2]) * across - (q[2] / n[2]) * port.normal
    c.inside = -(k / n[0]) * across - (q[0] / n[0]) * port.normal
    length = wp.vec3(h[0] * n[0] / q[0], h[1] * n[1] / q[1], h[2] * n[2] / q[2])
    c.water = length[2]
    c.exit = x + c.water * c.to_port
    c.path = c.water + port.delay[0] * length[0] + port.delay[1] * length[1]
    c.transmission = transmission(wp.vec4(n[0], n[1], n[1], n[2]), wp.vec4(q[0], q[1], q[1], q[2]))
    # d(Omega)/dA = k/(n_w^2 cos(theta_w) rho rho'(k)) on the port's plane; rho/k and rho' are sums of positive terms.
    ratio = length[0] / n[0] + length[1] / n[1] + length[2] / n[2]
    slope = length[0] * n[0] / (q[0] * q[0]) + length[1] * n[1] / (q[1] * q[1]) + length[2] * n[2] / (q[2] * q[2])
    c.density = n[0] / (n[2] * q[0] * q[2] * ratio * slope)
    return c


@wp.func
def apparent_flat(port: Port, x: wp.vec3, o: wp.vec3, c: Connection) -> wp.vec3:
    """Where the ray of a connection from x to o meets the port's axis through o if it goes straight on."""
    n = port.index
    q_water = -n[2] * wp.dot(c.to_port, port.normal)
    q_inside = -n[0] * wp.dot(c.inside, port.normal)
    k2 = n[0] * n[0] - q_inside * q_inside
    q_glass = wp.sqrt(n[1] * n[1] - k2)
    inside = port.distance - wp.dot(o, port.normal)
    behind = inside * q_water / q_inside + port.thickness * q_water / q_glass
    return o + (inside + port.thickness - behind) * port.normal


@wp.func
def apparent_centre_flat(port: Port) -> wp.vec3:
    """`apparent_flat` of the lens's centre, for rays along the normal."""
    n = port.index
    behind = port.distance * n[2] / n[0] + port.thickness * n[2] / n[1]
    return (port.distance + port.thickness - behind) * port.normal


@wp.func
def leave_flat(port: Port, x: wp.vec3, u: wp.vec3) -> Passage:
    """What comes of a ray from x in the water along u, up to the plane z = 0 inside; x may lie behind the port, on the
    ray as it goes straight on."""
    p = Passage()
    n = port.index
    cosine = -wp.dot(u, port.normal)
    behind = wp.dot(x, port.normal) - port.distance - port.thickness
    across = n[2] * (u + cosine * port.normal)
    k2 = wp.dot(across, across)
    least = wp.min(n[0], n[1])
    if cosine <= 0.0 or k2 >= least * least:
        return p
    q0 = wp.sqrt(n[0] * n[0] - k2)
    q1 = wp.sqrt(n[1] * n[1] - k2)
    p.water = behind / cosine
    glass = port.thickness / q1
    inner = x + p.water * u + glass * across - port.thickness * port.normal
    p.u = (across - q0 * port.normal) / n[0]
    if p.u[2] >= 0.0:
        return p
    length = -inner[2] / p.u[2]
    p.x = inner + length * p.u
    p.path = port.delay[0] * length + port.delay[1] * glass * n[1]
    p.transmission = transmission(wp.vec4(n[0], n[1], n[1], n[2]), wp.vec4(q0, q1, q1, n[2] * cosine))
    return p


@wp.func
def enter_flat(port: Port, x: wp.vec3, u: wp.vec3) -> Passage:
    """What comes of a ray from x inside along u, up to where it enters the water."""
    p = Passage()
    n = port.index
    cosine = wp.dot(u, port.normal)
    before = port.distance - wp.dot(x, port.normal)
    across = n[0] * (u - cosine * port.normal)
    k2 = wp.dot(across, across)
    least = wp.min(n[1], n[2])
    if cosine <= 0.0 or before <= 0.0 or k2 >= least * least:
        return p
    q1 = wp.sqrt(n[1] * n[1] - k2)
    q2 = wp.sqrt(n[2] * n[2] - k2)
    length = before / cosine
    glass = port.thickness / q1
    p.x = x + length * u + glass * across + port.thickness * port.normal
    p.u = (across + q2 * port.normal) / n[2]
    p.path = port.delay[0] * length + port.delay[1] * glass * n[1]
    p.transmission = transmission(wp.vec4(n[0], n[1], n[1], n[2]), wp.vec4(n[0] * cosine, q1, q1, q2))
    return p


@wp.func
def cosines_flat(port: Port, x: wp.vec3, u: wp.vec3) -> wp.vec4:
    """Index times cosine at the interfaces of the ray through x in the water along u."""
    n = port.index
    across = n[2] * wp.cross(u, port.normal)
    k2 = wp.dot(across, across)
    q0 = wp.sqrt(wp.max(n[0] * n[0] - k2, 0.0))
    q1 = wp.sqrt(wp.max(n[1] * n[1] - k2, 0.0))
    return wp.vec4(q0, q1, q1, n[2] * wp.abs(wp.dot(u, port.normal)))
