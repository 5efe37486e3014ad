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
    return spadwarp.simulate(plate(), photons=3_000_000, seed=1, device="cpu")


def exposure(light, overrides, pulses=2_000_000, seed=3):
    return spadwarp.detect(
        replace(light, scene=light.scene.with_overrides(overrides)), pulses=pulses, seed=seed, device="cpu"
    )


@pytest.mark.slow
@pytest.mark.parametrize("detector", DETECTORS)
def test_estimates_are_within_their_errors(light, detector):
    overrides = DETECTORS[detector]
    found = spadwarp.fit(
        exposure(light, overrides),
        plate(overrides),
        unknown=UNKNOWN,
        initial_guess={"medium.absorption": 0.75, "medium.scattering": 0.25},
        photons=1_000_000,
        seed=5,
        device="cpu",
    )
    assert found.converged and found.names == list(TRUTH)
    for name, one in found.estimates.items():
        # The light that the counts were drawn from has noise of its own, that of 3 renderings.
        assert abs(one.value - TRUTH[name]) < 5 * one.standard_error, name
        assert one.standard_error < 0.1 * one.value and one.interval[0] < one.value < one.interval[1], name
    assert found.scene.medium.absorption == found.estimates["medium.absorption"].value
    assert abs(found.counts.sum() - found.expected.sum()) < 5 * found.counts.sum() ** 0.5


@pytest.mark.slow
def test_depth_is_not_that_of_the_centroid(light):
    """Light that is scattered forward comes late; the model knows, the centroid does not."""
    frames = exposure(light, {}, pulses=4_000_000)
    wrong = plate({"targets[0].translation": [0.0, 0.0, 1.51]})
    found = spadwarp.fit(frames, wrong, unknown="depth,reflectance", photons=600_000, seed=6, device="cpu")
    depth = found.estimates["depth"]
    assert abs(depth.value - 1.5) < max(4 * depth.standard_error, 5e-4)
    assert found.depth.shape == (8, 8) and np.nanmax(np.abs(found.depth - 1.5)) < 2e-3
    centroid = np.nanmedian(spadwarp.frames.depth_frame(light)) - 1.5
    assert abs(centroid) > 2 * abs(depth.value - 1.5)


def test_each_pixel_has_its_depth(light):
    frames = exposure(light, {}, pulses=4_000_000)
    found = spadwarp.fit(frames, plate(), unknown="depth:pixel,background:pixel", photons=400_000, device="cpu")
    depth = found.maps["depth"]
    normal = (depth.value - 1.5) / depth.standard_error
    assert np.isfinite(normal).all() and np.abs(normal).max() < 6 and found.estimates == {}
    both = spadwarp.fit(frames, plate(), unknown=UNKNOWN + ",background:pixel", photons=20_000, device="cpu")
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


@pytest.mark.parametrize(("depth", "is_inside"), [(1.5, True), (1.506, False)], ids=["inside a bin", "at its edge"])
def test_no_error_of_the_depth_is_below_its_bound(depth, is_inside):
    """Light inside a bin hardly changes when its target moves by less; the bound is that of moves by 1 mm."""
    places = {step: {"targets[0].translation": [0.0, 0.0, depth + step]} for step in (-1e-3, 0.0, 1e-3)}
    scenes = {step: plate({**IN_ONE_BIN, **place}) for step, place in places.items()}
    lights = {step: spadwarp.simulate(one, photons=200_000, seed=1, device="cpu") for step, one in scenes.items()}
    scene, axis = scenes[0.0], (scenes[0.0].gate.start, scenes[0.0].gate.bin_width)
    shape = lights[0.0].detections.shape
    receiver = Receiver.of(scene.detector, scene.laser, shape=shape, axis=axis, device="cpu")
    near, mean, far = (
        receiver.hazard(wp.array(one.detections.reshape(64, -1), dtype=wp.float32, device="cpu")).numpy()
        for one in lights.values()
    )
    pulses = 20_000
    information = pulses * np.sum(((far - near).astype(np.float64) / 2e-3) ** 2 / mean)
    frames = spadwarp.detect(lights[0.0], pulses=pulses, seed=3, device="cpu")
    fitter = Fitter(scene, "depth", read_exposure(frames, scene), photons=200_000, seed=8, device="cpu")
    found = fitter.fit(near=True)
    estimate = found.estimates["depth"]
    assert estimate.standard_error > 0.95 * information**-0.5
    assert abs(estimate.value - depth) < 3 * estimate.standard_error
    assert any("lies in one or two bins" in text for text in found.warnings) == is_inside


