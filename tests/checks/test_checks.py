"""The check's numbers against geometry done by hand."""

import math
import re
from pathlib import Path

import numpy as np
import pytest
import trimesh

from spadwarp.checks import CheckMessage, check, implausible, summary
from spadwarp.mesh import TriangleMesh
from spadwarp.scene import Scene, load_scene
from spadwarp.values import SPEED_OF_LIGHT, ConfigError

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


def checked(mesh=None, **overrides):
    """Messages about the scene with other values, dots of whose names are written "__"."""
    one = BASE.with_overrides({name.replace("__", "."): value for name, value in overrides.items()})
    return check(one, plate(5.0) if mesh is None else mesh)


def warnings(messages: list[CheckMessage]) -> list[str]:
    return [str(one) for one in messages if one.level == "warning"]


PENCIL = {"laser__profile": "collimated", "laser__beam_radius": 0.0}
NARROW = {"laser__half_angle_deg": 2.0}


def test_a_beam_that_a_dome_bends_beside_the_view_is_named():
    """n r sin θ stays the same through a sphere (Bouguer); not one that stays in view, nor one that fills the view."""
    dome = {"shape": "dome", "radius": 0.08, "thickness": 0.006, "index": 1.5}
    behind = {"camera__port": dome, "laser__port": "camera", "medium__phase_index": 1.34, **NARROW}
    message = find(checked(plate(5.0, side=8.0), **behind, laser__position=[-0.05, 0, 0]), "laser.port")
    inside, glass, outside, water = (math.asin(0.05 / x) for x in (0.08, 1.5 * 0.08, 1.5 * 0.086, 1.34 * 0.086))
    bend = math.degrees(inside - glass + outside - water)
    assert message.values["bend_deg"] == pytest.approx(bend, rel=1e-3)
    assert message.values["beside_deg"] == pytest.approx(bend - 10.0, abs=0.7)  # starts 5 cm beside, 0.6°
    assert not warnings(checked(plate(5.0, side=8.0), **behind, **PENCIL, laser__position=[-0.02, 0, 0]))
    wide = behind | {"laser__half_angle_deg": 30.0}
    assert not warnings(checked(plate(5.0, side=8.0), **wide, laser__position=[-0.05, 0, 0]))


@pytest.mark.parametrize(
    ("overrides", "mesh"),
    [
        ({}, plate(5.0)),
        ({}, plate(5.0, side=100.0, x=10.0, y=-20.0)),  # without a corner in the view
        ({"laser__half_angle_deg": 180.0, "transport__photons": 1e8}, plate(5.0)),
        (NARROW, plate(5.0, side=1.4)),  # that the beam misses most of is a note
        (PENCIL, plate(5.0)),
        (PENCIL | {"laser__direction": [0.7, 0, 5.0]}, plate(5.0, side=0.2, x=0.7)),
    ],
)
def test_a_target_in_view_beam_and_gate_is_no_matter_for_warnings(overrides, mesh):
    assert warnings(checked(mesh, **overrides)) == []


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


@pytest.mark.parametrize(
    ("mesh", "words", "values"),
    [
        (plate(5.0, x=3.0), "outside the view", {"half_width": 5 * math.tan(math.radians(10))}),
        (plate(5.0, y=-2.0), "outside the view", {}),
        (plate(5.0, side=4.0, x=3.0), "outside the view", {}),
        (plate(-5.0), "behind the camera: spans x", {"depth": -5.0}),
        (None, "reaches the lens", {}),  # a plane at the origin
    ],
)
def test_a_target_that_the_camera_does_not_see(mesh, words, values):
    message = find(check(BASE, mesh), "targets[0]")
    assert words in message.text and {name: message.values[name] for name in values} == pytest.approx(values)
    numbers = summary(BASE, mesh)
    assert numbers["signal_per_pulse"] is None and (mesh is None or numbers["target_range"] is None)


