"""The camera: from expected detections to frames of counts and depth; the noise of the simulation in them."""

import math
import warnings
from types import SimpleNamespace

import numpy as np
import pytest
import warp as wp

import spadwarp
from helpers.scenes import scene
from helpers.synthetic_result import make_result, make_scene
from spadwarp import ArgumentError
from spadwarp.frames import InstrumentResponse, coates, detect, first_photon_probabilities, monte_carlo_noise
from spadwarp.frames.spad import Receiver
from spadwarp.scene import Detector, Laser
from spadwarp.values import SpadwarpWarning

BIN = 100e-12
LASER = Laser(repetition_rate=20e6, pulse_fwhm_ps=85.0)  # period 50 ns: 500 bins
QUIET = Detector(dark_count_rate=0.0)
CALL = dict(gate_start=0.0, bin_width=BIN, laser=LASER, device="cpu")


def _spike(bin, signal=0.05, bins=500, image=(2, 3)):
    cube = np.zeros((*image, bins))
    cube[..., bin] = signal
    return cube


def test_counts_follow_the_expected_detections():
    found = detect(_spike(200), pulses=100_000, frames=3, seed=1, detector=QUIET, **CALL)
    assert found.counts.shape == (3, 2, 3, 500) and found.counts.dtype == np.int32
    expected = 100_000 * -np.expm1(-0.05)
    assert np.abs(found.intensity - expected).max() < 4.5 * np.sqrt(expected)
    mean = found.arrival_time("centroid") - 200.5 * BIN
    sigma = found.irf.sigma / np.sqrt(expected)
    # Pile-up takes photons from the end of the pulse: with α = 0.05 the mean moves by −α σ / (2 √π).
    assert abs(mean.mean() + 0.05 * found.irf.sigma / (2 * np.sqrt(np.pi))) < 4 * sigma / np.sqrt(18) + 0.02 * BIN


def test_one_seed_one_frame_one_answer():
    cube = _spike(100, signal=0.5)
    frames = detect(cube, pulses=300, frames=4, seed=9, **CALL)
    one = detect(cube, pulses=300, frames=1, first_frame=2, seed=9, **CALL)
    np.testing.assert_array_equal(one.counts[0], frames.counts[2])
    np.testing.assert_array_equal(
        detect(cube, pulses=300, frames=4, seed=9, summed=True, **CALL).counts, frames.counts.sum(0)
    )
    assert (detect(cube, pulses=300, frames=4, seed=10, **CALL).counts != frames.counts).any()
    call = {**CALL, "device": None}
    np.testing.assert_array_equal(
        detect(wp.array(cube, dtype=wp.float64, device="cpu"), pulses=300, frames=4, seed=9, **call).counts,
        frames.counts,
    )
    torch = pytest.importorskip("torch")
    np.testing.assert_array_equal(
        detect(torch.from_numpy(cube), pulses=300, frames=4, seed=9, **call).counts, frames.counts
    )


def test_a_target_beyond_the_unambiguous_range_appears_one_period_early():
    # Light after 73 ns at 20 MHz; the near-range light of the next pulse comes with it.
    cube = _spike(730, bins=1000)
    cube[..., 20] = 0.03
    found = detect(cube, pulses=50_000, seed=2, detector=QUIET, **CALL)
    assert found.counts.shape[-1] == 500 and found.period == pytest.approx(50e-9)
    times = found.arrival_time("matched")
    np.testing.assert_allclose(times, 23.05e-9, atol=BIN / 4)
    near = found.arrival_time("matched", gate=(0.0, 10e-9))
    np.testing.assert_allclose(near, 2.05e-9, atol=BIN / 4)
    straight = detect(cube, pulses=50_000, seed=2, detector=Detector(dark_count_rate=0.0, wrap=False), **CALL)
    assert straight.counts.shape[-1] == 1000 and straight.period is None
    np.testing.assert_allclose(straight.arrival_time("matched"), 73.05e-9, atol=BIN / 4)


