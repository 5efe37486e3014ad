"""What denoising of a file does with the gate that a user gives, and what it notes."""

import numpy as np
import pytest

pytest.importorskip("torch")
from helpers.datasets import make, recipe
from spadwarp.dataset import FrameReader
from spadwarp.denoise import denoise_file
from spadwarp.denoise.files import read_depth
from spadwarp.frames import instrument_response
from spadwarp.values import ArgumentError

BIN = 80e-12
KNOWN = {"bin_width": BIN, "gate_start": 0.0, "group_index": 1.0}
METRES = BIN * 299_792_458 / 2  # of a bin


def test_a_gate_without_any_depth_is_refused(tmp_path):
    np.save(tmp_path / "depth.npy", np.full((16, 16), 15.0, np.float32))
    with pytest.raises(ArgumentError, match=r"gate = \(2, 3\) m holds none of the depths of the file, 15 to 15 m"):
        denoise_file(tmp_path / "depth.npy", tmp_path / "out", gate=(2.0, 3.0), model="median")
    assert not (tmp_path / "out").exists()
    np.save(tmp_path / "depth.npy", np.full((16, 16), np.nan, np.float32))  # nothing reported: stays empty
    found = denoise_file(tmp_path / "depth.npy", tmp_path / "out", gate=(2.0, 3.0), model="median")
    assert np.isnan(found.depth).all()


@pytest.mark.parametrize("model", ["pooled", "pyramid", "median"])
def test_of_histograms_only_the_bins_within_the_gate_count(model, tmp_path):
    """A return in bin 150, behind a stronger one in bin 60; the gate is narrower than the histogram."""
    counts = np.random.default_rng(2).poisson(0.02, (16, 16, 256)).astype(np.uint16)
    counts[..., 59:62] += 5
    counts[..., 149:152] += 2
    np.save(tmp_path / "counts.npy", counts)
    response = instrument_response(pulse_fwhm=0.0, jitter_fwhm=200e-12)
    options = {"model": model, "irf": response, "device": "cpu", **KNOWN}
    gate = (100 * METRES, 220 * METRES)
    found = denoise_file(tmp_path / "counts.npy", tmp_path / "out", gate=gate, **options)
    assert found.depth == pytest.approx(150.5 * METRES, abs=0.3 * METRES)
    with pytest.raises(ArgumentError, match=r"outside the histograms, 0 to 3.07 m"):
        denoise_file(tmp_path / "counts.npy", tmp_path / "other", gate=(30.0, 32.0), **options)


def test_dim_pixels_of_expected_light_are_noted(tmp_path):
    """Columns beside a target that receive 1 % of its light, at the same time of flight."""
    rates = np.full((16, 16, 64), 1e-6)
    rates[..., 30:33] += np.where(np.arange(16) < 4, 0.01, 1.0)[:, None]
    np.save(tmp_path / "rates.npy", rates)
    options = {"model": "median", "irf": instrument_response(pulse_fwhm=0.0, jitter_fwhm=200e-12), **KNOWN}
    found = denoise_file(tmp_path / "rates.npy", tmp_path / "out", **options)
    assert "25 % of the pixels receive less than 5 % of the light" in found.notes[0]
    np.save(tmp_path / "rates.npy", rates[:, 4:])
    assert "of the light" not in denoise_file(tmp_path / "rates.npy", tmp_path / "out", **options).notes[0]


def test_histograms_of_a_dataset_are_not_used_and_it_is_said_why(tmp_path):
    traced = {"targets.builtin": ["staircase"], "targets.test": [], "targets.validation": [], "gate.bins": 32}
    traced |= {"scenes_per_target": 1, "monte_carlo.share": 1.0, "monte_carlo.photons": 20_000}
    make(recipe(**traced), tmp_path / "set")
    stored = [item["noisy"][0] for item in FrameReader(tmp_path / "set", "all")]
    for name in ("histograms-00000.h5", "frames-00000.h5"):
        found = denoise_file(tmp_path / "set" / name, tmp_path / "out", model="median", device="cpu")
        assert "histograms are not used, since a dataset does not keep their background" in found.notes[0]
        assert np.array_equal(read_depth(tmp_path / "set" / name).depth, stored, equal_nan=True)


def test_of_several_images_the_largest_is_named_and_equals_are_refused(tmp_path):
    """A camera matrix beside the depth does no harm; of depth and intensity of one size, nobody can know."""
    savemat = pytest.importorskip("scipy.io").savemat
    depth = np.random.default_rng(1).uniform(3.0, 4.0, (20, 30))
    savemat(tmp_path / "one.mat", {"K": np.eye(3), "depth": depth})
    found = read_depth(tmp_path / "one.mat")
    assert found.source == "depth as it is: depth, not K"
    assert found.depth[0] == pytest.approx(depth, rel=1e-6)
    savemat(tmp_path / "two.mat", {"depth": depth, "intensity": depth, "K": np.eye(3)})
    listed = r"depth \(20, 30\), intensity \(20, 30\), K \(3, 3\)"
    with pytest.raises(ArgumentError, match=rf"dataset is missing \(dataset\); the file holds {listed}"):
        read_depth(tmp_path / "two.mat")
    assert read_depth(tmp_path / "two.mat", dataset="depth").source == "depth as it is"
