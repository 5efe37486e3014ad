"""The check's numbers against geometry done by hand."""

import math
import re
from pathlib import Path

import numpy as np
import pytest

from spadwarp.checks import CheckMessage, check, summary
from spadwarp.errors import ConfigError
from spadwarp.mesh import TriangleMesh
from spadwarp.scene import Scene, load_scene
from spadwarp.units import SPEED_OF_LIGHT

SCENES = sorted((Path(__file__).parents[2] / "configs" / "scenes").glob("*.toml"))

BASE = Scene.from_dict(
    {
        "medium": {"extinction": 0.3, "albedo": 0.8, "group_index": "seawater"},
        "laser": {"half_angle_deg": 15.0},
        "camera": {"width": 32, "height": 24, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.02},
        "gate": {"start_ns": 40.0, "bin_width_ps": 100.0, "bins": 100},
        "targets": [{"builtin": "plane", "reflectance": 0.4}],
    }
)


def plate(z: float, side: float = 1.0, x: float = 0.0, y: float = 0.0, target: int = 0) -> TriangleMesh:
    """A square facing the camera: two triangles."""
    h = side / 2
    vertices = np.array([(x - h, y - h, z), (x + h, y - h, z), (x + h, y + h, z), (x - h, y + h, z)], dtype=np.float32)
    faces = np.array([(0, 2, 1), (0, 3, 2)], dtype=np.int32)
    return TriangleMesh(vertices, faces, np.full(2, 0.4, np.float32), np.full(2, target, np.int32))


def find(messages: list[CheckMessage], field: str, level: str = "warning") -> CheckMessage:
    (message,) = [one for one in messages if one.field == field and one.level == level]
    return message


def warnings(messages: list[CheckMessage]) -> list[str]:
    return [str(one) for one in messages if one.level == "warning"]


def test_a_target_in_view_beam_and_gate_is_no_matter_for_warnings():
    assert warnings(check(BASE, plate(5.0))) == []


@pytest.mark.parametrize("z", [5.0, 4.9])
@pytest.mark.parametrize("side", [0.01, 1.0, 30.0, 3000.0])
def test_arrival_times_are_those_of_the_nearest_and_farthest_point_in_view(z, side):
    numbers = summary(BASE, plate(z, side))
    half = min(side / 2, z * math.tan(math.radians(10)))
    corner = math.sqrt(z**2 + half**2 + min(side / 2, 0.75 * z * math.tan(math.radians(10))) ** 2)
    near, far = numbers["target_range"]
    assert near == pytest.approx(z, rel=1e-3)  # the plate is sampled, not minimised over
    assert far == pytest.approx(corner, rel=1e-6)
    nanoseconds = 2e9 * 1.3638 / SPEED_OF_LIGHT
    assert numbers["target_arrival_ns"] == pytest.approx((near * nanoseconds, far * nanoseconds))
    assert numbers["optical_depth"] == pytest.approx(0.3 * near)


@pytest.mark.parametrize("mesh", [plate(5.0, x=3.0), plate(5.0, y=-2.0), plate(5.0, side=4.0, x=3.0)])
def test_a_target_outside_the_view(mesh):
    message = find(check(BASE, mesh), "targets[0]")
    assert "outside the view" in message.text
    assert message.values["half_width"] == pytest.approx(5 * math.tan(math.radians(10)))
    assert summary(BASE, mesh)["target_range"] is None


def test_a_target_behind_the_camera():
    assert find(check(BASE, plate(-5.0)), "targets[0]").text.startswith("behind the camera: spans x")
    assert summary(BASE, plate(-5.0))["target_range"] is None


def test_a_target_that_fills_the_view_without_a_corner_in_it_is_seen():
    assert warnings(check(BASE, plate(5.0, side=100.0, x=10.0, y=-20.0))) == []


@pytest.mark.parametrize("profile", ["uniform_cone", "gaussian"])
def test_a_target_that_the_beam_misses(profile):
    narrow = BASE.with_overrides(laser={"half_angle_deg": 2.0, "profile": profile})
    message = find(check(narrow, plate(5.0, side=0.2, x=0.7)), "targets[0]")
    # The nearest point that is seen lies 0.6 m off the axis.
    assert message.values["nearest_angle_deg"] == pytest.approx(math.degrees(math.atan(0.6 / 5)), abs=1e-3)
    assert "half angle is 2°" in message.text
    mostly = find(check(narrow, plate(5.0, side=1.4)), "laser.half_angle_deg", "note")
    assert "misses most" in mostly.text and mostly.values["widest_angle_deg"] == pytest.approx(11.2, abs=0.5)
    assert warnings(check(narrow, plate(5.0, side=1.4))) == []


