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
    out, summary = tmp_path / "out", tmp_path / "json" / "summary.json"
    options = ("--set", "medium.extinction=0.5", "--set", "output.png=true", "--json", summary)
    printed = run("simulate", scene, "--out", out, *DEVICE, *options)

    twin = spadwarp.simulate(spadwarp.load_scene(scene, ["medium.extinction=0.5", "output.png=true"]), device="cpu")
    result = spadwarp.load_result(out / "result.h5")
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


def test_options_lie_over_the_scene(scene, tmp_path):
    out = tmp_path / "out"
    run("simulate", scene, "--out", out, "--photons", "1e4", "--seed", 2**64 - 1, *DEVICE, "--threads", 1)
    result = spadwarp.load_result(out / "result.h5")
    assert (result.photons, result.seed) == (10_000, 2**64 - 1)
    assert spadwarp.load_scene(out / "scene.toml").transport.photons == 10_000


@pytest.mark.filterwarnings("default::RuntimeWarning")
def test_warnings_of_a_run_are_shown_while_what_draws_is_loaded(scene, tmp_path, monkeypatch):
    """Matplotlib takes the warnings of all threads while it reads its styles."""
    load = importlib.import_module

    def load_slowly(name, package=None):
        if name == "spadwarp.viz":
            with warnings.catch_warnings(record=True):
                time.sleep(2.0)
        return load(name, package)

    monkeypatch.setattr(importlib, "import_module", load_slowly)
    thin = ("--set", "medium.extinction=1e-12", "--set", "output.png=true", "--photons", 1000)
    outcome = run("simulate", scene, "--out", tmp_path / "out", "--quiet", *thin, *DEVICE)
    assert "rounding to the histogram's unit" in outcome.stderr


def test_output_follows_the_scene(scene, tmp_path):
    out = tmp_path / "out"
    choices = ["output.png=false", "output.exr=false"]
    outcome = run("simulate", scene, "--out", out, "--quiet", *DEVICE, *(f"--set={choice}" for choice in choices))
    assert outcome.output == "" and {path.name for path in out.iterdir()} == {"result.h5", "scene.toml"}


def test_gate_that_opens_with_the_pulse(scene, tmp_path):
    """Its first bins are earlier than light can go from the laser to the lens: no range belongs to them."""
    out = tmp_path / "out"
    run("simulate", scene, "--out", out, "--quiet", *DEVICE, "--set", "gate.start_ns=0", "--set", "output.png=true")
    assert {path.name for path in out.iterdir()} == FILES | PICTURES


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
    (target,) = spadwarp.load_result(out / "result.h5").scene.targets
    assert (target.mesh, target.builtin, target.translation[2]) == (str(mesh), None, 2.0)
    assert 'mesh = "../square.obj"' in (out / "scene.toml").read_text()
    assert spadwarp.load_scene(out / "scene.toml").targets == (target,)
    depth = load_truth_maps(out / "truth.exr").depth
    assert np.allclose(depth[2:4, 2:6], 2.0) and np.isnan(depth[0, 0])  # 40 cm of the 70 that are seen


