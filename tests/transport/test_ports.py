"""Cameras and lasers behind ports: light of a plate and of the water arrives as quadrature says, the estimators agree,
laser and camera may change places, and a port that does not refract changes nothing.

All scenes have layers and a domain, and laser and camera behind ports of one shape, so that they share few kernels."""

import functools
import itertools
import math

import numpy as np
import pytest
from scipy.optimize import brentq

from helpers.estimators import PHOTONS, agreeing_cells, means
from helpers.scenes import BEYOND, ELSEWHERE, WATER, scene
from reference import refraction
from spadwarp import simulate

pytestmark = pytest.mark.physics

SEA = {"phase_index": 1.3415, "group_index": 1.3638}
GLASS = {"index": 1.5195, "group_index": 1.5463, "inside_index": 1.0003, "inside_group_index": 1.0003}
INDICES, GROUP = (1.0003, 1.5195, 1.3415), (1.0003, 1.5463, 1.3638)
NO_GLASS = {"index": 1.3415, "group_index": 1.3638, "inside_index": 1.3415, "inside_group_index": 1.3638}
FLAT_GLASS = {"distance": 0.05, "thickness": 0.02, **GLASS}
DOME_GLASS = {"shape": "dome", "radius": 0.08, "thickness": 0.01, "offset": [0.004, 0.0, 0.012], **GLASS}
NO_WINDOW = {"distance": 1e-5, "thickness": 1e-5, **NO_GLASS}  # a camera or a laser in the water
WINDOW = {"distance": 0.05, "thickness": 0.02, "material": "BK7"}
DOME = {"shape": "dome", "radius": 0.15, "thickness": 0.02, "offset": [0.01, 0.0, -0.03], "material": "acrylic"}
AHEAD = np.array([0.0, 0.0, 1.0])
OPEN = {"shape": "slab", "lower": -60.0, "upper": 60.0}


def ported(camera_port, laser_port, *, medium=(), camera=(), laser=(), place=(-0.1, 0.0, 0.0), **sections):
    return scene(
        medium={**WATER, "layers": ELSEWHERE, **SEA, **dict(medium)},
        camera={"port": camera_port, "aperture_diameter": 0.2, **dict(camera)},
        laser={"port": laser_port, "position": list(place), **dict(laser)},
        **{"domain": OPEN, "gate": {"bin_width_ps": 4549.1}, **sections},  # 1 m of path a bin
    )