def test_a_window_holds_the_light_of_all_pulses_that_reaches_it():
    # A gated target at 136 ns (15 m of sea water), window of 20 ns; light at 36 and 86 ns belongs to the next pulses.
    cube = _spike(1360, bins=1500)
    cube[..., 860] = 0.02
    cube[..., 360] = 0.01
    found = detect(cube, pulses=200_000, seed=3, window=(126e-9, 200), detector=QUIET, **CALL)
    expected = 200_000 * -np.expm1(-0.08)
    assert abs(found.intensity.mean() - expected) < 4 * np.sqrt(expected / 6)
    np.testing.assert_allclose(found.arrival_time("matched"), 136.05e-9, atol=BIN / 4)
    assert found.notes == ()


def test_light_that_the_source_does_not_hold_is_noted():
    late = {**CALL, "gate_start": 120e-9}
    assert "120 ns" in detect(_spike(10), pulses=10, seed=1, **late).notes[0]
    short = detect(_spike(10, bins=50), pulses=10, seed=1, **{**CALL, "gate_start": 10e-9})
    assert short.notes == ()  # 0 to 10 ns wrap to 50 to 60 ns, after the window
    assert detect(_spike(10), pulses=10, seed=1, detector=Detector(wrap=False), **late).notes == ()


def test_dark_counts_and_ambient_light_are_the_background():
    detector = Detector(
        dark_count_rate=1e5, dark_count_spread=0.4, hot_pixel_fraction=0.1, hot_pixel_rate=3e6, ambient_rate=2e5
    )
    image = (20, 30)
    found = detect(np.zeros((*image, 500)), pulses=20_000, seed=4, detector=detector, **CALL)
    expected = found.background.sum(axis=-1, dtype=np.float64) * 500 * 20_000
    assert found.background.shape == (*image, 1)
    piled = 20_000 * -np.expm1(-expected / 20_000)
    assert np.abs((found.intensity[0] - piled) / np.sqrt(piled)).max() < 5
    hot = expected / (20_000 * 50e-9) > 2e6
    assert 0.04 < hot.mean() < 0.18
    assert np.median(expected[~hot] / (20_000 * 50e-9)) == pytest.approx(3e5, rel=0.05)
    again = detect(np.zeros((*image, 500)), pulses=20_000, seed=5, detector=detector, **CALL)
    np.testing.assert_array_equal(again.background, found.background)  # the camera keeps its pixels


def test_estimators_know_the_background():
    rng = np.random.default_rng(0)
    bins, image = 500, (24, 24)
    decay = 0.02 * np.exp(-np.arange(bins) / 40.0)
    delay = rng.integers(150, 420, image)
    cube = np.tile(decay, (*image, 1))
    np.put_along_axis(cube, delay[..., None], np.take_along_axis(cube, delay[..., None], -1) + 1e-2, -1)
    detector = Detector(dark_count_rate=0.0, ambient_rate=2e5, jitter_fwhm_ps=400.0)
    backscatter = np.tile(decay, (*image, 1))
    found = detect(cube, pulses=10_000, seed=6, detector=detector, background=backscatter, **CALL)
    likelihood = found.arrival_time("likelihood", undo_pile_up=True)[0] / BIN - delay - 0.5
    centroid = found.arrival_time("centroid", undo_pile_up=True)[0] / BIN - delay - 0.5
    every = found.arrival_time("matched", min_significance=0)  # blind to backscatter
    assert np.median(every[0] / BIN - delay) < -50
    assert np.abs(likelihood).max() < 5
    assert np.std(likelihood) < 0.9 * np.std(centroid[np.abs(centroid) < 20])
    # Cramér–Rao: the Fisher information of the delay, in the pulses that the backscatter has left.
    width = found.irf.sigma / BIN
    t = np.arange(bins) - delay[..., None]
    shape = 1e-2 * np.exp(-0.5 * (t / width) ** 2) / (width * np.sqrt(2 * np.pi))
    hazard = shape + decay + 2e5 * BIN
    left = 10_000 * np.exp(-np.cumsum(hazard, axis=-1))
    information = np.sum(left * (shape * t / width**2) ** 2 / hazard, axis=-1)
    bound = np.sqrt(np.mean(1 / information))
    assert abs(np.std(likelihood) / bound - 1) < 4 / np.sqrt(2 * likelihood.size)


