"""Phase functions: densities against published values and closed integrals, samples and tables against densities."""

import math

import numpy as np
import pytest
from numpy.polynomial.legendre import leggauss
from scipy import stats

import spadwarp_kernels as sk
from helpers.launch import each
from helpers.statistics_of_samples import chi2_p, sample_count
from reference import fournier_forand
from reference.single_scatter import henyey_greenstein
from spadwarp_kernels import HENYEY_GREENSTEIN, TABULATED

COUNT = 1_000_000
FLAT = 2.0**-32  # the tables are constant up to here
ANISOTROPIES = [-0.7, 0.0, 0.01, 0.5, 0.924, 0.99]

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


# ---- Densities in float64.


@pytest.mark.parametrize(
    ("index", "slope", "fraction"),
    [  # Mobley, Ocean Optics Web Book, table of Fournier-Forand phase functions
        (1.021, 3.0742, 0.0001),
        (1.040, 3.2010, 0.001),
        (1.08, 3.483, 0.01),
        (1.10, 3.5835, 0.0183),
        (1.175, 4.065, 0.1),
        (1.15, 4.874, 0.4),
    ],
)
def test_fournier_forand_scatters_back_the_published_fraction(index, slope, fraction):
    """To the published digits; to ten of the closed integral."""
    back = sk.sphere_integral(lambda t: sk.fournier_forand_density(t, index, slope) * (t > 1))
    assert back == pytest.approx(fraction, rel=0.035 if fraction < 0.001 else 0.005)
    assert back == pytest.approx(1 - float(fournier_forand.cumulative(1.0, index, slope)), rel=1e-10)
    assert sk.sphere_integral(lambda t: sk.fournier_forand_density(t, index, slope)) == pytest.approx(1, abs=1e-4)


def test_fournier_forand_is_the_derivative_of_its_integral():
    t = np.geomspace(1e-9, 2.0, 500)
    t = t[np.abs(t / 0.015 - 1) > 0.02]
    expected = fournier_forand.density(t, 1.10, 3.5835)
    np.testing.assert_allclose(sk.fournier_forand_density(t, 1.10, 3.5835), expected, rtol=1e-9)
    # Both brackets of the formula vanish where delta is 1: no seam there.
    seam = np.linspace(0.0149, 0.0151, 4001)
    assert np.abs(np.diff(np.log(sk.fournier_forand_density(seam, 1.10, 3.5835)), 2)).max() < 1e-9


def test_values_of_the_reference():
    """Henyey-Greenstein understates what comes straight back: p(180°) of Fournier-Forand is 1.75 times that of
    g = 0.924. Two terms are a mixture."""
    back = float(sk.fournier_forand_density(2.0, 1.10, 3.5835))
    assert back == pytest.approx(0.00286, abs=5e-6)
    assert back / henyey_greenstein(-1, 0.924) == pytest.approx(1.749, abs=5e-4)
    # p(0) amplifies the rounding of g in float32.
    p = each(HENYEY_GREENSTEIN.pdf, [np.float32([2.0, 0.0]), medium_of("cpu", g=0.924)])
    np.testing.assert_allclose(p, [1.633780e-3, 26.50745], rtol=2e-6)
    t = np.linspace(0, 2, 9)
    expected = 0.7 * henyey_greenstein(1 - t, 0.9) + 0.3 * henyey_greenstein(1 - t, -0.2)
    np.testing.assert_allclose(sk.two_term_henyey_greenstein_density(t, 0.9, -0.2, 0.7), expected, rtol=1e-12)