BOTH = {"analog": 40_000, "guided": 20_000}
CASES = {
    "tilted": (
        PHOTONS,
        lambda: ported(
            WINDOW | {"normal": [0.3, -0.15, 1.0]},
            WINDOW | {"distance": 0.01},
            domain={"shape": "slab", "lower": -1.0, "upper": 3.0},
        ),
    ),
    "lens in front of the dome's centre": (BOTH, lambda: ported(DOME, "camera", camera={"aperture_diameter": 0.15})),
    "from the air": (
        BOTH,
        lambda: ported(
            {"distance": 0.7},
            "camera",
            domain={"shape": "slab", "lower": 0.7, "upper": 3.0},
            gate={"start_ns": 3.0, "bin_width_ps": 4549.1},
        ),
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_estimators_share_one_mean_behind_a_port(name, device):
    """Analog photons are refracted and must hit the lens themselves: they know nothing of solid angles."""
    photons, make = CASES[name]
    one = make().with_overrides({"medium.layers": None})
    agreeing_cells(one, device, photons=photons, seeds=16, pixels=True, clear=True)


def rays_of_a_cone(half_angle, axis, count=8):
    """Unit vectors `[N, 3]` of even density in solid angle, with their weights `[N]`."""
    node, weight = np.polynomial.legendre.leggauss(count)
    t = 0.5 * (node + 1.0) * (1.0 - math.cos(half_angle))
    phi = (np.arange(2 * count) + 0.5) * math.pi / count
    across, sine = np.linalg.svd(np.array(axis)[None])[2][1:], np.sqrt(t * (2.0 - t))
    around = np.cos(phi)[:, None] * across[0] + np.sin(phi)[:, None] * across[1]
    u = (1.0 - t)[:, None, None] * np.array(axis) + sine[:, None, None] * around
    return u.reshape(-1, 3), (np.repeat(0.25 * weight, 2 * count) / count).ravel()


def seen_through(faces, indices, point, flat=True):
    """Of the ray from a point in the water to the lens at the origin: direction there, lengths of (water, window,
    air), direction at the lens, and the part of the radiant intensity that the lens gets by area."""
    # Straight ahead, all light would be reflected by a window; light bends towards its normal in water.
    guess = -point * ((0.7, 0.7, 1.0) if flat else 1.0)
    u, v, way, through, density = refraction.connect(faces, indices, point, np.zeros(3), guess / np.linalg.norm(guess))
    return u, way, v, through * density * -v[2]


@pytest.mark.filterwarnings("ignore:.*rounding to the histogram:RuntimeWarning")  # of light that nearly is not
@pytest.mark.parametrize(
    ("x", "angle", "estimator"),
    [
        (1.25, 60.0, "next_event"),
        (1.25, 60.0, "guided"),
        pytest.param(0.0, 0.0, "next_event", marks=pytest.mark.slow),
        pytest.param(0.0, 0.0, "guided", marks=pytest.mark.slow),
    ],
)
def test_a_plate_through_a_window_returns_what_quadrature_says(x, angle, estimator, device):
    """Within 0.2 %, on the axis and at 60° in air; the laser's own way is in the water."""
    aim = np.array([x, 0.0, 1.5]) / math.hypot(x, 1.5)
    one = ported(
        WINDOW,
        NO_WINDOW,
        medium={"extinction": 0.05, "albedo": 1e-6, "phase_index": "seawater", "group_index": "seawater"},
        laser={"direction": aim.tolist(), "half_angle_deg": 2.0, "position": [0.0, 0.0, 0.0]},
        camera={"horizontal_fov_deg": 150.0, "aperture_diameter": 1e-3, "width": 2, "height": 2},
        targets=[{"builtin": "plane", "size": [1.0, 1.0], "translation": [x, 0.0, 1.5], "reflectance": 0.5}],
        gate={"bin_width_ps": 50_000.0, "bins": 1},
        transport={"estimator": estimator},
    )
    rays, weights = rays_of_a_cone(math.radians(2.0), aim)
    faces, expected, angles = refraction.flat_faces(AHEAD, 0.05, 0.02), 0.0, []
    for ray, weight in zip(rays, weights, strict=True):
        point = 1.5 / ray[2] * ray
        u, way, v, seen = seen_through(faces, (1.3415, 1.51947, 1.000277), point)
        water = math.exp(-0.05 * (np.linalg.norm(point) + way[0]))
        expected += weight * water * 0.5 / math.pi * -u[2] * seen * math.pi * 0.5e-3**2
        angles.append(math.degrees(math.acos(-v[2])))
    assert np.mean(angles) == pytest.approx(angle, abs=2.5)
    result = simulate(one, photons=60_000, seed=2, device=device)
    found = result.tallies[0].sum() * (result.unit / result.photons)
    assert found == pytest.approx(expected, rel=2e-3)


# Light of the water

TILT = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
EXTINCTION, ALBEDO, G, APERTURE = 0.4, 0.7, 0.5, 1e-3
BEAM, ALONG = np.array([-0.25, 0.05, 0.0]), np.array([0.25, 0.0, 1.0]) / math.hypot(0.25, 1.0)
CENTRE, ASIDE = np.array([0.004, 0.0, 0.012]), np.array([0.01, 0.0, 0.03])
LASER_WINDOW = FLAT_GLASS | {"distance": 0.01, "normal": AHEAD.tolist()}, refraction.flat_faces(AHEAD, 0.01, 0.02)[::-1]
LASER_DOME = (
    DOME_GLASS | {"offset": ASIDE.tolist()},
    [("sphere", BEAM + ASIDE, 0.08, False), ("sphere", BEAM + ASIDE, 0.09, False)],
)
# Port of the camera, its faces from the water, port of the laser and its faces from there.
PORTS = {
    "flat": (FLAT_GLASS, refraction.flat_faces(AHEAD, 0.05, 0.02), *LASER_WINDOW),
    "tilted": (FLAT_GLASS | {"normal": TILT.tolist()}, refraction.flat_faces(TILT, 0.05, 0.02), *LASER_WINDOW),
    "dome": (DOME_GLASS, refraction.dome_faces(CENTRE, 0.08, 0.01), *LASER_DOME),
}


def time_in_water(lengths):
    """Length of water that takes as long as a way through (water, window, air)."""
    return sum(length * n for length, n in zip(lengths, GROUP[::-1], strict=True)) / GROUP[2]


def single_scatter(faces, window, edges):
    """What the lens at the origin gets of a thin beam behind a window of its own, by bins of path; Gauss-Legendre."""
    start, along, lengths, entered = refraction.trace(window, INDICES, BEAM, ALONG)
    before = time_in_water([0.0, *lengths[::-1]])

    def at(s):
        point = start + s * along
        u, way, _, seen = seen_through(faces, INDICES[::-1], point, faces[0][0] == "plane")
        phase = (1.0 - G * G) / (4.0 * math.pi * (1.0 + G * G - 2.0 * G * (along @ u)) ** 1.5)
        value = entered * math.exp(-EXTINCTION * (s + way[0])) * ALBEDO * EXTINCTION * phase
        return before + s + time_in_water(way), value * seen * math.pi * APERTURE**2 / 4.0

    ends = [brentq(lambda s, edge=edge: at(s)[0] - edge, 0.3, 5.0, xtol=1e-7) for edge in edges]
    node, weight = np.polynomial.legendre.leggauss(8)
    points = [(0.5 * (b - a), 0.5 * (a + b)) for a, b in itertools.pairwise(ends)]
    rule = list(zip(node, weight, strict=True))
    return np.array([half * sum(w * at(m + half * t)[1] for t, w in rule) for half, m in points])


def scattered_once(name, estimator="guided"):
    return ported(
        PORTS[name][0],
        PORTS[name][2],
        medium={"extinction": EXTINCTION, "albedo": ALBEDO, "anisotropy": G},
        laser={"profile": "collimated", "beam_radius": 1e-6, "position": BEAM.tolist(), "direction": ALONG.tolist()},
        camera={"width": 1, "height": 1, "horizontal_fov_deg": 100.0, "aperture_diameter": APERTURE},
        gate={"start_ns": 6.0, "bin_width_ps": 4000.0, "bins": 6},
        targets=BEYOND,
        transport={"estimator": estimator, "max_collisions": 1},
    )


@functools.cache
def single_scatter_of(name):
    one = scattered_once(name)
    edges = (one.gate.start + one.gate.bin_width * np.arange(7)) * one.medium.pulse_speed
    return single_scatter(PORTS[name][1], PORTS[name][3], edges)


@pytest.mark.parametrize(
    ("name", "estimator"),
    [
        pytest.param("flat", "next_event", marks=pytest.mark.slow),
        ("flat", "guided"),
        ("tilted", "guided"),
        pytest.param("dome", "guided", marks=pytest.mark.slow),
    ],
)
def test_light_scattered_once_behind_a_port_is_what_quadrature_says(name, estimator, device):
    """Within 0.5 % in all, and within its error in each bin. Rays and solid angles of the reference are found by
    brute force."""
    one, expected = scattered_once(name, estimator), single_scatter_of(name)
    mean, error, total, total_error = means(one, device, 100_000, 16)
    assert total_error < 0.002 * expected.sum()
    assert total == pytest.approx(expected.sum(), rel=0.005)
    assert (np.abs(mean - expected) < 5.0 * error).all()
