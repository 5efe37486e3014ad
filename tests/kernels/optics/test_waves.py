"""Resolved waves: rays against the height field, what it leaves to facets, and the ways through it to the lens."""

import math

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import launched, unit
from spadwarp_kernels.optics.port import Port
from spadwarp_kernels.optics.sea import facet_at, facet_covariance, waves_distance

SIZE, INDEX = 4.0, 1.34
COLUMNS, ROWS = unit(np.array([1.0, 0.3, 0.0])), unit(np.array([-0.3, 1.0, 0.0]))
ORIGIN = np.array([0.1, 0.2, 0.3])
connect = sk.WAVES.connect


def ripples(amplitude=0.02, count=32):
    rng, x = np.random.default_rng(1), np.arange(count) * SIZE / count
    heights = np.zeros((count, count))
    for _ in range(12):
        kx, ky = rng.integers(-4, 5, 2) * 2.0 * math.pi / SIZE
        heights += amplitude * np.cos(kx * x + ky * x[:, None] + rng.uniform(0.0, 7.0))
    return heights


def sea_of(heights, mss=0.4, size=(SIZE, SIZE)):
    field = {"heights": heights, "size": size, "columns": COLUMNS.tolist(), "origin": ORIGIN.tolist(), "device": "cpu"}
    return sk.make_sea((0.5 * mss, 0.5 * mss), index=INDEX, normal=(0.0, 0.0, 1.0), height=0.3, **field)


def field_at(heights, x):
    """Height of the bilinear field at points, and its slopes along rows and from row to row, in float64."""
    count = heights.shape[0]
    a, b = ((x - ORIGIN) @ axis / (SIZE / count) for axis in (COLUMNS, ROWS))
    i, j = np.floor(a).astype(int), np.floor(b).astype(int)
    a, b = a - i, b - j
    node = [[heights[(j + r) % count, (i + c) % count] for c in (0, 1)] for r in (0, 1)]
    rows = [(1.0 - a) * low + a * high for low, high in node]
    slope_a = (1.0 - b) * (node[0][1] - node[0][0]) + b * (node[1][1] - node[1][0])
    return (1.0 - b) * rows[0] + b * rows[1], np.stack([slope_a, rows[1] - rows[0]], axis=-1) * (count / SIZE)


@wp.kernel(enable_backward=False)
def rays_kernel(
    sea: sk.Sea, x: wp.array[wp.vec3], u: wp.array[wp.vec3], above: bool, height: wp.array[float], met: wp.array[float]
):
    k = wp.tid()
    height[k] = wp.dot(x[k] - sea.waves.origin, sea.waves.normal) - facet_at(sea.waves, x[k]).height
    met[k] = waves_distance(sea, x[k], u[k], above, 20.0)


@wp.kernel(enable_backward=False)
def connect_kernel(
    sea: sk.Sea, port: Port, x: wp.vec3, o: wp.vec3, number: wp.array[int], point: wp.array[wp.vec3], e: wp.array[float]
):
    k = wp.tid()
    c = connect(sea, port, x, o, wp.uint64(number[k]) * wp.uint64(0x9E3779B97F4A7C15))
    point[k] = c.exit
    e[k] = c.density


def test_rays_meet_the_field():
    """Where steps of 4 mm in float64 find the first change of sides."""
    heights, rng, count = ripples(), np.random.default_rng(2), 400
    sea, t = sea_of(heights), np.arange(0.0, 20.0, 0.004)
    x = np.stack([rng.uniform(-5.0, 5.0, count), rng.uniform(-5.0, 5.0, count), rng.uniform(-0.3, 0.9, count)], axis=1)
    u = unit(rng.normal(size=(count, 3)) * [1.0, 1.0, 0.3])
    x, u = x.astype(np.float32), u.astype(np.float32)
    height = x[:, 2] - ORIGIN[2] - field_at(heights, x.astype(float))[0]
    met = np.zeros(count)
    for above in (False, True):
        own, found = launched(rays_kernel, [sea, x, u, above], (float, float))
        met = np.where((height > 0.0) == above, found, met)
    np.testing.assert_allclose(own, height, atol=1e-6)
    # Whatever a ray meets is the field, and not behind the first step that crosses it: shorter grazes lie before that.
    ends = x + np.minimum(met, 20.0)[:, None].astype(float) * u
    off = ends[:, 2] - ORIGIN[2] - field_at(heights, ends)[0]
    assert np.abs(off[met < 20.0]).max() < 1e-5
    ray = x[:, None].astype(float) + t[:, None] * u[:, None]
    crosses = (ray[..., 2] - ORIGIN[2] > field_at(heights, ray)[0]) != (height > 0.0)[:, None]
    first = np.where(crosses.any(axis=1), t[crosses.argmax(axis=1)], np.inf)
    assert (met <= np.minimum(first, 1e31) + 3e-5).all()
    assert (np.abs(met - first)[np.isfinite(first)] < 0.0041).mean() > 0.99
    assert (met[np.isinf(first)] > 19.9).mean() > 0.99


def test_facets_hold_what_the_waves_leave():
    heights, rng = ripples(), np.random.default_rng(3)
    x = ORIGIN + rng.uniform(0.0, SIZE, (200_000, 1)) * COLUMNS + rng.uniform(0.0, SIZE, (200_000, 1)) * ROWS
    slopes = field_at(heights, x)[1]
    covariance = facet_covariance(heights, (SIZE, SIZE))
    np.testing.assert_allclose(slopes.T @ slopes / len(x), covariance, atol=4e-4)
    sea = sea_of(heights)
    assert np.hypot(*slopes.T).max() == pytest.approx(sea.waves.steepest, rel=0.03)
    along, across = np.array(sea.along), np.cross([0.0, 0.0, 1.0], np.array(sea.along))
    frame = np.array([[v @ COLUMNS, v @ ROWS] for v in (along, across)])
    rest = frame.T @ np.diag(np.square(sea.slope) / 2.0) @ frame
    np.testing.assert_allclose(rest + covariance, np.diag([0.2, 0.2]), atol=1e-6)
    with pytest.raises(sk.ArgumentError, match=r"heights: the waves hold 1\.03 of the variance .* outside \[0, 0\.9\]"):
        sea_of(heights, mss=0.12)
    with pytest.raises(sk.ArgumentError, match=r"heights of shape \(4,\)"):
        sea_of(np.zeros(4))