def test_a_pencil_beam_hits_what_lies_on_its_line_only():
    pencil = BASE.with_overrides(laser={"profile": "collimated", "beam_radius": 0.0})
    assert warnings(check(pencil, plate(5.0))) == []
    assert summary(pencil, plate(5.0))["target_range"] == pytest.approx((5.0, 5.0))
    assert "the beam misses" in find(check(pencil, plate(5.0, side=0.2, x=0.7)), "targets[0]").text
    aimed = pencil.with_overrides({"laser.direction": [0.7, 0, 5.0]})
    assert warnings(check(aimed, plate(5.0, side=0.2, x=0.7))) == []


def test_a_target_that_nobody_moved_away_from_the_lens():
    assert "reaches the lens" in find(check(BASE), "targets[0]").text  # a plane at the origin
    assert summary(BASE)["signal_per_pulse"] is None


def test_a_lamp_that_shines_everywhere_lights_every_target():
    assert (
        warnings(check(BASE.with_overrides({"laser.half_angle_deg": 180.0, "transport.photons": 1e8}), plate(5.0)))
        == []
    )


def test_a_target_outside_the_gate():
    message = find(check(BASE, plate(2.0)), "targets[0]")
    assert message.text.startswith("outside the gate")
    assert message.values["first_ns"] == pytest.approx(4.0 * 1.3638 / SPEED_OF_LIGHT * 1e9, rel=1e-4)
    assert (message.values["start_ns"], message.values["stop_ns"]) == pytest.approx((40.0, 50.0))
    part = find(check(BASE.with_overrides({"gate.start_ns": 45.6}), plate(5.0)), "targets[0]")
    assert part.text.startswith("partly outside the gate")
    start, bins = re.search(r"start_ns = (\d+) and bins = (\d+) hold it", message.text).groups()
    assert (
        warnings(check(BASE.with_overrides({"gate.start_ns": float(start), "gate.bins": int(bins)}), plate(2.0))) == []
    )


def test_beyond_the_unambiguous_range():
    fast = BASE.with_overrides({"laser.repetition_rate": 40e6})
    message = find(check(fast, plate(5.0)), "laser.repetition_rate")
    assert message.values["unambiguous_range"] == pytest.approx(SPEED_OF_LIGHT / (2 * 1.3638 * 40e6))
    assert summary(fast, plate(5.0))["unambiguous_range"] == message.values["unambiguous_range"]
    unfolded = check(fast.with_overrides({"detector.wrap": False}), plate(5.0))
    assert "ignored" in find(unfolded, "laser.repetition_rate", "note").text


def test_bins_coarser_than_the_instrument_response():
    coarse = BASE.with_overrides(
        gate={"bin_width_ps": 300.0}, laser={"pulse_fwhm_ps": 30.0}, detector={"jitter_fwhm_ps": 40.0}
    )
    assert find(check(coarse, plate(5.0)), "gate.bin_width_ps", "note").values["irf_fwhm_ps"] == pytest.approx(50.0)


def test_a_phase_index_in_place_of_the_group_index():
    far = BASE.with_overrides({"medium.group_index": 1.33, "gate.start_ns": 130.0, "laser.repetition_rate": 1e6})
    message = find(check(far, plate(15.0)), "medium.group_index")
    assert message.values["error"] == pytest.approx(0.38, abs=0.005)
    silent = Scene.from_dict({**BASE.to_dict(), "medium": {"extinction": 0.3, "albedo": 0.8}})
    assert "not given" in find(check(silent, plate(5.0)), "medium.group_index", "note").text


def test_less_absorption_than_pure_water():
    clear = BASE.with_overrides({"medium": {"absorption": 0.01, "scattering": 0.1}})
    assert find(check(clear, plate(5.0)), "medium.absorption", "note").values["pure_water"] == pytest.approx(
        0.0447, abs=1e-3
    )
    assert not [one for one in check(BASE, plate(5.0)) if one.field == "medium.absorption"]


def test_large_memory():
    large = BASE.with_overrides({"camera": {"width": 1024, "height": 768}, "gate.bins": 1000})
    assert find(check(large, plate(5.0)), "gate.bins").values["bytes"] == 3 * 8 * 1024 * 768 * 1000


