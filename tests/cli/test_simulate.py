"""`simulate`: what it writes, what it refuses; and that it says what Python says."""

import importlib
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest

import spadwarp
from helpers.cli import DEVICE, FILES, PICTURES, run, tables
from spadwarp.files import write_run
from spadwarp.io.arrays import read_exr
from spadwarp.io.paths import atomic_path
from spadwarp.result.file import load_truth_maps
from spadwarp.transport.records import load_records


def test_simulate_writes_what_python_computes(scene, tmp_path):
    """With a gate that opens with the pulse too: no range belongs to its first bins."""
    out, summary = tmp_path / "out", tmp_path / "json" / "summary.json"
    changes = ["medium.extinction=0.5", "gate.start_ns=0", "output.png=true"]
    printed = run("simulate", scene, "--out", out, *DEVICE, *(f"--set={one}" for one in changes), "--json", summary)

    twin = spadwarp.simulate(spadwarp.load_scene(scene, changes), device="cpu")
    result = spadwarp.load(out / "result.h5")
    assert np.array_equal(result.tallies, twin.tallies)
    assert result.energy_balance == twin.energy_balance
    assert result.scene == twin.scene == spadwarp.load_scene(out / "scene.toml")
    assert {path.name for path in out.iterdir()} == FILES | PICTURES
    assert np.array_equal(read_exr(out / "depth.exr")[0]["Z"], twin.depth().astype(np.float32), equal_nan=True)
    assert np.array_equal(load_truth_maps(out / "truth.exr").depth, twin.truth.depth, equal_nan=True)

    plain = tables(summary)
    assert plain["collected_fraction"] == twin.summary()["collected_fraction"]
    assert {Path(name).name for name in plain["files"]} == FILES | PICTURES
    assert "energy balance exact" in " ".join(printed.stdout.split())
    assert "20 000 of 20 000 photons" in printed.stderr


def test_options_lie_over_the_scene_and_output_follows_it(scene, tmp_path):
    out = tmp_path / "out"
    options = ("--photons", "1e4", "--seed", 2**64 - 1, "--threads", 1, "--quiet", "--set", "output.exr=false")
    assert run("simulate", scene, "--out", out, *options, *DEVICE).output == ""
    result = spadwarp.load(out / "result.h5")
    assert (result.photons, result.seed) == (10_000, 2**64 - 1)
    assert spadwarp.load_scene(out / "scene.toml").transport.photons == 10_000
    assert {path.name for path in out.iterdir()} == {"result.h5", "scene.toml"}


@pytest.mark.slow
@pytest.mark.filterwarnings("default::RuntimeWarning")
def test_warnings_of_a_run_are_shown_while_what_draws_is_loaded(scene, tmp_path, monkeypatch):
    """Matplotlib takes the warnings of all threads while it reads its styles."""
    load = importlib.import_module

    def load_slowly(name, package=None):
        if name == "spadwarp.viz":
            with warnings.catch_warnings(record=True):
                time.sleep(1.0)
        return load(name, package)

    monkeypatch.setattr(importlib, "import_module", load_slowly)
    thin = ("--set", "medium.extinction=1e-12", "--set", "output.png=true", "--photons", 1000)
    outcome = run("simulate", scene, "--out", tmp_path / "out", "--quiet", *thin, *DEVICE)
    assert "rounding to the histogram's unit" in outcome.stderr


