"""Sampling along a flight, free paths and the lens: each follows its own density."""

import math

import numpy as np
import pytest
import warp as wp
from scipy import stats

from helpers.statistics_of_samples import DEVICES, chi2_p
from spadwarp_kernels import (
    TABULATED,
    Camera,
    Gate,
    Medium,
    fournier_forand_density,
    free_path,
    lens_point,
    make_phase_tables,
    random_block,
    u01,
    u01_fine,
)
from spadwarp_kernels.estimators import make_sample_flight
from spadwarp_kernels.phase import HENYEY_GREENSTEIN_GUIDE
from spadwarp_kernels.sensor import clip_to_gate, clip_to_planes, field

COUNT = 10_000_000
G = 0.924
A2 = (1 - G) ** 2 / G


def _hg_angle(theta):
    """Over the angle, what is (a^2 + c^2)^(-3/2) over the chord c = 2 sin(theta/2), and its integral from theta on."""
    c = 2 * np.sin(0.5 * theta)
    return (A2 + c**2) ** -1.5 * np.cos(0.5 * theta), (1 - c / np.sqrt(A2 + c**2)) / A2


_THETA = np.concatenate([np.geomspace(2.2e-5, 1.0, 40_001), np.linspace(1.0, np.pi, 20_001)[1:]])
_Q = fournier_forand_density(2 * np.sin(_THETA / 2) ** 2, 1.10, 3.5835)
_REST = np.append(np.cumsum((0.5 * (_Q[1:] + _Q[:-1]) * np.diff(_THETA))[::-1])[::-1], 0.0)


def _table_angle(theta):
    """Fournier-Forand over the angle itself, and its integral from theta on."""
    return np.interp(theta, _THETA, _Q), np.interp(theta, _THETA, _REST)


