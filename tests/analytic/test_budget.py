"""Budgets and sweeps: the numbers an experimenter asks first."""

import math

import numpy as np
import pytest

from helpers.scenes import scene
from spadwarp.analytic import budget, combinations, model_notes, parse_values, parse_vary, simulate_analytic, sweep
from spadwarp.values import ArgumentError, ConfigError, SpadwarpWarning

SCENE = scene(
    medium={"extinction": 0.3, "albedo": 0.7},
    laser={"half_angle_deg": 10.0, "position": [0.0, 0.0, 0.0]},
    camera={"width": 8, "height": 8, "horizontal_fov_deg": 10.0, "aperture_diameter": 0.01},
    gate={"start_ns": 5.0, "bin_width_ps": 50.0, "bins": 400},
)


@pytest.mark.slow
def test_a_row_is_the_analytic_model_on_the_axis():
    row = budget(SCENE, ranges=[2.2])[0]
    result = simulate_analytic(SCENE, frames=0)
    assert row.signal == pytest.approx(result.signal[3:5, 3:5].mean(), rel=2e-3)
    assert row.sigma_depth == pytest.approx(result.sigma_depth[3:5, 3:5].mean(), rel=2e-3)
    assert row.background == pytest.approx((result.backscatter + 100.0 * 2e-8)[3:5, 3:5].mean(), rel=2e-2)
    assert row.alpha == pytest.approx(row.signal + row.background, rel=1e-6)
    assert row.optical_depth == pytest.approx(0.66)
    assert (row.gate_start, row.gate_stop) == (SCENE.gate.start, SCENE.gate.stop) and not row.gate_moved
    assert row.sigma_depth / row.sigma_time == pytest.approx(0.5 * 299_792_458.0, rel=1e-9)  # index 1


@pytest.mark.slow
def test_rows_run_over_waters_and_ranges_and_the_gate_follows():
    ranges = [1.0, 4.0, 9.0]
    rows = budget(SCENE, ranges=ranges, media=["uwoc-clear", "uwoc-harbour"])
    assert [(row.medium, row.range) for row in rows] == [(w, r) for w in ("uwoc-clear", "uwoc-harbour") for r in ranges]
    clear, harbour = rows[:3], rows[3:]
    assert clear[0].extinction == pytest.approx(0.149) and harbour[0].extinction == pytest.approx(2.17)
    for row in rows:
        assert row.gate_start <= row.arrival <= row.gate_stop and row.gate_moved
        assert row.gate_stop - row.gate_start == pytest.approx(2e-8)
    for few, more in zip(harbour, clear, strict=True):
        assert few.signal < more.signal and few.sigma_depth > more.sigma_depth
        assert few.pulses_for_1cm > more.pulses_for_1cm and few.signal_to_backscatter < more.signal_to_backscatter
    assert [row.signal for row in clear] == sorted((row.signal for row in clear), reverse=True)
    (named,) = budget(SCENE, ranges=[4.0], media={"tank": {"extinction": 1.0, "albedo": 0.9}})
    assert (named.medium, named.extinction) == ("tank", 1.0)


@pytest.mark.parametrize(
    "count_law",
    [
        pytest.param("per_pulse", marks=pytest.mark.slow),
        "per_frame",
        pytest.param("per_frame_lu2024", marks=pytest.mark.slow),
    ],
)
def test_the_pulses_needed_are_enough_and_not_too_many(count_law):
    """With them the bound is within 1 cm and outliers are within 1 %; with a tenth less one of the two is not."""
    one = SCENE.with_overrides({"laser.pulse_energy": 1e-11, "detector.dark_count_rate": 2e4})
    one = one.with_overrides({"analytic.count_law": count_law})
    per_frame = 1 if count_law == "per_pulse" else one.analytic.exposure * one.laser.repetition_rate
    field = "analytic.pulses_per_depth_frame" if count_law == "per_pulse" else "analytic.frames"
    for distance in (2.0, 8.0):
        needed = budget(one, ranges=[distance])[0].pulses_for_1cm
        assert 10 < needed < 1e15
        counts = (max(1, math.ceil(needed * factor / per_frame)) for factor in (1.01, 0.9))
        enough, scarce = (budget(one.with_overrides({field: n}), ranges=[distance])[0] for n in counts)
        assert enough.sigma_depth <= 0.0101 and enough.outlier_probability <= 0.0101
        if needed > 20 * per_frame:
            assert scarce.sigma_depth > 0.01 or scarce.outlier_probability > 0.01


