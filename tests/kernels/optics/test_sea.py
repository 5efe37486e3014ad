"""The surface of the sea: its facets and their densities against quadrature, reciprocity, and the ways to the lens."""

import math

import numpy as np
import pytest
import warp as wp
from scipy.stats import chisquare

import spadwarp_kernels as sk
from helpers.launch import launched, unit
from reference.refraction import reflectance
from spadwarp_kernels.optics.port import Port
from spadwarp_kernels.optics.sea import passage_density, sample_passage

INDEX = 1.34
connect_sea = sk.FACETS.connect
UP = (0.0, 0.0, 1.0)


def sea_of(mss=None, wind=5.0, **choices):
    variances = (0.5 * mss, 0.5 * mss) if mss is not None else sk.slope_variances(wind)
    return sk.make_sea(variances, **{"index": INDEX, "normal": UP, "height": 0.0, **choices})


@wp.kernel(enable_backward=False)
def passage_kernel(
    sea: sk.Sea,
    u: wp.array[wp.vec3],
    above: bool,
    first: wp.array[int],
    second: wp.array[int],
    third: wp.array[int],
    v: wp.array[wp.vec3],
    part: wp.array[float],
    reflected: wp.array[int],
):
    k = wp.tid()
    random = wp.vec4ui(wp.uint32(first[k]), wp.uint32(second[k]), wp.uint32(third[k]), wp.uint32(0))
    passage = sample_passage(sea, u[k], above, random)
    v[k] = passage.u
    part[k] = passage.part
    reflected[k] = wp.where(passage.reflected, 1, 0)


@wp.kernel(enable_backward=False)
def density_kernel(sea: sk.Sea, u: wp.array[wp.vec3], v: wp.array[wp.vec3], density: wp.array[float]):
    k = wp.tid()
    density[k] = passage_density(sea, u[k], v[k])


@wp.kernel(enable_backward=False)
def connection_kernel(
    sea: sk.Sea,
    port: Port,
    x: wp.vec3,
    o: wp.vec3,
    number: wp.array[int],
    surface: wp.array[wp.vec3],
    density: wp.array[float],
):
    k = wp.tid()
    c = connect_sea(sea, port, x, o, wp.uint64(number[k]) * wp.uint64(0x9E3779B97F4A7C15))
    surface[k] = c.exit
    density[k] = c.transmission * c.density


def words(values):
    """Words of uniform numbers, as int32."""
    return (np.minimum(values * 2.0**32, 2.0**32 - 1).astype(np.uint64).astype(np.uint32)).view(np.int32)


def passages(sea, u, above, count, third):
    """For evenly spread facets with the last number given: directions, unmasked parts and whether reflected."""
    side = int(math.sqrt(count))
    grid = (np.stack(np.meshgrid(*2 * [np.arange(side) + 0.5], indexing="ij")) / side).reshape(2, -1)
    rows = np.broadcast_to(np.asarray(u, np.float32), (side * side, 3)).copy()
    last = np.full(side * side, third)
    inputs = [sea, rows, above, *map(words, grid), words(last)]
    return launched(passage_kernel, inputs, (wp.vec3, float, int))


def parts(sea, u, above):
    """Transmitted and reflected parts that leave the surface, by the sampler's facets and Fresnel's equations here."""
    u = np.asarray(u, np.float64)
    mirrored, part, reflected = passages(sea, u, above, 1024**2, 0.0)
    assert reflected.all()
    cosine = np.sqrt(np.clip((1.0 + (-u * mirrored).sum(axis=1)) / 2.0, 0.0, 1.0))
    share = reflectance(cosine, INDEX if above else 1.0 / INDEX)
    _, passed, back = passages(sea, u, above, 1024**2, 1.0)
    return ((1.0 - share) * np.where(back, 0.0, passed)).mean(), (share * part).mean()


