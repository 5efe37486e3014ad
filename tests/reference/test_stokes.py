"""The references for polarised light against published values, exact limits and each other."""

import numpy as np
import pytest

from reference.polarised_lidar import linear, stokes_factor
from reference.single_scatter import Lidar, single_scatter, single_scatter_total
from reference.stokes import block_matrix, rayleigh_density, rayleigh_matrix, scattered

pytestmark = pytest.mark.physics


def test_the_field_of_a_driven_dipole_is_the_rayleigh_matrix():
    """Light of any linear polarisation sets a dipole in motion, whose field is the projection across the direction."""
    rng = np.random.default_rng(1)
    incoming, outgoing, axis = (_units(rng.normal(size=(50, 3))) for _ in range(3))
    field = _units(np.cross(axis, incoming))
    radiated = field - (field * outgoing).sum(-1, keepdims=True) * outgoing
    found = scattered(
        [1.0, 1.0, 0.0, 0.0], field, incoming, outgoing, _units(np.cross(axis, outgoing)), rayleigh_matrix
    )
    first = _units(np.cross(axis, outgoing))
    e1, e2 = (radiated * first).sum(-1), (radiated * np.cross(first, outgoing)).sum(-1)
    expected = np.stack([e1**2 + e2**2, e1**2 - e2**2, 2.0 * e1 * e2, 0.0 * e1], -1)
    # p11 of Rayleigh is proportional to 1 + cos², half of which the matrix has been divided by.
    found *= 0.5 * (1.0 + (incoming * outgoing).sum(-1, keepdims=True) ** 2)
    np.testing.assert_allclose(found, expected, atol=1e-12)


def test_depolarised_rayleigh_scattering_has_its_ratio_and_its_density():
    for ratio in (0.0, 0.039, 0.2):
        i, q = rayleigh_matrix(np.array(0.0), ratio)[:2, 0]
        assert (i + q) / (i - q) == pytest.approx(ratio, abs=1e-14)
        x, gauss = np.polynomial.legendre.leggauss(8)
        assert 2.0 * np.pi * (gauss @ rayleigh_density(x, ratio)) == pytest.approx(1.0, rel=1e-12)


def test_a_pulse_that_scatters_once_is_the_same_from_the_laser_s_side_and_from_the_camera_s():
    case = Lidar(half_angle=np.radians(20.0), field_of_view=np.radians(60.0), pixels=8, edges=np.arange(1.0, 5.0))
    factor = stokes_factor(case, _with_circular, linear(np.radians(30.0)))
    found = single_scatter(case, factor=factor).sum((0, 1))
    expected = single_scatter_total(case, order=120, factor=factor)
    # what keeps them apart is the rim of the cone across the pixels
    np.testing.assert_allclose(found / expected[:, :1], expected / expected[:, :1], rtol=0, atol=2e-3)


def _with_circular(cos_scatter):
    """A Rayleigh-like matrix with all its elements different."""
    mu = np.asarray(cos_scatter)
    sine = np.sqrt(np.maximum(1.0 - mu**2, 0.0))
    return block_matrix(-0.6 * (1.0 - mu**2), 1.0 - 0.2 * sine, 0.8 * mu, 0.3 * sine * (1.0 + mu), 0.7 * mu)


def _units(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