def test_pulses_of_a_depth_frame_are_those_of_the_detector_unless_given():
    """The bound falls with the square root of either; the table and its row say which counted."""
    one, four = (budget(SCENE.with_overrides({"detector.pulses_per_frame": n}), ranges=[2.0])[0] for n in (500, 2000))
    assert (one.pulses, four.pulses) == (500, 2000)
    assert one.sigma_depth == pytest.approx(2 * four.sigma_depth)
    own = SCENE.with_overrides({"detector.pulses_per_frame": 500, "analytic.pulses_per_depth_frame": 2000})
    assert budget(own, ranges=[2.0])[0] == four and own.pulses_per_depth_frame == 2000
    frames = SCENE.with_overrides({"analytic.count_law": "per_frame", "analytic.frames": 7, "analytic.exposure": 1e-5})
    assert budget(frames, ranges=[2.0])[0].pulses == pytest.approx(7 * 1e-5 * 20e6)
    with pytest.warns(SpadwarpWarning, match="no number depends on detector.pulses_per_frame: .* has its place"):
        assert sweep(own, vary="detector.pulses_per_frame=100,200").is_flat
    assert not sweep(SCENE, vary="detector.pulses_per_frame=100,200").is_flat


def test_where_nothing_comes_back_no_number_of_pulses_is_enough():
    row = budget(SCENE, ranges=[50.0], media={"ink": {"extinction": 20.0, "albedo": 0.1}})[0]
    assert row.pulses_for_1cm == math.inf and row.signal == 0.0
    assert math.isnan(row.sigma_depth) and math.isnan(row.outlier_probability)


@pytest.mark.parametrize(
    ("text", "field", "values"),
    [
        ("medium.extinction=0.1:2:20", "medium.extinction", [*np.linspace(0.1, 2, 20).tolist()]),
        ("laser.pulse_energy = 1e-9:1e-7:3:log", "laser.pulse_energy", [1e-9, 1e-8, 1e-7]),
        ("laser.pulse_energy=1 nJ:1 µJ:4:log", "laser.pulse_energy", [1e-9, 1e-8, 1e-7, 1e-6]),
        ("laser.pulse_energy=1 nJ,20 nJ", "laser.pulse_energy", [1e-9, 20e-9]),
        ("gate.bin_width_ps=0.05 ns:100:2", "gate.bin_width_ps", [50.0, 100.0]),
        ("gate.bins=64,128", "gate.bins", [64, 128]),
        ("gate.bins=10:100:4:log", "gate.bins", [10, 22, 46, 100]),
        ("camera.width=1:3:5", "camera.width", [1, 2, 3]),
        ("targets[0].translation[2]=5:15:3", "targets[0].translation[2]", [5.0, 10.0, 15.0]),
        ("targets[0].translation=[0, 0, 2], [0, 0, 3]", "targets[0].translation", [[0, 0, 2], [0, 0, 3]]),
        ("medium.preset=uwoc-clear,uwoc-harbour", "medium.preset", ["uwoc-clear", "uwoc-harbour"]),
    ],
)
def test_what_to_vary(text, field, values):
    name, parsed = parse_vary(text)
    assert name == field and len(parsed) == len(values)
    for one, other in zip(parsed, values, strict=True):
        assert type(one) is type(other) and one == (pytest.approx(other) if isinstance(other, float) else other)


FORM = r"vary.* is not of the form (section\.field=)?from:to:count"
COUNT = r"a\.b = '1:2:.*': the number of values = -?[\d.e+]+ is .*\[2, 10000\]"


@pytest.mark.parametrize(
    ("match", "texts"),
    [
        (FORM, ["medium.extinction", "=1:2:3", "a.b=", "a.b=1:2", "a.b=1:2:3:4", "a.b=-1:2:3:log", "a.b=1:x:3"]),
        (COUNT, [f"a.b=1:2:{count}" for count in ("0", "1", "999999999", "1e30", "-1", "2.5")]),
        ("'1 ns' is a time; an energy is needed", ["laser.pulse_energy=1 ns:2 nJ:3"]),
    ],
)
def test_what_cannot_be_varied(match, texts):
    for text in texts:
        with pytest.raises(ValueError, match=match):
            parse_vary(text)


