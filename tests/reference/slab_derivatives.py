"""Derivatives of what a slab reflects and transmits, from adding and doubling: by a and b along the imaginary axis,
where nothing cancels, by g from central differences of fourth order."""

import numpy as np

from reference.adding_doubling import _needed_nodes, slab


def slab_derivatives(*, anisotropy, albedo, optical_depth):
    """d(reflected, transmitted)/d(absorption, scattering, anisotropy), `[2, 3]`; the extinction is 1 1/m."""
    nodes, step = _needed_nodes(anisotropy), 1e-20
    a, b, thickness = 1.0 - albedo, albedo, optical_depth

    def leaving(absorption, scattering, g):
        c = absorption + scattering
        solved = slab(anisotropy=g, albedo=scattering / c, optical_depth=c * thickness, nodes=nodes)
        return np.array([solved.reflected, solved.transmitted])

    by_absorption = leaving(a + 1j * step, b, anisotropy).imag / step
    by_scattering = leaving(a, b + 1j * step, anisotropy).imag / step
    h = 2e-3
    moved = {k: leaving(a, b, anisotropy + k * h) for k in (-2, -1, 1, 2)}
    by_anisotropy = (8.0 * (moved[1] - moved[-1]) - (moved[2] - moved[-2])) / (12.0 * h)
    return np.stack([by_absorption, by_scattering, by_anisotropy], axis=1)
