"""Scattering matrices: measured, of particles, and from files."""

import numpy as np
import pytest

import spadwarp

pytestmark = pytest.mark.physics


def coherency(matrix):
    """Cloude's coherency matrices [n, 4, 4] of m12, m22, m33, m34, m44 [n, 5]: no negative eigenvalue if physical."""
    m12, m22, m33, m34, m44 = np.moveaxis(matrix, -1, 0)
    result = np.zeros((len(matrix), 4, 4), np.complex128)
    result[:, 0, 0], result[:, 1, 1] = 1.0 + m22 + m33 + m44, 1.0 + m22 - m33 - m44
    result[:, 2, 2], result[:, 3, 3] = 1.0 - m22 + m33 - m44, 1.0 - m22 - m33 + m44
    result[:, 0, 1] = 2.0 * m12 - 2.0j * m34
    result[:, 1, 0] = result[:, 0, 1].conj()
    return 0.25 * result


def test_ocean_water_has_a_physical_matrix_as_it_was_measured():
    cosine = np.cos(np.radians(np.linspace(0.0, 180.0, 361)))
    matrix = spadwarp.water.voss_fry_matrix(cosine)
    assert matrix.shape == (361, 5)
    assert np.linalg.eigvalsh(coherency(matrix)).min() > -1e-12
    m12, m22, m33, m34, m44 = matrix.T
    assert m12.min() == pytest.approx(-0.66) and np.argmin(m12) == 180
    assert not m34.any() and np.array_equal(m33, m44)
    # straight on the plane of polarisation is that of nothing but the light's own
    assert m22[0] == pytest.approx(m33[0], abs=1e-4) and m12[0] == 0.0
    # 21 % of the light scattered straight back has lost its polarisation: a depolarisation ratio of 0.12
    assert (1.0 - m22[-1]) / (1.0 + m22[-1]) == pytest.approx(0.117, abs=0.001)
    assert m22[-1] == pytest.approx(-m33[-1], abs=0.006)