@pytest.mark.parametrize("profile", ["uniform_cone", "gaussian"])
def test_a_target_that_the_beam_misses(profile):
    message = find(checked(plate(5.0, side=0.2, x=0.7), **NARROW, laser__profile=profile), "targets[0]")
    # The nearest point that is seen lies 0.6 m off the axis.
    assert message.values["nearest_angle_deg"] == pytest.approx(math.degrees(math.atan(0.6 / 5)), abs=1e-3)
    assert "half angle is 2°" in message.text
    mostly = find(checked(plate(5.0, 1.4), **NARROW, laser__profile=profile), "laser.half_angle_deg", "note")
    assert "misses most" in mostly.text and mostly.values["widest_angle_deg"] == pytest.approx(11.2, abs=0.5)
    # Through the sea, 15° beside the vertical, light goes another way than straight: the view reaches 0.028°.
    notes = [(one.field, one.level) for one in check(load_scene("aircraft_1km", {"laser.profile": profile}))]
    assert ("laser.half_angle_deg", "note") not in notes


def test_a_pencil_beam_hits_what_lies_on_its_line_only():
    pencil = {name.replace("__", "."): value for name, value in PENCIL.items()}
    assert summary(BASE.with_overrides(pencil), plate(5.0))["target_range"] == pytest.approx((5.0, 5.0))
    assert "the beam misses" in find(checked(plate(5.0, side=0.2, x=0.7), **PENCIL), "targets[0]").text


def test_a_target_outside_the_gate():
    message = find(checked(plate(2.0)), "targets[0]")
    assert message.text.startswith("outside the gate")
    assert message.values["first_ns"] == pytest.approx(4.0 * 1.3638 / SPEED_OF_LIGHT * 1e9, rel=1e-4)
    assert (message.values["start_ns"], message.values["stop_ns"]) == pytest.approx((40.0, 50.0))
    assert find(checked(gate__start_ns=45.6), "targets[0]").text.startswith("partly outside the gate")
    start, bins = re.search(r"start_ns = (\d+) and bins = (\d+) hold it", message.text).groups()
    assert warnings(checked(plate(2.0), gate__start_ns=float(start), gate__bins=int(bins))) == []


def test_beyond_the_unambiguous_range():
    fast = {"laser__repetition_rate": 40e6}
    message = find(checked(**fast), "laser.repetition_rate")
    assert message.values["unambiguous_range"] == pytest.approx(SPEED_OF_LIGHT / (2 * 1.3638 * 40e6))
    numbers = summary(BASE.with_overrides({"laser.repetition_rate": 40e6}), plate(5.0))
    assert numbers["unambiguous_range"] == message.values["unambiguous_range"]
    assert "ignored" in find(checked(**fast, detector__wrap=False), "laser.repetition_rate", "note").text


COARSE = {"gate.bin_width_ps": 300.0, "laser.pulse_fwhm_ps": 30.0, "detector.jitter_fwhm_ps": 40.0}
LARGE = {"camera": {"width": 1024, "height": 768}, "gate.bins": 1000}
FINDINGS = {
    "gate.bin_width_ps": (COARSE, "coarser than", {"irf_fwhm_ps": 50.0}),
    "medium.group_index": ({"medium.group_index": 1.33}, "a phase index", {"error": 5.0 * (1.3638 / 1.33 - 1.0)}),
    "medium.absorption": ({"medium": {"absorption": 0.01, "scattering": 0.1}}, "below", {"pure_water": 0.0447}),
    "gate.bins": (LARGE, "GiB", {"bytes": 3 * 8 * 1024 * 768 * 1000}),
    "transport.lateral_limit": ({"transport.lateral_limit": 0.3}, "cuts", {"side": 0.5}),
    "transport.max_path": ({"transport.max_path": 9.0}, "max_path = 9 m", {}),
    "targets[0].specular": ({"targets[0].specular": 0.3}, "acts in `simulate` alone", {"specular": 0.3}),
    "targets[0]": ({"domain.shape": "slab", "domain.lower": -1, "domain.upper": 4}, "nothing outside is hit", {}),
    "transport.estimator": ({"transport.estimator": "analog", "transport.photons": 100}, "of 100 photons", {}),
    "transport.photons": ({"transport.photons": 100}, "of 100 photons", {}),
    "laser.pulse_energy": ({"laser.pulse_energy": 1e-3}, "20 kW on average", {}),
    "targets[0].translation": ({"targets[0].translation": [0, 0, 5e3]}, "in mm it would be [0.0, 0.0, 5.0] m", {}),
}


