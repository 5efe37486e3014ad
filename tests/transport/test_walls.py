"""Faces of the domain that reflect: the walls of a tank, the surface seen from below."""

import numpy as np
import pytest

from helpers.scenes import scene
from spadwarp import simulate
from spadwarp.errors import ConfigError
from spadwarp.transport.records import trace

WATER = 1.34


def reflectance(cosine, outside):
    ratio = outside / WATER
    sine2 = (1 - cosine**2) / ratio**2
    if sine2 >= 1:
        return 1.0
    behind = np.sqrt(1 - sine2)
    s, p = (
        (cosine - ratio * behind) / (cosine + ratio * behind),
        (ratio * cosine - behind) / (ratio * cosine + behind),
    )
    return 0.5 * (s**2 + p**2)


def beam(direction, domain, *, medium=(), max_collisions=7, **sections):
    """A narrow beam without a target, in water that is nearly clear."""
    return scene(
        medium={"extinction": 1e-6, "albedo": 1.0, "anisotropy": 0.0, "phase_index": WATER, **dict(medium)},
        laser={"profile": "collimated", "beam_radius": 1e-6, "direction": direction, "position": [0, 0, 0]},
        targets=[],
        domain=domain,
        transport={"max_collisions": max_collisions, "weight_cutoff": 0.0},
        **sections,
    )


def emitted(records):
    return round(len(records.id) / records.energy_balance_unit)


def test_a_beam_between_two_faces_keeps_the_products_of_their_reflectances(device):
    slab = {"shape": "slab", "lower": -1.0, "upper": 1.0, "outside_index": {"z_low": 1.0, "z_high": 2.0}}
    records = trace(beam([0.3, 0.0, 1.0], slab), photons=64, device=device)
    cosine = 1 / np.hypot(0.3, 1.0)
    expected = reflectance(cosine, 2.0) ** 4 * reflectance(cosine, 1.0) ** 3
    np.testing.assert_allclose(records.weight, expected, rtol=1e-4)
    np.testing.assert_allclose(records.path, 13 / cosine, rtol=1e-5)  # 1 m, then 6 times 2 m
    np.testing.assert_allclose(records.direction, np.tile([0.3 * cosine, 0, cosine], (64, 1)), atol=1e-5)
    assert (records.collisions == 7).all() and records.ended("max_collisions").all()
    # What is not reflected leaves by the face, and nothing is lost.
    leaves = records.energy_balance["exit_z_high"] / emitted(records)
    r_high, r_low = reflectance(cosine, 2.0), reflectance(cosine, 1.0)
    assert leaves == pytest.approx((1 - r_high) * sum((r_high * r_low) ** k for k in range(4)), rel=1e-4)
    assert sum(records.energy_balance.values()) == emitted(records)


def test_beyond_the_critical_angle_all_light_is_reflected(device):
    """A beam at 50° in water under air; the critical angle is 48.3°."""
    slab = {"shape": "slab", "lower": -1.0, "upper": 1.0, "outside_index": {"z_low": 1.0, "z_high": 1.0}}
    records = trace(beam([np.tan(np.radians(50)), 0.0, 1.0], slab, max_collisions=30), photons=64, device=device)
    assert (records.weight == 1.0).all() and (records.collisions == 30).all()
    assert records.energy_balance["max_collisions"] == emitted(records)
    below = trace(beam([np.tan(np.radians(47)), 0.0, 1.0], slab, max_collisions=1), photons=64, device=device)
    np.testing.assert_allclose(below.weight, reflectance(np.cos(np.radians(47)), 1.0), rtol=1e-3)


