"""Faces of the domain that reflect: the walls of a tank, the surface seen from below, and light by way of them."""

import numpy as np
import pytest

from helpers.estimators import agreeing_cells, means
from helpers.scenes import BEYOND, ELSEWHERE, scene
from reference.refraction import reflectance
from spadwarp import simulate
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.transport import trace
from spadwarp.transport.model import build_model
from spadwarp.values import ConfigError

WATER = 1.34
TURNED = {"position": [0.1, 0.2, 0.3], "rotation_deg": [20.0, -35.0, 50.0]}


def beam(direction, domain, *, medium=(), max_collisions=7):
    """A narrow beam from the origin of the world without a target, in water that is nearly clear; a turned camera."""
    place = {"profile": "collimated", "beam_radius": 1e-6, "frame": "world", "position": [0, 0, 0]}
    return scene(
        medium={"extinction": 1e-6, "albedo": 1.0, "anisotropy": 0.0, "phase_index": WATER, **dict(medium)},
        laser={**place, "direction": direction},
        camera=TURNED,
        targets=[],
        domain=domain,
        transport={"max_collisions": max_collisions, "weight_cutoff": 0.0},
    )


def emitted(records):
    return round(len(records.id) / records.energy_balance_unit)


SLAB = {"shape": "slab", "lower": -1.0, "upper": 1.0}
BOX = {"shape": "box", "lower": [-0.7, -0.5, -0.4], "upper": [0.5, 0.9, 1.6]}


def test_a_beam_between_two_faces_keeps_the_products_of_their_reflectances(device):
    records = trace(
        beam([0.3, 0.0, 1.0], {**SLAB, "outside_index": {"z_low": 1.0, "z_high": 2.0}}), photons=64, device=device
    )
    cosine = 1 / np.hypot(0.3, 1.0)
    r_high, r_low = (reflectance(cosine, outside / WATER) for outside in (2.0, 1.0))
    np.testing.assert_allclose(records.weight, r_high**4 * r_low**3, rtol=1e-4)
    np.testing.assert_allclose(records.path, 13 / cosine, rtol=1e-5)  # 1 m, then 6 times 2 m
    np.testing.assert_allclose(records.direction, np.tile([0.3 * cosine, 0, cosine], (64, 1)), atol=1e-5)
    assert (records.collisions == 7).all() and records.ended("max_collisions").all()
    # What is not reflected leaves by the face, and nothing is lost.
    leaves = records.energy_balance["exit_z_high"] / emitted(records)
    assert leaves == pytest.approx((1 - r_high) * sum((r_high * r_low) ** k for k in range(4)), rel=1e-4)
    assert sum(records.energy_balance.values()) == emitted(records)


def test_beyond_the_critical_angle_all_light_is_reflected(device):
    """A beam at 50° in water under air; the critical angle is 48.3°."""
    slab = {**SLAB, "outside_index": {"z_low": 1.0, "z_high": 1.0}}
    records = trace(beam([np.tan(np.radians(50)), 0.0, 1.0], slab, max_collisions=30), photons=64, device=device)
    assert (records.weight == 1.0).all() and (records.collisions == 30).all()
    assert records.energy_balance["max_collisions"] == emitted(records)
    below = trace(beam([np.tan(np.radians(47)), 0.0, 1.0], slab, max_collisions=1), photons=64, device=device)
    np.testing.assert_allclose(below.weight, reflectance(np.cos(np.radians(47)), 1.0 / WATER), rtol=1e-3)


def test_light_in_a_white_box_stays_and_fills_it(device):
    """Mirrors all around water without absorption: no weight is lost, and after many events positions are uniform and
    directions isotropic."""
    mirrors = dict.fromkeys(("x_low", "x_high", "y_low", "y_high", "z_low", "z_high"), 1e9)
    one = beam([0.2, 0.1, 1.0], {**BOX, "outside_index": mirrors}, medium={"extinction": 1.0}, max_collisions=120)
    records = trace(one, photons=20_000, device=device)
    assert records.energy_balance["max_collisions"] == pytest.approx(emitted(records), rel=1e-5)
    assert sum(records.energy_balance.values()) == emitted(records)
    low, high = np.array(BOX["lower"]), np.array(BOX["upper"])
    # The last event is a reflection for a part of the photons, which are then on a face; the others scatter where light
    # is, in all directions alike.
    inside = (records.position > low + 1e-4).all(axis=1) & (records.position < high - 1e-4).all(axis=1)
    assert ((records.position > low - 1e-5) & (records.position < high + 1e-5)).all()
    share, heading = (records.position[inside] - low) / (high - low), records.direction[inside]
    for values, mean, variance in (
        (share, 1 / 2, 1 / 12),
        (share**2, 1 / 3, 4 / 45),
        (heading, 0.0, 1 / 3),
        (heading**2, 1 / 3, 4 / 45),
    ):
        np.testing.assert_allclose(values.mean(axis=0), mean, atol=4.5 * np.sqrt(variance / inside.sum()))