def directions(count, above):
    """Directions of a half-space, even in both angles, and their solid angles."""
    theta = 0.5 * math.pi * (np.arange(count) + 0.5) / count
    azimuth = 4.0 * math.pi * (np.arange(count // 2) + 0.5) / count
    theta, phi = (grid.ravel() for grid in np.meshgrid(theta, azimuth, indexing="ij"))
    r, z = np.sin(theta), np.cos(theta)
    rows = np.stack([r * np.cos(phi), r * np.sin(phi), z if above else -z], axis=1)
    return rows, r * (2.0 * math.pi**2 / count**2)


@pytest.mark.parametrize(
    ("angle", "above", "transmitted", "reflected"),
    [
        pytest.param(0, True, 0.97887, 0.02113, marks=pytest.mark.slow),
        pytest.param(40, True, 0.97340, 0.02659, marks=pytest.mark.slow),
        (60, True, 0.93420, 0.06287),
        pytest.param(0, False, 0.97882, 0.02118, marks=pytest.mark.slow),
        (40, False, 0.81919, 0.18060),
    ],
)
def test_transmitted_and_reflected_parts(angle, above, transmitted, reflected):
    sea = sea_of()
    theta = math.radians(angle)
    u = np.array([math.sin(theta), 0.0, -math.cos(theta) if above else math.cos(theta)])
    sampled = parts(sea, u, above)
    np.testing.assert_allclose(sampled, (transmitted, reflected), atol=6e-5)
    # The densities have the same integrals over the half-spaces.
    for up, part in ((not above, transmitted), (above, reflected)):
        v, solid_angle = directions(1400, up)
        rows = np.broadcast_to(u.astype(np.float32), v.shape).copy()
        integral = launched(density_kernel, [sea, rows, v.astype(np.float32)])[0] @ solid_angle
        assert integral == pytest.approx(part, abs=8e-5)


def test_slopes_of_cox_and_munk():
    assert sum(sk.slope_variances(5.0)) == pytest.approx(0.0286)
    along, across = sk.slope_variances(10.0, by_direction=True)
    assert (along, across) == pytest.approx((0.0316, 0.0222))
    # From straight above, facets have the slopes of the surface.
    sea = sea_of(wind=10.0)
    sea.slope = wp.vec2(math.sqrt(2.0 * along), math.sqrt(2.0 * across))
    v, _, _ = passages(sea, (0.0, 0.0, -1.0), True, 512**2, 0.0)
    m = unit(v + np.array([0.0, 0.0, 1.0]))
    slopes = m[:, :2] / m[:, 2:]
    spread = slopes.var(axis=0)
    axis = np.array([sea.along[0], sea.along[1]])
    assert (slopes @ axis).var() == pytest.approx(along, rel=4e-3)
    assert spread.sum() == pytest.approx(along + across, rel=4e-3)


@pytest.mark.parametrize(("angle", "above"), [(70, True), (30, False)])
def test_sampled_directions_follow_the_density(angle, above):
    sea, rng, count = sea_of(wind=12.0), np.random.default_rng(angle), 200_000
    theta = math.radians(angle)
    u = np.array([math.sin(theta), 0.0, -math.cos(theta) if above else math.cos(theta)])
    rows = np.broadcast_to(u.astype(np.float32), (count, 3)).copy()
    inputs = [sea, rows, above, *map(words, rng.random((3, count)))]
    v, part, _ = launched(passage_kernel, inputs, (wp.vec3, float, int))
    left = rng.random(count) < part
    edges = [np.linspace(-1.0, 1.0, 9)] * 3
    observed = np.histogramdd(v[left], edges)[0].ravel()
    expected = np.zeros(observed.shape)
    for up in (True, False):
        grid, solid_angle = directions(1400, up)
        many = np.broadcast_to(u.astype(np.float32), grid.shape).copy()
        density = launched(density_kernel, [sea, many, grid.astype(np.float32)])[0]
        expected += np.histogramdd(grid, edges, weights=density * solid_angle)[0].ravel()
    # What is masked is a cell of its own.
    observed, expected = np.append(observed, count - left.sum()), count * np.append(expected, 1.0 - expected.sum())
    rare = expected < 20.0
    observed, expected = (np.append(part[~rare], part[rare].sum()) for part in (observed, expected))
    assert chisquare(observed, expected * (count / expected.sum())).pvalue > 1e-3


def test_reciprocity():
    """q(i→o)|i·n|/n_o² = q(o→i)|o·n|/n_i²."""
    rng, sea = np.random.default_rng(1), sea_of(wind=8.0)
    u, v = (unit(rng.normal(size=(4000, 3))) for _ in range(2))
    there = launched(density_kernel, [sea, u.astype(np.float32), v.astype(np.float32)])[0]
    back = launched(density_kernel, [sea, (-v).astype(np.float32), (-u).astype(np.float32)])[0]
    n_i, n_o = np.where(u[:, 2] < 0.0, 1.0, INDEX), np.where(v[:, 2] > 0.0, 1.0, INDEX)
    left, right = there * np.abs(u[:, 2]) / n_o**2, back * np.abs(v[:, 2]) / n_i**2
    seen = left > 1e-6
    assert seen.sum() > 500
    np.testing.assert_allclose(left[seen], right[seen], rtol=2e-3)


def test_glint_of_a_parallel_beam():
    """L = E F D(m) G/(4 cosθ_o) with Smith's G and E across the beam."""
    mss = 0.0286
    sea = sea_of(mss)
    for zenith, azimuth, incidence in ((20.0, 0.0, 30.0), (45.0, 1.0, 40.0), (10.0, 3.0, 5.0)):
        a, b = math.radians(incidence), math.radians(zenith)
        u = np.array([math.sin(a), 0.0, -math.cos(a)])
        v = np.array([math.sin(b) * math.cos(azimuth), math.sin(b) * math.sin(azimuth), math.cos(b)])
        m = unit(v - u)
        tan2 = 1.0 / m[2] ** 2 - 1.0
        facets = math.exp(-tan2 / mss) / (math.pi * mss * m[2] ** 4)

        def masking(cosine):
            t = cosine / math.sqrt((1.0 - cosine**2) * mss)
            return 1.0 / (1.0 + 0.5 * (math.exp(-t * t) / (t * math.sqrt(math.pi)) - math.erfc(t)))

        shape = reflectance(float(-u @ m), INDEX) * facets * masking(-u[2]) * masking(v[2])
        radiance = shape / (4.0 * v[2])
        density = launched(density_kernel, [sea, np.float32([u]), np.float32([v])])[0][0]
        # Power per area of the plane, E cosθ_i, times the density is radiance times cosθ_o.
        assert density * -u[2] / v[2] == pytest.approx(radiance, rel=1e-3)


def test_footprint_of_a_vertical_beam():
    """10 m deep, a vertical beam has spread by .4268 m; z(1 − 1/n)√mss = .4291 for small slopes."""
    v, part, reflected = passages(sea_of(0.0286), (0.0, 0.0, -1.0), True, 1024**2, 1.0)
    passed = ~reflected.astype(bool)
    v, part = v[passed], part[passed]
    places = 10.0 * v[:, :2] / -v[:, 2:]
    weight = part * (1.0 - reflectance(np.ones(1), INDEX)[0])
    assert math.sqrt(np.average((places**2).sum(axis=1), weights=weight)) == pytest.approx(0.4268, abs=5e-4)


def connections(mss, height, depth, aside, *, lens_above=True, count=400_000, variances=None):
    """Points S, relative to the flat surface's, and densities of connections to a lens on the other side."""
    sea = sea_of(mss, height=-height if lens_above else depth)
    if variances is not None:
        sea.slope = wp.vec2(*(math.sqrt(2.0 * variance) for variance in variances))
    index = (1.0, 1.0, INDEX) if lens_above else (INDEX, INDEX, 1.0)
    distance, normal = (height, (0.0, 0.0, -1.0)) if lens_above else (depth, UP)
    port = sk.make_flat_port(distance=distance, normal=normal, index=index, group_index=index)
    z = -(height + depth) if lens_above else height + depth
    x, o = wp.vec3(aside, 0.0, z), wp.vec3(0.0, 0.0, 0.0)
    return launched(connection_kernel, [sea, port, x, o, np.arange(1, count + 1)], (wp.vec3, float))


@pytest.mark.parametrize(
    ("height", "depth", "aside", "expected"),
    [(200.0, 10.0, 60.0, 1.176e-5), (5.0, 2.0, 3.0, 1.078e-2), (0.5, 10.0, 0.2, 8.79e-3)],
)
def test_connections_by_drawn_points(height, depth, aside, expected):
    """The integral over S with the transmittance of the facets as 1, by grids over S; here with it, and over it."""
    surface, density = connections(0.0286, height, depth, aside)
    to_lens, from_point = -surface, surface - [aside, 0.0, -(height + depth)]
    u, v = unit(from_point), unit(to_lens)
    between = u * INDEX - v  # along the facet's normal, in the water
    cosine = (u * unit(between)).sum(axis=1)
    share = 1.0 - reflectance(np.abs(cosine), 1.0 / INDEX)
    values = density / share
    error = values.std() / math.sqrt(len(values))
    assert error < 2e-3 * expected
    assert values.mean() == pytest.approx(expected, abs=4 * error + 5e-4 * expected)
    assert values.max() < 6.0 * values.mean()


def test_connections_become_those_of_a_flat_surface():
    _, flat = connections(0.0, 200.0, 10.0, 60.0, count=1)
    theta = np.linspace(0.0, math.pi / 3, 200_001)
    aside = 200.0 * np.tan(theta) + 10.0 * np.tan(np.arcsin(np.sin(theta) / INDEX))
    theta = np.interp(60.0, aside, theta)
    share = 1.0 - reflectance(np.array([math.cos(theta)]), INDEX)[0]
    assert flat[0] / share == pytest.approx(1.17539e-5, rel=2e-5)
    _, nearly = connections(1e-6, 200.0, 10.0, 60.0)
    assert nearly.mean() == pytest.approx(flat[0], rel=1e-3)


def test_width_of_the_drawn_points():
    surface, density = connections(0.0286, 200.0, 10.0, 60.0)
    weights = density / density.sum()
    mean = weights @ surface
    spread = np.sqrt(weights @ (surface - mean) ** 2)
    np.testing.assert_allclose(spread[:2], (0.322, 0.308), atol=3e-3)


def test_connections_of_either_side_and_direction():
    """Light goes both ways: E over the point's intensity, times n² of the lens's side, is the same with media and ends
    exchanged; with slopes that differ by direction, too."""
    for variances in (None, (0.02, 0.01)):
        _, up = connections(0.0286, 3.0, 2.0, 2.0, lens_above=True, variances=variances)
        _, down = connections(0.0286, 3.0, 2.0, 2.0, lens_above=False, variances=variances)
        # The lens is above at distance 3 with the point 2 below; or 2 below with the point 3 above.
        error = math.hypot(up.std() / up.mean(), down.std() / down.mean()) / math.sqrt(len(up))
        assert up.mean() * INDEX**2 == pytest.approx(down.mean(), rel=4 * error + 1e-4)