@pytest.mark.parametrize("rotation", [None, [20.0, -35.0, 50.0]], ids=["upright", "rotated"])
def test_light_in_a_white_box_stays_and_fills_it(rotation, device):
    """Mirrors all around water without absorption: no weight is lost, and after many events positions are uniform and
    directions isotropic."""
    mirrors = dict.fromkeys(("x_low", "x_high", "y_low", "y_high", "z_low", "z_high"), 1e9)
    box = {"shape": "box", "lower": [-0.7, -0.5, -0.4], "upper": [0.5, 0.9, 1.6], "outside_index": mirrors}
    pose = {} if rotation is None else {"position": [0.1, 0.2, 0.3], "rotation_deg": rotation}
    one = beam([0.2, 0.1, 1.0], box, medium={"extinction": 1.0}, max_collisions=120)
    one = one.with_overrides(camera=pose)
    records = trace(one, photons=20_000, device=device)
    assert records.energy_balance["max_collisions"] == pytest.approx(emitted(records), rel=1e-5)
    assert sum(records.energy_balance.values()) == emitted(records)
    low, high = np.array(box["lower"]), np.array(box["upper"])
    # The last event is a reflection for a part of the photons, which are then on a face; the others scatter where light
    # is, in all directions alike.
    inside = (records.position > low + 1e-4).all(axis=1) & (records.position < high - 1e-4).all(axis=1)
    assert ((records.position > low - 1e-5) & (records.position < high + 1e-5)).all()
    share = (records.position[inside] - low) / (high - low)
    error = np.sqrt(1 / 12 / inside.sum())
    np.testing.assert_allclose(share.mean(axis=0), 0.5, atol=4.5 * error)
    np.testing.assert_allclose((share**2).mean(axis=0), 1 / 3, atol=4.5 * np.sqrt(4 / 45 / inside.sum()))
    heading = records.direction[inside]
    np.testing.assert_allclose(heading.mean(axis=0), 0.0, atol=4.5 * np.sqrt(1 / 3 / inside.sum()))
    np.testing.assert_allclose((heading**2).mean(axis=0), 1 / 3, atol=4.5 * np.sqrt(4 / 45 / inside.sum()))


BOX = {"shape": "box", "lower": -1.0, "upper": 3.0}


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"domain": {"outside_index": {"z_low": 1.0}}}, "outside_index.z_low: the domain has no such face"),
        ({"domain": {"shape": "slab", "lower": -1.0, "outside_index": {"z_high": 1.0}}}, "outside_index.z_high"),
        ({"domain": {**BOX, "outside_index": {"z_high": 0.5}}}, "z_high = 0.5 is outside"),
        ({"domain": {**BOX, "outside_index": {"top": 1.0}}}, "top"),
        ({"domain": {**BOX, "max_reflections": 9}}, "max_reflections = 9 is outside"),
        (
            {"domain": {**BOX, "outside_index": {"z_high": 1.0}}, "transport": {"lateral_limit": 1.0}},
            "transport.lateral_limit = 1.0 does not go with domain.outside_index",
        ),
    ],
)
def test_faces_that_cannot_reflect_are_refused_by_name(sections, message):
    with pytest.raises(ConfigError, match=message.replace(".", r"\.")):
        scene(**sections)


@pytest.mark.parametrize(
    ("sections", "message"),
    [
        ({"camera": {"position": [0.0, -0.9, 0.0]}}, "camera.aperture_diameter: reaches 0.1 m through y_low"),
        (
            {"laser": {"profile": "collimated", "beam_radius": 0.3, "position": [0.0, -0.9, 0.0]}},
            "laser.beam_radius: reaches 0.2 m through y_low",
        ),
    ],
)
def test_a_lens_or_a_beam_through_a_face_is_refused(sections, message):
    one = scene(domain={**BOX, "outside_index": {"y_low": 1.0}}, **sections)
    with pytest.raises(ConfigError, match=message):
        simulate(one, photons=10, device="cpu")


def test_faces_that_reflect_survive_a_scene_file():
    one = scene(domain={**BOX, "outside_index": {"y_low": 1.0, "x_high": 1.52}, "max_reflections": 3})
    again = type(one).from_toml(one.to_toml())
    assert again == one and hash(again) == hash(one)
    assert again.domain.reflecting == {"x_high": 1.52, "y_low": 1.0}
    changed = one.with_overrides(["domain.outside_index.y_low=1.1", "domain.outside_index.z_high=1.0"])
    assert changed.domain.reflecting == {"x_high": 1.52, "y_low": 1.1, "z_high": 1.0}
    assert one.with_overrides({"domain.outside_index": None}).domain.reflecting == {}
