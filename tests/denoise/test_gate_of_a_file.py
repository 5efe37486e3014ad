"""The gate that a user gives with a file."""

import numpy as np
import pytest

pytest.importorskip("torch")
from spadwarp.denoise import denoise_file
from spadwarp.errors import ArgumentError
from spadwarp.frames import instrument_response

BIN = 80e-12
KNOWN = {"bin_width": BIN, "gate_start": 0.0, "group_index": 1.0}
METRES = BIN * 299_792_458 / 2  # of a bin


def test_a_gate_without_any_depth_is_refused(tmp_path):
    np.save(tmp_path / "depth.npy", np.full((16, 16), 15.0, np.float32))
    with pytest.raises(ArgumentError, match=r"gate = \(2, 3\) m holds no depth of the file, which are 15 to 15 m"):
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
