"""Numbers with a unit, and what a laser's energy is given by."""

import math
import re

import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene as make_scene
from spadwarp.scene import Camera, Gate, Laser, Medium, Scene
from spadwarp.scene.sections import field_unit, table_of
from spadwarp.values import percent, quantity, with_prefix

QUANTITIES = {
    "J": {"150 nJ": 150e-9, "37.5nJ": 37.5e-9},
    "ps": {"50 ps": 50.0, "0.085 ns": 85.0},
    "µm": {"1e-3 m": 1000.0, "5 um": 5.0, "5 µm": 5.0, "5 μm": 5.0},  # the micro sign, and the Greek letter
    "Hz": {"20 MHz": 20e6},
    "1/s": {"2 kcps": 2000.0},
    "°": {"180 deg": 180.0, f"{math.pi} rad": 180.0},
    "1/m": {".3 /m": 0.3, "0.003 1/cm": 0.3},
    "1": {"20 %": 0.2},
    "m": {"-5 cm": -0.05},
    "s": {"2 min": 120.0},
}


@pytest.mark.parametrize("unit", QUANTITIES)
def test_texts_become_numbers_correctly_rounded(unit):
    assert {text: quantity(text, unit) for text in QUANTITIES[unit]} == QUANTITIES[unit]


@pytest.mark.parametrize(
    ("text", "unit", "words"),
    [
        ("150 ns", "J", "is a time; an energy is needed, such as '150 nJ'"),
        ("5 mj", "J", "did you mean '5 mJ' or '5 MJ'?"),
        ("20 mHz", "Hz", "did you mean '20 MHz'?"),
        ("5", "ns", "has no unit; write 5 without quotes for ns"),
        ("1e400", "ns", "is beyond the largest number"),
        ("1,5 nJ", "J", "',5 nJ', which is not known"),
        ("nJ", "J", "is not an energy"),
        ("5 furlongs", "m", "'furlongs', which is not known"),
        ("532 ps", "nm", "a length is needed, such as '50 nm'"),
    ],
)
def test_what_is_not_a_quantity_is_said(text, unit, words):
    with pytest.raises(ValueError, match=re.escape(words)):
        quantity(text, unit)


def test_numbers_with_a_prefix_and_percents_of_two_digits():
    numbers = {"150 nJ": (1.5e-7, "J"), "1 µJ": (0.9999e-6, "J"), "11.2 MHz": (11.2487e6, "Hz"), "0 m": (0.0, "m")}
    for text, number in (numbers | {"inf m": (math.inf, "m"), "10 mm": (0.01, "m")}).items():
        assert with_prefix(*number) == text
    assert [percent(share) for share in (0.0, 0.0123, 0.996, 260.4)] == ["0", "1.2", "100", "26000"]


def test_fields_convert_to_their_own_unit():
    assert Gate(bin_width_ps="0.05 ns", start_ns="2 µs", bins=3) == Gate(bin_width_ps=50.0, start_ns=2000.0, bins=3)
    camera = {"width": 4, "height": 4, "horizontal_fov_deg": "0.5 rad", "aperture_diameter": "2 cm"}
    assert Camera(**camera).horizontal_fov_deg == pytest.approx(math.degrees(0.5))
    assert Laser(position=["-10 cm", 0, "5 mm"]).position == (-0.1, 0.0, 0.005)
    assert Medium(extinction="0.4 1/m", albedo="80 %").scattering == pytest.approx(0.32)
    assert Medium(extinction=0.4, albedo="lu2024").albedo == "lu2024"  # words stay words


def test_files_and_overrides_take_units(tmp_path):
    path = tmp_path / "scene.toml"
    text = make_scene().to_toml().replace("half_angle_deg = 20.0", 'half_angle_deg = "20 deg"')
    assert '"20 deg"' in text
    path.write_text(text)
    assert spadwarp.load_scene(path) == make_scene()
    changed = spadwarp.load_scene(path, ["medium.extinction=0.5 1/m", "targets[0].translation=[0, '20 cm', 4]"])
    assert changed.medium.extinction == 0.5 and changed.targets[0].translation == (0.0, 0.2, 4.0)
    assert changed.medium.albedo == make_scene().medium.albedo  # the override keeps it, as with a number


def test_every_field_with_a_suffix_has_that_unit():
    """The docstring's unit is the one that converts; a wrong one would be a wrong number."""
    suffixes = {"ps": "ps", "ns": "ns", "um": "µm", "nm": "nm", "deg": "°"}
    found = 0
    for section in Scene.model_fields:
        for name, info in table_of(Scene, section).model_fields.items():
            suffix = name.rsplit("_", 1)[-1]
            if suffix in suffixes:
                assert field_unit(info) == suffixes[suffix], name
                found += 1
    assert found > 12


# The laser's energy


def test_energy_follows_from_either_power():
    average = Laser(average_power="20 mW", repetition_rate="100 kHz")
    assert average.pulse_energy == pytest.approx(200e-9) and average.given == ("average_power",)
    peak = Laser(peak_power="1 kW", pulse_fwhm_ps=500.0)
    assert peak.pulse_energy == pytest.approx(1.064467 * 1e3 * 500e-12)
    assert peak.average_power == pytest.approx(peak.pulse_energy * 20e6)
    assert Laser().peak_power == pytest.approx(37.5e-9 / (1.064467 * 85e-12))
    for laser in (average, peak, Laser(), Laser(preset="picoquant-visuv-532", average_power=0.01)):
        assert Laser(**laser.to_dict()) == laser


def test_average_power_stays_where_the_rate_changes():
    scene = make_scene(laser={"average_power": "1 W", "repetition_rate": 1e6})
    faster = scene.with_overrides(laser={"repetition_rate": 2e6})
    assert faster.laser.average_power == 1.0 and faster.laser.pulse_energy == 0.5e-6
    replaced = faster.with_overrides(laser={"pulse_energy": "1 nJ"})
    assert replaced.laser.given == ("pulse_energy",) and replaced.laser.average_power == pytest.approx(2e-3)
    assert Scene.from_dict(replaced.to_dict()) == replaced


def test_values_of_numpy_stand_for_those_of_python():
    values = {"camera.width": np.int64(16), "laser.position": np.array([0, 0, 1]), "gate.bin_width_ps": np.float32(50)}
    changed = make_scene().with_overrides(values)
    assert (changed.camera.width, changed.laser.position, changed.gate.bin_width_ps) == (16, (0.0, 0.0, 1.0), 50.0)