@pytest.mark.parametrize("field", FINDINGS)
def test_findings_have_their_numbers(field):
    overrides, words, values = FINDINGS[field]
    one = next(one for one in check(BASE.with_overrides(overrides), plate(5.0)) if one.field == field)
    assert words in one.text and {name: one.values[name] for name in values} == pytest.approx(values, rel=0.01)
    assert not any(words in other.text for other in check(BASE, plate(5.0)) if other.field == field)


def test_each_line_is_checked_in_its_own_water():
    lines = {"laser__wavelengths_nm": [480.0, 532.0, 600.0], "medium__group_index": 1.34}
    assert find(checked(**lines), "laser.wavelengths_nm").text.startswith("all lines have the same water")
    coastal = {"preset": "uwoc-coastal", "group_index": 1.36}
    several = {"medium": coastal, "laser": {"wavelengths_nm": [480.0, 532.0, 600.0]}}
    messages = check(Scene.from_dict({**BASE.to_dict(), **several}), plate(5.0))
    assert find(messages, "medium.preset").text.startswith("at 480, 600 nm: ")


def test_what_is_not_there_is_noted():
    assert "not given" in find(checked(medium__group_index=None), "medium.group_index", "note").text
    empty = BASE.with_overrides({"targets": []})
    assert find(check(empty), "targets", "note") and summary(empty)["optical_depth"] is None


def test_what_ends_a_history_first():
    # 0.8^n < 2e-4 at n = 39.
    murky = {"medium__extinction": 5.0}
    message = find(checked(**murky), "transport.weight_cutoff", "note")
    assert message.values["cutoff_collisions"] == 39 and 0.8**39 < 2e-4 < 0.8**38
    assert message.values["path_collisions"] == pytest.approx(5.0 * 50e-9 * SPEED_OF_LIGHT / 1.3638)
    few = find(checked(**murky, transport__max_collisions=20), "transport.max_collisions")
    assert "max_collisions = 20" in few.text
    for free in ({"termination": "roulette"}, {"weight_cutoff": 0.0}):
        fields = {one.field for one in checked(**murky, transport={**free, "max_collisions": 1000})}
        assert not fields & {"transport.weight_cutoff", "transport.max_collisions"}


def test_a_camera_and_a_laser_outside_the_water_are_both_named():
    dry = checked(domain={"shape": "slab", "lower": 1, "upper": 9})
    assert len([one for one in dry if one.field == "domain" and one.level == "warning"]) == 2


def test_expected_signal_of_a_plate_that_fills_a_pixel():
    """Lidar equation: E0 λ/(hc) PDE · pixel solid angle / cone solid angle · exp(−2cR) · Γ A / (π R²)."""
    numbers = summary(BASE.with_overrides(transport={"photons": 1_000_000}), plate(5.0))
    pixel = (2 * math.tan(math.radians(10)) / 32) ** 2
    cone = 2 * math.pi * (1 - math.cos(math.radians(15)))
    signal = pixel / cone * math.exp(-3.0) * 0.4 * 0.01**2 / 25.0 * numbers["photons_per_pulse"] * numbers["pde"]
    assert numbers["signal_per_pulse"] == pytest.approx(signal, rel=1e-3)
    assert numbers["samples_per_pixel"] == pytest.approx(1e6 * pixel / cone * math.exp(-1.5), rel=1e-3)
    assert numbers["average_power"] == 0.75
    assert numbers["irradiance"] == pytest.approx(0.75 / (cone * 5.0**2) * math.exp(-1.5), rel=1e-3)
    assert numbers["photons_per_pixel"] == pytest.approx(numbers["signal_per_pulse"] / numbers["pde"])