def test_measured_points_are_joined_by_power_laws():
    density = sk.interpolated_density([0.1, 0.4, 3.0], [8.0, 2.0, 1.0])
    at = [float(density(2 * math.sin(0.5 * angle) ** 2)) for angle in (0.05, 0.1, 0.2, 0.4, 3.0, 3.1)]
    np.testing.assert_allclose(np.array(at) / at[1], [2.0, 1.0, 0.5, 0.25, 0.125, 0.125], rtol=1e-9)
    assert sk.sphere_integral(density) == pytest.approx(1.0, rel=1e-12)
    # Linear next to a zero; nothing below 0.
    gap = sk.interpolated_density([0.0, 1.0, 2.0], [1.0, 0.0, 1.0])
    at = [float(gap(2 * math.sin(0.5 * angle) ** 2)) for angle in (0.5, 1.0, 1.5, 2.5)]
    np.testing.assert_allclose(np.array(at) / at[3], [0.5, 0.0, 0.5, 1.0], atol=1e-12)


# ---- Samples and densities of the kernels.


def medium_of(device, density="two_term", g=0.85):
    medium = sk.Medium()
    medium.anisotropy, medium.phase = g, sk.make_phase_tables(DENSITIES[density], device=device)
    return medium


def sampled(phase, medium, device, count=COUNT):
    xi = np.minimum(np.random.default_rng(11).random(count), 1 - 2.0**-24).astype(np.float32)
    return each(phase.sample, [xi, medium], device=device)


@pytest.mark.physics
@pytest.mark.parametrize("g", ANISOTROPIES)
def test_henyey_greenstein_has_its_law_and_mean_cosine(g, device):
    def law(t):
        """Distribution function, from the integral of the density in float64."""
        h = float(np.float32(g))
        return t / 2 if h == 0 else (1 - h * h) / (2 * h) * (1 / (1 - h) - 1 / np.sqrt((1 - h) ** 2 + 2 * h * t))

    values = sampled(HENYEY_GREENSTEIN, medium_of(device, g=g), device, sample_count(device))
    assert values.min() >= 0.0 and values.max() <= 2.0
    assert chi2_p(values, law) > 1e-4
    # Of 0.99 a third of all angles lie below 3e-3 rad, where 1 - cos in float32 would be a few grid steps.
    assert g < 0.99 or len(np.unique(values[values < 5e-6])) > 20_000
    # The standard error of a mean of 2e6 numbers in [-1, 1] is below 7.1e-4.
    assert abs(1 - values.mean() - g) < 5 * values.std() / np.sqrt(values.size)
    fine = np.concatenate([[0.0], np.geomspace(1e-9, 1.0, 20_001)])
    edges = np.concatenate([fine, 2.0 - fine[-2::-1]])
    middle = 0.5 * (edges[1:] + edges[:-1])
    density = each(HENYEY_GREENSTEIN.pdf, [middle.astype(np.float32), medium_of(device, g=g)], device=device)
    mass = 2.0 * np.pi * density * np.diff(edges)
    assert mass.sum() == pytest.approx(1.0, abs=2e-5)
    assert (mass * (1 - middle)).sum() == pytest.approx(g, abs=2e-5)


# ---- Tables.


def distribution(density):
    """Distribution function of t from its own quadrature of the density, constant up to FLAT as the tables are."""
    near, far = FLAT * np.geomspace(1e-300 / FLAT, 1.0, 4001)[1:], np.geomspace(FLAT, 1.0, 8001)[1:]
    edges = np.concatenate([[0.0], near, far, 2.0 - np.geomspace(1e-9, 1.0, 8001)[-2::-1], [2.0]])
    node, weight = leggauss(4)
    t = 0.5 * (edges[1:] + edges[:-1])[:, None] + 0.5 * np.diff(edges)[:, None] * node
    mass = np.pi * np.diff(edges) * (density(np.maximum(t, 1e-300)) @ weight)
    total = np.concatenate([[0.0], np.cumsum(mass)])
    total, edges = total[edges >= FLAT * (1 - 1e-9)] / total[-1], edges[edges >= FLAT * (1 - 1e-9)]
    return lambda x: np.interp(x, np.concatenate([[0.0], edges]), np.concatenate([[0.0], total]))


