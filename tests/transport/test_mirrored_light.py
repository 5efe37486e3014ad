"""Light that reaches the lens by way of reflecting faces: the estimators against each other and against quadrature."""

import numpy as np
import pytest

import spadwarp
from helpers.estimators import agreeing_cells, clear_at_the_lens
from helpers.scenes import scene

SURFACE = {"x_high": 1.49, "y_low": 1.0, "y_high": 1e9, "z_low": 1.0}
TANK = {"shape": "box", "lower": [-0.9, -0.5, -0.5], "upper": [0.7, 0.6, 2.6], "outside_index": SURFACE}
WIDE = {"horizontal_fov_deg": 80.0}


def tank(**sections):
    """A plate in a narrow tank: the surface above, a mirror below, a wall of acrylic beside, an open one opposite."""
    target = {"builtin": "plane", "size": [1.0, 0.8], "translation": [-0.1, 0.0, 2.0], "reflectance": 0.7}
    domain = {**TANK, "max_reflections": 4, **sections.pop("domain", {})}
    return scene(camera={**WIDE, **sections.pop("camera", {})}, targets=[target], domain=domain, **sections)


CASES = {
    "water": tank(),
    "port, rotated, roulette": tank(
        camera={
            "port": {"shape": "flat", "distance": 0.1},
            "horizontal_fov_deg": 60.0,
            "rotation_deg": [12.0, -8.0, 25.0],
            "position": [0.05, 0.1, 0.1],
        },
        transport={"termination": "roulette", "weight_cutoff": 0.3},
    ),
}


@pytest.mark.slow
@pytest.mark.physics
@pytest.mark.parametrize("name", CASES)
def test_estimators_agree_in_a_tank_with_reflecting_walls(name, device):
    photons = {"analog": 60_000, "next_event": 20_000, "guided": 20_000}
    agreeing_cells(CASES[name], device, photons=photons, pixels=True, clear=name != "water")


def reflectance(cosine, outside, water=1.34):
    ratio = outside / water
    q = np.sqrt(np.maximum(ratio**2 - 1 + cosine**2, 0.0))
    s, p = (cosine - q) / (cosine + q), (ratio**2 * cosine - q) / (ratio**2 * cosine + q)
    return np.where(ratio**2 <= 1 - cosine**2, 1.0, 0.5 * (s**2 + p**2))


LOW, HIGH, BEAM_Y = -0.35, 0.3, 0.1
OUTSIDE = {"y_low": 1.0, "y_high": 1e9}
EXTINCTION, ALBEDO, G, AREA, TANGENT = 0.4, 0.7, 0.5, np.pi * 0.01**2, np.tan(np.radians(30))


def single_scatter(reflections):
    """Light of a thin beam along z that is scattered once and reflected so many times at most, by path [3 m, 9 m] in 6
    bins: each image of the beam is a source of its own."""
    s = (np.arange(400_000) + 0.5) * (8.0 / 400_000)
    found = np.zeros(6)
    for first in ((), *((side,) for side in OUTSIDE)):
        for count in range(1 if first else 0, reflections + 1 if first else 1):
            other = {"y_low": "y_high", "y_high": "y_low"}
            met = [first[0] if k % 2 == 0 else other[first[0]] for k in range(count)]  # in the order from the beam
            y = BEAM_Y
            for side in met:
                y = 2 * {"y_low": LOW, "y_high": HIGH}[side] - y
            r = np.hypot(y, s)
            passes = np.prod([reflectance(abs(y) / r, OUTSIDE[side]) for side in met], axis=0) if met else 1.0
            phase = (1 - G**2) / (4 * np.pi * (1 + G**2 + 2 * G * s / r) ** 1.5)
            value = ALBEDO * EXTINCTION * np.exp(-EXTINCTION * (s + r)) * phase * AREA * (s / r) / r**2 * passes
            value *= np.abs(y) / s < TANGENT
            found += np.histogram(s + r, bins=6, range=(3, 9), weights=value * (s[1] - s[0]))[0]
    return found


@pytest.mark.physics
@pytest.mark.parametrize("estimator", ["next_event", "guided"])
def test_light_scattered_once_between_two_faces_is_that_of_the_images(estimator, device):
    """Mirroring a point in one face after the other gives the images here in their order from the beam, and the
    kernel's in their order from the lens."""
    one = scene(
        medium={"extinction": EXTINCTION, "albedo": ALBEDO, "anisotropy": G, "phase_index": 1.34},
        laser={"profile": "collimated", "beam_radius": 1e-6, "position": [0.0, BEAM_Y, 0.0]},
        camera={"width": 1, "height": 1, "horizontal_fov_deg": 60.0, "aperture_diameter": 0.02, "pinhole": True},
        gate={"start_ns": 3 * 3.33564095, "bins": 6},
        targets=[],
        domain={
            "shape": "box",
            "lower": [-np.inf, LOW, -np.inf],
            "upper": [np.inf, HIGH, np.inf],
            "outside_index": OUTSIDE,
            "max_reflections": 3,
        },
        transport={"estimator": estimator, "max_collisions": 1},
    )
    rows = []
    for seed in range(16):
        result = spadwarp.simulate(one, photons=40_000, seed=seed, device=device)
        rows.append(result.tallies.sum(axis=(0, 1, 2)) * (result.unit / 40_000))
    expected, straight = single_scatter(3), single_scatter(0)
    assert straight.sum() < 0.75 * expected.sum()  # the images count
    mean, error = np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1) / 4
    totals = np.sum(rows, axis=1)
    assert totals.std() / 4 < 0.005 * expected.sum()
    assert totals.mean() == pytest.approx(expected.sum(), abs=4.5 * totals.std(ddof=1) / 4)
    seen = expected > 0
    assert (np.abs(mean - expected)[seen] < 5.5 * error[seen]).all()


def test_analog_counts_what_it_drops_for_too_many_reflections(device):
    """Without mirrored connections, and with so many that hardly anything is left out; next_event reports none."""
    results = [
        spadwarp.simulate(
            tank(domain={"max_reflections": longest}, transport={"estimator": "analog"}), photons=60_000, device=device
        )
        for longest in (0, 3)
    ]
    dropped, none = (result.counters["beyond_max_reflections"] for result in results)
    assert dropped > 100 > 2 >= none
    # A history that has ended already flies on no further, which is not counted.
    gained = results[1].counters["contributions"] - results[0].counters["contributions"]
    assert dropped - none <= gained < 1.1 * (dropped - none)
    assert results[0].counters["reflections"] > 10_000
    for result in results:
        assert result.energy_report()["exact"]
    # The transport itself, up to the light of last events, is the same: no weight is taken by what is dropped.
    assert results[0].energy_balance["absorbed_water"] == results[1].energy_balance["absorbed_water"]


def test_ballistic_light_has_not_been_reflected(device):
    """Faces that reflect leave it as it is, to the bit."""
    walls = clear_at_the_lens(tank(transport={"estimator": "next_event"}))  # a kernel that the tests above compile
    runs = [
        spadwarp.simulate(one, photons=20_000, device=device).component("ballistic")
        for one in (walls, walls.with_overrides({"domain.outside_index": None}))
    ]
    np.testing.assert_array_equal(*runs)