def test_the_domain_stands_in_the_world(device):
    """Photons end on the faces of the box that the ledger names; one is a mirror."""
    mirror = {**BOX, "outside_index": {"z_low": 1e9}}
    one = beam([0.2, 0.1, 1.0], mirror, medium={"extinction": 2.0}, max_collisions=1000)
    records = trace(one, photons=20_000, seed=1, device=device)
    for index, axis in enumerate("xyz"):
        for side, corner in (("low", BOX["lower"]), ("high", BOX["upper"])):
            ended = records.ended(f"exit_{axis}_{side}")
            assert ended.sum() > 100 or (axis, side) == ("z", "low")
            np.testing.assert_allclose(records.position[ended, index], corner[index], atol=1e-5)


ROOM = {"shape": "box", "lower": -1.0, "upper": 3.0}


def box(**fields):
    return {"domain": {**ROOM, **fields}}


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"domain": {"outside_index": {"z_low": 1.0}}}, "outside_index.z_low: the domain has no such face"),
        ({"domain": {"shape": "slab", "lower": -1.0, "outside_index": {"z_high": 1.0}}}, "outside_index.z_high"),
        (box(outside_index={"z_high": 0.5}), "z_high = 0.5 is outside"),
        (box(outside_index={"top": 1.0}), "top"),
        (box(max_reflections=9), "max_reflections = 9 is outside"),
        (
            {**box(outside_index={"z_high": 1.0}), "transport": {"lateral_limit": 1.0}},
            "transport.lateral_limit = 1.0 does not go with domain.outside_index",
        ),
        ({"camera": {"position": [0.0, -0.9, 0.0]}}, "camera.aperture_diameter: reaches 0.1 m through y_low"),
        (
            {"laser": {"profile": "collimated", "beam_radius": 0.3, "position": [0.0, -0.9, 0.0]}},
            "laser.beam_radius: reaches 0.2 m through y_low",
        ),
    ],
)
def test_faces_that_cannot_reflect_are_refused_by_name(sections, message):
    """And a lens or a beam that reaches through one."""
    medium = {"phase_index": WATER, "layers": ELSEWHERE}
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        one = scene(**{**box(outside_index={"y_low": 1.0}), "medium": medium, **sections})
        build_model(one, pick_device("cpu"), build_mesh(one))


def test_faces_that_reflect_survive_a_scene_file():
    one = scene(domain={**ROOM, "outside_index": {"y_low": 1.0, "x_high": 1.52}, "max_reflections": 3})
    again = type(one).from_toml(one.to_toml())
    assert again == one and hash(again) == hash(one)
    assert again.domain.reflecting == {"x_high": 1.52, "y_low": 1.0}
    changed = one.with_overrides(["domain.outside_index.y_low=1.1", "domain.outside_index.z_high=1.0"])
    assert changed.domain.reflecting == {"x_high": 1.52, "y_low": 1.1, "z_high": 1.0}
    assert one.with_overrides({"domain.outside_index": None}).domain.reflecting == {}


# Light that reaches the lens by way of the faces: the estimators against each other and against quadrature

SURFACE = {"x_high": 1.49, "y_low": 1.0, "y_high": 1e9, "z_low": 1.0}
TANK = {"shape": "box", "lower": [-0.9, -0.5, -0.5], "upper": [0.7, 0.6, 2.6], "outside_index": SURFACE}


def tank(**sections):
    """A plate in a narrow tank: the surface above, a mirror below, a wall of acrylic beside, an open one opposite."""
    target = {"builtin": "plane", "size": [1.0, 0.8], "translation": [-0.1, 0.0, 2.0], "reflectance": 0.7}
    changes = sections.pop("domain", {})
    domain = {"shape": "unbounded"} if changes is None else {**TANK, "max_reflections": 4, **changes}
    camera = {"horizontal_fov_deg": 80.0, **sections.pop("camera", {})}
    return scene(camera=camera, targets=[target], domain=domain, **sections)


