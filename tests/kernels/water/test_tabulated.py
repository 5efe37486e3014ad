"""Phase functions on tables: drawn as they claim, true to what was tabulated, resolved at the forward peak."""

import math

import numpy as np
import pytest
import warp as wp
from numpy.polynomial.legendre import leggauss
from scipy import stats

import spadwarp_kernels as sk
from helpers.launch import Floats, launched
from helpers.statistics_of_samples import chi2_p
from reference import fournier_forand
from spadwarp_kernels import TABULATED, random_block
from spadwarp_kernels.base.philox import u01_fine

pytestmark = pytest.mark.physics

COUNT = 1_000_000
FLAT = 2.0**-32  # the tables are constant up to here

# Petzold's harbour shape in five points, a table with a gap, and one with its peak straight back.
MEASURED = {
    "steep": ([0.1, 1.0, 10.0, 90.0, 180.0], [1767.0, 71.61, 1.153, 4.29e-3, 3.15e-3]),
    "gap": ([0.0, 20.0, 40.0, 60.0, 120.0, 180.0], [1.0, 0.5, 0.0, 0.0, 0.2, 0.1]),
}
DENSITIES = {
    "henyey_greenstein 0.924": lambda t: sk.henyey_greenstein_density(t, 0.924),
    "henyey_greenstein -0.9": lambda t: sk.henyey_greenstein_density(t, -0.9),
    "two_term": lambda t: sk.two_term_henyey_greenstein_density(t, 0.98, -0.4, 0.95),
    "fournier_forand": lambda t: sk.fournier_forand_density(t, 1.10, 3.5835),
    "fournier_forand, steepest": lambda t: sk.fournier_forand_density(t, 1.02, 3.05),
    **{name: sk.interpolated_density(np.radians(angles), values) for name, (angles, values) in MEASURED.items()},
}


@wp.kernel(enable_backward=False)
def _sample(medium: sk.Medium, seed: wp.uint64, t: Floats):
    i = wp.tid()
    xi = u01_fine(random_block(seed, wp.uint64(i), wp.uint32(0), wp.uint32(1))[1])
    t[i] = wp.static(TABULATED.sample)(xi, medium)


@wp.kernel(enable_backward=False)
def _evaluate(
    medium: sk.Medium, t: Floats, theta: Floats, p: Floats, lobe: Floats, complement: Floats, q: Floats, back: Floats
):
    i = wp.tid()
    guiding = sk.Guiding()
    p[i] = wp.static(TABULATED.pdf)(t[i], medium)
    lobe[i] = wp.static(TABULATED.guide.lobe_pdf)(t[i], medium, guiding)
    complement[i] = wp.static(TABULATED.guide.complement)(theta[i], medium)
    q[i] = wp.static(TABULATED.guide.density)(theta[i], medium)
    back[i] = wp.static(TABULATED.guide.angle)(complement[i], medium)


def _medium(name, device):
    medium = sk.Medium()
    medium.phase = sk.make_phase_tables(DENSITIES[name], device=device)
    return medium


def _evaluated(name, t, theta, device="cpu"):
    """pdf(t), lobe(t), complement(theta), q(theta), angle(complement(theta)) in float64."""
    return launched(_evaluate, [_medium(name, device), t, theta], [float] * 5, device)


def _fine_grid():
    forward = np.concatenate([[0.0], np.geomspace(1e-12, 1.0, 40_001)])
    return np.concatenate([forward, 2.0 - forward[-2::-1]])


def _cdf(density):
    """Distribution function of t from its own quadrature of the density, constant up to FLAT as the tables are."""
    edges = np.concatenate(
        [[0.0], FLAT * np.geomspace(1e-300 / FLAT, 1.0, 4001)[1:], np.geomspace(FLAT, 1.0, 8001)[1:]]
    )
    edges = np.concatenate([edges, 2.0 - np.geomspace(1e-9, 1.0, 8001)[-2::-1], [2.0]])
    node, weight = leggauss(4)
    t = 0.5 * (edges[1:] + edges[:-1])[:, None] + 0.5 * np.diff(edges)[:, None] * node
    mass = np.pi * np.diff(edges) * (density(np.maximum(t, 1e-300)) @ weight)
    total = np.concatenate([[0.0], np.cumsum(mass)])
    total, edges = total[edges >= FLAT * (1 - 1e-9)] / total[-1], edges[edges >= FLAT * (1 - 1e-9)]
    return lambda x: np.interp(x, np.concatenate([[0.0], edges]), np.concatenate([[0.0], total]))


