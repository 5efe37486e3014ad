"""The camera: from expected detections to frames of counts and depth; the noise of the simulation in them."""

import dataclasses
import warnings
from types import SimpleNamespace

import h5py
import numpy as np
import pytest
import warp as wp

import spadwarp
from helpers.synthetic_result import make_result, make_scene
from spadwarp.frames import (
    FramesFile,
    InstrumentResponse,
    coates,
    detect,
    first_photon_probabilities,
    record_frames,
)
from spadwarp.frames.spad import Receiver
from spadwarp.scene import Detector, Laser
from spadwarp.values import SpadwarpWarning

BIN = 100e-12
LASER = Laser(repetition_rate=20e6, pulse_fwhm_ps=85.0)  # period 50 ns: 500 bins
AXIS = {"gate_start": 0.0, "bin_width": BIN, "laser": LASER}
SHARP = InstrumentResponse()


def light(*, bins=500, image=(2, 3), **signals):
    """Expected detections: `at_N` of them in bin N."""
    cube = np.zeros((*image, bins))
    for place, signal in signals.items():
        cube[..., int(place.removeprefix("at_"))] = signal
    return cube


def frames_of(cube, pulses, *, seed=1, detector=None, device="cpu", **options):
    """Frames of a detector without dark counts; `detector` changes others of its fields."""
    fields = {"dark_count_rate": 0.0, **(detector or {})}
    return detect(cube, pulses=pulses, seed=seed, detector=Detector(**fields), device=device, **{**AXIS, **options})


def test_counts_follow_the_expected_detections():
    found = frames_of(light(at_200=0.05), 100_000, frames=3)
    assert found.counts.shape == (3, 2, 3, 500) and found.counts.dtype == np.int32
    expected = 100_000 * -np.expm1(-0.05)
    assert np.abs(found.intensity - expected).max() < 4.5 * np.sqrt(expected)
    mean = found.arrival_time("centroid") - 200.5 * BIN
    sigma = found.irf.sigma / np.sqrt(expected)
    # Pile-up takes photons from the end of the pulse: with α = 0.05 the mean moves by −α σ / (2 √π).
    assert abs(mean.mean() + 0.05 * found.irf.sigma / (2 * np.sqrt(np.pi))) < 4 * sigma / np.sqrt(18) + 0.02 * BIN
    assert frames_of(light(at_10=0.05), 20_000, detector={"max_count": 255}).counts.max() == 255


def test_one_seed_one_frame_one_answer():
    cube = light(at_100=0.5)

    def counts(source=cube, seed=9, frames=4, **options):
        return detect(source, pulses=300, seed=seed, frames=frames, **AXIS, **{"device": "cpu", **options}).counts

    found = counts()
    np.testing.assert_array_equal(counts(frames=1, first_frame=2)[0], found[2])
    np.testing.assert_array_equal(counts(summed=True), found.sum(0))
    np.testing.assert_array_equal(counts(wp.array(cube, dtype=wp.float64, device="cpu"), device=None), found)
    assert (counts(seed=10) != found).any()


def test_light_comes_in_the_window_of_the_pulse_that_it_meets():
    """At 20 MHz light after 73 ns appears at 23 ns; a window after the second pulse holds the light of three."""
    cube = light(at_730=0.05, at_20=0.03, bins=1000)
    for wrap, bins, times in ((True, 500, {23.05e-9: None, 2.05e-9: (0.0, 10e-9)}), (False, 1000, {73.05e-9: None})):
        found = frames_of(cube, 50_000, seed=2, detector={"wrap": wrap})
        assert found.counts.shape[-1] == bins and found.period == (pytest.approx(50e-9) if wrap else None)
        for time, gate in times.items():
            np.testing.assert_allclose(found.arrival_time("matched", gate=gate), time, atol=BIN / 4)
    cube = light(at_1360=0.05, at_860=0.02, at_360=0.01, bins=1500)
    found = frames_of(cube, 200_000, seed=3, window=(126e-9, 200))
    expected = 200_000 * -np.expm1(-0.08)
    assert abs(found.intensity.mean() - expected) < 4 * np.sqrt(expected / 6) and found.notes == ()
    np.testing.assert_allclose(found.arrival_time("matched"), 136.05e-9, atol=BIN / 4)