def test_start_is_that_of_a_lidar(light):
    frames = exposure(light, {"laser.pulse_energy": 1e-11}, pulses=200_000)
    scene = plate({"laser.pulse_energy": 1e-11})
    start = lidar_initial_guess(scene, read_exposure(frames, scene), device="cpu")
    for name, value in start.items():
        assert 1 / 3.5 < value / TRUTH[name] < 3.5, name
    late = plate({"gate.start_ns": 13.5})
    assert lidar_initial_guess(late, read_exposure(np.zeros((8, 8, 160), int), late), device="cpu") == {}


def test_what_a_fit_leaves_out_is_refused(light):
    frames = exposure(light, {}, pulses=10)
    for field, value in (("afterpulsing_probability", 0.1), ("max_count", 7)):
        with pytest.raises(spadwarp.ConfigError, match=field):
            spadwarp.fit(frames, plate({f"detector.{field}": value}), unknown="depth", device="cpu")
    for argument, words in (
        ({"initial_guess": {"medium.absorption": 1.0}}, "is not an unknown"),
        ({"prior": {"depth": 1.0}}, "standard deviation"),
        ({"photons": 10}, "photons = 10"),
    ):
        with pytest.raises(spadwarp.ArgumentError, match=words):
            spadwarp.fit(frames, plate(), unknown="depth", device="cpu", **argument)


@pytest.mark.slow
def test_commands_say_what_python_says(light, tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(plate().to_toml())
    light.save(tmp_path / "result.h5")
    run("detect", tmp_path / "result.h5", "--pulses", 1000000, "--out", tmp_path / "frames", "--quiet", *DEVICE)
    options = ("--unknown", "reflectance,depth:pixel", "--photons", "2e5", "--seed", 7, *DEVICE)
    summary = tmp_path / "fit.json"
    printed = run("fit", tmp_path / "frames", scene, *options, "--out", tmp_path / "fit", "--json", summary)
    names = {"fit.png", "scene.toml", "depth.npy", "depth_error.npy"}
    assert {path.name for path in (tmp_path / "fit").iterdir()} == names
    twin = spadwarp.fit(
        tmp_path / "frames" / "frames.h5",
        scene,
        unknown="reflectance,depth:pixel",
        photons=200_000,
        seed=7,
        device="cpu",
    )
    found = tables(summary)["estimates"]["targets[0].reflectance"]
    assert found["value"] == pytest.approx(twin.estimates["targets[0].reflectance"].value, rel=1e-6)
    assert "targets[0].reflectance" in printed.stdout and "depth of each pixel" in printed.stdout
    assert np.load(tmp_path / "fit" / "depth.npy").shape == (8, 8)
    assert "NAME=VALUE" in run("fit", tmp_path, scene, *options, "--start", "a", "--out", tmp_path / "x", code=2).stderr
    options = ("--unknown", UNKNOWN, "--photons", "1e5", "--pulses", "1e4", *DEVICE)
    printed = run("fit", scene, "--bounds", *options, "--json", tmp_path / "crlb.json")
    assert "medium.scattering [1/m]" in printed.stdout and "counts expected in 10 000 pulses" in printed.stdout
    twin = spadwarp.inverse.bounds(scene, unknown=UNKNOWN, photons=100_000, pulses=10_000, device="cpu")
    one = tables(tmp_path / "crlb.json")["bounds"]["medium.scattering"]
    assert one["standard_error"] == pytest.approx(twin.bounds["medium.scattering"].standard_error, rel=1e-6)


def test_noise_that_simulated_counts_inherit_is_said():
    scene = plate()
    few = spadwarp.simulate(scene, photons=30_000, seed=2, uncertainty=True, device="cpu")
    frames = spadwarp.detect(few, pulses=500_000, frames=4, seed=3, device="cpu")
    assert read_exposure(frames, scene).monte_carlo_noise == pytest.approx(2 * frames.monte_carlo_noise)
    found = spadwarp.fit(frames, scene, unknown="absorption", photons=30_000, device="cpu")
    assert any("the simulation traced too few photons for 2000000 pulses" in text for text in found.warnings)
