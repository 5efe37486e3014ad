"""Frames on disk: what is written is read back."""

import h5py
import numpy as np
import pytest

import spadwarp
from helpers.synthetic_result import make_result, make_scene
from spadwarp.frames import FramesFile, record_frames


@pytest.fixture(scope="module")
def result():
    return make_result(make_scene(width=6, height=4))


@pytest.fixture
def path(result, tmp_path):
    options = {"pulses": 1000, "frames": 3, "seed": 2**64 - 1, "methods": ("centroid", "peak"), "device": "cpu"}
    return record_frames(result, tmp_path / "frames.h5", **options).file.path


def test_a_file_holds_what_detect_draws(result, path):
    file = FramesFile.load(path)
    frames = spadwarp.detect(result, pulses=1000, frames=3, seed=2**64 - 1, device="cpu")
    assert np.array_equal(file.counts(), frames.counts) and np.array_equal(file.counts(2), frames.counts[2])
    assert np.array_equal(file.intensity(), frames.intensity)
    for name in ("expected", "background", "edges"):
        assert np.array_equal(getattr(file, name), getattr(frames, name)), name
    for name in ("pulses", "frames", "seed", "gate_start", "bin_width", "period"):
        assert getattr(file, name) == getattr(frames, name), name
    assert file.irf.fwhm == frames.irf.fwhm and file.scene == result.scene
    assert set(file.methods) == {"centroid", "peak"} and file.best_method == "centroid"
    assert file.depth("peak", 1).shape == (4, 6) and np.isfinite(file.depth("peak")).any()


def test_what_cannot_be_read_is_named(path):
    with pytest.raises(spadwarp.ArgumentError, match=r"frame = 3 is outside \[0, 3\), the frames of .*frames.h5"):
        FramesFile.load(path).counts(3)
    with h5py.File(path, "r+") as file:
        file.attrs["format_version"] = 99
    with pytest.raises(spadwarp.FileError, match="format version 99 is newer"):
        FramesFile.load(path)
