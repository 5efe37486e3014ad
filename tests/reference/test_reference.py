"""The float64 references against published values, exact limits and each other."""

import math

import numpy as np
import pytest

from reference.adding_doubling import cumulative_reflectance, exit_cosine_fractions, reflected_by_order, slab, stack
from reference.moments import after_collisions, after_path, isotropic_radial_cdf, snapped_mean_cosines
from reference.polarised_lidar import linear, stokes_factor
from reference.single_scatter import Lidar, henyey_greenstein, lambertian_plane, single_scatter, single_scatter_total
from reference.stokes import block_matrix, rayleigh_density, rayleigh_matrix, scattered
from reference.walk import Medium, isotropic, pencil, walk

pytestmark = pytest.mark.physics


def within(score, expected, errors=4.0, digits=0.0):
    """Whether the mean of scores is the expected value, within so many of its standard errors."""
    return abs(score.mean() - expected) < errors * score.std() / math.sqrt(len(score)) + digits


@pytest.mark.parametrize(
    ("g", "albedo", "parts", "reflected", "transmitted"),
    [
        (0.75, 0.9, (0.5, 0.7, 0.8), "0.09739", "0.66096"),
        (0, 0.5, (0.5, 0.5), "0.099119", "0.446058"),
        (0.924, 0.8, (2.0, 1.0), "0.017351", "0.492535"),
        (0, 0.8, (math.inf,), "0.285255", "0.000000"),
    ],
)
def test_slabs_reproduce_published_totals(g, albedo, parts, reflected, transmitted):
    """And a stack of equal layers is the slab."""
    solved = slab(anisotropy=g, albedo=albedo, optical_depth=sum(parts))
    found = solved.reflected, solved.transmitted
    for value, digits in zip(found, (reflected, transmitted), strict=True):
        # half a unit of the last digit given
        assert abs(value - float(digits)) <= 0.5000001 * 10.0 ** -len(digits.split(".")[1])
    assert stack([(g, albedo, part) for part in parts]) == pytest.approx(found, abs=1e-9)


def test_a_stack_keeps_all_light_and_knows_its_order():
    above, below = (0.8, 0.7, 0.6), (0.3, 1.0, 1.1)
    assert stack([(0.8, 0.0, 0.6), (0.3, 0.0, 1.1)]) == pytest.approx((0.0, math.exp(-1.7)), rel=1e-9)
    # Without absorption nothing is lost, whatever the order.
    for layers in ([(0.8, 1.0, 0.6), below], [below, (0.8, 1.0, 0.6)], [(-0.5, 1.0, 3.0)], [(0.924, 1.0, 3.0)]):
        assert sum(stack(layers)) == pytest.approx(1.0, abs=1e-9)
    assert stack([above, below]) != pytest.approx(stack([below, above]), rel=1e-3)


CASE = {"anisotropy": 0.75, "albedo": 0.9, "optical_depth": 2}


def test_slab_reproduces_the_published_reflection_function():
    mu = [0, 0.1, 0.3, 0.5, 0.7, 0.9, 1]
    published = [0.10641, 0.13304, 0.13856, 0.11956, 0.09411, 0.07132, 0.06180]
    solved = slab(**CASE, mu=mu)
    np.testing.assert_allclose(solved.reflection, published, atol=0.50001e-5, rtol=0)
    assert solved.direct == pytest.approx(math.exp(-2), rel=1e-12)
    back, forth = exit_cosine_fractions(**CASE, edges=np.linspace(0, 1, 6))
    assert back.sum() == pytest.approx(solved.reflected, abs=1e-6)
    assert forth.sum() == pytest.approx(solved.transmitted - solved.direct, abs=1e-6)


@pytest.mark.slow
def test_time_resolved_reflectance_agrees_with_the_walk_and_adds_up_to_the_steady_one():
    case = {"anisotropy": 0.0, "scattering": 0.8, "absorption": 0.2, "nodes": 24}
    assert cumulative_reflectance(200.0, **case) == pytest.approx(0.285255, abs=1e-6)
    rng = np.random.default_rng(3)
    photons = walk(Medium(1.0, 0.8, 0.0), pencil(100_000), rng, lower=(-math.inf, -math.inf, 0), max_path=8.0)
    for path in (1.0, 3.0, 6.0):
        score = photons.weight * ((photons.reason == "z_low") & (photons.path <= path))
        assert within(score, cumulative_reflectance(path, **case))


def test_walk_agrees_with_doubling():
    """All that leaves a slab, by face and by exit cosine."""
    edges, inf = np.linspace(0, 1, 6), math.inf
    faces = {"lower": (-inf, -inf, 0), "upper": (inf, inf, 2)}
    photons = walk(Medium(1.0, 0.9, 0.75), pencil(100_000), np.random.default_rng(1), **faces)
    back, forth = exit_cosine_fractions(**CASE, edges=edges)
    for face, sign, expected in (("z_low", -1, back), ("z_high", 1, forth)):
        cosine = sign * photons.direction[:, 2]
        for i in range(5):
            hit = (photons.reason == face) & (cosine >= edges[i]) & (cosine < edges[i + 1]) & (photons.collisions > 0)
            assert within(photons.weight * hit, expected[i])


