"""Sampling along a flight follows its own density."""

import math

import numpy as np
import pytest
import warp as wp
from scipy import stats

from helpers.launch import each
from spadwarp_kernels import TABULATED, Camera, Layers, Medium, fournier_forand_density, make_phase_tables
from spadwarp_kernels.estimators.contribution import FlightSample, make_sample_flight
from spadwarp_kernels.optics.visibility import LensSample, make_sample_lens
from spadwarp_kernels.water.phase_functions import HENYEY_GREENSTEIN_GUIDE

G = 0.924
A2 = (1 - G) ** 2 / G


def hg_angle(theta):
    """Over the angle, what is (a^2 + c^2)^(-3/2) over the chord c = 2 sin(theta/2), and its integral from theta on."""
    c = 2 * np.sin(0.5 * theta)
    return (A2 + c**2) ** -1.5 * np.cos(0.5 * theta), (1 - c / np.sqrt(A2 + c**2)) / A2


_THETA = np.concatenate([np.geomspace(2.2e-5, 1.0, 40_001), np.linspace(1.0, np.pi, 20_001)[1:]])
_Q = fournier_forand_density(2 * np.sin(_THETA / 2) ** 2, 1.10, 3.5835)
_REST = np.append(np.cumsum((0.5 * (_Q[1:] + _Q[:-1]) * np.diff(_THETA))[::-1])[::-1], 0.0)


def table_angle(theta):
    """Fournier-Forand over the angle itself, and its integral from theta on."""
    return np.interp(theta, _THETA, _Q), np.interp(theta, _THETA, _REST)


# How a flight is sampled, what its angle follows, and how closely a density in a cell of the table keeps to it.
LAWS = {
    "henyey_greenstein": (make_sample_flight(HENYEY_GREENSTEIN_GUIDE), hg_angle, 1e-4),
    "tabulated": (make_sample_flight(TABULATED.guide), table_angle, 1e-3),
}

# Flights x + s u, s in [0, length], as the lens at the origin sees them: towards it, away from it, past it.
FLIGHTS = {
    "towards": ((0.3, -0.1, 5.0), (-0.05, 0.02, -1.0), (0.2, 4.9)),
    "aimed at the lens": ((0.0, 0.0, 5.0), (1e-4, 0.0, -1.0), (0.0, 4.99)),
    "away": ((0.1, 0.0, 0.0), (0.02, 0.01, 1.0), (0.8, 7.0)),
    "away, coaxial": ((1e-4, 0.0, 0.0), (0.02, 0.01, 1.0), (0.1, 7.0)),
    "past": ((-3.0, 0.2, 2.0), (1.0, 0.0, 0.1), (0.5, 6.0)),
    "short": ((0.3, -0.1, 5.0), (0.6, 0.0, -0.8), (0.0, 0.01)),
}


def mixture(law, s, x, u, s0, s1, c):
    """The density in float64, from its definition: half exp(-c s), half in the angle."""
    x, u = np.asarray(x), np.asarray(u) / np.linalg.norm(u)
    t_c, d = -x @ u, np.linalg.norm(np.cross(x, u))
    r2 = d**2 + (s - t_c) ** 2
    linear = c * np.exp(-c * (s - s0)) / -math.expm1(-c * (s1 - s0))
    if s0 >= t_c:
        psi = np.arctan2(d, s - t_c)
        ends = np.tan(0.5 * np.arctan2(d, np.array([s0, s1]) - t_c))
        angular = 0.5 / np.cos(0.5 * psi) ** 2 * d / r2 / (ends[0] - ends[1])
    else:
        rest = law(np.arctan2(d, t_c - np.array([s0, s1])))[1]
        angular = law(np.arctan2(d, t_c - s))[0] / (rest[0] - rest[1]) * d / r2
    return 0.5 * linear + 0.5 * angular