def test_a_result_brings_its_own_axis_laser_detector_and_backscatter():
    scene = make_scene(laser={"position": [0.1, 0.0, 0.0], "repetition_rate": 1e6, "pulse_fwhm_ps": 300.0})
    result = make_result(scene)
    found = detect(result, pulses=1000, frames=20, seed=3, device="cpu")
    assert found.counts.shape == (20, *result.histogram.shape)
    assert found.gate_start == scene.gate.start and found.bin_width == scene.gate.bin_width
    assert found.irf.fwhm == pytest.approx(np.hypot(300e-12, scene.detector.jitter_fwhm_ps * 1e-12))
    # Shot noise about the result's own numbers; dark counts are nothing here, and the gate's ends cut 0.3 % off.
    expected = 20_000 * -np.expm1(-result.detections.sum(axis=-1))
    assert abs(found.counts.sum() - expected.sum()) < 4 * np.sqrt(expected.sum()) + 0.003 * expected.sum()
    z = (found.intensity.sum(axis=0) - expected) / np.sqrt(expected)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / z.size)
    backscatter = result.component("backscatter").sum() * scene.laser.photons_per_pulse * scene.detector.pde
    assert found.background.sum() == pytest.approx(backscatter, rel=0.02)


def test_pile_up_is_undone():
    cube = _spike(100, signal=2.0, image=(4, 4)) + _spike(300, signal=0.5, image=(4, 4))
    found = detect(cube, pulses=400_000, seed=7, detector=QUIET, irf=InstrumentResponse(), **CALL)
    law = found.counts[0].mean(axis=(0, 1)) / 400_000
    assert abs(law[100] - -np.expm1(-2.0)) < 1e-3
    assert abs(law[300] - np.exp(-2.0) * -np.expm1(-0.5)) < 1e-3
    np.testing.assert_allclose(found.coates()[0].mean(axis=(0, 1))[[100, 300]], [2.0, 0.5], rtol=0.01)
    np.testing.assert_allclose(first_photon_probabilities(cube)[0, 0], law, atol=1.5e-3)


def test_crosstalk_adds_its_mean_to_the_neighbours():
    cube = np.zeros((5, 5, 100))
    cube[2, 2, 30] = 0.8
    detector = Detector(dark_count_rate=0.0, crosstalk_probability=0.05, wrap=False)
    found = detect(cube, pulses=2_000_000, seed=8, detector=detector, irf=InstrumentResponse(), **CALL)
    expected = 2_000_000 * -np.expm1(0.05 * np.expm1(-0.8))
    neighbours = found.counts[0, [1, 3, 2, 2], [2, 2, 1, 3], 30]
    assert np.abs(neighbours - expected).max() < 4 * np.sqrt(expected)
    assert found.intensity[0][0, 0] == 0 and found.intensity[0].sum() == neighbours.sum() + found.intensity[0][2, 2]


def test_wide_bins_collect_more():
    widths = np.tile([0.5, 1.5], 250)
    detector = Detector(dark_count_rate=1e6)
    found = detect(np.zeros((4, 4, 500)), pulses=100_000, seed=9, detector=detector, tdc_widths=widths, **CALL)
    law = found.coates()[0].mean(axis=(0, 1))
    assert law[0::2].mean() / law[1::2].mean() == pytest.approx(1 / 3, rel=0.02)
    assert found.edges[-1] == pytest.approx(50e-9) and np.allclose(np.diff(found.edges), widths * BIN)
    assert found.background.shape == (4, 4, 500)


def test_free_running_detects_after_its_dead_time():
    rate = 4e7
    cube = np.full((3, 3, 500), rate * BIN)
    detector = Detector(dark_count_rate=0.0, mode="free_running", dead_time_ns=35.0)
    found = detect(cube, pulses=50_000, seed=10, detector=detector, irf=InstrumentResponse(), **CALL)
    expected = rate / (1 + rate * 35e-9) * 50_000 * 50e-9
    assert abs(found.intensity.mean() / expected - 1) < 0.005
    # A window of half the period: the other half fires unseen and blocks it as much.
    half = detect(cube, pulses=50_000, seed=10, detector=detector, irf=InstrumentResponse(), window=(0, 250), **CALL)
    assert abs(half.intensity.mean() / expected - 0.5) < 0.005