@pytest.mark.physics
@pytest.mark.parametrize("name", DENSITIES)
def test_samples_follow_what_was_tabulated_and_densities_integrate_to_one(name, device):
    medium = medium_of(device, name)
    values = sampled(TABULATED, medium, device)
    assert values.min() >= 0.0 and values.max() <= 2.0
    assert chi2_p(values, distribution(DENSITIES[name]), bins=100) > 1e-5
    mean = sk.sphere_integral(lambda t: t * DENSITIES[name](t)) / sk.sphere_integral(DENSITIES[name])
    assert abs(values.mean() - mean) < 5 * values.std() / math.sqrt(COUNT)
    forward = np.concatenate([[0.0], np.geomspace(1e-12, 1.0, 40_001)])
    edges = np.concatenate([forward, 2.0 - forward[-2::-1]])
    solid_angle, t = 2 * np.pi * np.diff(edges), 0.5 * (edges[1:] + edges[:-1])
    lobe = each(TABULATED.guide.lobe_pdf, [t, medium, sk.Guiding()], device=device)
    for density in (each(TABULATED.pdf, [t, medium], device=device), lobe):
        assert (density * solid_angle).sum() == pytest.approx(1.0, abs=1e-4)
    # The angle at which a flight turns: complement falls from 1 to 0, and `angle` undoes it.
    theta = np.linspace(1e-5, math.pi, len(t))
    complement = each(TABULATED.guide.complement, [theta, medium], device=device)
    back = each(TABULATED.guide.angle, [complement, medium], device=device)
    assert (np.diff(complement) <= 0).all() and complement[-1] < 1e-6 < complement[0]
    inside = (complement[1:-1] > 1e-6) & (np.abs(np.diff(complement)[1:]) > 1e-5 * complement[1:-1])
    np.testing.assert_allclose(back[1:-1][inside], theta[1:-1][inside], rtol=1e-3)


@pytest.mark.physics
@pytest.mark.parametrize("name", ["henyey_greenstein 0.924", "henyey_greenstein -0.9", "fournier_forand", "steep"])
def test_tables_are_true_to_the_function(name):
    """To a few thousandths at any angle; the angle at which a flight turns is drawn from the same function."""
    medium = medium_of("cpu", name)
    t = np.concatenate([np.geomspace(1e-9, 1.0, 20_000), 2.0 - np.geomspace(1e-5, 1.0, 20_000)]).astype(np.float32)
    np.testing.assert_allclose(each(TABULATED.pdf, [t, medium]), DENSITIES[name](t.astype(np.float64)), rtol=2e-3)
    theta = np.concatenate([np.geomspace(1e-4, 1.0, 20_000), np.linspace(1.0, 3.14, 20_000)]).astype(np.float32)
    q, complement = (each(f, [theta, medium]) for f in (TABULATED.guide.density, TABULATED.guide.complement))
    turned = DENSITIES[name](2.0 * np.sin(0.5 * theta.astype(np.float64)) ** 2)
    np.testing.assert_allclose(q / turned, np.median(q / turned), rtol=5e-3)
    # The complement is the integral of q from the angle on.
    parts = 0.5 * (q[1:] + q[:-1]) * np.diff(theta.astype(np.float64))
    np.testing.assert_allclose(complement[:-1], complement[-1] + np.cumsum(parts[::-1])[::-1], rtol=2e-3)


@pytest.mark.physics
def test_the_forward_peak_is_resolved_far_below_a_tenth_of_a_degree():
    """5 % of Petzold's light turns by less than 0.1 degrees; the tables spread it over two thousand times less."""
    angle = np.degrees(np.sqrt(2.0 * sampled(TABULATED, medium_of("cpu", "fournier_forand"), "cpu")))
    for limit in (0.1, 0.01, 0.0015):
        expected = float(fournier_forand.cumulative(2.0 * math.sin(math.radians(limit) / 2) ** 2, 1.10, 3.5835))
        assert stats.binomtest(int((angle < limit).sum()), COUNT, expected).pvalue > 1e-4
    assert len(np.unique(angle[angle < 0.1])) > 0.9 * (angle < 0.1).sum()