@pytest.mark.physics
@pytest.mark.parametrize("flight", FLIGHTS)
@pytest.mark.parametrize(
    ("law", "extinction"),
    [("henyey_greenstein", 0.3)]
    + [pytest.param(law, c, marks=pytest.mark.slow) for law, c in (("henyey_greenstein", 2.5), ("tabulated", 0.3))],
)
def test_flight_samples_follow_their_density(law, extinction, flight, device):
    sample_flight, angle, closeness = LAWS[law]
    x, u, (s0, s1) = FLIGHTS[flight]
    medium, rng = Medium(), np.random.default_rng(2)
    medium.anisotropy = G
    medium.phase = make_phase_tables(lambda t: fournier_forand_density(t, 1.10, 3.5835), device=device)
    xi = np.minimum(rng.random((2, 500_000 if device == "cpu" else 10_000_000)), 1 - 2.0**-24).astype(np.float32)
    ray = (wp.vec3(*x), wp.vec3(*u / np.linalg.norm(u)))
    inputs = [*ray, wp.vec2(s0, s1), extinction, medium, *xi, Layers(), wp.vec3()]
    sample = each(sample_flight, inputs, [FlightSample], device)
    s, p = sample["s"].astype(float), sample["density"]
    assert s.min() >= np.float32(s0) and s.max() <= np.float32(s1)
    assert np.isfinite(p).all() and (p > 0).all()
    # What is claimed is what the definition says, to float32's resolution of the position.
    claimed = p[:2000] / mixture(angle, s[:2000], x, u, s0, s1, extinction) - 1
    assert np.abs(np.median(claimed)) < closeness and np.quantile(np.abs(claimed), 0.9) < 5e-3
    # And what is drawn: equal parts by the integral of the density, with nodes where the density is.
    grid = np.unique(np.concatenate([np.linspace(s0, s1, 100_001), np.quantile(s, np.linspace(0, 1, 100_001))]))
    parts = np.diff(grid) * mixture(angle, 0.5 * (grid[1:] + grid[:-1]), x, u, s0, s1, extinction)
    mass = np.concatenate([[0], np.cumsum(parts)])
    assert mass[-1] == pytest.approx(1.0, abs=1e-3)
    edges = np.interp(np.linspace(0, 1, 41), mass / mass[-1], grid)
    wide = np.diff(edges) > 64 * np.spacing(np.float32(max(s1, 5.0)))  # narrower parts are a few grid points wide
    counts = np.histogram(s, bins=edges)[0][wide]
    assert stats.chisquare(counts, np.full(counts.size, counts.sum() / counts.size)).pvalue > 1e-5


@pytest.mark.parametrize("passes", [(0.0, 0.0), (0.15, 0.05), (0.0, -0.199), (0.3, 0.0)])
def test_lens_points_are_even_but_for_their_weight(passes, device):
    """Means over an even disc of radius 0.2; where the flight passes the disc, the score's 1/D is bounded."""
    camera, radius = Camera(), 0.2
    camera.aperture_radius = radius
    u = np.array([0.3, -0.2, -0.9])
    u /= np.linalg.norm(u)
    place = np.array([*passes, 0.0])
    x, xi = place - 2.0 * u, np.random.default_rng(3).random((2, 400_000), np.float32)
    sample = each(make_sample_lens(None), [camera, wp.vec3(*x), wp.vec3(*u), *xi], [LensSample], device)
    point, weight = sample["point"].astype(float), sample["weight"].astype(float)
    a, b = point[:, 0] / radius, point[:, 1] / radius
    assert (a**2 + b**2 < 1 + 1e-4).all() and not point[:, 2].any()
    expected = {"1": 1.0, "a": 0.0, "b": 0.0, "a*a": 0.25, "b*b": 0.25, "a*b": 0.0, "(a*a + b*b)**2": 1 / 3}
    for term, mean in expected.items():
        values = weight * eval(term)
        assert values.mean() == pytest.approx(mean, abs=4.5 * values.std() / math.sqrt(values.size) + 1e-6), term
    away = np.linalg.norm(np.cross(point - place, u), axis=1)
    if np.hypot(*passes) < radius:
        assert (weight < 1.001 * 4 * away / abs(u[2]) / radius + 1e-4).all()
    else:
        assert (weight == 1.0).all()