def test_afterpulsing_adds_counts():
    cube = _spike(50, signal=0.01)
    detector = {"dark_count_rate": 0.0, "afterpulsing_probability": 0.1, "afterpulsing_time_constant_ns": 10.0}
    options = {"pulses": 400_000, "seed": 11, **CALL}
    free = detect(cube, detector=Detector(**detector, mode="free_running", dead_time_ns=5.0), **options)
    primaries = 6 * 400_000 * 0.01
    assert abs(free.intensity.sum() / (primaries / 0.9) - 1) < 4 / np.sqrt(primaries) + 0.02
    # First photon: what is trapped comes out after the next pulses, e^(−45 ns / 10 ns) of it in the next window.
    gated = detect(cube, detector=Detector(**detector, dead_time_ns=5.0), **options)
    late = gated.counts[..., 100:].sum() / gated.counts[..., :100].sum()
    carried = 0.1 * np.exp(-4.0)  # 45 ns to the next pulse, 5 ns of them dead
    assert late < carried
    assert gated.intensity.sum() > primaries * 0.99


@pytest.mark.parametrize("mode", ["first_photon", "free_running"])
def test_time_tags_are_the_counts_one_by_one(mode):
    cube = _spike(70, signal=0.3)
    detector = Detector(dark_count_rate=1e5, mode=mode, dead_time_ns=20.0)
    found = detect(cube, pulses=400, frames=2, first_frame=5, seed=12, detector=detector, tags=True, **CALL)
    rebuilt = np.zeros_like(found.counts)
    np.add.at(rebuilt, (found.tags.frame - 5, found.tags.y, found.tags.x, found.tags.bin), 1)
    np.testing.assert_array_equal(rebuilt, found.counts)
    assert found.tags.pulse.max() < 400


def test_a_shallow_counter_is_full():
    found = detect(_spike(10), pulses=1_000_000, seed=1, detector=Detector(max_count=255), **CALL)
    assert found.counts.max() == 255


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"source": np.full((2, 2, 5), -1.0)}, r"source holds a negative or non-finite value in pixel \(0, 0\)"),
        ({"source": np.full((2, 2, 5), np.nan)}, "source holds"),
        ({"source": np.zeros((2, 5))}, r"source has shape \(2, 5\)"),
        ({"detector": {}}, "detector = .* is not the section detector of a scene"),
        ({"laser": {}}, "laser = .* is not the section laser of a scene"),
        ({"background": np.zeros((2, 2, 5))}, r"background has shape \(2, 2, 5\)"),
        ({"background": np.full((2, 3, 500), -1.0)}, "background holds"),
        ({"pulses": 0}, "pulses = 0"),
        ({"pulses": 2**31}, "pulses = 2147483648"),
        ({"pulses": 1.5}, "pulses = 1.5"),
        ({"frames": 0}, "frames = 0"),
        ({"seed": -1}, "seed = -1"),
        ({"pulses": 2**30, "frames": 4, "summed": True}, "pulses · frames"),
        ({"gate_start": None}, "gate_start or bin_width is missing"),
        ({"bin_width": 0.0}, "bin_width = 0.0"),
        ({"laser": None}, "laser is missing"),
        ({"window": (0.0, 0)}, "window = "),
        ({"tdc_widths": [1.0]}, r"tdc_widths has shape \(1,\)"),
        ({"tdc_widths": np.zeros(500)}, "tdc_widths = 0.0"),
        ({"bin_width": 60e-9}, "longer than the pulse period"),
    ],
)
def test_wrong_input_is_named(changes, message):
    call = {"source": _spike(3), "pulses": 10, "seed": 1, **CALL, **changes}
    with pytest.raises(ValueError, match=message):
        detect(call.pop("source"), **call)


def test_a_result_has_its_own_time_axis():
    with pytest.raises(ArgumentError, match="gate_start and bin_width are for arrays"):
        detect(SimpleNamespace(scene=object()), pulses=10, seed=1, gate_start=0.0)