def test_directory_in_use_is_refused_unless_overwritten(scene, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("kept")
    (out / "records.h5").write_text("of an earlier run")
    refused = run("simulate", scene, "--out", out, code=2)
    assert "not empty" in refused.stderr and "--overwrite" in refused.stderr
    assert not (out / "result.h5").exists()

    run("simulate", scene, "--out", out, "--overwrite", "--quiet", *DEVICE)
    assert {path.name for path in out.iterdir()} == FILES | {"mine.txt"}


@pytest.mark.slow
def test_lines_are_runs_of_their_own_beside_what_has_all_of_them(scene, tmp_path):
    out, changes = tmp_path / "out", ["--set=laser.wavelengths_nm=[650, 450]", "--set=medium.chlorophyll=0.5"]
    run("simulate", scene, "--out", out, *DEVICE, *changes, "--set=output.png=true")
    assert {path.name for path in out.iterdir()} == {"450nm", "650nm", "spectrum.h5", "spectrum.png"}
    for line in (450.0, 650.0):  # too far apart to share photons
        alone = spadwarp.load_scene(scene, {"laser.wavelength_nm": line, "medium.chlorophyll": 0.5})
        own = spadwarp.simulate(alone, device="cpu")
        assert np.array_equal(spadwarp.load(out / f"{line:g}nm").tallies, own.tallies)
    refused = run("simulate", scene, "--out", out, *changes, "--records", code=2)
    assert "--records" in refused.output and "cannot be combined" in refused.output


@pytest.mark.slow
def test_a_spectrum_is_a_result_beside_its_lines(scene, tmp_path):
    broad = ["--set=laser.linewidth_nm=1", "--set=laser.wavelengths_nm=spectrum", "--photons=500"]
    run("simulate", scene, "--out", tmp_path / "out", *DEVICE, *broad)
    assert {path.name for path in (tmp_path / "out").iterdir()} == FILES | {"spectrum.h5"}


@pytest.mark.slow
def test_records_are_those_of_trace(scene, tmp_path):
    out = tmp_path / "out"
    run("simulate", scene, "--out", out, "--records", "--quiet", *DEVICE, "--photons", 1000)
    records = load_records(out / "records.h5")
    twin = spadwarp.transport.trace(spadwarp.load_scene(scene), photons=1000, device="cpu")
    for name in ("id", "position", "direction", "weight", "path", "collisions", "reason"):
        assert np.array_equal(getattr(records, name), getattr(twin, name)), name
    assert (records.reasons, records.energy_balance) == (twin.reasons, twin.energy_balance)


def test_mesh_takes_the_place_of_the_first_target(scene, tmp_path):
    mesh = tmp_path / "square.obj"
    mesh.write_text("v -20 -20 0\nv 20 -20 0\nv 20 20 0\nv -20 20 0\nf 1 3 2\nf 1 4 3\n")
    summary = tmp_path / "summary.json"
    scale = ["--set", "targets[0].scale=0.01"]
    run("check", scene, "--mesh", mesh, *scale, "--json", summary)
    assert tables(summary)["faces"] == 2

    out = tmp_path / "out"
    run("simulate", scene, "--out", out, "--mesh", mesh, *scale, "--quiet", *DEVICE)
    (target,) = spadwarp.load(out / "result.h5").scene.targets
    assert (target.mesh, target.builtin, target.translation[2]) == (str(mesh), None, 2.2)
    assert 'mesh = "../square.obj"' in (out / "scene.toml").read_text()
    assert spadwarp.load_scene(out / "scene.toml").targets == (target,)
    depth = load_truth_maps(out / "truth.exr").depth
    assert np.allclose(depth[1:3, 1:4], 2.2) and np.isnan(depth[0, 0])  # 40 cm of the 78 that are seen


@pytest.mark.parametrize("content", [None, "", "time_ps,value\n0,1\n", "time_ps,value\n0,-1\n1,nan\n"])
def test_a_response_that_cannot_be_read_is_found_before_the_run(scene, tmp_path, monkeypatch, content):
    monkeypatch.setattr(spadwarp, "simulate", lambda *_, **__: pytest.fail("it ran"))
    path = tmp_path / "irf.csv"
    if content is not None:
        path.write_text(content)
    for command in (("check", scene), ("simulate", scene, "--out", tmp_path / "out")):
        outcome = run(*command, "--set", f"detector.irf={path}", code=2)
        assert "detector.irf" in outcome.stderr and "irf.csv" in outcome.stderr, outcome.stderr
    assert not (tmp_path / "out").exists()


def test_a_disk_that_is_too_small_is_found_out_before_the_run(scene, tmp_path, monkeypatch):
    monkeypatch.setattr("shutil.disk_usage", lambda path: type("usage", (), {"free": 1000}))
    monkeypatch.setattr("spadwarp.transport.simulation", lambda *_, **__: pytest.fail("it ran"))
    assert "1000 bytes are free" in run("simulate", scene, "--out", tmp_path / "out", code=1).stderr


def test_a_result_survives_pictures_and_a_folder_that_cannot_be_written(scene, tmp_path, monkeypatch):
    save, out, refuge = spadwarp.Result.save, tmp_path / "out", tmp_path / "refuge"

    def full(*_, **__):
        raise spadwarp.FileError("depth.png: cannot be written: No space left on device")

    with monkeypatch.context() as patch:
        patch.setattr("spadwarp.viz.result.save", full)
        outcome = run("simulate", scene, "--out", out, *DEVICE, "--set", "output.png=true", code=1)
    assert "No space left" in outcome.stderr
    assert spadwarp.load(out / "result.h5").photons == 20_000

    monkeypatch.setattr(
        spadwarp.Result, "save", lambda result, path: full() if Path(path).parent == out else save(result, path)
    )
    refuge.mkdir()
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(refuge))
    outcome = run("simulate", scene, "--out", out, "--overwrite", *DEVICE, code=1)
    (saved,) = refuge.iterdir()
    assert saved.name in outcome.stderr
    assert spadwarp.load(saved).photons == 20_000


@pytest.mark.skipif(sys.platform != "linux", reason="pictures are not drawn by processes of their own")
def test_an_interrupt_leaves_no_parts_of_pictures(scene, tmp_path, monkeypatch):
    def draw(*_, **__):
        with atomic_path(tmp_path / "depth.png"):
            time.sleep(60.0)

    def interrupted(*_):
        while not any(tmp_path.iterdir()):
            time.sleep(0.01)
        raise KeyboardInterrupt

    result = spadwarp.simulate(spadwarp.load_scene(scene, ["output.png=true"]), photons=1000, device="cpu")
    monkeypatch.setattr("spadwarp.viz.draw_result", draw)
    monkeypatch.setattr(spadwarp.Result, "save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_run(result, tmp_path)
    assert not any(tmp_path.iterdir())