@pytest.mark.parametrize(
    ("start", "bins", "wrap", "is_noted"),
    [(120e-9, 500, True, True), (120e-9, 500, False, False), (10e-9, 50, True, False)],  # wraps to after the window
)
def test_light_that_the_source_does_not_hold_is_noted(start, bins, wrap, is_noted):
    notes = frames_of(light(at_10=0.05, bins=bins), 10, gate_start=start, detector={"wrap": wrap}).notes
    assert "120 ns" in notes[0] if is_noted else notes == ()


def test_dark_counts_and_ambient_light_are_the_background():
    image, exposure = (20, 30), 20_000 * 50e-9
    noise = {"dark_count_rate": 1e5, "dark_count_spread": 0.4, "ambient_rate": 2e5}
    noise |= {"hot_pixel_fraction": 0.1, "hot_pixel_rate": 3e6}
    found, again = (frames_of(np.zeros((*image, 500)), 20_000, seed=seed, detector=noise) for seed in (4, 5))
    assert found.background.shape == (*image, 1)
    rate = found.background.sum(axis=-1, dtype=np.float64) * 500 * 20_000 / exposure
    piled = 20_000 * -np.expm1(-rate * 50e-9)
    assert np.abs((found.intensity[0] - piled) / np.sqrt(piled)).max() < 5
    hot = rate > 2e6
    assert 0.04 < hot.mean() < 0.18 and np.median(rate[~hot]) == pytest.approx(3e5, rel=0.05)
    np.testing.assert_array_equal(again.background, found.background)  # the camera keeps its pixels


def test_estimators_know_the_background():
    """A return on decaying backscatter: the likelihood meets the Cramér–Rao bound of the pulses that are left."""
    bins, image = 500, (24, 24)
    decay = 0.02 * np.exp(-np.arange(bins) / 40.0)
    delay = np.random.default_rng(0).integers(150, 420, image)
    cube = np.tile(decay, (*image, 1))
    np.put_along_axis(cube, delay[..., None], np.take_along_axis(cube, delay[..., None], -1) + 1e-2, -1)
    noisy = {"ambient_rate": 2e5, "jitter_fwhm_ps": 400.0}
    found = frames_of(cube, 10_000, seed=6, detector=noisy, background=np.tile(decay, (*image, 1)))
    likelihood, centroid = (
        found.arrival_time(method, undo_pile_up=True)[0] / BIN - delay - 0.5 for method in ("likelihood", "centroid")
    )
    every = found.arrival_time("matched", min_significance=0)  # blind to backscatter
    assert np.median(every[0] / BIN - delay) < -50
    assert np.abs(likelihood).max() < 5 and np.std(likelihood) < 0.9 * np.std(centroid[np.abs(centroid) < 20])
    width = found.irf.sigma / BIN
    t = np.arange(bins) - delay[..., None]
    shape = 1e-2 * np.exp(-0.5 * (t / width) ** 2) / (width * np.sqrt(2 * np.pi))
    hazard = shape + decay + 2e5 * BIN
    left = 10_000 * np.exp(-np.cumsum(hazard, axis=-1))
    bound = np.sqrt(np.mean(1 / np.sum(left * (shape * t / width**2) ** 2 / hazard, axis=-1)))
    assert abs(np.std(likelihood) / bound - 1) < 4 / np.sqrt(2 * likelihood.size)


