"""Phase functions in float64 against published values, closed integrals and each other."""

import math

import numpy as np
import pytest

import spadwarp_kernels as sk
from reference import fournier_forand
from reference.single_scatter import henyey_greenstein


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


def test_henyey_greenstein_understates_what_comes_straight_back():
    """p(180°) of Fournier-Forand is 0.00286 per steradian, 1.75 times that of Henyey-Greenstein of g = 0.924."""
    back = float(sk.fournier_forand_density(2.0, 1.10, 3.5835))
    assert back == pytest.approx(0.00286, abs=5e-6)
    assert back / henyey_greenstein(-1, 0.924) == pytest.approx(1.749, abs=5e-4)
    assert back == pytest.approx(float(fournier_forand.density(2.0, 1.10, 3.5835)), rel=1e-9)


def test_two_terms_are_a_mixture():
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


@pytest.mark.parametrize(
    ("angles", "values", "text"),
    [
        ([0.1], [1.0], "two or more"),
        ([0.1, 0.1], [1.0, 1.0], "ascending"),
        ([0.1, 4.0], [1.0, 1.0], "outside"),
        ([-0.1, 1.0], [1.0, 1.0], "outside"),
        ([0.1, 1.0], [1.0, -1.0], "not negative"),
        ([0.1, 1.0], [0.0, 0.0], "not all 0"),
        ([0.1, 1.0], [1.0, math.nan], "finite"),
    ],
)
def test_what_is_no_phase_function_is_refused(angles, values, text):
    with pytest.raises(ValueError, match=text):
        sk.interpolated_density(angles, values)
