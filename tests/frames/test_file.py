"""Frames on disk: what is written is read back."""

import h5py
import numpy as np
import pytest

import spadwarp
from helpers.synthetic_result import make_result, make_scene
from spadwarp.frames import FramesFile, record_frames


def test_a_file_holds_what_detect_draws_and_says_what_it_has_not(tmp_path):
    result, options = make_result(make_scene(width=6, height=4)), {"pulses": 1000, "frames": 3, "seed": 2**64 - 1}
    path = record_frames(
        result, tmp_path / "frames.h5", **options, methods=("centroid", "peak"), device="cpu"
    ).file.path
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