PORT = {"port": {"shape": "flat", "distance": 0.1}, "horizontal_fov_deg": 60.0}
CASES = {
    "water": ({"analog": 40_000, "guided": 20_000}, tank()),
    "port, rotated, roulette": (
        {"next_event": 20_000, "guided": 20_000},
        tank(
            camera={**PORT, "rotation_deg": [12.0, -8.0, 25.0], "position": [0.05, 0.1, 0.1]},
            laser={"position": [-0.1, 0.0, 0.25]},
            transport={"termination": "roulette", "weight_cutoff": 0.3},
        ),
    ),
}


@pytest.mark.slow
@pytest.mark.physics
@pytest.mark.parametrize("name", CASES)
def test_estimators_agree_in_a_tank_with_reflecting_walls(name, device):
    photons, one = CASES[name]
    agreeing_cells(one, device, photons=photons, pixels=True, clear=True)


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
            passes = np.prod([reflectance(abs(y) / r, OUTSIDE[side] / WATER) for side in met], axis=0) if met else 1.0
            phase = (1 - G**2) / (4 * np.pi * (1 + G**2 + 2 * G * s / r) ** 1.5)
            value = ALBEDO * EXTINCTION * np.exp(-EXTINCTION * (s + r)) * phase * AREA * (s / r) / r**2 * passes
            value *= np.abs(y) / s < TANGENT
            found += np.histogram(s + r, bins=6, range=(3, 9), weights=value * (s[1] - s[0]))[0]
    return found


@pytest.mark.slow
@pytest.mark.physics
def test_light_scattered_once_between_two_faces_is_that_of_the_images(device):
    """Mirroring a point in one face after the other gives the images here in their order from the beam, and the
    kernel's in their order from the lens."""
    one = scene(
        medium={"extinction": EXTINCTION, "albedo": ALBEDO, "anisotropy": G, "phase_index": WATER, "layers": ELSEWHERE},
        laser={"profile": "collimated", "beam_radius": 1e-6, "position": [0.0, BEAM_Y, 0.0]},
        camera={"width": 1, "height": 1, "horizontal_fov_deg": 60.0, "aperture_diameter": 0.02, "pinhole": True},
        gate={"start_ns": 3 * 3.33564095, "bins": 6},
        targets=BEYOND,
        domain={
            "shape": "box",
            "lower": [-np.inf, LOW, -np.inf],
            "upper": [np.inf, HIGH, np.inf],
            "outside_index": OUTSIDE,
            "max_reflections": 3,
        },
        transport={"max_collisions": 1},
    )
    expected, straight = single_scatter(3), single_scatter(0)
    assert straight.sum() < 0.75 * expected.sum()  # the images count
    mean, error, total, total_error = means(one, device, 40_000, 16)
    assert total_error < 0.005 * expected.sum()
    assert total == pytest.approx(expected.sum(), abs=4.5 * total_error)
    seen = expected > 0
    assert (np.abs(mean - expected)[seen] < 5.5 * error[seen]).all()


@pytest.mark.slow
def test_analog_counts_what_it_drops_for_too_many_reflections(device):
    """Without mirrored connections, and with so many that hardly anything is left out. Faces that reflect leave
    ballistic light as it is, to the bit."""
    few, many, open_water = (
        simulate(
            tank(domain=domain, medium={"layers": ELSEWHERE}, transport={"estimator": "analog"}),
            photons=60_000,
            device=device,
        )
        for domain in ({"max_reflections": 0}, {"max_reflections": 3}, None)
    )
    dropped, none = (result.counters["beyond_max_reflections"] for result in (few, many))
    assert dropped > 100 > 2 >= none
    # A history that has ended already flies on no further, which is not counted.
    gained = many.counters["contributions"] - few.counters["contributions"]
    assert dropped - none <= gained < 1.1 * (dropped - none)
    assert few.counters["reflections"] > 10_000
    assert few.energy_report()["exact"] and many.energy_report()["exact"]
    # The transport itself, up to the light of last events, is the same: no weight is taken by what is dropped.
    assert few.energy_balance["absorbed_water"] == many.energy_balance["absorbed_water"]
    assert open_water.component("ballistic").any()
    np.testing.assert_array_equal(many.component("ballistic"), open_water.component("ballistic"))
