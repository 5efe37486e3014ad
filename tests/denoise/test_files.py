"""Denoising of files: what is read of each kind, the gate that a user gives, and what is noted."""

import json
import re
import sys

import h5py
import numpy as np
import pytest
from scipy.io import savemat

from helpers.cli import run
from helpers.datasets import make, recipe
from helpers.stepped_frames import noisy_frame, scene
from spadwarp import ArgumentError, FileError, SpadwarpError, SpadwarpWarning
from spadwarp.dataset import FrameReader
from spadwarp.denoise import denoise_file, files
from spadwarp.denoise.files import read_depth
from spadwarp.frames import instrument_response
from spadwarp.io.arrays import write_exr
from spadwarp.values import range_from_time

BIN = 80e-12
KNOWN = {"bin_width": BIN, "gate_start": 0.0, "group_index": 1.0}
METRES = BIN * 299_792_458 / 2  # of a bin


def response(fwhm):
    return {"irf": instrument_response(pulse_fwhm=0.0, jitter_fwhm=fwhm)}


def saved(folder, values):
    np.save(folder / "one.npy", values)
    return folder / "one.npy", folder / "out"


def test_files_of_every_kind(tmp_path):
    noisy = noisy_frame(np.nan_to_num(scene(), nan=15.0))
    path, out = saved(tmp_path, noisy)
    write_exr(tmp_path / "engine.exr", {"A": np.ascontiguousarray(100.0 * noisy)})
    savemat(tmp_path / "matlab.mat", {"depth": noisy, "name": "a text", "scalar": 3.0})
    np.savez(tmp_path / "numbers.npz", depth=noisy)
    common = ["--model", "median", "--gate", "13.5:16", "--out", out]
    run("denoise", tmp_path / "engine.exr", "--input", "scale=0.01", *common)
    run("denoise", tmp_path / "matlab.mat", *common, "--overwrite")
    run("denoise", tmp_path / "numbers.npz", *common, "--overwrite")
    run("denoise", path, "--json", tmp_path / "one.json", *common, "--overwrite")
    for name in ("engine", "matlab", "numbers"):
        assert np.nanmax(np.abs(np.load(out / f"{name}.npy") - np.load(out / "one.npy"))) < 1e-4
    assert (out / "one.png").stat().st_size > 10_000
    assert json.loads((tmp_path / "one.json").read_text())["files"][0]["gate"] == [13.5, 16.0]


def test_the_only_array_of_a_file_needs_no_name(tmp_path):
    noisy = noisy_frame(scene())
    several, flags = np.stack([noisy, noisy]), np.ones(noisy.shape, np.uint8)
    for name, arrays in {
        "one": {"camera/depth": noisy, "exposure": 3.0},
        "two": {"depth": noisy, "flags": flags},
        "frames": {"depth": several, "flags": flags},
        "none": {"exposure": np.ones(4)},
    }.items():
        with h5py.File(tmp_path / f"{name}.h5", "w") as file:
            file.update(arrays)
    for name, options, depth in (("one", {}, noisy[None]), ("two", {"dataset": "depth"}, noisy[None])):
        np.testing.assert_array_equal(read_depth(tmp_path / f"{name}.h5", **options).depth, depth)
    assert read_depth(tmp_path / "frames.h5", as_depth=True).depth.shape == several.shape
    with pytest.raises(FileError, match=r"none.h5: no array of 3 or 4 dimensions; it holds exposure \(4,\)"):
        read_depth(tmp_path / "none.h5")
    out = tmp_path / "new" / "out"
    output = run("denoise", tmp_path / "two.h5", "--model", "median", "--out", out, code=2).output
    assert output.count("two.h5") == 1 and "(dataset); the file holds depth (" in output and not out.parent.exists()
    run("denoise", tmp_path / "one.h5", "--model", "median", "--out", out)
    output = run("depth", tmp_path / "one.h5", "--out", tmp_path / "depth", code=1).output
    assert re.search(r"no array of 3 or 4 dimensions; it holds .*camera/depth \(48, 64\)", output)


def test_of_several_images_the_largest_is_named_and_equals_are_refused(tmp_path):
    """A camera matrix beside the depth does no harm; of depth and intensity of one size, nobody can know."""
    depth = np.random.default_rng(1).uniform(3.0, 4.0, (20, 30))
    savemat(tmp_path / "one.mat", {"K": np.eye(3), "depth": depth})
    savemat(tmp_path / "two.mat", {"depth": depth, "intensity": depth, "K": np.eye(3)})
    found = read_depth(tmp_path / "one.mat")
    assert found.source == "depth as it is: depth, not K" and found.depth[0] == pytest.approx(depth, rel=1e-6)
    listed = r"depth \(20, 30\), intensity \(20, 30\), K \(3, 3\)"
    with pytest.raises(ArgumentError, match=rf"dataset is missing \(dataset\); the file holds {listed}"):
        read_depth(tmp_path / "two.mat")
    assert read_depth(tmp_path / "two.mat", dataset="depth").source == "depth as it is"


