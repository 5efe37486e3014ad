"""`detect` and `depth`: counts and depth are those of Python."""

import h5py
import numpy as np
import pytest
import trimesh

import spadwarp
from helpers.cli import DEVICE, run, tables
from spadwarp.io.arrays import read_exr

# The shared run has few photons on purpose.
pytestmark = pytest.mark.filterwarnings("ignore:not enough photons")


@pytest.mark.slow
def test_frames_are_those_of_detect(done, tmp_path, monkeypatch):
    """Drawn one by one as where they are many."""
    monkeypatch.setattr("spadwarp.frames.file._PART_BYTES", 1)
    out = tmp_path / "out"
    options = ("--pulses", "2e3", "--frames", 3, "--seed", 5, "--tags", *DEVICE)
    printed = run("detect", done, "--out", out, *options, "--json", tmp_path / "printed.json")
    result = spadwarp.load(done / "result.h5")
    twin = spadwarp.detect(result, pulses=2000, frames=3, seed=5, tags=True, device="cpu")
    with h5py.File(out / "frames.h5") as file:
        assert np.array_equal(file["counts"], twin.counts)
        assert np.array_equal(file["intensity"], twin.intensity)
        assert np.array_equal(file["tags/bin"], twin.tags.bin) and np.array_equal(file["tags/y"], twin.tags.y)
        assert np.array_equal(file["bound/time"], spadwarp.crlb(result, pulses=2000, device="cpu"), equal_nan=True)
        assert sorted(file["depth"]) == ["centroid", "likelihood", "matched", "peak"]
        depth, bound, matched = (file[name][...] for name in ("depth/likelihood", "bound/depth", "depth/matched"))
    recorded = spadwarp.load(out)
    assert np.array_equal(recorded.frame(2).counts[0], twin.counts[2]) and recorded.plot(2).axes
    assert (out / "frame.png").read_bytes().startswith(b"\x89PNG")
    error = np.abs(depth[0].astype(float) - result.truth.depth)
    # No estimator beats its bound; this one comes near it: 20 pixels, bins of 15 mm, light that was scattered forward.
    assert 0.3 * np.median(bound) < np.median(error) < 10 * np.median(bound)
    plain = tables(tmp_path / "printed.json")
    assert plain["depth"]["likelihood"]["median"] == pytest.approx(np.median(error), rel=1e-3)
    assert printed.stderr.count("not enough photons: the simulation's noise shows") == 1
    assert plain["noise_ratio"] > 0.1
    assert printed.stdout.count("estimate fraction") == 4

    # `depth` of frames knows their response.
    run("depth", out, "--out", tmp_path / "again", "--method", "matched", *DEVICE)
    assert np.allclose(np.load(tmp_path / "again" / "depth.npy"), matched, rtol=1e-5, equal_nan=True)


def test_frames_without_a_detection(done, tmp_path):
    options = ("--pulses", 1, "--method", "peak", *DEVICE, "--set", "detector.pdp=1e-9")
    printed = run("detect", done, "--out", tmp_path, *options, "--json", tmp_path / "printed.json")
    assert list(spadwarp.load(tmp_path).methods) == ["peak"]
    assert "estimate fraction 0" in printed.stdout and "nan" not in printed.stdout
    assert tables(tmp_path / "printed.json")["depth"]["peak"]["median"] is None


def test_the_detector_can_be_another(done, tmp_path):
    bright = ("--set", "laser.pulse_energy=1e-6", *DEVICE)
    assert "warning: pile-up: " in run("detect", done, "--out", tmp_path / "bright", *bright).stderr
    dark = ("--set", "detector.dark_count_rate=1e7", "--set", "laser.pulse_energy=1e-20")
    options = (*dark, "--method", "peak", "--json", tmp_path / "dark.json", *DEVICE)
    piled = run("detect", done, "--out", tmp_path / "dark", *options).stderr
    assert "pile-up: " in piled and "less dark counts and ambient light" in piled  # of which no light of the laser is
    expected = -np.expm1(-1e7 * 150 * 100e-12)  # one count a pulse at most
    assert tables(tmp_path / "dark.json")["detections_per_pulse_and_pixel"] == pytest.approx(expected, rel=0.02)


def test_depth_of_a_result_is_that_of_python(done, tmp_path):
    out, points = tmp_path / "out", tmp_path / "points.ply"
    run("depth", done, "--out", out, "--background", 0, "--ply", points, "--quiet", *DEVICE)
    depth = spadwarp.load(done / "result.h5").depth(device="cpu")
    assert np.array_equal(np.load(out / "depth.npy"), depth.astype(np.float32), equal_nan=True)
    assert np.array_equal(read_exr(out / "depth.exr")[0]["Z"], depth.astype(np.float32), equal_nan=True)
    assert (out / "depth.png").is_file()
    assert np.allclose(trimesh.load(points).vertices[:, 2], depth[np.isfinite(depth)], rtol=1e-6)


def test_depth_of_measured_histograms(tmp_path):
    """A wall at 3 m in fresh water, whose pulses come back as a Gaussian."""
    index, width = 1.3566, 50e-12
    arrival = 2 * 3.0 * index / 299_792_458.0
    edges = np.arange(401) * width + 20e-9
    irf = spadwarp.frames.instrument_response(pulse_fwhm=0.0, jitter_fwhm=300e-12)
    expected = 4000 * np.diff(irf.cumulative(edges - arrival)) + 0.5
    counts = np.random.default_rng(1).poisson(expected, (3, 4, 400)).astype(np.uint16)
    np.save(tmp_path / "counts.npy", counts)
    facts = ["bin_width=50ps", "gate_start=20ns", f"group_index={index}", "irf=300ps"]
    bound = 300e-12 / 2.3548 / np.sqrt(4000) / arrival * 3.0  # [m], without background

    def depth(out, *options, facts=facts, code=0):
        words = ("--out", tmp_path / out, "--input", ",".join(facts), *options, "--quiet", *DEVICE)
        return run("depth", tmp_path / "counts.npy", *words, code=code).stderr

    for method in ("centroid", "matched", "likelihood"):
        depth(method, "--method", method)
        distance = np.load(tmp_path / method / "range.npy")
        assert np.abs(distance - 3.0).max() < (5 if method == "likelihood" else 40) * bound, method
        assert "Z" not in read_exr(tmp_path / method / "range.exr")[0]

    seen = ("--input", "horizontal_fov_deg=60", "--ply", tmp_path / "points.ply", "--json", tmp_path / "printed.json")
    depth("seen", *seen)
    printed = tables(tmp_path / "printed.json")
    assert printed["quantity"] == "depth" and printed["metres"]["min"] < printed["metres"]["median"] < 3
    centre = np.load(tmp_path / "seen" / "depth.npy")[1, 1]
    assert centre == pytest.approx(3.0 / np.sqrt(1 + 0.1443**2), rel=2e-3)  # half a pixel off the axis

    for given, words in ((facts[1:], "bin width"), (facts[:2], "group index"), (facts[:3], "instrument response")):
        assert words in depth("x", "--method", "matched", facts=given, code=2)
    assert "field of view" in depth("x", "--ply", tmp_path / "p.ply", code=2)
    assert "written as .ply" in depth("x", *seen[:2], "--ply", tmp_path / "p.txt", code=2)

    np.save(tmp_path / "counts.npy", np.stack([counts, 0 * counts, counts]))  # all frames count
    assert not depth("three", "--json", tmp_path / "three.json")
    assert tables(tmp_path / "three.json")["pixels_with_return"] == 24
