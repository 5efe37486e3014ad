"""Cramér–Rao bounds against closed forms, and that the noise of a simulation does not count as information."""

import numpy as np
import pytest

import spadwarp
from helpers.inverse import CLEAR, UNKNOWN, plate
from spadwarp.frames import detector_response
from spadwarp.inverse import bounds, read_unknowns
from spadwarp.inverse.exposure import Exposure
from spadwarp.inverse.rendering import Renderer

pytestmark = pytest.mark.physics


@pytest.fixture(scope="module")
def clear():
    """Clear water: all light has gone from the laser to the plate and back."""
    return bounds(plate(CLEAR), unknown=UNKNOWN + ",depth", pulses=10**6, photons=400_000, device="cpu")


def test_of_a_plate_in_clear_water_are_those_of_counting(clear):
    # m ∝ Γ exp(−a L): of N counts, σ(ln Γ) = 1/√N and σ(a) = 1/(L √N), each with the other known.
    scene, root = plate(CLEAR), clear.counts**0.5
    assert clear.bounds["targets[0].reflectance"].alone / 0.4 == pytest.approx(1 / root, rel=0.01)
    path = np.nanmean(spadwarp.simulate(scene, photons=1000, device="cpu").true_path())
    assert clear.bounds["medium.absorption"].alone == pytest.approx(1 / (path * root), rel=0.01)
    # Little but the number of counts is left to tell absorption from reflectance.
    assert any("hardly told apart" in text for text in clear.warnings)
    assert clear.bounds["medium.absorption"].standard_error > 20 * clear.bounds["medium.absorption"].alone


def test_of_depth_is_that_of_the_pixels_delays_and_of_the_response(clear):
    scene = plate(CLEAR)
    result = spadwarp.simulate(scene, photons=400_000, seed=8, device="cpu")
    delays = spadwarp.crlb(result, pulses=clear.pulses, device="cpu")  # from the slope of each pixel's histogram
    together = 0.5 * scene.medium.pulse_speed / np.sqrt(np.sum(delays**-2.0))
    assert clear.bounds["depth"].alone == pytest.approx(together, rel=0.07)
    # σ_t/√N of a Gaussian; light is even over a bin of the source, and counts are of a bin: Δ²/12 of variance each.
    response = detector_response(scene.detector, scene.laser)
    sigma = (response.sigma**2 + scene.gate.bin_width**2 / 6) ** 0.5
    best = 0.5 * scene.medium.pulse_speed * sigma / clear.counts**0.5
    assert clear.bounds["depth"].alone == pytest.approx(best, rel=0.08)


def test_fall_with_the_root_of_the_pulses_and_with_a_prior(clear):
    scene = plate(CLEAR)
    more = bounds(scene, unknown=UNKNOWN + ",depth", pulses=4 * 10**6, photons=400_000, device="cpu")
    assert more.bounds["depth"].alone == pytest.approx(clear.bounds["depth"].alone / 2, rel=0.01)
    known = {"targets[0].reflectance": (0.4, 1e-7)}
    alone = bounds(scene, unknown=UNKNOWN, pulses=10**6, photons=200_000, prior=known, device="cpu")
    one = alone.bounds["medium.absorption"]
    assert one.standard_error == pytest.approx(one.alone, rel=0.02)


def test_noise_of_the_simulation_is_no_information():
    scene = plate()
    few, many = (
        bounds(scene, unknown=UNKNOWN, pulses=1000, photons=photons, seed=seed, device="cpu")
        for photons, seed in ((50_000, 3), (600_000, 4))
    )
    for name, one in many.bounds.items():
        assert 0.97 * one.alone < few.bounds[name].alone < 1.2 * one.alone, name
    assert few.simulation > many.simulation


def test_of_a_pixels_depth_know_of_the_water():
    found = bounds(plate(), unknown=UNKNOWN + ",depth:pixel", pulses=10**5, photons=800_000, device="cpu")
    together, alone = found.maps["depth"], found.alone_maps["depth"]
    assert together.shape == (8, 8) and np.isfinite(together).all()
    assert (together > 0.99 * alone).all()
    assert found.bounds["depth"].per_pixel and found.names == list(found.bounds)[:3]


@pytest.mark.slow
def test_bins_much_wider_than_the_response_are_named():
    """Where in its bin a return lies is not in the counts."""
    wide = plate({"gate.bin_width_ps": 1000.0, "gate.bins": 20})
    for unknown, named in (("depth", True), ("reflectance", False)):
        found = bounds(wide, unknown=unknown, photons=2000, device="cpu")
        assert any("much shorter than a bin" in text for text in found.warnings) == named


def test_the_median_of_the_pixels_is_that_of_those_that_see_a_target():
    # Half of the image is water, which has light of the plate that was scattered beside it.
    scene = plate({"targets[0].translation": [-1.5, 0.0, 1.5]})
    found = bounds(scene, unknown="depth:pixel", pulses=10**6, photons=400_000, device="cpu")
    seen = np.isfinite(spadwarp.truth_maps(scene, device="cpu").depth)
    beside = found.maps["depth"][~seen]
    assert 0.4 < seen.mean() < 0.6 and np.isfinite(beside).any()
    assert found.bounds["depth"].standard_error == np.nanmedian(found.maps["depth"][seen])
    assert found.bounds["depth"].standard_error < 0.5 * np.nanmedian(beside)


def test_the_depth_is_looked_for_in_the_view_of_the_scene():
    # Of a focal length in metres: with a focus in metres, the sensor would stand further from the lens than in focus on
    # the target, and the view would be 5 % narrower.
    lens = {"camera.focal_length": 0.08, "camera.pixel_pitch_um": 4000.0}
    tilted = {"targets[0].rotation_deg": [0.0, 40.0, 0.0], "targets[0].size": [1.0, 1.0]}
    scene = plate({**lens, **tilted})
    exposure = Exposure(counts=None, pulses=1, window=(scene.gate.start, scene.gate.bins))
    render = Renderer(scene, read_unknowns(scene, "depth"), exposure, device="cpu")
    render({"depth": 0.0}, photons=1000)
    np.testing.assert_array_equal(render.truth.depth, spadwarp.truth_maps(scene, device="cpu").depth)