def test_warnings_come_first():
    levels = [one.level for one in checked(gate__start_ns=90.0)]
    assert levels == sorted(levels, reverse=True)


def test_many_small_faces_agree_with_two_large_ones():
    plane = {"builtin": "plane", "size": [30, 30], "translation": [0, 0, 5]}
    fine, coarse = (BASE.with_overrides(targets=[{**plane, "subdivisions": n}]) for n in (7, 0))
    assert summary(fine)["target_range"] == pytest.approx(summary(coarse)["target_range"], rel=1e-3)


@pytest.mark.parametrize("path", SCENES, ids=lambda path: path.stem)
def test_every_shipped_scene_is_free_of_warnings(path):
    assert warnings(check(load_scene(path))) == []


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
        ("camera.port.distance", 50.0, '"50 mm" (0.05 m)'),
        ("camera.port.thickness", 10.0, '"10 mm" (0.01 m)'),
    ],
)
def test_a_value_in_the_wrong_unit_is_told_with_the_likely_one(field, value, words):
    port = {"camera__port": {"distance": 0.05, "thickness": 0.01, "material": "BK7"}} if "port" in field else {}

    def about(value):
        return [one for one in checked(**port, **{field.replace(".", "__"): value}) if one.field == field]

    message = find(about(value), field)
    assert words in message.text and message.values["value"] == value
    # What it suggests is plausible.
    assert not any("plausible" in one.text for one in about(words.split('"')[1]))


@pytest.mark.parametrize(
    ("overrides", "field", "words"),
    [
        ({"medium.group_index": 1.0}, "medium.group_index", "group_index = 1 is below phase_index = 1.3415"),
        ({"medium.salinity": 0.035}, "medium.salinity", "0.035 g/kg is not plausible"),
        ({"detector.dead_time_ns": 50.0}, "detector.dead_time_ns", "goes with detector.mode = 'free_running'"),
    ],
)
def test_without_a_ray_a_scene_shows_what_is_implausible(overrides, field, words):
    assert implausible(BASE) == []
    assert words in find(implausible(BASE.with_overrides(overrides)), field).text


def test_a_spectrum_lies_about_the_laser_s_wavelength(tmp_path):
    (tmp_path / "spectrum.csv").write_text("wavelength [nm],power\n480,1\n482,1\n")
    messages = checked(laser__spectrum=str(tmp_path / "spectrum.csv"))
    assert "the spectrum lies about 481 nm" in find(messages, "laser.wavelength_nm").text


def test_a_mesh_in_millimetres_is_told_with_its_scale(tmp_path):
    trimesh.creation.box((400, 300, 2000)).export(tmp_path / "box.stl")
    scene = BASE.with_overrides(targets=[{"mesh": str(tmp_path / "box.stl"), "translation": [0, 0, 5000.0]}])
    text = find(check(scene), "targets[0].scale").text
    assert "unit is mm, scale = 0.001 makes it 0.4 x 0.3 x 2 m" in text


def test_polarised_light_that_is_not_recorded_and_fields_that_are_not_used_are_noted(tmp_path: Path) -> None:
    light = {"laser__polarisation": "right_circular", "laser__polarisation_angle_deg": 30}
    light["transport__axis_threshold"] = 1.0
    messages = checked(**light, medium__scattering_matrix="voss_fry")
    assert "no channel records" in find(messages, "camera.polarisation", "note").text
    assert "'linear'" in find(messages, "laser.polarisation_angle_deg", "note").text
    table = tmp_path / "matrix.csv"
    table.write_text("angle_deg,m12,m22,m33,m34,m44\n0,0,1,1,0,1\n170,0,1,-1,0,-1\n")
    with pytest.raises(ConfigError, match=r"matrix\.csv: angle_deg goes from 0 to 170"):
        checked(**light, medium__scattering_matrix="tabulated", medium__matrix_table=str(table))
