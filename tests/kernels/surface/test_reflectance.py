"""Reflection: diffuse by Lambert's law, and the rough specular lobe."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from helpers.launch import each, unit
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels.surface.reflectance import ggx_brdf, ggx_normals, ggx_pdf, sample_ggx, sample_lambert, unshadowed

pytestmark = pytest.mark.physics

NORMAL = np.array([0.36, -0.48, 0.8])
ACROSS = np.array([0.8, 0.6, 0.0])
ASIDE = np.cross(NORMAL, ACROSS)


def uniform(count):
    return np.random.default_rng(11).random((2, count), np.float32)


def draw(angle, alpha, count, device):
    """Directions of the lobe, and the part of their light that leaves the surface."""
    u, n = wp.vec3(*incoming(angle)), wp.vec3(*NORMAL)
    v = each(sample_ggx, [u, n, alpha, *uniform(count)], [wp.vec3], device)
    return v, each(unshadowed, [u, v, n, alpha, 1.0], device=device)


def evaluate(function, u, v, alpha):
    u, v = np.broadcast_arrays(u, v)
    return each(function, [u, v, wp.vec3(*NORMAL), alpha])


def incoming(angle_deg):
    """Propagation towards the surface at an angle from the normal."""
    angle = np.radians(angle_deg)
    return np.sin(angle) * ACROSS - np.cos(angle) * NORMAL


def facet_grid(alpha, rows, columns):
    """tan(theta_h), azimuth and share of D cos(theta_h) of equal cells of (x, azimuth), x = 1 - sqrt(1 - s), with
    s = tan^2/(alpha^2 + tan^2) their distribution function; in x the long tail of the tangent is harmless."""
    x = (np.arange(rows) + 0.5) / rows
    x, phi = np.meshgrid(x, (np.arange(columns) + 0.5) / columns * 2 * np.pi, indexing="ij")
    return alpha * np.sqrt(x * (2 - x)) / (1 - x), phi, 2 * (1 - x) / (rows * columns)


def facet_shares(angle_deg, alpha, rows, columns, fine=40):
    """Chance that the mirroring facet's normal lies in each cell of (x, azimuth): the visible facets D G1
    max(w.h, 0)/cos_in."""
    tangent, phi, share = facet_grid(alpha, rows * fine, columns * fine)
    angle = np.radians(angle_deg)
    # w.h/cos(theta_h) with w = (-sin, 0, cos), the direction that the light comes from
    seen = np.maximum(np.cos(angle) - np.sin(angle) * tangent * np.cos(phi), 0)
    shadowing = 2 / (1 + np.sqrt(1 + (alpha * np.tan(angle)) ** 2))  # Walter eq 34
    chance = share * shadowing * seen / np.cos(angle)
    return chance.reshape(rows, fine, columns, fine).sum(axis=(1, 3))


def albedo(angle_deg, alpha):
    """Directional albedo of the lobe: Walter's D and Heitz' height-correlated Smith term, integrated over facets."""
    tangent, phi, share = facet_grid(alpha, 1000, 720)
    h = np.stack([tangent * np.cos(phi), tangent * np.sin(phi), np.ones_like(phi)]) / np.sqrt(1 + tangent**2)
    w = np.array([-np.sin(np.radians(angle_deg)), 0.0, np.cos(np.radians(angle_deg))])[:, None, None]
    along = (w * h).sum(axis=0)
    v = 2 * along * h - w
    with np.errstate(invalid="ignore", divide="ignore"):
        masks = [(np.sqrt(1 + alpha**2 * (1 - c**2) / c**2) - 1) / 2 for c in (w[2], v[2])]
        values = np.where((along > 0) & (v[2] > 0), along / (w[2] * h[2]) / (1 + masks[0] + masks[1]), 0.0)
    return (share * values).sum()


CASES = [(0.0, 0.02), (60.0, 0.02), (30.0, 0.2), (75.0, 0.3), (85.0, 1.0)]


@pytest.mark.parametrize(("angle", "alpha"), CASES)
def test_sampled_facets_follow_the_visible_normals(angle, alpha, device):
    count, rows, columns = (10_000_000 if device != "cpu" else 200_000), 20, 24
    v, _ = draw(angle, alpha, count, device)
    np.testing.assert_allclose(np.linalg.norm(v, axis=1), 1.0, atol=1e-6)
    h = v - incoming(angle)
    # Along n the sum of two unit vectors cancels little; across it the float32 of v limits narrow lobes to 1e-7/alpha.
    across, aside, along = h @ ACROSS, h @ ASIDE, h @ NORMAL
    tangent2 = (across**2 + aside**2) / along**2
    x = np.minimum(1 - np.sqrt(alpha**2 / (alpha**2 + tangent2)), 1 - 1e-12)
    phi = np.arctan2(aside, across) % (2 * np.pi)
    cells = (x * rows).astype(int) * columns + (phi / (2 * np.pi) * columns).astype(int) % columns
    observed = np.bincount(cells, minlength=rows * columns)
    expected = facet_shares(angle, alpha, rows, columns).ravel()
    assert expected.sum() == pytest.approx(1.0, abs=1e-3)
    expected *= count / expected.sum()
    rare = expected < 10
    observed, expected = (np.append(cells[~rare], cells[rare].sum()) for cells in (observed, expected))
    if expected[-1] < 10:
        observed, expected = observed[:-1], expected[:-1]
        expected *= observed.sum() / expected.sum()
    assert stats.chisquare(observed, expected).pvalue > 1e-4


@pytest.mark.parametrize(("angle", "alpha"), CASES)
def test_density_and_facets_are_normalised(angle, alpha):
    """On facets as points of quadrature: v mirrors u, and dv = 4 (w.h) dh."""
    tangent, phi, share = (a.ravel() for a in facet_grid(alpha, 400, 180))
    h = tangent[:, None] * (np.cos(phi)[:, None] * ACROSS + np.sin(phi)[:, None] * ASIDE) + NORMAL
    cosine = 1 / np.sqrt(1 + tangent**2)
    h *= cosine[:, None]
    u = incoming(angle)
    along = -(h @ u)
    v = u + 2 * along[:, None] * h
    pdf, facets = evaluate(ggx_pdf, u, v, alpha), each(ggx_normals, [h, wp.vec3(*NORMAL), alpha])
    density = 1 / (np.pi * alpha**2 * cosine**4 * (1 + (tangent / alpha) ** 2) ** 2)  # Walter eq 33
    np.testing.assert_allclose(facets, density, rtol=2e-3 if alpha < 0.1 else 1e-4)
    seen = along > 1e-3
    total = (share * np.where(seen, pdf * 4 * along / (density * cosine), 0)).sum()
    assert total == pytest.approx(1.0, abs=1e-3)


@pytest.mark.parametrize("alpha", [0.05, 0.3, 1.0])
def test_light_and_eye_may_change_places(alpha):
    rng = np.random.default_rng(4)
    w, v = unit(rng.normal(size=(2, 5000, 3)))
    w, v = (a - 2 * np.minimum(a @ NORMAL, 0)[:, None] * NORMAL for a in (w, v))
    there, back = evaluate(ggx_brdf, -w, v, alpha), evaluate(ggx_brdf, -v, w, alpha)
    assert (there > 0).all()
    np.testing.assert_allclose(there, back, rtol=1e-4)


@pytest.mark.parametrize(("angle", "alpha"), CASES)
def test_lobe_reflects_its_albedo_and_no_more(angle, alpha, device):
    expected = albedo(angle, alpha)
    assert 0.3 < expected <= 1.0
    _, leaving = draw(angle, alpha, 200_000, device)
    assert leaving.min() >= 0 and leaving.max() <= 1
    error = leaving.std() / np.sqrt(len(leaving))
    assert abs(leaving.mean() - expected) < 4.5 * error + 2e-4


def test_nothing_is_reflected_through_the_surface():
    below = incoming(20.0), np.array([incoming(40.0), -NORMAL]), 0.5
    assert (evaluate(ggx_brdf, *below) == 0).all() and np.isfinite(evaluate(ggx_pdf, *below)).all()


def test_lambert_follows_the_cosine_law(device):
    """cos^2 is uniform under the cosine law."""
    cosine = each(sample_lambert, [wp.vec3(*NORMAL), *uniform(sample_count(device))], [wp.vec3], device) @ NORMAL
    assert cosine.min() > -1e-6
    assert chi2_p(cosine, lambda c: np.clip(c, 0, 1) ** 2) > 1e-4
