"""Cameras and lasers behind ports: light of a plate and of the water arrives as quadrature says, the estimators agree,
laser and camera may change places, and a port that does not refract changes nothing."""

import functools
import itertools
import math

import numpy as np
import pytest
from scipy.optimize import brentq

from helpers.estimators import agreeing_cells, means
from helpers.scenes import WATER, scene
from reference import refraction
from spadwarp import simulate

pytestmark = pytest.mark.physics

SEAWATER = WATER | {"phase_index": "seawater", "group_index": "seawater"}
WINDOW = {"distance": 0.05, "thickness": 0.02, "material": "BK7"}
DOME = {"shape": "dome", "radius": 0.15, "thickness": 0.02, "material": "acrylic"}
GATE = {"start_ns": 0.0, "bin_width_ps": 4549.1, "bins": 8}  # 1 m of path a bin


def ported(camera_port, *, laser_port=None, aperture=0.2, **sections):
    camera = {"port": camera_port, "aperture_diameter": aperture}
    laser = {} if laser_port is None else {"port": laser_port}
    return scene(**{"medium": SEAWATER, "camera": camera, "laser": laser, "gate": GATE} | sections)


CASES = {
    "flat": lambda: ported(WINDOW),
    "tilted": lambda: ported(
        WINDOW | {"normal": [0.3, -0.15, 1.0]},
        laser_port=WINDOW | {"distance": 0.01},
        domain={"shape": "slab", "lower": -1.0, "upper": 3.0},
    ),
    "lens in front of the dome's centre": lambda: ported(
        DOME | {"offset": [0.01, 0.0, -0.03]}, laser_port="camera", aperture=0.15
    ),
    "from the air": lambda: ported(
        {"distance": 0.7},
        laser_port="camera",
        domain={"shape": "slab", "lower": 0.7, "upper": 3.0},
        gate=GATE | {"start_ns": 3.0},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_estimators_share_one_mean_behind_a_port(name, device):
    """Analog photons are refracted and must hit the lens themselves: they know nothing of solid angles."""
    agreeing_cells(CASES[name](), device, pixels=True, clear=name != "flat")


def test_equal_indices_are_a_camera_in_the_water(device):
    """Photon by photon, in water that is empty where the stack is."""
    medium = SEAWATER | {"layers": [{"start": 0.2, "extinction": 0.5, "albedo": 0.8}], "extinction": 1e-12}
    water = {"index": 1.3415, "group_index": 1.3638, "inside_index": 1.3415, "inside_group_index": 1.3638}
    ports = [None, {"distance": 0.15, "thickness": 0.05, **water}]
    ports.append({"distance": 0.15, "thickness": 0.05, "normal": [0.1, 0.0, 1.0], **water})
    for estimator, photons in (("next_event", 30_000), ("analog", 80_000)):
        runs = []
        for port in ports:
            one = ported(port, medium=medium, transport={"estimator": estimator, "axis_threshold": 1.0})
            result = simulate(one, photons=photons, seed=3, device=device)
            assert "laser_port" not in result.energy_balance
            runs.append(result.tallies.sum(axis=(1, 2, 3)) * (result.unit / photons))
        assert runs[1] == pytest.approx(runs[0], rel=1e-6)
        # Of a tilted one the empty wedge differs; its water is what counts.
        assert runs[2] == pytest.approx(runs[0], rel=0.2)


def on_the_plate(half_angle, axis, start, plate_depth, count=40):
    """Points where a cone of light meets a plane across z, with even weights of solid angle; `[N, 3]`, `[N]`."""
    node, weight = np.polynomial.legendre.leggauss(count)
    t = 0.5 * (node + 1.0) * (1.0 - math.cos(half_angle))
    phi = (np.arange(2 * count) + 0.5) * math.pi / count
    across = np.linalg.svd(np.array(axis)[None])[2][1:]
    sine = np.sqrt(t * (2.0 - t))
    u = (1.0 - t)[:, None, None] * np.array(axis) + sine[:, None, None] * (
        np.cos(phi)[:, None] * across[0] + np.sin(phi)[:, None] * across[1]
    )
    points = np.array(start) + ((plate_depth - start[2]) / u[..., 2])[..., None] * u
    return points.reshape(-1, 3), (np.repeat(0.25 * weight, 2 * count) / count).ravel()


def plate_seen_through_a_window(points, area, extinction, reflectance):
    """What the lens at the origin collects of light that falls on each point, by section 7 in float64.

    0.05 m of air, 0.02 m of BK7, seawater; the invariant by bisection.
    """
    h, n = (0.05, 0.02), (1.000277, 1.51947, 1.3415)
    rho, water = np.hypot(points[:, 0], points[:, 1]), points[:, 2] - sum(h)
    layers = [(h[0], n[0]), (h[1], n[1]), (water, n[2])]
    low, high = np.zeros(len(rho)), np.full(len(rho), n[0])
    for _ in range(80):
        k = 0.5 * (low + high)
        aside = sum(d * k / np.sqrt(m * m - k * k) for d, m in layers)
        low, high = np.where(aside < rho, k, low), np.where(aside < rho, high, k)
    ratio = sum(d / np.sqrt(m * m - k * k) for d, m in layers)
    slope = sum(d * m * m / (m * m - k * k) ** 1.5 for d, m in layers)
    cosine = [np.sqrt(1.0 - (k / m) ** 2) for m in n]
    s, p = 1.0, 1.0
    for i in range(2):
        r_s = (n[i] * cosine[i] - n[i + 1] * cosine[i + 1]) / (n[i] * cosine[i] + n[i + 1] * cosine[i + 1])
        r_p = (n[i + 1] * cosine[i] - n[i] * cosine[i + 1]) / (n[i + 1] * cosine[i] + n[i] * cosine[i + 1])
        s, p = s * (1.0 - r_s**2), p * (1.0 - r_p**2)
    through = 0.5 * (s + p) * np.exp(-extinction * water / cosine[2])
    spread = 1.0 / (n[2] ** 2 * cosine[2] * ratio * slope)
    return reflectance / math.pi * cosine[2] * through * spread * area, np.degrees(np.arccos(cosine[0]))


@pytest.mark.filterwarnings("ignore:.*rounding to the histogram:RuntimeWarning")  # of light that nearly is not
@pytest.mark.parametrize(("x", "angle"), [(0.0, 0.0), (1.25, 60.0)])
@pytest.mark.parametrize("estimator", ["next_event", "guided"])
def test_a_plate_through_a_window_returns_what_quadrature_says(x, angle, estimator, device):
    """Within 0.2 %, on the axis and at 60° in air; the laser's own way is in the water."""
    aim = np.array([x, 0.0, 1.5]) / math.hypot(x, 1.5)
    one = scene(
        medium={"extinction": 0.05, "albedo": 1e-6, "phase_index": "seawater", "group_index": "seawater"},
        laser={"direction": aim.tolist(), "half_angle_deg": 2.0, "position": [0.0, 0.0, 0.0]},
        camera={"port": WINDOW, "horizontal_fov_deg": 150.0, "aperture_diameter": 1e-3, "width": 2, "height": 2},
        targets=[{"builtin": "plane", "size": [1.0, 1.0], "translation": [x, 0.0, 1.5], "reflectance": 0.5}],
        gate={"start_ns": 0.0, "bin_width_ps": 50_000.0, "bins": 1},
        transport={"estimator": estimator},
    )
    points, weight = on_the_plate(math.radians(2.0), aim, (0.0, 0.0, 0.0), 1.5)
    seen, angles = plate_seen_through_a_window(points, math.pi * 0.5e-3**2, 0.05, 0.5)
    assert angles.mean() == pytest.approx(angle, abs=2.5)
    expected = (weight * seen * np.exp(-0.05 * np.linalg.norm(points, axis=1))).sum()
    result = simulate(one, photons=60_000, seed=2, device=device)
    found = result.tallies[0].sum() * (result.unit / result.photons)
    assert found == pytest.approx(expected, rel=2e-3)


# Light of the water

SEA = {"phase_index": 1.3415, "group_index": 1.3638}
GLASS = {"index": 1.5195, "group_index": 1.5463, "inside_index": 1.0003, "inside_group_index": 1.0003}
INDICES, GROUP = (1.0003, 1.5195, 1.3415), (1.0003, 1.5463, 1.3638)
TILT = np.array([0.2, -0.1, 1.0]) / np.linalg.norm([0.2, -0.1, 1.0])
FLAT_GLASS = {"distance": 0.05, "thickness": 0.02, **GLASS}
DOME_GLASS = {"shape": "dome", "radius": 0.08, "thickness": 0.01, "offset": [0.004, 0.0, 0.012], **GLASS}
EXTINCTION, ALBEDO, G, APERTURE = 0.4, 0.7, 0.5, 1e-3

PORTS = {
    "flat": (FLAT_GLASS, refraction.flat_faces(np.array([0.0, 0.0, 1.0]), 0.05, 0.02)),
    "tilted": (FLAT_GLASS | {"normal": TILT.tolist()}, refraction.flat_faces(TILT, 0.05, 0.02)),
    "dome": (DOME_GLASS, refraction.dome_faces(np.array([0.004, 0.0, 0.012]), 0.08, 0.01)),
}
BEAM, ALONG = np.array([-0.25, 0.05, 0.0]), np.array([0.25, 0.0, 1.0]) / math.hypot(0.25, 1.0)


def time_in_water(lengths):
    """Length of water that takes as long as a way through (water, window, air)."""
    return sum(length * n for length, n in zip(lengths, GROUP[::-1], strict=True)) / GROUP[2]


def single_scatter(faces, edges):
    """What the lens at the origin gets of a thin beam behind a window of its own, by bins of path; Gauss-Legendre."""
    window = refraction.flat_faces(np.array([0.0, 0.0, 1.0]), 0.01, 0.02)
    start, along, lengths, entered = refraction.trace(window[::-1], INDICES, BEAM, ALONG)
    before = time_in_water([0.0, *lengths[::-1]])

    def at(s):
        point = start + s * along
        # Straight ahead, all light would be reflected by a window; light bends towards its normal in water.
        guess = -point * ((0.7, 0.7, 1.0) if faces[0][0] == "plane" else 1.0)
        guess /= np.linalg.norm(guess)
        u, v, way, through, density = refraction.connect(faces, INDICES[::-1], point, np.zeros(3), guess)
        cosine = along @ u
        phase = (1.0 - G * G) / (4.0 * math.pi * (1.0 + G * G - 2.0 * G * cosine) ** 1.5)
        value = entered * math.exp(-EXTINCTION * (s + way[0])) * ALBEDO * EXTINCTION * phase
        return before + s + time_in_water(way), value * through * density * math.pi * APERTURE**2 / 4.0 * -v[2]

    ends = [brentq(lambda s, edge=edge: at(s)[0] - edge, 0.3, 5.0, xtol=1e-7) for edge in edges]
    node, weight = np.polynomial.legendre.leggauss(8)
    return np.array(
        [
            0.5 * (b - a) * sum(w * at(0.5 * (a + b) + 0.5 * (b - a) * t)[1] for t, w in zip(node, weight, strict=True))
            for a, b in itertools.pairwise(ends)
        ]
    )


def scattered_once(port, estimator):
    return scene(
        medium={"extinction": EXTINCTION, "albedo": ALBEDO, "anisotropy": G, **SEA},
        laser={
            "profile": "collimated",
            "beam_radius": 1e-6,
            "position": BEAM.tolist(),
            "direction": ALONG.tolist(),
            "port": {**FLAT_GLASS, "distance": 0.01, "normal": [0.0, 0.0, 1.0]},
        },
        camera={"port": port, "width": 1, "height": 1, "horizontal_fov_deg": 100.0, "aperture_diameter": APERTURE},
        gate={"start_ns": 6.0, "bin_width_ps": 4000.0, "bins": 6},
        targets=[],
        transport={"estimator": estimator, "max_collisions": 1},
    )


@functools.cache
def single_scatter_of(name):
    one = scattered_once(PORTS[name][0], "guided")
    edges = (one.gate.start + one.gate.bin_width * np.arange(7)) * one.medium.pulse_speed
    return single_scatter(PORTS[name][1], edges)


@pytest.mark.parametrize("estimator", ["next_event", "guided"])
@pytest.mark.parametrize("name", PORTS)
def test_light_scattered_once_behind_a_port_is_what_quadrature_says(name, estimator, device):
    """Within 0.5 % in all, and within its error in each bin. Rays and solid angles of the reference are found by
    brute force."""
    one, expected = scattered_once(PORTS[name][0], estimator), single_scatter_of(name)
    mean, error, total, total_error = means(one, device, 100_000, 16)
    assert total_error < 0.002 * expected.sum()
    assert total == pytest.approx(expected.sum(), rel=0.005)
    assert (np.abs(mean - expected) < 5.0 * error).all()


HALF_ANGLE, PIXELS = 12.0, 32
ENDS = {
    "both behind ports": (
        {"shape": "flat", "distance": 0.05, "thickness": 0.02, "normal": [0.15, 0.0, 1.0], **GLASS},
        {"shape": "dome", "radius": 0.08, "thickness": 0.01, **GLASS},
        1.0,
    ),
    "one in the water": (FLAT_GLASS, None, (INDICES[2] / INDICES[0]) ** 2),
}


def disc_weights():
    """Weights of pixels with which the camera has the field of the laser's cone."""
    fine = (np.arange(16 * PIXELS) + 0.5) / (8 * PIXELS) - 1.0
    tangent = math.tan(math.radians(HALF_ANGLE))
    squared = (fine[:, None] ** 2 + fine**2) * tangent**2
    weight = np.sqrt(1.0 + squared) * (squared < tangent**2)
    return weight.reshape(PIXELS, 16, PIXELS, 16).mean(axis=(1, 3))


def exchanged(port, other, swapped):
    """A laser behind `other`, 0.4 m aside of a camera behind `port`, a tilted plate in turbid water before them; or the
    two in each other's place."""
    aside = [-0.4, 0.0, 0.0]
    ports = [{"port": p} if p else {} for p in (port, other)]
    places = [[0.0, 0.0, 0.0], aside]
    if swapped:
        ports, places = ports[::-1], places[::-1]
    return scene(
        medium={"extinction": 0.8, "albedo": 0.85, "anisotropy": 0.8, **SEA},
        camera={
            "width": PIXELS,
            "height": PIXELS,
            "horizontal_fov_deg": 2 * HALF_ANGLE,
            "aperture_diameter": 1e-3,
            "position": places[0],
            **ports[0],
        },
        laser={
            "position": places[1],
            "frame": "world",
            "half_angle_deg": HALF_ANGLE,
            "profile": "uniform_cone",
            **ports[1],
        },
        targets=[
            {
                "builtin": "plane",
                "size": [0.3, 0.2],
                "rotation_deg": [10.0, 20.0, 0.0],
                "translation": [-0.1, 0.05, 1.8],
            }
        ],
        gate={"start_ns": 10.0, "bin_width_ps": 4000.0, "bins": 4},
        transport={"estimator": "guided", "max_collisions": 12},
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", ENDS)
def test_laser_and_camera_may_change_places_in_turbid_water(name, device):
    """Between air and water the radiance over the square of the index is kept: a camera in the water gets more."""
    port, other, factor = ENDS[name]
    weights, seeds, photons = disc_weights(), 16, 40_000
    read = []
    for swapped in (False, True):
        one, rows = exchanged(port, other, swapped), []
        for seed in range(seeds):
            result = simulate(one, photons=photons, seed=seed + 100 * swapped, device=device)
            parts = np.einsum("cijt,ij->ct", result.tallies * (result.unit / photons), weights)
            rows.append(np.concatenate([parts.sum(axis=0), parts.sum(axis=1)]))
        read.append(np.array(rows))
    mean, error = np.mean(read, axis=1), np.std(read, axis=1, ddof=1) / math.sqrt(seeds)
    z = (mean[1] - factor * mean[0]) / np.hypot(error[1], factor * error[0])
    assert (error[:, 4:] < 0.03 * mean[:, 4:]).all()
    assert (np.abs(z) < 3.0).all()


def test_equal_indices_leave_guided_as_it_is(device, monkeypatch):
    """Photon by photon, in water that begins at the window: flights then end there with and without it. Those of a
    dome, whose view has a margin, do not: the means are the same."""
    monkeypatch.setattr("spadwarp.transport.model._check_domain", lambda *_: None)  # lets a lens stay outside the water
    water = {"index": 1.3415, "group_index": 1.3638, "inside_index": 1.3415, "inside_group_index": 1.3638}
    window = {"distance": 0.15, "thickness": 0.05, **water}
    dome = {"shape": "dome", "radius": 0.15, "thickness": 0.05, **water}
    runs = []
    for port in (None, window, dome):
        one = scene(
            medium=WATER | SEA | {"extinction": 1e-12, "layers": [{"start": 0.2, "extinction": 0.5, "albedo": 0.8}]},
            domain={"shape": "slab", "lower": 0.2, "upper": 3.0},
            camera={"aperture_diameter": 0.2} | ({} if port is None else {"port": port}),
            laser={"position": [-0.1, 0.0, 0.2]},
            transport={"estimator": "guided"},
        )
        rows = []
        for seed in range(8):
            result = simulate(one, photons=20_000, seed=seed, device=device)
            rows.append(result.tallies.sum(axis=(1, 2)) * (result.unit / 20_000))
        runs.append(np.array(rows))
    bare, flat, domed = (rows.sum(axis=2).mean(axis=0) for rows in runs)
    assert flat == pytest.approx(bare, rel=1e-6)
    # A flight at the very edge of the view may count in one of them and not in the other.
    np.testing.assert_allclose(runs[1], runs[0], rtol=3e-4, atol=1e-6 * bare.max())
    error = np.sqrt(runs[0].sum(axis=2).var(axis=0, ddof=1) / 8 + runs[2].sum(axis=2).var(axis=0, ddof=1) / 8)
    assert (np.abs(domed - bare) < 4 * error + 1e-6 * bare).all() and (error < 0.01 * bare).all()
