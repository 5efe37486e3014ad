"""The command line beyond `simulate`: counts and depth, planning, adding runs up, validation, targets."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
from typer.testing import CliRunner

import spadwarp
from helpers.scenes import scene as make_scene
from spadwarp.cli import app
from spadwarp.io.exr import read_exr
from spadwarp.result.file import save_truth_maps

DEVICE = ("--device", "cpu")
# A laser in the lens, a gate that begins at 2 m of path and a response of some bins.
SECTIONS = {
    "laser": {"half_angle_deg": 20.0, "position": [-0.05, 0.0, 0.0], "pulse_energy": 1e-14, "repetition_rate": 1e7},
    "camera": {"width": 5, "height": 4, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.4},
    "gate": {"start_ns": 6.0, "bin_width_ps": 100.0, "bins": 150},
    "detector": {"dark_count_rate": 1e3, "pulses": 5000},
    "transport": {"photons": 20_000, "seed": 1, "max_collisions": 12},
}


def run(*arguments, code=0):
    """One command in this process; its result after its exit code was looked at."""
    outcome = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert outcome.exit_code == code, outcome.output
    return outcome


def tables(path):
    return json.loads(Path(path).read_text())


@pytest.fixture(scope="module")
def scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("scene") / "scene.toml"
    path.write_text(make_scene(**SECTIONS).to_toml())
    return path


@pytest.fixture(scope="module")
def done(scene):
    """The directory of a finished run."""
    out = scene.parent / "run"
    run("simulate", scene, "--out", out, "--quiet", "--uncertainty", *DEVICE)
    return out


# simulate, merge


def test_a_resumed_run_is_the_long_run(scene, tmp_path):
    """Also of one that stopped early because it was good enough."""
    out = tmp_path / "out"
    options = ("--relative-error", 0.3, "--photons", 200_000, "--quiet", *DEVICE)
    run("simulate", scene, "--out", out, *options, "--json", tmp_path / "first.json")
    first = spadwarp.load_result(out / "result.h5")
    assert 0 < tables(tmp_path / "first.json")["relative_error"] == first.relative_error <= 0.3
    assert first.photons < 200_000 and not first.partial

    total = 2 * first.photons
    told = run("simulate", "--resume", out, "--photons", total, *DEVICE)
    result = spadwarp.load_result(out / "result.h5")
    long = spadwarp.simulate(spadwarp.load_scene(scene), photons=total, device="cpu")
    assert np.array_equal(result.tallies, long.tallies) and result.ledger == long.ledger
    assert result.photons == total == spadwarp.load_scene(out / "scene.toml").transport.photons
    assert f"{100 * result.relative_error:.3g} % in the bins that decide the depth" in told.stdout


def test_merged_runs_are_one_run(scene, done, tmp_path):
    one, two, both = (tmp_path / name for name in ("one", "two", "both"))
    size = spadwarp.load_result(done / "result.h5").batch_size
    first, second = 16 * size, 16 * size
    for out, photons, start in ((one, first, 0), (two, second, first)):
        options = ("--photons", photons, "--first-photon", start, "--quiet", *DEVICE)
        run("simulate", scene, "--out", out, *options)
    told = run("merge", one, two / "result.h5", "--out", both, "--json", tmp_path / "both.json", *DEVICE)
    merged = spadwarp.load_result(both / "result.h5")
    long = spadwarp.simulate(spadwarp.load_scene(scene), photons=first + second, device="cpu")
    assert np.array_equal(merged.tallies, long.tallies) and merged.ledger == long.ledger
    assert tables(tmp_path / "both.json")["photon_ranges"] == [[0, first + second]]
    assert "closes exactly" in told.stdout and (both / "depth.exr").is_file()
    assert "photon ids 0 to" in run("merge", one, one, "--out", tmp_path / "twice", code=2).stderr


def test_what_does_not_go_with_resume(scene, done, tmp_path):
    assert "--seed" in run("simulate", "--resume", done, "--seed", 3, code=2).stderr
    assert "SCENE" in run("simulate", scene, "--resume", done, code=2).stderr
    photons = spadwarp.load_result(done / "result.h5").photons
    assert f"no more than the {photons}" in run("simulate", "--resume", done, code=2).stderr
    run("simulate", "--resume", tmp_path, code=1)
    assert "outside (0, 1)" in run("simulate", scene, "--out", tmp_path / "x", "--relative-error", 2, code=2).stderr


# detect, depth


def test_frames_are_those_of_detect(done, tmp_path):
    out = tmp_path / "out"
    options = ("--pulses", "2e3", "--frames", 3, "--seed", 5, "--tags", *DEVICE)
    told = run("detect", done, "--out", out, *options, "--json", tmp_path / "told.json")
    result = spadwarp.load_result(done / "result.h5")
    twin = spadwarp.detect(result, pulses=2000, frames=3, seed=5, tags=True, device="cpu")
    with h5py.File(out / "frames.h5") as file:
        assert np.array_equal(file["counts"], twin.counts)
        assert np.array_equal(file["intensity"], twin.intensity)
        assert np.array_equal(file["tags/bin"], twin.tags.bin) and np.array_equal(file["tags/y"], twin.tags.y)
        assert np.array_equal(file["bound/time"], spadwarp.crlb(result, pulses=2000, device="cpu"), equal_nan=True)
        assert sorted(file["depth"]) == ["centroid", "likelihood", "matched", "peak"]
        depth = file["depth/likelihood"][...]
        bound = file["bound/depth"][...]
    assert (out / "frame.png").read_bytes().startswith(b"\x89PNG")
    error = np.abs(depth.astype(float) - result.truth.depth)
    # No estimator beats its bound; this one comes near it: 20 pixels, bins of 15 mm, light that was scattered forward.
    assert 0.3 * np.median(bound) < np.median(error) < 10 * np.median(bound)
    plain = tables(tmp_path / "told.json")
    assert plain["depth"]["likelihood"]["median"] == pytest.approx(np.median(error), rel=1e-3)
    assert "Cramér–Rao" in told.stdout and told.stdout.count("% of the target's pixels") == 4


def test_frames_do_not_depend_on_the_parts_they_are_drawn_in(done, tmp_path, monkeypatch):
    monkeypatch.setattr("spadwarp.frames.record._PART_BYTES", 1)
    run("detect", done, "--out", tmp_path, "--frames", 3, "--method", "peak", "--quiet", *DEVICE)
    with h5py.File(tmp_path / "frames.h5") as file:
        twin = spadwarp.detect(spadwarp.load_result(done / "result.h5"), frames=3, seed=0, device="cpu")
        assert np.array_equal(file["counts"], twin.counts)
        assert list(file["depth"]) == ["peak"]


def test_the_detector_can_be_another(done, tmp_path):
    dark = ("--set", "detector.dark_count_rate=1e7", "--set", "laser.pulse_energy=1e-20")
    run(
        "detect", done, "--out", tmp_path / "dark", *dark, "--method", "peak", "--json", tmp_path / "dark.json", *DEVICE
    )
    found = tables(tmp_path / "dark.json")
    expected = -np.expm1(-1e7 * 150 * 100e-12)  # one count a pulse at most
    assert found["detections_per_pulse_and_pixel"] == pytest.approx(expected, rel=0.02)
    refused = run("detect", done, "--out", tmp_path / "x", "--set", "medium.extinction=1", code=2)
    assert "medium.extinction" in refused.stderr and "simulate again" in refused.stderr
    assert "frames = 0" in run("detect", done, "--out", tmp_path / "x", "--frames", 0, code=2).stderr


def test_depth_of_a_result_is_that_of_python(done, tmp_path):
    out, points = tmp_path / "out", tmp_path / "points.ply"
    run("depth", done, "--out", out, "--background", 0, "--ply", points, "--quiet", *DEVICE)
    result = spadwarp.load_result(done / "result.h5")
    depth = result.depth(device="cpu")
    assert np.array_equal(np.load(out / "depth.npy"), depth.astype(np.float32), equal_nan=True)
    assert np.array_equal(read_exr(out / "depth.exr")[0]["Z"], depth.astype(np.float32), equal_nan=True)
    assert (out / "depth.png").is_file()
    import trimesh

    cloud = trimesh.load(points)
    assert np.allclose(cloud.vertices[:, 2], depth[np.isfinite(depth)], rtol=1e-6)


def test_depth_of_frames_knows_the_response(done, tmp_path):
    run("detect", done, "--out", tmp_path / "frames", "--frames", 2, "--quiet", *DEVICE)
    run("depth", tmp_path / "frames", "--out", tmp_path / "out", "--method", "matched", *DEVICE)
    with h5py.File(tmp_path / "frames" / "frames.h5") as file:
        assert np.allclose(np.load(tmp_path / "out" / "depth.npy"), file["depth/matched"], rtol=1e-5, equal_nan=True)
    asked = run("depth", done, "--out", tmp_path / "x", "--bin-width-ps", 5, code=2)
    assert "the file knows its bin width" in asked.stderr


def test_depth_of_measured_histograms(tmp_path):
    """A wall at 3 m in fresh water, whose pulses come back as a Gaussian."""
    index, width = 1.3566, 50e-12
    arrival = 2 * 3.0 * index / 299_792_458.0
    edges = np.arange(401) * width + 20e-9
    irf = spadwarp.instrument_response(pulse_fwhm=0.0, jitter_fwhm=300e-12)
    expected = 4000 * irf.bin_fractions(edges, arrival=arrival) + 0.5
    counts = np.random.default_rng(1).poisson(expected, (3, 4, 400)).astype(np.uint16)
    np.save(tmp_path / "counts.npy", counts)
    axis = ("--bin-width-ps", 50, "--gate-start-ns", 20, "--group-index", index, "--irf-fwhm-ps", 300)
    bound = 300e-12 / 2.3548 / np.sqrt(4000) / arrival * 3.0  # [m], without background
    for method in ("centroid", "matched", "likelihood"):
        out = tmp_path / method
        run("depth", tmp_path / "counts.npy", "--out", out, *axis, "--method", method, "--quiet", *DEVICE)
        distance = np.load(out / "range.npy")
        assert np.abs(distance - 3.0).max() < (5 if method == "likelihood" else 40) * bound, method
        assert "Z" not in read_exr(out / "range.exr")[0]

    seen = ("--horizontal-fov-deg", 60, "--ply", tmp_path / "points.ply", "--json", tmp_path / "told.json")
    run("depth", tmp_path / "counts.npy", "--out", tmp_path / "seen", *axis, *seen, *DEVICE)
    assert tables(tmp_path / "told.json")["quantity"] == "depth"
    depth = np.load(tmp_path / "seen" / "depth.npy")
    assert depth[1, 1] == pytest.approx(3.0 / np.sqrt(1 + 0.1443**2), rel=2e-3)  # half a pixel off the axis

    for missing, words in ((axis[2:], "bin width"), (axis[:4], "group index")):
        assert words in run("depth", tmp_path / "counts.npy", "--out", tmp_path / "x", *missing, code=2).stderr
    without = run("depth", tmp_path / "counts.npy", "--out", tmp_path / "x", *axis[:6], "--method", "matched", code=2)
    assert "instrument response" in without.stderr
    blind = run("depth", tmp_path / "counts.npy", "--out", tmp_path / "x", *axis, "--ply", tmp_path / "p.ply", code=2)
    assert "field of view" in blind.stderr


# analytic, budget, sweep


def test_analytic_frames_are_those_of_python(scene, tmp_path):
    options = ("--frames", 7, "--seed", 3, "--set", "analytic.backscatter_fraction=0.2", *DEVICE)
    told = run("analytic", scene, "--out", tmp_path, *options, "--json", tmp_path / "told.json")
    twin = spadwarp.simulate_analytic(
        spadwarp.load_scene(scene, {"analytic.backscatter_fraction": 0.2}), frames=7, seed=3, device="cpu"
    )
    with h5py.File(tmp_path / "analytic.h5") as file:
        assert np.array_equal(file["depth"], twin.depth, equal_nan=True)
        assert np.array_equal(file["labels"], twin.labels)
        assert np.array_equal(file["maps/sigma_depth"], twin.sigma_depth, equal_nan=True)
    assert tables(tmp_path / "told.json")["sigma_depth"] == np.median(twin.sigma_depth)
    assert "20 % of their pixels stray" in told.stdout and (tmp_path / "analytic.png").is_file()


def test_analytic_takes_truth_and_profile_from_files(scene, done, tmp_path):
    result = spadwarp.load_result(done / "result.h5")
    exported = save_truth_maps(result, tmp_path / "truth.exr")
    rendered = ("--depth", exported, "--depth-channel", "Z", "--depth-scale", 1, "--albedo", 0.7)
    run("analytic", scene, "--out", tmp_path / "a", *rendered, "--frames", 0, *DEVICE)
    run("analytic", scene, "--out", tmp_path / "b", "--frames", 0, "--quiet", *DEVICE)
    with h5py.File(tmp_path / "a" / "analytic.h5") as a, h5py.File(tmp_path / "b" / "analytic.h5") as b:
        assert np.allclose(a["truth/range"], b["truth/range"], rtol=1e-6)
        facing = -b["truth/normal"][..., 2]  # without normals every surface faces the camera
        assert (a["maps/signal"][...] >= b["maps/signal"][...] * (1 - 1e-6)).all() and (facing <= 1).all()
    monte_carlo = ("--set", "analytic.backscatter=monte_carlo", "--profile", done)
    run("analytic", scene, "--out", tmp_path / "c", *monte_carlo, *DEVICE)
    with h5py.File(tmp_path / "c" / "analytic.h5") as file:
        scale = result.scene.laser.photons_per_pulse * result.scene.detector.pde
        assert np.allclose(file["maps/backscatter"], result.component("backscatter").sum(-1) * scale, rtol=1e-5)
    assert "--depth" in run("analytic", scene, "--out", tmp_path / "x", "--radial", code=2).stderr
    assert "monte_carlo" in run("analytic", scene, "--out", tmp_path / "x", "--profile", done, code=2).stderr
    wrong = run("analytic", scene, "--out", tmp_path / "x", "--depth", exported, "--depth-channel", "Q", code=1)
    assert "no channel 'Q'" in wrong.stderr


def test_budget_is_that_of_python(scene, tmp_path):
    summary = tmp_path / "told.json"
    waters = ("--medium", "uwoc-clear", "--medium", "uwoc-harbour")
    told = run("budget", scene, "--range", "1:3:3", *waters, "--out", tmp_path / "out", "--json", summary, *DEVICE)
    twin = spadwarp.budget(spadwarp.load_scene(scene), [1, 2, 3], ["uwoc-clear", "uwoc-harbour"], device="cpu")
    assert [row["signal"] for row in tables(summary)["rows"]] == [row.signal for row in twin]
    assert "uwoc-harbour" in told.stdout and "range [m]" in told.stdout and "σ* [mm]" in told.stdout
    csv = (tmp_path / "out" / "budget.csv").read_text().splitlines()
    assert len(csv) == 7 and csv[0].startswith("medium,extinction,range")
    assert (tmp_path / "out" / "budget.png").is_file()
    assert "'x'" in run("budget", scene, "--range", "x", code=2).stderr
    assert "uwoc-clear" in run("budget", scene, "--medium", "uwoc-cleer", code=2).stderr


@pytest.mark.parametrize("of", ["budget", "depth-error"])
def test_sweep_is_that_of_python(scene, tmp_path, of):
    summary, vary = tmp_path / "told.json", "medium.extinction=0.1:2:3"
    run("sweep", scene, "--vary", vary, "--of", of, "--out", tmp_path / "out", "--json", summary, *DEVICE)
    twin = spadwarp.sweep(spadwarp.load_scene(scene), vary=vary, of=of, device="cpu")
    found = tables(summary)
    assert (found["field"], found["values"]) == ("medium.extinction", [0.1, 1.05, 2.0])
    assert [row["sigma_depth"] for row in found["rows"]] == [row.sigma_depth for row in twin.rows]
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"sweep.png", "sweep.csv"}
    assert "medium.typo" in run("sweep", scene, "--vary", "medium.typo=1:2:2", "--out", tmp_path / "x", code=2).stderr
    assert "from:to:count" in run("sweep", scene, "--vary", "nonsense", "--out", tmp_path / "x", code=2).stderr


# validate, targets


def test_validation_says_what_failed(tmp_path, monkeypatch):
    report = tmp_path / "report.json"
    told = run("validate", "ledger", "--photons", "2e3", "--json", report, "--plots", tmp_path / "plots", *DEVICE)
    found = tables(report)
    assert found["passed"] and found["photons"] == 2000
    assert f"{len(found['results'])} of {len(found['results'])} agree" in told.stdout
    assert (tmp_path / "plots" / "ledger.png").is_file()

    wrong = [spadwarp.validate.CaseResult("ledger", "its sum", 1.0, 2.0, 0.1, -10.0, 1e-20, False)]
    monkeypatch.setattr("spadwarp.validate.validate", lambda *_, **__: wrong)
    failed = run("validate", "ledger", code=1)
    assert "0 of 1 agree" in failed.stdout and "its sum: z = -10.00" in failed.stderr
    monkeypatch.undo()
    assert "nope" in run("validate", "nope", code=2).stderr
    assert "cube60" in run("validate", "--list").stdout


def test_targets_are_listed_and_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr("spadwarp.viz.targets.builtin_names", lambda: ("plane", "staircase"))
    told = run("targets", "--out", tmp_path / "out", "--json", tmp_path / "told.json", *DEVICE)
    assert "staircase" in told.stdout and "4.00 x 4.00 x 0.70 m" in told.stdout
    assert (tmp_path / "out" / "targets.png").read_bytes().startswith(b"\x89PNG")
    assert tables(tmp_path / "told.json")["targets"][0] == {"name": "plane", "faces": 2, "extent": [1.0, 1.0, 0.0]}
    assert "not empty" in run("targets", "--out", tmp_path / "out", code=2).stderr