def test_a_folder_is_denoised_file_by_file(tmp_path):
    folder = tmp_path / "in"
    folder.mkdir()
    for name in ("first", "second"):
        np.save(folder / f"{name}.npy", noisy_frame(scene()))
    (folder / "bad.npy").write_bytes(b"junk")
    output = run("denoise", folder, "--model", "median", "--out", tmp_path / "out", code=1).output
    assert "1 of 3 files could not be denoised" in output
    found = {path.stem for path in (tmp_path / "out").glob("*.npy")}
    assert found == {stem + part for stem in ("first", "second") for part in ("", "_target", "_confidence")}


def test_histograms_become_depth_first(tmp_path):
    """Gaussian returns at 2.0 m of water in bins of 100 ps."""
    index, speed = 1.3566, 299_792_458 / 1.3566
    arrivals = np.random.default_rng(5).normal(4.0 / speed, 150e-12, (32, 32, 50))
    edges = np.arange(257) * 100e-12 + 10e-9
    counts = np.apply_along_axis(lambda one: np.histogram(one, edges)[0], -1, arrivals)
    path, out = saved(tmp_path, counts.astype(np.uint16))
    found = denoise_file(path, out, model="median", bin_width=100e-12, gate_start=10e-9, group_index=index)
    assert abs(np.median(found.depth) - 2.0) < 0.005
    assert found.gate == pytest.approx((speed / 2 * 10e-9, speed / 2 * 35.6e-9))
    facts = {"bin_width": 100e-12, "gate_start": 10e-9, "group_index": index, "horizontal_fov_deg": 60.0}
    seen = denoise_file(path, tmp_path / "seen", model="pooled", **response(350e-12), **facts)  # planar: z of a sphere
    tangent = np.tan(np.radians(30.0)) * 2**0.5 * np.array([15.5, 0.5]) / 16
    assert seen.depth[0, [0, 16], [0, 16]] == pytest.approx(2.0 / np.hypot(1.0, tangent), rel=0.01)
    with pytest.raises(ArgumentError, match="another is needed"):
        denoise_file(path, tmp_path)
    with pytest.raises(ArgumentError, match="bin width is missing"):
        read_depth(path, group_index=index, gate_start=0.0)


def test_open_water_has_no_target_whether_the_response_is_known_or_not(tmp_path):
    path, out = saved(tmp_path, np.random.default_rng(3).poisson(0.05, (16, 16, 128)).astype(np.uint16))
    for given in ({}, response(350e-12)):
        assert not (denoise_file(path, out, **given, **KNOWN).target_probability > 0.08).any()


def test_depth_in_millimetres_is_warned_of(tmp_path):
    path, _ = saved(tmp_path, np.full((16, 16), 14_800.0, np.float32))
    with pytest.warns(SpadwarpWarning, match=r"depths of 1.48e\+04 m; no light comes back so far"):
        read_depth(path)


def test_a_peak_before_the_pulse_is_no_depth(tmp_path):
    """Noise in the first bin of a gate that opens with the pulse: its centre may lie before it."""
    counts = np.random.default_rng(2).poisson(0.05, (16, 16, 128)).astype(np.uint16)
    counts[..., 60:63] += 3
    counts[4, 5], counts[4, 5, 0] = 0, 30
    found = denoise_file(*saved(tmp_path, counts), **response(350e-12), **KNOWN)
    assert np.median(found.depth) == pytest.approx(61.5 * METRES, abs=0.01)


def test_a_gate_without_any_depth_is_refused(tmp_path):
    path, out = saved(tmp_path, np.full((16, 16), 15.0, np.float32))
    with pytest.raises(ArgumentError, match=r"gate = \(2, 3\) m holds none of the depths of the file, 15 to 15 m"):
        denoise_file(path, out, gate=(2.0, 3.0), model="median")
    with pytest.raises(ArgumentError, match="a gate in time of flight needs a group index"):
        denoise_file(path, out, gate_time=(1e-8, 2e-8), model="median")
    assert not out.exists()
    saved(tmp_path, np.full((16, 16), np.nan, np.float32))  # nothing reported: stays empty
    assert np.isnan(denoise_file(path, out, gate=(2.0, 3.0), model="median").depth).all()