@pytest.mark.parametrize(
    ("arguments", "code", "words"),
    [
        (["simulate", "SCENE", "--out", "OUT", "--set", "medium.albedo=1.2"], 2, ["medium.albedo = 1.2", "[0, 1]"]),
        (["simulate", "SCENE", "--out", "OUT", "--photons", "2.5"], 2, ["'2.5'", "whole number"]),
        (["simulate", "SCENE", "--out", "OUT", "--photons", "0"], 2, ["transport.photons = 0", "[1, "]),
        (["simulate", "SCENE", "--out", "OUT", "--photons", "3e9", "--records"], 2, ["--records", "3000000000"]),
        (["simulate", "SCENE"], 2, ["--out"]),
        (["simulate", "SCENE", "--out", "SCENE"], 2, ["is a file"]),
        (["simulate", "SCENE", "--out", "SCENE/below"], 1, ["cannot be written"]),
        (["simulate", "SCENE", "--out", "OUT", "--device", "cuda:99"], 1, ["cuda:99", "cpu"]),
        (["simulate", "SCENE", "--out", "OUT", "--mesh", "missing.stl"], 1, ["missing.stl", "no such file"]),
        (["simulate", "missing.toml", "--out", "OUT"], 1, ["missing.toml"]),
        (["check", "SCENE", "--set", "medium.typo=1"], 2, ["medium.typo", "not a known field"]),
        (["info", "SCENE"], 1, ["scene.toml", "HDF5"]),
        (["list", "presets", "water"], 2, ["'water'", "medium"]),
        (["water", "900"], 2, ["wavelength_nm = 900.0 is outside [400, 700]"]),
        (["nonsense"], 2, ["nonsense"]),
    ],
)
def test_errors_say_what_is_wrong(scene, tmp_path, arguments, code, words):
    places = {"SCENE": str(scene), "OUT": str(tmp_path / "out")}
    for name, place in places.items():
        arguments = [argument.replace(name, place) for argument in arguments]
    outcome = run(*arguments, code=code)
    assert outcome.stdout == ""
    assert all(word in outcome.stderr for word in words), outcome.stderr
    assert not (tmp_path / "out" / "result.h5").exists()


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
    def disk_usage(path):
        return type("usage", (), {"free": 1000})

    monkeypatch.setattr("shutil.disk_usage", disk_usage)
    monkeypatch.setattr("spadwarp.transport.simulation", lambda *_, **__: pytest.fail("it ran"))
    outcome = run("simulate", scene, "--out", tmp_path / "out", code=1)
    assert "1000 bytes are free" in outcome.stderr


def test_result_survives_a_picture_that_cannot_be_written(scene, tmp_path, monkeypatch):
    def full(*_, **__):
        raise spadwarp.FileError("depth.png: cannot be written: No space left on device")

    monkeypatch.setattr("spadwarp.viz.result.save", full)
    out = tmp_path / "out"
    outcome = run("simulate", scene, "--out", out, *DEVICE, "--set", "output.png=true", code=1)
    assert "No space left" in outcome.stderr
    assert spadwarp.load_result(out / "result.h5").photons == 20_000


@pytest.mark.skipif(sys.platform != "linux", reason="pictures are not drawn by processes of their own")
def test_an_interrupt_leaves_no_parts_of_pictures(scene, tmp_path, monkeypatch):
    def draw():
        with atomic_path(tmp_path / "depth.png"):
            time.sleep(60.0)

    def interrupted(*_):
        while not any(tmp_path.iterdir()):
            time.sleep(0.01)
        raise KeyboardInterrupt

    monkeypatch.setattr("spadwarp.files.run._pictures", lambda *_: [draw])
    monkeypatch.setattr("spadwarp.files.run._save", interrupted)
    with pytest.raises(KeyboardInterrupt):
        write_run(spadwarp.simulate(scene, photons=1000, device="cpu"), tmp_path)
    assert not any(tmp_path.iterdir())


def test_result_that_cannot_be_written_finds_a_refuge(scene, tmp_path, monkeypatch):
    save = spadwarp.Result.save
    out, refuge = tmp_path / "out", tmp_path / "refuge"
    refuge.mkdir()

    def full(self, path):
        if Path(path).parent == out:
            raise spadwarp.FileError(f"{path}: cannot be written: No space left on device")
        return save(self, path)

    monkeypatch.setattr(spadwarp.Result, "save", full)
    monkeypatch.setattr("tempfile.gettempdir", lambda: str(refuge))
    outcome = run("simulate", scene, "--out", out, *DEVICE, code=1)
    (saved,) = refuge.iterdir()
    assert saved.name in outcome.stderr
    assert spadwarp.load_result(saved).photons == 20_000
