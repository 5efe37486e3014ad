"""Fits of simulated exposures: values, intervals, detectors, files."""

from dataclasses import replace

import numpy as np
import pytest
import warp as wp

import spadwarp
from helpers.cli import DEVICE, run, tables
from helpers.inverse import TRUTH, UNKNOWN, plate
from spadwarp.frames import Receiver
from spadwarp.inverse import Fitter, lidar_initial_guess, read_exposure

pytestmark = [pytest.mark.physics, pytest.mark.filterwarnings("ignore::spadwarp.values.SpadwarpWarning")]
DETECTORS = {
    "first photon": {},
    "free running": {"detector.mode": "free_running", "detector.dead_time_ns": 40.0, "laser.repetition_rate": 1e7},
    "crosstalk": {"detector.crosstalk_probability": 0.02},
}


@pytest.fixture(scope="module")
def light():
    return spadwarp.simulate(plate(), photons=1_500_000, seed=1, device="cpu")


def exposure(light, overrides=None, pulses=2_000_000, seed=3):
    other = replace(light, scene=light.scene.with_overrides(overrides or {}))
    return spadwarp.detect(other, pulses=pulses, seed=seed, device="cpu")


def fit(frames, scene, unknown, **options):
    return spadwarp.fit(frames, scene, unknown=unknown, device="cpu", **options)


@pytest.mark.slow
@pytest.mark.parametrize("detector", DETECTORS)
def test_estimates_are_within_their_errors(light, detector):
    overrides, start = DETECTORS[detector], {"medium.absorption": 0.75, "medium.scattering": 0.25}
    options = {"initial_guess": start, "photons": 500_000, "seed": 5}
    found = fit(exposure(light, overrides), plate(overrides), UNKNOWN, **options)
    assert found.converged and found.names == list(TRUTH)
    for name, one in found.estimates.items():
        # The light that the counts were drawn from has noise of its own, that of 3 renderings.
        assert abs(one.value - TRUTH[name]) < 5 * one.standard_error, name
        assert one.standard_error < 0.1 * one.value and one.interval[0] < one.value < one.interval[1], name
    assert found.scene.medium.absorption == found.estimates["medium.absorption"].value
    assert abs(found.counts.sum() - found.expected.sum()) < 5 * found.counts.sum() ** 0.5


@pytest.mark.slow
def test_concentrations_of_two_constituents_from_one_exposure():
    parts = [
        {"name": "molecules", "absorption": 0.05, "scattering": 0.3, "phase_function": "rayleigh"},
        {"name": "algae", "absorption": 0.2, "scattering": 0.5, "phase_function": "fournier_forand"},
    ]
    own = dict.fromkeys(("absorption", "scattering", "anisotropy"))
    true = plate({"medium": {**own, "constituents": parts}})
    frames = exposure(spadwarp.simulate(true, photons=1_000_000, seed=1, device="cpu"))
    start = {f"medium.constituents[{k}].concentration": value for k, value in enumerate((0.5, 2.0))}
    found = fit(frames, true, "molecules,algae", photons=200_000, seed=5, initial_guess=start)
    assert found.converged
    for one in found.estimates.values():
        assert abs(one.value - 1.0) < 5 * one.standard_error < 0.1


@pytest.mark.slow
def test_depth_is_not_that_of_the_centroid(light):
    """Light that is scattered forward comes late; the model knows, the centroid does not."""
    wrong = plate({"targets[0].translation": [0.0, 0.0, 1.51]})
    found = fit(exposure(light, pulses=4_000_000), wrong, "depth,reflectance", photons=300_000, seed=6)
    depth = found.estimates["depth"]
    assert abs(depth.value - 1.5) < max(4 * depth.standard_error, 5e-4)
    assert found.depth.shape == (8, 8) and np.nanmax(np.abs(found.depth - 1.5)) < 2e-3
    centroid = np.nanmedian(spadwarp.frames.depth_frame(light)) - 1.5
    assert abs(centroid) > 2 * abs(depth.value - 1.5)


@pytest.mark.slow
def test_each_pixel_has_its_depth(light):
    frames = exposure(light, pulses=4_000_000)
    found = fit(frames, plate(), "depth:pixel,background:pixel", photons=200_000)
    depth = found.maps["depth"]
    normal = (depth.value - 1.5) / depth.standard_error
    assert np.isfinite(normal).all() and np.abs(normal).max() < 6 and found.estimates == {}
    both = fit(frames, plate(), UNKNOWN + ",background:pixel", photons=20_000)
    assert both.names == list(TRUTH) and both.maps["detector.ambient_rate"].value.shape == (8, 8)


# Nearly all light of a pixel in one bin before the response. Half of the response is 12 mm, the error below 1 mm.
IN_ONE_BIN = {
    "medium.scattering": 0.1,
    "laser.pulse_fwhm_ps": 500.0,
    "laser.half_angle_deg": 12.0,
    "laser.position": [-0.1, 0.0, 0.0],
    "laser.pulse_energy": 1e-12,
    "camera.horizontal_fov_deg": 8.0,
    "gate.start_ns": 7.0,
    "gate.bin_width_ps": 200.0,
    "gate.bins": 50,
}