def test_wrong_counts_are_named():
    with pytest.raises(ValueError, match="pulses = 5 is below the 7 counts"):
        coates(np.array([[3, 4]]), pulses=5)
    with pytest.raises(ValueError, match="integers are needed"):
        coates(np.array([[3.0, 4.0]]), pulses=50)
    with pytest.raises(ArgumentError, match="counts = 4611686018427387904 is above"):
        coates(np.full((1, 64), 2**62), pulses=50)
    for pulses in (None, math.nan, 0):
        with pytest.raises(ArgumentError, match="pulses = "):
            coates(np.array([[3, 4]]), pulses=pulses)
    with pytest.raises(ValueError, match="hazard holds a negative"):
        first_photon_probabilities(np.array([[0.1, -0.2]]))


WEAK = Laser(pulse_energy=1e-15)  # far from pile-up


def test_frames_of_two_runs_differ_by_what_is_said(whole):
    """Pixel by pixel, the mean over frames is off by the standard error, in units of the shot noise of a frame."""
    result = whole[True]
    pulses = 100_000
    noise = monte_carlo_noise(result, pulses=pulses, laser=WEAK)
    part = 10  # runs of a tenth of the photons, whose spread is larger by its root
    others = [spadwarp.simulate(scene(), photons=result.photons // part, seed=k, device="cpu") for k in range(100, 124)]
    scale = pulses * WEAK.photons_per_pulse * result.scene.detector.pde
    spread = np.std([other.intensity for other in others], axis=0, ddof=1) * scale / np.sqrt(part)
    dark = pulses * result.scene.detector.noise_rate * (result.scene.gate.stop - result.scene.gate.start)
    ratio = spread / np.sqrt(result.intensity * scale + dark)
    # Each spread has a relative standard error of 1/sqrt(2 * 23), and so has the standard error from the batches.
    assert noise.ratio == pytest.approx(np.quantile(ratio, 0.95), rel=0.3)
    assert noise.photons_needed == pytest.approx(noise.photons * (noise.ratio / 0.5) ** 2)


def test_longer_exposures_show_more_of_it(whole):
    one, hundred = (monte_carlo_noise(whole[True], pulses=pulses, laser=WEAK) for pulses in (10**4, 10**6))
    # Shot noise of a pixel grows with the square root of the pulses, the standard error with their number.
    assert hundred.ratio == pytest.approx(10 * one.ratio)
    assert hundred.photons_needed == pytest.approx(100 * one.photons_needed)


def test_a_warning_with_numbers_or_a_note_that_nobody_knows(whole):
    keywords = {"laser": WEAK, "seed": 1, "device": "cpu"}
    with pytest.warns(SpadwarpWarning, match=r"Monte Carlo noise.* of the pixels, and .* photons instead of") as caught:
        frames = spadwarp.detect(whole[True], pulses=10**8, **keywords)
    assert len(caught) == 1 and frames.notes == ()
    with warnings.catch_warnings(action="error"):
        quiet = spadwarp.detect(whole[True], pulses=1000, **keywords)
        unknown = spadwarp.detect(whole[False], pulses=1000, **keywords)
    assert quiet.notes == () and "Monte Carlo noise is unknown" in unknown.notes[0]


def test_slopes_of_a_receiver_with_crosstalk_are_differences_of_its_rates():
    """By the light, and by the noise that all pixels share; weak light, of which every detection may leak."""
    rows = np.full((12, 8), 1e-5, np.float32)

    def receiver(ambient):
        detector = Detector(crosstalk_probability=0.05, dark_count_rate=0.0)
        return Receiver.of(detector, LASER, shape=(3, 4, 8), axis=(0.0, 1e-9), device="cpu", ambient=ambient)

    here, light = receiver(2e3), wp.array(rows, device="cpu")
    by_noise = (receiver(3e3).hazard(light).numpy() - here.hazard(light).numpy()) / 1e3
    np.testing.assert_allclose(here.noise_slope().numpy(), by_noise, rtol=2e-3)
    more = here.hazard(wp.array(1.5 * rows, device="cpu")).numpy() - here.hazard(light).numpy()
    np.testing.assert_allclose(here.slope(light).numpy(), 2.0 * more, rtol=2e-3)