def test_what_ends_a_history_first():
    # 0.8^n < 2e-4 at n = 39.
    murky = BASE.with_overrides({"medium.extinction": 5.0})
    message = find(check(murky, plate(5.0)), "transport.weight_cutoff", "note")
    assert message.values["cutoff_collisions"] == 39
    assert 0.8**39 < 2e-4 < 0.8**38
    assert message.values["path_collisions"] == pytest.approx(5.0 * 50e-9 * SPEED_OF_LIGHT / 1.3638)
    few = murky.with_overrides({"transport.max_collisions": 20})
    assert "max_collisions = 20" in find(check(few, plate(5.0)), "transport.max_collisions").text
    for free in ({"termination": "roulette"}, {"weight_cutoff": 0.0}):
        capped = check(murky.with_overrides(transport={**free, "max_collisions": 1000}), plate(5.0))
        assert not [
            one for one in capped if one.field.startswith("transport.w") or one.field == "transport.max_collisions"
        ]


def test_limits_that_cut_the_target():
    short = BASE.with_overrides({"transport.max_path": 9.0})
    assert "max_path = 9 m" in find(check(short, plate(5.0)), "transport.max_path").text
    thin = BASE.with_overrides({"transport.lateral_limit": 0.3})
    assert find(check(thin, plate(5.0)), "transport.lateral_limit").values["side"] == pytest.approx(0.5)
    slab = BASE.with_overrides(domain={"shape": "slab", "lower": -1, "upper": 4})
    assert "nothing outside is hit" in find(check(slab, plate(5.0)), "targets[0]").text
    dry = BASE.with_overrides(domain={"shape": "slab", "lower": 1, "upper": 9})
    assert len([one for one in check(dry, plate(5.0)) if one.field == "domain" and one.level == "warning"]) == 2


def test_expected_signal_of_a_plate_that_fills_a_pixel():
    # Lidar equation: E0 λ/(hc) PDE · pixel solid angle / cone solid angle · exp(−2cR) · Γ A / (π R²).
    numbers = summary(BASE, plate(5.0))
    pixel = (2 * math.tan(math.radians(10)) / 32) ** 2
    cone = 2 * math.pi * (1 - math.cos(math.radians(15)))
    fraction = pixel / cone * math.exp(-3.0) * 0.4 * math.pi * 0.01**2 / (math.pi * 25.0)
    assert numbers["signal_per_pulse"] == pytest.approx(
        fraction * numbers["photons_per_pulse"] * numbers["pde"], rel=1e-3
    )
    assert numbers["samples_per_pixel"] == pytest.approx(1e6 * pixel / cone * math.exp(-1.5), rel=1e-3)


@pytest.mark.parametrize("estimator", ["analog", "next_event"])
def test_too_few_photons(estimator):
    few = BASE.with_overrides(transport={"estimator": estimator, "photons": 100})
    field = "transport.estimator" if estimator == "analog" else "transport.photons"
    assert "of 100 photons" in find(check(few, plate(5.0)), field).text


def test_a_scene_without_targets():
    empty = BASE.with_overrides({"targets": []})
    assert find(check(empty), "targets", "note")
    assert summary(empty)["optical_depth"] is None


def test_warnings_come_first():
    levels = [one.level for one in check(BASE.with_overrides({"gate.start_ns": 90.0}), plate(5.0))]
    assert levels == sorted(levels, reverse=True)


def test_many_small_faces_agree_with_two_large_ones():
    fine = BASE.with_overrides(
        targets=[{"builtin": "plane", "size": [30, 30], "subdivisions": 7, "translation": [0, 0, 5]}]
    )
    coarse = fine.with_overrides({"targets[0].subdivisions": 0})
    assert summary(fine)["target_range"] == pytest.approx(summary(coarse)["target_range"], rel=1e-3)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_every_shipped_scene_is_free_of_warnings(path):
    assert warnings(check(load_scene(path))) == []


def test_a_specular_lobe_is_said_to_be_left_out_of_budgets():
    shiny = BASE.with_overrides({"targets[0].specular": 0.3})
    assert find(check(shiny, plate(5.0)), "targets[0].specular", "note").values == {"specular": 0.3}


# Plausible values


