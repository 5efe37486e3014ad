"""The references for polarised light against published values, exact limits and each other."""

import numpy as np
import pytest

from reference.polarised_lidar import linear, pencil, stokes_factor
from reference.single_scatter import Lidar, single_scatter, single_scatter_total
from reference.stokes import analysed, block_matrix, rayleigh_density, rayleigh_matrix, reciprocal, scattered

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


def test_two_ways_through_two_scatterings_are_reciprocal():
    """P·Mᵀ·P is the matrix of the reversed way, the plain transpose is not."""
    rng = np.random.default_rng(2)
    first, middle, last = _units(rng.normal(size=(3, 3)))
    start, end = (_units(np.cross(rng.normal(size=3), k)) for k in (first, last))
    between = _units(np.cross(rng.normal(size=3), middle))

    def way(directions, references):
        stokes = np.eye(4)
        for k, new, r, r_new in zip(directions[:-1], directions[1:], references[:-1], references[1:], strict=True):
            stokes = scattered(stokes, r, k, new, r_new, _with_circular)
        return stokes.T

    there = way((first, middle, last), (start, between, end))
    back = way((-last, -middle, -first), (end, between, start))
    np.testing.assert_allclose(back, reciprocal(there), atol=1e-12)
    assert np.abs(back - there.T).max() > 0.01


def test_a_pulse_that_scatters_once_is_the_same_from_the_laser_s_side_and_from_the_camera_s():
    case = Lidar(half_angle=np.radians(20.0), field_of_view=np.radians(60.0), pixels=8, edges=np.arange(1.0, 5.0))
    factor = stokes_factor(case, _with_circular, linear(np.radians(30.0)))
    found = single_scatter(case, factor=factor).sum((0, 1))
    expected = single_scatter_total(case, order=120, factor=factor)
    # what keeps them apart is the rim of the cone across the pixels
    np.testing.assert_allclose(found / expected[:, :1], expected / expected[:, :1], rtol=0, atol=2e-3)


def test_light_scattered_straight_back_by_rayleigh_keeps_its_plane():
    """Beside the lens, seen at small angles: co-polarised at the laser's angle, nothing across it."""
    case = Lidar(laser_position=(-1e-3, 0.0, 0.0), field_of_view=np.radians(2.0), phase_function=rayleigh_density)
    for angle in np.radians([0.0, 30.0, -60.0]):
        seen = pencil(case, stokes_factor(case, rayleigh_matrix, linear(angle)))
        co, cross = np.moveaxis(analysed(seen, angle), -1, 0)
        np.testing.assert_allclose(co, seen[:, 0], rtol=1e-5)
        np.testing.assert_allclose(cross / co, 0.0, atol=1e-5)
    # A cone of almost no width is the pencil.
    narrow = Lidar(laser_position=(-1e-3, 0.0, 0.0), half_angle=1e-4, phase_function=rayleigh_density)
    cone = single_scatter_total(narrow, order=12, factor=stokes_factor(narrow, rayleigh_matrix, linear(0.3)))
    beam = pencil(narrow, stokes_factor(narrow, rayleigh_matrix, linear(0.3)))
    np.testing.assert_allclose(cone, beam, rtol=1e-5, atol=1e-7 * beam[:, 0].min())


def _with_circular(cos_scatter):
    """A Rayleigh-like matrix with all its elements different."""
    mu = np.asarray(cos_scatter)
    sine = np.sqrt(np.maximum(1.0 - mu**2, 0.0))
    return block_matrix(-0.6 * (1.0 - mu**2), 1.0 - 0.2 * sine, 0.8 * mu, 0.3 * sine * (1.0 + mu), 0.7 * mu)


def _units(vectors):
    return vectors / np.linalg.norm(vectors, axis=-1, keepdims=True)