def test_a_result_brings_its_own_axis_laser_detector_and_backscatter():
    one = make_scene(laser={"position": [0.1, 0.0, 0.0], "repetition_rate": 1e6, "pulse_fwhm_ps": 300.0})
    result = make_result(one)
    found = detect(result, pulses=1000, frames=20, seed=3, device="cpu")
    assert found.counts.shape == (20, *result.histogram.shape)
    assert (found.gate_start, found.bin_width) == (one.gate.start, one.gate.bin_width)
    assert found.irf.fwhm == pytest.approx(np.hypot(300e-12, one.detector.jitter_fwhm_ps * 1e-12))
    # Shot noise about the result's own numbers; dark counts are nothing here, and the gate's ends cut 0.3 % off.
    expected = 20_000 * -np.expm1(-result.detections.sum(axis=-1))
    assert abs(found.counts.sum() - expected.sum()) < 4 * np.sqrt(expected.sum()) + 0.003 * expected.sum()
    z = (found.intensity.sum(axis=0) - expected) / np.sqrt(expected)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / z.size)
    backscatter = result.component("backscatter").sum() * one.laser.photons_per_pulse * one.detector.pde
    assert found.background.sum() == pytest.approx(backscatter, rel=0.02)


def test_wide_bins_collect_more():
    widths = np.tile([0.5, 1.5], 250)
    dark = {"dark_count_rate": 1e6}
    found = frames_of(np.zeros((4, 4, 500)), 100_000, seed=9, detector=dark, tdc_widths=widths)
    law = found.coates()[0].mean(axis=(0, 1))
    assert law[0::2].mean() / law[1::2].mean() == pytest.approx(1 / 3, rel=0.02)
    assert found.edges[-1] == pytest.approx(50e-9) and np.allclose(np.diff(found.edges), widths * BIN)
    assert found.background.shape == (4, 4, 500)


@pytest.mark.parametrize(("window", "part"), [(None, 1.0), ((0, 250), 0.5)])
def test_free_running_detects_after_its_dead_time(window, part):
    """Also light outside the window, which fires unseen and blocks it as much."""
    rate = 4e7
    detector = {"mode": "free_running", "dead_time_ns": 35.0}
    found = frames_of(np.full((3, 3, 500), rate * BIN), 50_000, seed=10, detector=detector, irf=SHARP, window=window)
    assert found.intensity.mean() / (rate / (1 + rate * 35e-9) * 50_000 * 50e-9) == pytest.approx(part, abs=0.005)


def test_afterpulsing_adds_counts():
    detector = {"afterpulsing_probability": 0.1, "afterpulsing_time_constant_ns": 10.0, "dead_time_ns": 5.0}
    free, gated = (
        frames_of(light(at_50=0.01), 400_000, seed=11, detector={**detector, "mode": mode})
        for mode in ("free_running", "first_photon")
    )
    primaries = 6 * 400_000 * 0.01
    assert abs(free.intensity.sum() / (primaries / 0.9) - 1) < 4 / np.sqrt(primaries) + 0.02
    # First photon: of what is trapped e^(−45 ns / 10 ns) comes out in the next window, 5 ns of them dead.
    assert gated.counts[..., 100:].sum() / gated.counts[..., :100].sum() < 0.1 * np.exp(-4.0)
    assert gated.intensity.sum() > primaries * 0.99


REFUSED = {
    r"source holds a negative or non-finite value in pixel \(0, 0\)": {"source": np.full((2, 2, 5), -1.0)},
    r"source has shape \(2, 5\)": {"source": np.zeros((2, 5))},
    "gate_start and bin_width are for arrays": {"source": SimpleNamespace(scene=object())},
    "laser is missing": {"laser": None},
    r"background has shape \(2, 2, 5\)": {"background": np.zeros((2, 2, 5))},
    "pulses · frames": {"pulses": 2**30, "frames": 4, "summed": True},
    "gate_start or bin_width is missing": {"gate_start": None},
    r"tdc_widths has shape \(1,\)": {"tdc_widths": [1.0]},
}


@pytest.mark.parametrize("match", REFUSED)
def test_wrong_input_is_named(match):
    call = {"source": light(at_3=0.05), "pulses": 10, "seed": 1, "device": "cpu", **AXIS, **REFUSED[match]}
    with pytest.raises(ValueError, match=match):
        detect(call.pop("source"), **call)