def test_lidar_return_is_the_published_one_from_the_laser_s_side_and_from_the_camera_s():
    """Two quadratures over different variables; what keeps them apart is the rim of the cone across the pixels."""
    found = single_scatter_total(Lidar(), order=150)
    assert found == pytest.approx([3.4429e-9, 2.0505e-9, 1.0213e-9, 5.0801e-10, 2.6848e-10], rel=2e-5)
    np.testing.assert_allclose(single_scatter(Lidar()).sum((0, 1)), found, rtol=1e-4)
    assert henyey_greenstein([-1, 1], 0.924) == pytest.approx([1.633780e-3, 26.50745], rel=5e-7)


def test_lambertian_plane_keeps_radiometry():
    """A small field on axis, laser beside the lens: Γ·e^{−2cd}·A/(π d²) times the share of the cone in view."""
    lidar = Lidar(laser_position=(0, 0, 0), half_angle=math.radians(5), field_of_view=math.radians(1), pixels=4)
    image = lambertian_plane(lidar, depth=5.0, reflectance=0.5)
    share = (2 * math.tan(math.radians(0.5))) ** 2 / lidar.solid_angle
    expected = 0.5 / math.pi * share * math.exp(-2 * 0.3 * 5) * 1e-4 / 25
    assert image.sum() == pytest.approx(expected, rel=3e-4)


def test_moments_reproduce_published_values():
    """And agree with the walk."""
    five, collided = after_path(5, scattering=1, anisotropy=0), after_collisions(5, extinction=1, anisotropy=0.924)
    assert (five.z, five.r2) == pytest.approx((0.993262, 8.013476), abs=5e-7)
    found = (collided.z, collided.r2, collided.cos_theta)
    assert found == pytest.approx((4.295598, 27.128079, 0.673535), abs=5e-7)
    rng = np.random.default_rng(4)
    for g, limit, expected in (
        (0.924, {"max_collisions": 5}, collided),
        (0.5, {"max_path": 5.0}, after_path(5.0, scattering=1.0, anisotropy=0.5)),
    ):
        ended = walk(Medium(1.0, 1.0, g), pencil(100_000), rng, **limit)
        scores = (ended.position[:, 2], (ended.position**2).sum(1), ended.direction[:, 2])
        for score, value in zip(scores, (expected.z, expected.r2, expected.cos_theta), strict=True):
            assert within(score, value)


def test_near_axis_rule_narrows_the_beam():
    """Snapping drops tilt: the mean cosine after several collisions comes out too high, by as much as predicted."""
    for threshold in (0.9, 1.0):
        limits = {"max_collisions": 5, "axis_threshold": threshold}
        photons = walk(Medium(1.0, 1.0, 0.924), pencil(50_000), np.random.default_rng(5), **limits)
        expected = snapped_mean_cosines(5, anisotropy=0.924, axis_threshold=threshold)
        assert within(photons.direction[:, 2], expected[5])
        assert threshold == 1.0 or expected[5] > 0.70
    np.testing.assert_allclose(expected, 0.924 ** np.arange(6), rtol=1e-12)


def test_orders_of_scattering_add_up():
    """The first order in closed form, of isotropic scattering: ω/2·(1 − ln 2)."""
    orders = reflected_by_order(30, anisotropy=0.0, albedo=0.8, nodes=32)
    assert orders[0] == pytest.approx(0.0, abs=1e-7)
    assert orders[1] == pytest.approx(0.8 / 2 * (1 - math.log(2)), abs=1e-6)
    assert orders.sum() == pytest.approx(0.285255, abs=5e-5)


@pytest.mark.slow
def test_isotropic_fluence_agrees_with_the_walk_and_its_second_moment():
    rng, edges = np.random.default_rng(6), np.linspace(0, 5, 6)[1:-1]
    ended = walk(Medium(1.0, 1.0, 0.0), isotropic(100_000, rng), rng, max_path=5.0)
    distance = np.linalg.norm(ended.position, axis=1)
    for edge, share in zip(edges, isotropic_radial_cdf(edges, path=5.0, scattering=1.0), strict=True):
        assert within(distance < edge, share)
    node, gauss = (v / 2 for v in np.polynomial.legendre.leggauss(20))
    radius = 5 * (node + 0.5)
    second = 25 - 2 * np.sum(5 * gauss * radius * isotropic_radial_cdf(radius, path=5.0, scattering=1.0))
    assert second == pytest.approx(after_path(5.0, scattering=1.0, anisotropy=0.0).r2, abs=1e-4)


# Stokes vectors


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