def test_a_sweep_follows_the_lidar_equation():
    """S falls as e^{−2cR} with the extinction and rises with the pulse energy; the field may be any of the scene."""
    curves = sweep(SCENE, vary="medium.extinction=0.1:1.1:3")
    assert curves.column("medium.extinction") == pytest.approx((0.1, 0.6, 1.1))
    signal, distance = curves.column("signal"), curves.rows[0].range
    np.testing.assert_allclose(np.log(signal[:-1] / signal[1:]), 2 * 0.5 * distance, rtol=1e-6)
    first, second = sweep(SCENE, vary=("laser.pulse_energy", [1e-9, 3e-9])).rows
    assert second.sigma_depth < first.sigma_depth and second.signal == pytest.approx(3.0 * first.signal)
    far = sweep(SCENE, vary="targets[0].translation[2]=2:4:3").rows
    assert [row.range for row in far] == pytest.approx([2.0, 3.0, 4.0], rel=0.01)


def test_choices_of_an_experiment_are_combined():
    seen = {"laser.polarisation": "linear", "laser.port": "camera", "camera.port.preset": "flat-glass"}
    vary = ["laser.wavelength_nm=480,532", "camera.analyser=none,cross", "camera.port.preset=none,flat-glass"]
    scene = SCENE.with_overrides({"medium.chlorophyll": 0.5, **seen})
    fields, chosen = combinations(scene, [*vary, "range=2 m"], planned=True)
    assert len(chosen) == 8 and len(fields) == 4
    assert len({scene.medium.absorption for _, scene, _ in chosen}) == 2  # blue and green water
    assert {arguments["channel"] for _, _, arguments in chosen} == {"I", "cross"}
    for values, one, _ in chosen:  # a laser behind the camera's port is in the water without it
        assert (one.camera.port is None) == (one.laser.port is None) == (values[2] == "none")
    assert all(arguments["ranges"] == (2.0, 2.0) for *_, arguments in chosen)


@pytest.mark.parametrize("text", ["1:5", "a,", "", ":", "1 s,2 s", "1:2:0", "1:inf:3", "1,,2"])
def test_values_that_are_wrong_are_named_by_their_option(text):
    with pytest.raises(ArgumentError, match=r"^--range"):
        parse_values(text, "m", name="--range")


@pytest.mark.parametrize(
    ("ask", "match"),
    [
        (lambda: sweep(SCENE, vary="medium.haze=1:2:2"), r"medium\.haze"),
        (lambda: sweep(SCENE, vary="medium.anisotropy=0.5:1.5:3"), "outside"),
        (lambda: budget(SCENE, ranges=[2.0, -1.0]), r"ranges: an item = -1.0 is outside \[1e-6, 1e6\] m"),
        (lambda: sweep(SCENE.with_overrides({"targets": []}), vary="medium.extinction=1"), "no target is in view"),
        (lambda: sweep(SCENE, vary="laser.wavelength_nm=480,532"), r"its own water.* give medium\.chlorophyll"),
        (lambda: sweep(SCENE, vary="camera.analyser=cross", of="plan"), r"laser\.polarisation = 'linear'"),
        (lambda: sweep(SCENE, vary=["medium.albedo=0.5", "range=2,3"]), "of = 'plan'"),
    ],
)
def test_bad_requests_are_named(ask, match):
    with pytest.raises((ArgumentError, ConfigError), match=match):
        ask()


POLARISED = SCENE.with_overrides(
    {"laser.polarisation": "linear", "medium.scattering_matrix": "voss_fry", "camera.polarisation": "analyser"}
)


@pytest.mark.parametrize(
    ("simulate", "options"),
    [
        (simulate_analytic, {"frames": 0}),
        (budget, {"ranges": [2.2]}),
        (sweep, {"vary": ("laser.pulse_energy", [1e-9]), "of": "budget"}),
    ],
)
def test_the_model_says_that_it_has_no_polarisation(simulate, options):
    assert not model_notes(SCENE)
    with pytest.warns(SpadwarpWarning, match="without the camera's analyser") as caught:
        simulate(POLARISED, **options)
    assert [str(one.message) for one in caught] == model_notes(POLARISED)