@pytest.mark.parametrize(
    ("counts", "pulses", "match"),
    [
        ([[3, 4]], 5, "pulses = 5 is below the 7 counts"),
        (np.full((1, 64), 2**62), 50, "counts = 4611686018427387904 is above"),
    ],
)
def test_wrong_counts_are_named(counts, pulses, match):
    with pytest.raises(ValueError, match=match):
        coates(np.array(counts), pulses=pulses)
    with pytest.raises(ValueError, match="hazard holds a negative"):
        first_photon_probabilities(np.array([[0.1, -0.2]]))


WEAK = Laser(pulse_energy=1e-15)  # far from pile-up


def test_a_warning_with_numbers_or_a_note_that_nobody_knows(whole):
    keywords = {"laser": WEAK, "seed": 1, "device": "cpu"}
    with pytest.warns(SpadwarpWarning, match="not enough photons: .* photons instead of") as caught:
        frames = spadwarp.detect(whole, pulses=10**8, **keywords)
    assert len(caught) == 1 and frames.notes == ()
    alone = dataclasses.replace(whole, second_moment=None, batch_size=0, batches=0)
    with warnings.catch_warnings(action="error"):
        quiet, unknown = (spadwarp.detect(run, pulses=1000, **keywords) for run in (whole, alone))
    assert quiet.notes == () and "simulation is not known" in unknown.notes[0]


def test_slopes_of_a_receiver_with_crosstalk_are_differences_of_its_rates():
    """By the light, and by the noise that all pixels share; weak light, of which every detection may leak."""
    rows = np.full((12, 8), 1e-5, np.float32)

    def receiver(ambient):
        detector = Detector(crosstalk_probability=0.05, dark_count_rate=0.0)
        return Receiver.of(detector, LASER, shape=(3, 4, 8), axis=(0.0, 1e-9), device="cpu", ambient=ambient)

    def rates(of, factor=1.0):
        return of.hazard(wp.array(factor * rows, device="cpu", dtype=float)).numpy()

    here = receiver(2e3)
    np.testing.assert_allclose(here.noise_slope().numpy(), (rates(receiver(3e3)) - rates(here)) / 1e3, rtol=2e-3)
    slope = here.slope(wp.array(rows, device="cpu")).numpy()
    np.testing.assert_allclose(slope, 2.0 * (rates(here, 1.5) - rates(here)), rtol=2e-3)


# The file of frames


def test_a_file_holds_what_detect_draws_and_says_what_it_has_not(tmp_path):
    result, options = make_result(make_scene(width=6, height=4)), {"pulses": 1000, "frames": 3, "seed": 2**64 - 1}
    path, methods = tmp_path / "frames.h5", ("centroid", "peak")
    assert record_frames(result, path, **options, methods=methods, device="cpu").file.path == path
    file, frames = FramesFile.load(path), spadwarp.detect(result, **options, device="cpu")
    assert np.array_equal(file.counts(), frames.counts) and np.array_equal(file.counts(2), frames.counts[2])
    assert np.array_equal(file.intensity(), frames.intensity)
    for name in ("expected", "background", "edges"):
        assert np.array_equal(getattr(file, name), getattr(frames, name)), name
    for name in ("pulses", "frames", "seed", "gate_start", "bin_width", "period"):
        assert getattr(file, name) == getattr(frames, name), name
    assert file.irf.fwhm == frames.irf.fwhm and file.scene == result.scene
    assert set(file.methods) == {"centroid", "peak"} and file.best_method == "centroid"
    assert file.depth("peak", 1).shape == (4, 6) and np.isfinite(file.depth("peak")).any()
    with pytest.raises(spadwarp.ArgumentError, match=r"frame = 3 is outside \[0, 3\), the frames of .*frames.h5"):
        file.counts(3)
    with h5py.File(path, "r+") as stored:
        stored.attrs["format_version"] = 99
    with pytest.raises(spadwarp.FileError, match="format version 99 is newer"):
        FramesFile.load(path)