@pytest.mark.parametrize("model", ["pooled", "pyramid", "median"])
def test_of_histograms_only_the_bins_within_the_gate_count(model, tmp_path, monkeypatch):
    """A return in bin 150, behind a stronger one in bin 60; depth is estimated once, from the 120 bins of the gate."""
    counts = np.random.default_rng(2).poisson(0.02, (16, 16, 256)).astype(np.uint16)
    counts[..., 59:62] += 5
    counts[..., 149:152] += 2
    estimated, depth_of = [], files.depth_of
    monkeypatch.setattr(files, "depth_of", lambda held, **rest: estimated.append(held) or depth_of(held, **rest))
    path, out = saved(tmp_path, counts)
    options = {"model": model, "device": "cpu", **response(200e-12), **KNOWN}
    gate = (100 * METRES, 220 * METRES)
    found = denoise_file(path, out, gate=gate, **options)
    assert found.depth == pytest.approx(150.5 * METRES, abs=0.3 * METRES) and found.gate == gate
    assert [held.values.shape for held in estimated] == [(16, 16, 120)]
    in_time = denoise_file(path, tmp_path / "time", gate_time=(100 * BIN, 220 * BIN), **options)
    assert in_time.depth == pytest.approx(found.depth, rel=1e-6) and in_time.gate == pytest.approx(gate)
    for wrong, problem in (((30.0, 32.0), "outside the histograms, 0 to 3.07"), ((1.0, 0.5), "gate = "), (3.0, "gate")):
        with pytest.raises(ArgumentError, match=problem):
            denoise_file(path, out, gate=wrong, **options)


def test_dim_pixels_of_expected_light_are_noted(tmp_path):
    """Columns beside a target that receive 1 % of its light, at the same time of flight."""
    rates = np.full((16, 16, 64), 1e-6)
    rates[..., 30:33] += np.where(np.arange(16) < 4, 0.01, 1.0)[:, None]
    for values, is_noted in ((rates, True), (rates[:, 4:], False)):
        found = denoise_file(*saved(tmp_path, values), model="median", **response(200e-12), **KNOWN)
        assert ("25 % of the pixels receive less than 5 % of the light" in found.notes[0]) == is_noted
        assert ("of the light" in found.notes[0]) == is_noted


def test_histograms_of_a_dataset_are_not_used_and_it_is_said_why(tmp_path):
    few = {"targets.builtin": ["staircase"], "targets.test": [], "targets.validation": [], "gate.bins": 32}
    few |= {"scene.camera.width": 12, "scene.camera.height": 8, "scenes_per_target": 1, "frames.per_scene": 2}
    make(recipe(**few, **{"monte_carlo.share": 1.0, "monte_carlo.photons": 5_000}), tmp_path / "set")
    stored = [item["noisy"][0] for item in FrameReader(tmp_path / "set", "all")]
    for name in ("histograms-00000.h5", "frames-00000.h5"):
        found = denoise_file(tmp_path / "set" / name, tmp_path / "out", model="median", device="cpu")
        assert "histograms are not used, since a dataset does not keep their background" in found.notes[0]
        assert np.array_equal(read_depth(tmp_path / "set" / name).depth, stored, equal_nan=True)
    index, times = FrameReader(tmp_path / "set", "all").scene(0).medium.group_index, (1.3e-7, 1.5e-7)
    gate = read_depth(tmp_path / "set" / "frames-00000.h5", gate_time=times).gate
    assert gate == pytest.approx([range_from_time(time, index) for time in times])


def test_what_cannot_be_read(tmp_path):
    (tmp_path / "empty").mkdir()
    (tmp_path / "bad.npy").write_bytes(b"junk")
    (tmp_path / "text.txt").write_text("1")
    np.save(tmp_path / "complex.npy", np.full((16, 16), 15.0 + 1.0j))
    savemat(tmp_path / "scalar.mat", {"scalar": 3.0})
    for name, message in {
        "none.npy": "no such file",
        "bad.npy": "damaged",
        "complex.npy": r"complex128 \(16, 16\); depth is real numbers",
        "text.txt": r"'.txt' is not one of",
        "scalar.mat": r"no array of 3 or 4 dimensions, sparse matrix or cells; it holds scalar \(1, 1\)",
    }.items():
        with pytest.raises(FileError, match=message):
            read_depth(tmp_path / name)
    with pytest.raises(FileError, match="no file that ends in"):
        files.depth_files(tmp_path / "empty")


def test_a_package_that_is_missing_is_named_before_anything_is_read(tmp_path, monkeypatch):
    monkeypatch.setitem(sys.modules, "safetensors", None)
    with pytest.raises(SpadwarpError, match="denoising needs safetensors: pip install"):
        denoise_file(tmp_path / "none.npy", tmp_path / "out")


def test_depths_below_zero_count_as_not_reported(tmp_path):
    marked = read_depth(saved(tmp_path, np.where(np.eye(16) > 0, -1.0, 15.0))[0])
    assert "16 values below 0" in marked.source and np.isnan(marked.depth).sum() == 16