def masking(v, width):
    a = np.abs(v[..., 2]) / np.maximum(np.hypot(v[..., 0] * width[0], v[..., 1] * width[1]), 1e-12)
    erfc = np.vectorize(math.erfc)(a)
    return 1.0 / (1.0 + 0.5 * (np.exp(-a * a) / (a * math.sqrt(math.pi)) - erfc))


@pytest.mark.parametrize(("aside", "depth"), [(0.0, 0.02), (0.7, 0.6)])
def test_ways_through_waves_to_the_lens(aside, depth):
    """In the mean the integral over the field by its own grid; from the crest of a wave, above the mean plane, too."""
    heights = ripples(0.005)
    sea, count = sea_of(heights, mss=0.03), 400
    covariance = np.diag([0.015, 0.015]) - facet_covariance(heights, (SIZE, SIZE))
    values, vectors = np.linalg.eigh(covariance)
    o, crest = np.array([0.0, 0.0, 2.3]), ORIGIN + np.argmax(heights.max(axis=0)) * SIZE / 32 * COLUMNS
    crest = crest + np.argmax(heights[:, np.argmax(heights.max(axis=0))]) * SIZE / 32 * ROWS
    o[:2] += crest[:2]
    x = np.array([crest[0] + aside, crest[1], ORIGIN[2] + heights.max() - depth])
    port = sk.make_flat_port(
        distance=2.0, normal=(0.0, 0.0, -1.0), index=(1.0, 1.0, INDEX), group_index=(1.0, 1.0, INDEX), origin=o.tolist()
    )
    # The mean plane is at z = 0.3, as seen from the origin of this frame.
    port.distance = -0.3
    inputs = [sea, port, wp.vec3(*x), wp.vec3(*o), np.arange(1, 200_001)]
    _, drawn = launched(connect_kernel, inputs, (wp.vec3, float))
    reach = 4.5 * depth * 0.17 + 0.01
    middle = x + (o - x) * depth / (INDEX * 2.0 + depth)
    grid = np.linspace(-reach, reach, count)
    p, q = np.meshgrid(grid, grid)
    s = np.stack([middle[0] + p, middle[1] + q, np.zeros_like(p)], axis=-1)
    height, slope = field_at(heights, s)
    s[..., 2] = ORIGIN[2] + height
    n = unit(np.array([0.0, 0.0, 1.0]) - slope[..., :1] * COLUMNS - slope[..., 1:] * ROWS)
    axis = vectors[0, 1] * COLUMNS + vectors[1, 1] * ROWS
    along = unit(axis - (n @ axis)[..., None] * n)
    width = np.sqrt(2.0 * values[::-1])
    frame = np.stack([along, np.cross(n, along), n], axis=-2)
    up, out = unit(s - x), unit(o - s)
    i, v = (np.einsum("yxij,yxj->yxi", frame, d) for d in (up, out))  # upwards both
    m = unit(INDEX * i - v)
    m = np.where(m[..., 2:] > 0.0, m, -m)
    cos_i, cos_o = (i * m).sum(axis=-1), (v * m).sum(axis=-1)
    tan2 = (m[..., 0] / (m[..., 2] * width[0])) ** 2 + (m[..., 1] / (m[..., 2] * width[1])) ** 2
    facets = np.exp(-tan2) / (math.pi * width[0] * width[1] * m[..., 2] ** 4)
    behind = np.sqrt(np.maximum(1.0 - INDEX**2 * (1.0 - cos_i**2), 0.0))
    share = 0.5 * ((INDEX * cos_i - behind) / (INDEX * cos_i + behind)) ** 2
    share += 0.5 * ((cos_i - INDEX * behind) / (cos_i + INDEX * behind)) ** 2
    jacobian = np.abs(cos_o) / (INDEX * cos_i - cos_o) ** 2
    density = (1.0 - share) * cos_i * facets * jacobian * masking(i, width) * masking(v, width) / i[..., 2]
    seen = (i[..., 2] > 0.0) & (v[..., 2] > 0.0) & (cos_i > 0.0) & (cos_o > 0.0)
    r2 = ((s - x) ** 2).sum(axis=-1) * ((o - s) ** 2).sum(axis=-1)
    integrand = np.where(seen, density * i[..., 2] / (r2 * n[..., 2]), 0.0)
    expected, error = integrand.sum() * (grid[1] - grid[0]) ** 2, drawn.std() / math.sqrt(len(drawn))
    assert error < 0.01 * expected
    assert drawn.mean() == pytest.approx(expected, abs=4.0 * error + 2e-3 * expected)


def test_a_view_is_widened_by_the_steepest_wave():
    """By nothing without slopes, by facets, and more by facets that stand on waves."""
    index = {"distance": 5.0, "index": (1.0, 1.0, INDEX), "group_index": (1.0, 1.0, INDEX), "largest_angle": 0.3}
    seas = None, sea_of(np.zeros((8, 8)), 0.03), sea_of(ripples(0.005), 0.03)
    window, calm, rough = (sk.make_flat_port(**index, sea=sea) for sea in seas)
    assert window.margin == 0.0 < calm.margin < rough.margin
    assert window.late < calm.late < rough.late