@pytest.mark.parametrize(
    ("field", "value", "words"),
    [
        ("laser.pulse_energy", 15.0, 'did you mean "15 nJ" (1.5e-08 J) or "15 µJ"'),
        ("laser.repetition_rate", 2.0, '"2 MHz" (2e+06 Hz)'),
        ("laser.wavelength_nm", 532e-9, '"5.32e-07 m" (532 nm)'),
        ("detector.jitter_fwhm_ps", 50e-12, '"5e-11 s" (50 ps)'),
        ("camera.aperture_diameter", 25.0, '"25 mm" (0.025 m)'),
        ("gate.bin_width_ps", 0.05, '"0.05 ns" (50 ps)'),
        ("laser.repetition_rate", 100.0, '"100 kHz" (100000 Hz)'),
        ("laser.pulse_fwhm_ps", 0.5, '"0.5 ns" (500 ps)'),
        ("gate.bin_width_ps", 1e6, '"1e+06 fs" (1000 ps)'),
    ],
)
def test_a_value_in_the_wrong_unit_is_told_with_the_likely_one(field, value, words):
    message = find(check(BASE.with_overrides({field: value}), plate(5.0)), field)
    assert words in message.text and message.values["value"] == value
    section, name = field.split(".")
    right = words.split('"')[1]  # what it suggests is plausible
    found = check(BASE.with_overrides({section: {name: right}}), plate(5.0))
    assert not any("plausible" in one.text for one in found if one.field == field)


@pytest.mark.parametrize(
    ("field", "value", "words"), [("distance", 50.0, '"50 mm" (0.05 m)'), ("thickness", 10.0, '"10 mm" (0.01 m)')]
)
def test_ports_in_millimetres_are_told(field, value, words):
    port = {"distance": 0.05, "thickness": 0.01, "material": "BK7", field: value}
    assert words in find(check(BASE.with_overrides({"camera.port": port}), plate(5.0)), f"camera.port.{field}").text


def test_powers_and_places_that_nobody_has_are_told():
    strong = BASE.with_overrides(laser={"pulse_energy": 1e-3})
    assert "20 kW on average" in find(check(strong, plate(5.0)), "laser.pulse_energy").text
    far = BASE.with_overrides({"targets[0].translation": [0, 0, 5000.0]})
    assert "in mm it would be [0.0, 0.0, 5.0] m" in find(check(far, plate(5.0)), "targets[0].translation").text


def test_a_mesh_in_millimetres_is_told_with_its_scale(tmp_path):
    import trimesh

    trimesh.creation.box((400, 300, 2000)).export(tmp_path / "box.stl")
    scene = BASE.with_overrides(targets=[{"mesh": str(tmp_path / "box.stl"), "translation": [0, 0, 5000.0]}])
    text = find(check(scene), "targets[0].scale").text
    assert "unit is mm, scale = 0.001 makes it 0.4 x 0.3 x 2 m" in text


def test_the_light_at_the_target_and_in_a_pixel():
    numbers = summary(BASE, plate(5.0))
    cone = 2 * math.pi * (1 - math.cos(math.radians(15))) * 5.0**2
    assert numbers["irradiance"] == pytest.approx(0.75 / cone * math.exp(-1.5), rel=1e-3)
    assert numbers["average_power"] == 0.75
    assert numbers["photons_per_pixel"] == pytest.approx(numbers["signal_per_pulse"] / numbers["pde"])


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_scenes_that_come_with_the_package_are_plausible(path):
    assert not [str(one) for one in check(load_scene(path)) if "plausible" in one.text]


def test_polarised_light_that_is_not_recorded_and_fields_that_are_not_used_are_noted(tmp_path: Path) -> None:
    polarised = {"medium.scattering_matrix": "voss_fry", "transport.axis_threshold": 1.0}
    one = BASE.with_overrides({**polarised, "laser.polarisation": "right_circular", "laser.polarisation_angle_deg": 30})
    messages = check(one, plate(5.0))
    assert "no channels" in find(messages, "camera.polarisation", "note").text
    assert "'linear'" in find(messages, "laser.polarisation_angle_deg", "note").text

    table = tmp_path / "matrix.csv"
    table.write_text("angle_deg,m12,m22,m33,m34,m44\n0,0,1,1,0,1\n170,0,1,-1,0,-1\n")
    changed = {"medium.scattering_matrix": "tabulated", "medium.matrix_table": str(table)}
    with pytest.raises(ConfigError, match=r"matrix\.csv: angle_deg goes from 0 to 170"):
        check(one.with_overrides(changed), plate(5.0))