@pytest.mark.slow
@pytest.mark.parametrize(("depth", "is_inside"), [(1.5, True), (1.506, False)], ids=["inside a bin", "at its edge"])
def test_no_error_of_the_depth_is_below_its_bound(depth, is_inside):
    """Light inside a bin hardly changes when its target moves by less; the bound is that of moves by 1 mm."""
    lights = []
    for step in (-1e-3, 1e-3, 0.0):
        scene = plate({**IN_ONE_BIN, "targets[0].translation": [0.0, 0.0, depth + step]})
        lights.append(spadwarp.simulate(scene, photons=200_000, seed=1, device="cpu"))
    shape, axis = lights[-1].detections.shape, (scene.gate.start, scene.gate.bin_width)
    receiver = Receiver.of(scene.detector, scene.laser, shape=shape, axis=axis, device="cpu")
    near, far, mean = (
        receiver.hazard(wp.array(one.detections.reshape(64, -1), dtype=wp.float32, device="cpu")).numpy()
        for one in lights
    )
    pulses = 20_000
    information = pulses * np.sum(((far - near).astype(np.float64) / 2e-3) ** 2 / mean)
    frames = spadwarp.detect(lights[-1], pulses=pulses, seed=3, device="cpu")
    fitter = Fitter(scene, "depth", read_exposure(frames, scene), photons=200_000, seed=8, device="cpu")
    found = fitter.fit(near=True)
    estimate = found.estimates["depth"]
    assert estimate.standard_error > 0.95 * information**-0.5
    assert abs(estimate.value - depth) < 3 * estimate.standard_error
    assert any("lies in one or two bins" in text for text in found.warnings) == is_inside


def test_start_is_that_of_a_lidar():
    light = spadwarp.simulate(plate(), photons=200_000, seed=1, device="cpu")
    frames = exposure(light, {"laser.pulse_energy": 1e-11}, pulses=200_000)
    scene = plate({"laser.pulse_energy": 1e-11})
    start = lidar_initial_guess(scene, read_exposure(frames, scene), device="cpu")
    for name, value in start.items():
        assert 1 / 3.5 < value / TRUTH[name] < 3.5, name
    late = plate({"gate.start_ns": 13.5})
    assert lidar_initial_guess(late, read_exposure(np.zeros((8, 8, 160), int), late), device="cpu") == {}


@pytest.mark.parametrize(
    ("overrides", "options", "words"),
    [
        ({"detector.afterpulsing_probability": 0.1}, {}, "afterpulsing_probability"),
        ({"detector.max_count": 7}, {}, "max_count"),
        ({"laser.polarisation": "linear", "camera.polarisation": "stokes"}, {}, "knows no channels such as"),
        ({}, {"initial_guess": {"medium.absorption": 1.0}}, "is not an unknown"),
        ({}, {"prior": {"depth": 1.0}}, "standard deviation"),
        ({}, {"photons": 10}, "photons = 10"),
    ],
)
def test_what_a_fit_leaves_out_is_refused(overrides, options, words):
    with pytest.raises((spadwarp.ConfigError, spadwarp.ArgumentError), match=words):
        fit(np.ones((8, 8, 160), int), plate(overrides), "depth", **options)


@pytest.mark.slow
def test_commands_say_what_python_says(light, tmp_path):
    scene, summary, bounds = (tmp_path / name for name in ("scene.toml", "fit.json", "bounds.json"))
    scene.write_text(plate().to_toml())
    light.save(tmp_path / "result.h5")
    run("detect", tmp_path / "result.h5", "--pulses", 1000000, "--out", tmp_path / "frames", "--quiet", *DEVICE)
    options = ("--unknown", "reflectance,depth:pixel", "--photons", "5e4", "--seed", 7, *DEVICE)
    printed = run("fit", tmp_path / "frames", scene, *options, "--out", tmp_path / "fit", "--json", summary)
    names = {"fit.png", "scene.toml", "depth.npy", "depth_error.npy"}
    assert {path.name for path in (tmp_path / "fit").iterdir()} == names
    twin = fit(tmp_path / "frames" / "frames.h5", scene, "reflectance,depth:pixel", photons=50_000, seed=7)
    name = "targets[0].reflectance"
    assert tables(summary)["estimates"][name]["value"] == pytest.approx(twin.estimates[name].value, rel=1e-6)
    assert name in printed.stdout and "depth of each pixel" in printed.stdout
    assert np.load(tmp_path / "fit" / "depth.npy").shape == (8, 8)
    assert "NAME=VALUE" in run("fit", tmp_path, scene, *options, "--start", "a", "--out", tmp_path / "x", code=2).stderr
    options = ("--unknown", UNKNOWN, "--photons", "2e4", "--pulses", "1e4", *DEVICE)
    printed = run("fit", scene, "--bounds", *options, "--json", bounds)
    assert "medium.scattering [1/m]" in printed.stdout and "counts expected in 10 000 pulses" in printed.stdout
    twin = spadwarp.inverse.bounds(scene, unknown=UNKNOWN, photons=20_000, pulses=10_000, device="cpu")
    error = tables(bounds)["bounds"]["medium.scattering"]["standard_error"]
    assert error == pytest.approx(twin.bounds["medium.scattering"].standard_error, rel=1e-6)


def test_noise_that_simulated_counts_inherit_is_said():
    scene = plate()
    few = spadwarp.simulate(scene, photons=30_000, seed=2, device="cpu")
    frames = spadwarp.detect(few, pulses=500_000, frames=4, seed=3, device="cpu")
    assert read_exposure(frames, scene).noise_ratio == pytest.approx(4 * frames.target_noise_ratio)
    found = fit(frames, scene, UNKNOWN, photons=30_000)
    assert any("the simulation traced too few photons for 2000000 pulses" in text for text in found.warnings)
