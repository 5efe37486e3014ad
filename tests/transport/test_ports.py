"""Cameras and lasers behind ports: the estimators agree, and light of a plate arrives as quadrature says."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.estimators import agreeing_cells
from helpers.scenes import WATER, scene

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
            result = spadwarp.simulate(one, photons=photons, seed=3, device=device)
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
    result = spadwarp.simulate(one, photons=60_000, seed=2, device=device)
    found = result.tallies[0].sum() * (result.unit / result.photons)
    assert found == pytest.approx(expected, rel=2e-3)
