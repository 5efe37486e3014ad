"""Tables of large spheres against a Mie series of this test's own: no angle of the pattern is left out."""

import numpy as np
import pytest
from scipy.special import spherical_jn, spherical_yn

from spadwarp.water import mie_particles, refractive_index, single_size

pytest.importorskip("miepython")
IN_WATER = 532e-9 / refractive_index(532.0)


def series(x, m):
    """a_n and b_n by Bohren & Huffman 1983, eqs 4.53, 4.89 and appendix A: the logarithmic derivative downwards."""
    count = int(x + 4.0 * x ** (1 / 3) + 2.0) + 1
    y, start = m * x, int(1.2 * max(count, abs(m * x))) + 50
    log_derivative = np.zeros(start + 1, complex)
    for n in range(start, 0, -1):
        log_derivative[n - 1] = n / y - 1.0 / (log_derivative[n] + n / y)
    n = np.arange(count + 1)
    psi, xi = x * spherical_jn(n, x), x * (spherical_jn(n, x) + 1j * spherical_yn(n, x))
    n = n[1:]

    def coefficient(slope):
        return (slope * psi[1:] - psi[:-1]) / (slope * xi[1:] - xi[:-1])

    slopes = log_derivative[1 : count + 1]
    return coefficient(slopes / m + n / x), coefficient(slopes * m + n / x)


def backscattered(a, b, x):
    """The integral of the pattern over the backward half by Gauss's rule, which is exact for polynomials."""
    cosine, weight = np.polynomial.legendre.leggauss(len(a) + 2)
    cosine, weight = 0.5 * cosine - 0.5, 0.5 * weight
    pi, tau = np.zeros((len(a) + 1, cosine.size)), np.zeros((len(a) + 1, cosine.size))
    pi[1] = 1.0
    for n in range(1, len(a) + 1):
        if n > 1:
            pi[n] = ((2 * n - 1) * cosine * pi[n - 1] - n * pi[n - 2]) / (n - 1)
        tau[n] = n * cosine * pi[n] - (n + 1) * pi[n - 1]
    n = np.arange(1, len(a) + 1)
    factor = (2 * n + 1) / (n * (n + 1))
    s1, s2 = (factor * a) @ pi[1:] + (factor * b) @ tau[1:], (factor * a) @ tau[1:] + (factor * b) @ pi[1:]
    return (weight * (np.abs(s1) ** 2 + np.abs(s2) ** 2)).sum() / x**2


@pytest.mark.parametrize("diameter", [1e-6, 10e-6, 20e-6, 50e-6])
@pytest.mark.parametrize("index", [1.05, 1.18])
def test_tables_of_large_spheres_keep_their_moments(diameter, index):
    x = np.pi * diameter / IN_WATER
    a, b = series(x, index)
    n = np.arange(1, len(a) + 1)
    efficiency = 2.0 / x**2 * ((2 * n + 1) * (np.abs(a) ** 2 + np.abs(b) ** 2)).sum()
    pairs = (n * (n + 2) / (n + 1))[:-1] * (a[:-1] * a[1:].conj() + b[:-1] * b[1:].conj()).real
    cosine = 4.0 / x**2 * (pairs.sum() + ((2 * n + 1) / (n * (n + 1)) * (a * b.conj()).real).sum()) / efficiency
    spheres = mie_particles(single_size(diameter), 532.0, index=index, concentration=1.0)
    assert 1.0 - spheres.mean_cosine == pytest.approx(1.0 - cosine, rel=1e-3)
    assert spheres.backscatter_fraction == pytest.approx(backscattered(a, b, x) / efficiency, rel=1e-3)
    assert spheres.scattering == pytest.approx(1.5e-6 * efficiency / diameter, rel=1e-8)