# What the angle follows: the guide, its law, how closely a density in a cell of the table keeps to it, draws.
LAWS = {
    "henyey_greenstein": (HENYEY_GREENSTEIN_GUIDE, _hg_angle, 1e-4, COUNT),
    "tabulated": (TABULATED.guide, _table_angle, 1e-3, COUNT // 10),
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


def _flights(guide):
    sample_flight = make_sample_flight(guide)

    @wp.kernel(enable_backward=False, module="unique")
    def flights(
        x: wp.vec3,
        u: wp.vec3,
        interval: wp.vec2,
        c: float,
        medium: Medium,
        s: wp.array(dtype=float),
        p: wp.array(dtype=float),
    ):
        i = wp.tid()
        block = random_block(wp.uint64(2), wp.uint64(i), wp.uint32(0), wp.uint32(2))
        sample = sample_flight(x, u, interval, c, medium, u01(block[0]), u01_fine(block[1]))
        s[i] = sample.s
        p[i] = sample.density

    return flights


FLIGHT_KERNELS = {name: _flights(guide) for name, (guide, *_) in LAWS.items()}


@wp.kernel(enable_backward=False)
def _free_paths(c: float, l: wp.array(dtype=float)):
    i = wp.tid()
    l[i] = free_path(u01(random_block(wp.uint64(6), wp.uint64(i), wp.uint32(0), wp.uint32(1))[0]), c)


@wp.kernel(enable_backward=False)
def _lens(camera: Camera, o: wp.array(dtype=wp.vec3)):
    i = wp.tid()
    block = random_block(wp.uint64(8), wp.uint64(i), wp.uint32(0), wp.uint32(4))
    o[i] = lens_point(camera, u01(block[0]), u01(block[1]))


@wp.kernel(enable_backward=False)
def _clips(
    camera: Camera,
    gate: Gate,
    x: wp.array(dtype=wp.vec3),
    u: wp.array(dtype=wp.vec3),
    path: float,
    out: wp.array(dtype=wp.vec2),
):
    i = wp.tid()
    seen = clip_to_planes(field(camera), x[i], u[i], 9.0)
    out[i] = clip_to_gate(gate, x[i], u[i], path, wp.vec3(0.001, -0.002, 0.0), seen)


def _mixture(law, s, x, u, s0, s1, c):
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


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("flight", FLIGHTS)
@pytest.mark.parametrize(
    ("name", "extinction"), [("henyey_greenstein", 0.3), ("henyey_greenstein", 2.5), ("tabulated", 0.3)]
)
def test_flight_samples_follow_their_density(name, flight, extinction, device):
    _, law, closeness, count = LAWS[name]
    medium = Medium()
    medium.anisotropy = G
    medium.phase = make_phase_tables(lambda t: fournier_forand_density(t, 1.10, 3.5835), device=device)
    x, u, (s0, s1) = FLIGHTS[flight]
    direction = np.asarray(u) / np.linalg.norm(u)
    s, p = (wp.empty(count, dtype=float, device=device) for _ in range(2))
    inputs = [wp.vec3(*x), wp.vec3(*direction), wp.vec2(s0, s1), extinction, medium]
    wp.launch(FLIGHT_KERNELS[name], count, [*inputs, s, p], device=device)
    s, p = s.numpy().astype(np.float64), p.numpy().astype(np.float64)
    assert s.min() >= np.float32(s0) and s.max() <= np.float32(s1)
    # What is claimed is what the definition says, to float32's resolution of the position.
    fine = np.isfinite(p)
    assert fine.all()
    claimed = p[:2000] / _mixture(law, s[:2000], x, u, s0, s1, extinction) - 1
    assert np.abs(np.median(claimed)) < closeness and np.quantile(np.abs(claimed), 0.9) < 5e-3
    # And what is drawn: equal parts by the integral of the density, with nodes where the density is.
    grid = np.unique(np.concatenate([np.linspace(s0, s1, 100_001), np.quantile(s, np.linspace(0, 1, 100_001))]))
    mass = np.concatenate(
        [[0], np.cumsum(np.diff(grid) * _mixture(law, 0.5 * (grid[1:] + grid[:-1]), x, u, s0, s1, extinction))]
    )
    assert mass[-1] == pytest.approx(1.0, abs=1e-3)
    edges = np.interp(np.linspace(0, 1, 41), mass / mass[-1], grid)
    wide = np.diff(edges) > 64 * np.spacing(np.float32(max(s1, 5.0)))  # narrower parts are a few grid points wide
    counts = np.histogram(s, bins=edges)[0][wide]
    assert stats.chisquare(counts, np.full(counts.size, counts.sum() / counts.size)).pvalue > 1e-5


@pytest.mark.parametrize("device", DEVICES)
def test_free_paths_are_exponential(device):
    l = wp.empty(COUNT, dtype=float, device=device)
    wp.launch(_free_paths, COUNT, [0.4, l], device=device)
    values = l.numpy().astype(np.float64)
    assert np.isfinite(values).all()
    assert chi2_p(values, lambda l: -np.expm1(-0.4 * l)) > 1e-4
    assert abs(values.mean() - 2.5) < 5 * 2.5 / math.sqrt(COUNT)


@pytest.mark.parametrize("device", DEVICES)
def test_lens_points_fill_the_aperture_evenly(device):
    camera = Camera()
    camera.aperture_radius = 0.02
    o = wp.empty(COUNT, dtype=wp.vec3, device=device)
    wp.launch(_lens, COUNT, [camera, o], device=device)
    points = o.numpy().astype(np.float64)
    assert not points[:, 2].any()
    area = (points[:, :2] ** 2).sum(axis=1) / 0.02**2
    assert area.max() < 1 + 1e-5
    assert chi2_p(area, lambda a: np.minimum(a, 1.0)) > 1e-4
    assert chi2_p(np.arctan2(points[:, 1], points[:, 0]), lambda a: (a + np.pi) / (2 * np.pi)) > 1e-4


@pytest.mark.parametrize("device", DEVICES)
def test_the_clip_is_what_camera_and_gate_see(device):
    """Against points along each flight, tested one by one for view and arrival."""
    camera, gate = Camera(), Gate()
    camera.width, camera.height, camera.pixel_tangent = 20, 12, 0.05
    gate.start, gate.stop = 4.0, 11.0
    rng = np.random.default_rng(5)
    x = rng.uniform([-3, -3, -1], [3, 3, 6], size=(5000, 3)).astype(np.float32)
    u = rng.normal(size=x.shape)
    u = (u / np.linalg.norm(u, axis=1, keepdims=True)).astype(np.float32)
    out = wp.empty(len(x), dtype=wp.vec2, device=device)
    arrays = [wp.array(a, dtype=wp.vec3, device=device) for a in (x, u)]
    wp.launch(_clips, len(x), [camera, gate, *arrays, 1.5, out], device=device)
    s0, s1 = out.numpy().astype(np.float64).T
    s = np.linspace(0.0, 9.0, 901)
    y = x[:, None] + s[:, None] * u[:, None].astype(np.float64)
    arrival = 1.5 + s + np.linalg.norm(y - [0.001, -0.002, 0.0], axis=2)
    seen = (y[..., 2] > 0) & (np.abs(y[..., 0]) < 0.5 * y[..., 2]) & (np.abs(y[..., 1]) < 0.3 * y[..., 2])
    seen &= (arrival >= 4.0) & (arrival < 11.0)
    inside = (s > s0[:, None]) & (s < s1[:, None])
    near_an_end = (np.abs(s - s0[:, None]) < 1e-3) | (np.abs(s - s1[:, None]) < 1e-3)
    assert seen.any() and (seen == inside)[~near_an_end].all()