@pytest.mark.parametrize("name", DENSITIES)
def test_samples_follow_what_was_tabulated(name, device):
    (values,) = launched(_sample, [_medium(name, device), 11], device=device, count=COUNT)
    assert values.min() >= 0.0 and values.max() <= 2.0
    assert chi2_p(values, _cdf(DENSITIES[name]), bins=100) > 1e-5
    mean = sk.sphere_integral(lambda t: t * DENSITIES[name](t)) / sk.sphere_integral(DENSITIES[name])
    assert abs(values.mean() - mean) < 5 * values.std() / math.sqrt(COUNT)


@pytest.mark.parametrize("name", DENSITIES)
def test_densities_integrate_to_one(name, device):
    edges = _fine_grid()
    middle = 0.5 * (edges[1:] + edges[:-1])
    theta = np.linspace(1e-5, math.pi, len(middle))
    p, lobe, complement, _, back = _evaluated(name, middle, theta, device)
    solid_angle = 2 * np.pi * np.diff(edges)
    assert (p * solid_angle).sum() == pytest.approx(1.0, abs=1e-4)
    assert (lobe * solid_angle).sum() == pytest.approx(1.0, abs=1e-4)
    # The angle at which a flight turns: complement falls from 1 to 0, and `angle` undoes it.
    assert (np.diff(complement) <= 0).all() and complement[-1] < 1e-6 < complement[0]
    inside = (complement[1:-1] > 1e-6) & (np.abs(np.diff(complement)[1:]) > 1e-5 * complement[1:-1])
    np.testing.assert_allclose(back[1:-1][inside], theta[1:-1][inside], rtol=1e-3)


@pytest.mark.parametrize("name", ["henyey_greenstein 0.924", "henyey_greenstein -0.9", "fournier_forand", "steep"])
def test_tables_are_true_to_the_function(name):
    """To a few thousandths at any angle; the angle at which a flight turns is drawn from the same function."""
    t = np.concatenate([np.geomspace(1e-9, 1.0, 20_000), 2.0 - np.geomspace(1e-5, 1.0, 20_000)]).astype(np.float32)
    theta = np.concatenate([np.geomspace(1e-4, 1.0, 20_000), np.linspace(1.0, 3.14, 20_000)]).astype(np.float32)
    p, _, complement, q, _ = _evaluated(name, t, theta)
    truth = DENSITIES[name](t.astype(np.float64))
    np.testing.assert_allclose(p, truth, rtol=2e-3)
    turned = DENSITIES[name](2.0 * np.sin(0.5 * theta.astype(np.float64)) ** 2)
    np.testing.assert_allclose(q / turned, np.median(q / turned), rtol=5e-3)
    # The complement is the integral of q from the angle on.
    parts = 0.5 * (q[1:] + q[:-1]) * np.diff(theta.astype(np.float64))
    rest = complement[-1] + np.cumsum(parts[::-1])[::-1]
    np.testing.assert_allclose(complement[:-1], rest, rtol=2e-3)


def test_the_forward_peak_is_resolved_far_below_a_tenth_of_a_degree():
    """5 % of Petzold's light turns by less than 0.1 degrees; the tables spread it over two thousand times less."""
    (t,) = launched(_sample, [_medium("fournier_forand", "cpu"), 3], count=COUNT)
    angle = np.degrees(np.sqrt(2.0 * t))
    for limit in (0.1, 0.01, 0.0015):
        expected = float(fournier_forand.cumulative(2.0 * math.sin(math.radians(limit) / 2) ** 2, 1.10, 3.5835))
        assert stats.binomtest(int((angle < limit).sum()), COUNT, expected).pvalue > 1e-4
    assert len(np.unique(angle[angle < 0.1])) > 0.9 * (angle < 0.1).sum()
