"""Depth of counts only where something was detected: frames, files and measured histograms."""

import numpy as np
import pytest

import spadwarp
from spadwarp.frames import depth_of, read_histograms
from spadwarp.scene import Detector, Laser

BIN, BINS, IMAGE = 1e-10, 200, (60, 80)
METHODS = ("peak", "centroid", "matched", "likelihood")
IRF = spadwarp.frames.InstrumentResponse(sigma=130e-12)
CALL = {"gate_start": 0.0, "bin_width": BIN, "device": "cpu"}


def within(number, expected):
    """4 standard errors, and a tenth by which a bound may be above."""
    return 0.9 * expected - 4.0 * np.sqrt(expected) < number < expected + 4.0 * np.sqrt(expected)


def empty(mode, **options):
    detector = {"dark_count_rate": 3e3, "jitter_fwhm_ps": 300.0, "mode": mode, "wrap": False, **options}
    backscatter = np.broadcast_to(2e-2 * np.exp(-np.arange(BINS) / 30.0) / 30.0, (*IMAGE, BINS))
    exposure = {"pulses": 5000, "frames": 4, "seed": 5, "detector": Detector(**detector), "laser": Laser()}
    return spadwarp.detect(backscatter, background=backscatter, **exposure, **CALL)


@pytest.mark.parametrize("mode", ["first_photon", pytest.param("free_running", marks=pytest.mark.slow)])
def test_frames_of_empty_water(mode):
    """One false alarm in 20 pixels was asked for."""
    frames, least = empty(mode), -np.log10(0.05)
    found = np.empty(frames.counts.shape[:3], np.float32)
    for method in METHODS:
        time = frames.arrival_time(method, min_significance=least, significance=found, device="cpu")
        np.testing.assert_array_equal(np.isfinite(time), found >= least)
    assert within(np.isfinite(time).sum(), 0.05 * time.size)
    assert np.isfinite(frames.arrival_time("centroid", min_significance=0, device="cpu")).mean() > 0.99
    corrected = frames.arrival_time("centroid", undo_pile_up=True, min_significance=least, device="cpu")
    np.testing.assert_array_equal(np.isnan(corrected), np.isnan(time))


@pytest.mark.parametrize(
    ("mode", "wrap"),
    [
        ("first_photon", True),
        ("free_running", False),
        pytest.param("first_photon", False, marks=pytest.mark.slow),
        pytest.param("free_running", True, marks=pytest.mark.slow),
    ],
)
def test_the_background_has_its_own_crosstalk_and_afterpulses(mode, wrap):
    """Counts of dark pixels, corrected for pile-up or with little of it, have the mean and the alarms of it."""
    effects = {"crosstalk_probability": 0.03, "afterpulsing_probability": 0.2, "dead_time_ns": 5.0}
    frames = empty(mode, **effects, dark_count_rate=2e5, afterpulsing_time_constant_ns=15.0, wrap=wrap)
    seen = (frames.coates() if mode == "first_photon" else frames.counts / frames.pulses).mean(axis=(0, 1, 2))
    known = frames.background.mean(axis=(0, 1))
    error = np.sqrt(known.reshape(4, -1).sum(axis=1) / (frames.pulses * frames.counts[..., 0].size))
    difference = seen.reshape(4, -1).sum(axis=1) - known.reshape(4, -1).sum(axis=1)
    slack = 0.0 if mode == "first_photon" else 1e-2 * known.sum()  # lost in dead times
    assert (np.abs(difference) < 4.5 * error + slack).all(), difference / error
    assert known.sum() > 1.01 * frames.expected.mean(axis=(0, 1)).sum()
    found = np.empty(frames.counts.shape[:3], np.float32)
    frames.arrival_time("peak", significance=found, device="cpu")
    assert within((found >= 2.0).sum(), 0.01 * found.size)


def test_counts_without_a_known_background(tmp_path):
    """Its shape is that of all pixels; a wall in front of all of them is none of it."""
    counts = empty("first_photon").counts
    np.save(tmp_path / "water.npy", counts)
    histograms = read_histograms(tmp_path / "water.npy", bin_width=BIN, gate_start=0.0, irf=IRF, axes="nyxt")
    for method in METHODS:
        reduced = depth_of(histograms, method=method, group_index=1.35, min_significance=2.0, device="cpu")
        assert np.isfinite(reduced.values).sum() < 1.3 * 0.01 * counts[..., 0].size
        assert (reduced.significance.shape, reduced.significance.dtype) == (counts.shape[:3], np.float32)
    assert within((reduced.significance >= 2.0).sum(), 0.01 * counts[..., 0].size)
    counts = counts.copy()
    counts[..., 120:123] += np.random.default_rng(8).poisson([5.0, 10.0, 5.0], (*counts.shape[:3], 3)).astype(np.int32)
    seen = spadwarp.arrival_time(counts, irf=histograms.irf, **CALL)
    assert np.isfinite(seen).mean() > 0.99 and np.nanmax(np.abs(seen / BIN - 121.5)) < 5


def test_the_papers_detector_reports_every_pixel():
    assert Detector(preset="lu2024").min_significance == 0.0 and Detector().min_significance == 4.0
    with pytest.raises(spadwarp.SpadwarpError, match="needs counts, integers"):
        spadwarp.arrival_time(np.ones((2, 2, 8)), min_significance=4.0, **CALL)
