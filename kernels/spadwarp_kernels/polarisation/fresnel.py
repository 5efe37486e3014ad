"""Fresnel's equations for polarised light: reflection by a smooth boundary, transmission through a window.

Elements are with respect to the plane of incidence, with the parallel direction turned along with the ray, as for
scattering: light that is reflected straight back has m33 = m44 = -1 (Born & Wolf, section 1.5; signs as in Bohren &
Huffman 1983, section 2.7).
"""

import warp as wp

from spadwarp_kernels.math.once import made_once
from spadwarp_kernels.port.kinds import PortKind
from spadwarp_kernels.port.port import Port

from .stokes import Elements


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


@made_once
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
