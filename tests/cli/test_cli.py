"""The command line: what it writes, what it refuses, how it ends; and that it says what Python says."""

import json
import os
import signal
import subprocess
import sys
import time
import warnings
from pathlib import Path

import numpy as np
import pytest
from typer.testing import CliRunner

import spadwarp
from spadwarp.cli import app
from spadwarp.io.exr import read_exr
from spadwarp.result.file import load_truth_maps
from spadwarp.transport.records import load_records

ROOT = Path(__file__).parents[2]

SCENE = """
[medium]
extinction = 0.3
albedo = 0.8
group_index = "seawater"

[laser]
position = [-0.05, 0.0, 0.0]

[camera]
width = 8
height = 6
horizontal_fov_deg = 20.0
aperture_diameter = 0.02

[gate]
start_ns = 16.0
bin_width_ps = 200.0
bins = 30

[[targets]]
builtin = "plane"
size = [1.5, 1.5]
translation = [0.0, 0.0, 2.0]

[transport]
photons = 20_000
seed = 3
"""

FILES = {
    "result.h5",
    "scene.toml",
    "depth.exr",
    "truth.exr",
    "depth.png",
    "intensity.png",
    "histogram.png",
    "truth.png",
}


@pytest.fixture
def scene(tmp_path):
    path = tmp_path / "scene.toml"
    path.write_text(SCENE)
    return path


def run(*arguments, code=0):
    """One command in this process; its result after its exit code was looked at."""
    outcome = CliRunner().invoke(app, [str(argument) for argument in arguments])
    assert outcome.exit_code == code, outcome.output
    return outcome


def start(*arguments, **options):
    """One command in a process of its own."""
    path = os.pathsep.join(map(str, (ROOT, ROOT / "kernels")))
    command = [sys.executable, "-m", "spadwarp", *map(str, arguments)]
    return subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
        env={**os.environ, "PYTHONPATH": path},
        **options,
    )


def test_simulate_writes_what_python_computes(scene, tmp_path):
    out, summary = tmp_path / "out", tmp_path / "json" / "summary.json"
    told = run("simulate", scene, "--out", out, "--device", "cpu", "--set", "medium.extinction=0.5", "--json", summary)

    twin = spadwarp.simulate(spadwarp.load_scene(scene, ["medium.extinction=0.5"]), device="cpu")
    result = spadwarp.load_result(out / "result.h5")
    assert np.array_equal(result.tallies, twin.tallies)
    assert result.ledger == twin.ledger
    assert result.scene == twin.scene == spadwarp.load_scene(out / "scene.toml")
    assert {path.name for path in out.iterdir()} == FILES
    assert np.array_equal(read_exr(out / "depth.exr")[0]["Z"], twin.depth().astype(np.float32), equal_nan=True)
    assert np.array_equal(load_truth_maps(out / "truth.exr").depth, twin.truth.depth, equal_nan=True)

    plain = json.loads(summary.read_text())
    assert plain["collected_fraction"] == twin.summary()["collected_fraction"]
    assert {Path(name).name for name in plain["files"]} == FILES
    assert "closes exactly" in told.stdout
    assert "20 000 of 20 000 photons" in told.stderr


def test_options_lie_over_the_scene(scene, tmp_path):
    out = tmp_path / "out"
    run("simulate", scene, "--out", out, "--photons", "1e4", "--seed", 2**64 - 1, "--device", "cpu", "--threads", 1)
    result = spadwarp.load_result(out / "result.h5")
    assert (result.photons, result.seed) == (10_000, 2**64 - 1)
    assert spadwarp.load_scene(out / "scene.toml").transport.photons == 10_000


def test_quiet_is_silent(scene, tmp_path):
    outcome = run("simulate", scene, "--out", tmp_path / "out", "--quiet", "--device", "cpu")
    assert outcome.output == ""


def test_output_follows_the_scene(scene, tmp_path):
    out = tmp_path / "out"
    choices = ["output.png=false", "output.exr=false"]
    run("simulate", scene, "--out", out, "--quiet", "--device", "cpu", *(f"--set={choice}" for choice in choices))
    assert {path.name for path in out.iterdir()} == {"result.h5", "scene.toml"}


def test_gate_that_opens_with_the_pulse(scene, tmp_path):
    """Its first bins are earlier than light can go from the laser to the lens: no range belongs to them."""
    out = tmp_path / "out"
    run("simulate", scene, "--out", out, "--quiet", "--device", "cpu", "--set", "gate.start_ns=0")
    assert {path.name for path in out.iterdir()} == FILES


def test_directory_in_use_is_refused_unless_overwritten(scene, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    (out / "mine.txt").write_text("kept")
    (out / "records.h5").write_text("of an earlier run")
    refused = run("simulate", scene, "--out", out, code=2)
    assert "not empty" in refused.stderr and "--overwrite" in refused.stderr
    assert not (out / "result.h5").exists()

    run("simulate", scene, "--out", out, "--overwrite", "--quiet", "--device", "cpu")
    assert {path.name for path in out.iterdir()} == FILES | {"mine.txt"}


def test_records_are_those_of_trace(scene, tmp_path):
    out = tmp_path / "out"
    run("simulate", scene, "--out", out, "--records", "--quiet", "--device", "cpu", "--photons", 1000)
    records = load_records(out / "records.h5")
    twin = spadwarp.trace(spadwarp.load_scene(scene), photons=1000, device="cpu")
    for name in ("id", "position", "direction", "weight", "path", "collisions", "reason"):
        assert np.array_equal(getattr(records, name), getattr(twin, name)), name
    assert (records.reasons, records.ledger) == (twin.reasons, twin.ledger)


def test_mesh_takes_the_place_of_the_first_target(scene, tmp_path):
    mesh = tmp_path / "square.obj"
    mesh.write_text("v -20 -20 0\nv 20 -20 0\nv 20 20 0\nv -20 20 0\nf 1 3 2\nf 1 4 3\n")
    summary = tmp_path / "summary.json"
    scale = ["--set", "targets[0].scale=0.01"]
    run("check", scene, "--mesh", mesh, *scale, "--json", summary)
    assert json.loads(summary.read_text())["faces"] == 2

    out = tmp_path / "out"
    run("simulate", scene, "--out", out, "--mesh", mesh, *scale, "--quiet", "--device", "cpu")
    (target,) = spadwarp.load_result(out / "result.h5").scene.targets
    assert (target.mesh, target.builtin, target.translation[2]) == (str(mesh), None, 2.0)
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
        (["presets", "water"], 2, ["'water'", "medium"]),
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


def test_a_disk_that_is_too_small_is_found_out_before_the_run(scene, tmp_path, monkeypatch):
    def disk_usage(path):
        return type("usage", (), {"free": 1000})

    monkeypatch.setattr("shutil.disk_usage", disk_usage)
    monkeypatch.setattr("spadwarp.transport.simulate.simulate", lambda *_, **__: pytest.fail("it ran"))
    outcome = run("simulate", scene, "--out", tmp_path / "out", code=1)
    assert "1000 bytes are free" in outcome.stderr


def test_result_survives_a_picture_that_cannot_be_written(scene, tmp_path, monkeypatch):
    def full(*_, **__):
        raise spadwarp.FileError("depth.png: cannot be written: No space left on device")

    monkeypatch.setattr("spadwarp.viz.result.write_previews", full)
    out = tmp_path / "out"
    outcome = run("simulate", scene, "--out", out, "--device", "cpu", code=1)
    assert "No space left" in outcome.stderr
    assert spadwarp.load_result(out / "result.h5").photons == 20_000


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
    outcome = run("simulate", scene, "--out", out, "--device", "cpu", code=1)
    (saved,) = refuge.iterdir()
    assert saved.name in outcome.stderr
    assert spadwarp.load_result(saved).photons == 20_000


def test_check_warns_with_numbers(scene, tmp_path):
    summary = tmp_path / "summary.json"
    outcome = run("check", scene, "--set", "targets[0].translation=[0, 0, 9]", "--json", summary)
    assert "warning: targets[0]: outside the gate" in outcome.stdout
    found = json.loads(summary.read_text())["messages"]
    assert found[0]["values"]["stop_ns"] == pytest.approx(22.0)
    messages = spadwarp.check(spadwarp.load_scene(scene, ["targets[0].translation=[0, 0, 9]"]))
    assert [message["text"] for message in found] == [message.text for message in messages]
    assert all(str(message) in outcome.stdout for message in messages)


def test_check_accepts_every_scene_that_comes_along():
    for path in sorted((ROOT / "configs" / "scenes").glob("*.toml")):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            told = run("check", path).stdout
        lengths = told.partition("attenuation length")[2].partition("\n")[0].split("; ")
        assert len(lengths) == len(spadwarp.load_scene(path).medium.waters) and all("albedo" in one for one in lengths)


def test_info_tells_what_the_result_holds(scene, tmp_path):
    result = spadwarp.simulate(spadwarp.load_scene(scene), device="cpu")
    result.save(tmp_path / "result.h5")
    summary = tmp_path / "summary.json"
    told = run("info", tmp_path / "result.h5", "--json", summary).stdout
    assert run("info", tmp_path).stdout == told  # the directory stands for the result in it
    assert "20 000, seed 3" in told and "Energy ledger, exact" in told and "100.000000 %" in told
    assert json.loads(summary.read_text()) == json.loads(json.dumps(result.summary()))


def test_presets_water_and_devices_are_those_of_python(tmp_path):
    summary = tmp_path / "summary.json"
    told = run("presets", "medium", "--json", summary).stdout
    names = [preset["name"] for preset in json.loads(summary.read_text())["presets"]]
    assert names == list(spadwarp.presets("medium"))
    assert all(name in told for name in names) and "picoquant" not in told
    assert "picoquant-visuv-532" in run("presets").stdout

    told = run("water", 532, "--chlorophyll", 0.5, "--temperature", 10, "--salinity", 35, "--json", summary).stdout
    optics = spadwarp.water_optics(532.0, chlorophyll=0.5, temperature=10.0, salinity=35.0)
    assert f"{optics.extinction:.4g} 1/m" in told and f"{optics.group_index:.5f}" in told
    assert json.loads(summary.read_text())["absorption"] == optics.absorption

    assert "cpu" in run("devices", "--json", summary).stdout
    assert json.loads(summary.read_text())["devices"] == spadwarp.devices()
    assert sum(device["default"] for device in spadwarp.devices()) == 1


def test_every_help_shows_an_example():
    assert "Example" in run("--help").stdout
    for command in app.registered_commands:
        name = command.name or command.callback.__name__
        told = run(name, "--help").stdout
        assert f"spadwarp {name}" in told.split("Example", 1)[1], name


def test_version():
    assert run("--version").stdout == f"spadwarp {spadwarp.__version__}\n"


def test_importing_the_command_line_loads_nothing_heavy():
    code = "import sys, spadwarp.cli; print(*sys.modules)"
    path = os.pathsep.join(map(str, (ROOT, ROOT / "kernels")))
    told = subprocess.run(
        [sys.executable, "-c", code], env={**os.environ, "PYTHONPATH": path}, capture_output=True, text=True, check=True
    )
    heavy = {"warp", "h5py", "matplotlib", "trimesh", "torch", "OpenEXR", "pydantic", "numpy", "scipy", "manifold3d"}
    assert heavy.isdisjoint(told.stdout.split())


def test_a_process_keeps_stdout_for_the_answer(scene):
    """Also on a machine without a GPU, of which Warp's native code would complain."""
    process = start("devices")
    told, complaints = process.communicate(timeout=120)
    assert process.returncode == 0
    assert "Warp" not in told + complaints
    assert told.startswith("cpu")


def test_exit_code_of_a_process_that_was_used_wrongly(scene):
    process = start("simulate", scene)
    _, complaints = process.communicate(timeout=120)
    assert process.returncode == 2
    assert "Traceback" not in complaints


@pytest.mark.skipif(os.name == "nt", reason="sends signals")
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_interrupt_writes_what_is_done(scene, tmp_path, number):
    """Ctrl-C, and what a job scheduler sends before it kills."""
    out = tmp_path / "out"
    process = start("simulate", scene, "--out", out, "--device", "cpu", "--photons", "1e11", "--seed", 3)
    for line in process.stderr:
        if " % " in line:
            break
    process.send_signal(number)
    _, complaints = process.communicate(timeout=120)
    assert process.returncode == 130, complaints
    assert "marked partial" in complaints

    result = spadwarp.load_result(out / "result.h5")
    assert result.partial and 0 < result.photons < 10**11
    assert result.ledger_report()["exact"]
    assert {path.name for path in out.iterdir()} == FILES
    assert "stopped early" in run("info", out).stdout


@pytest.mark.skipif(os.name == "nt", reason="sends SIGKILL")
def test_a_killed_run_goes_on_from_its_checkpoint(scene, tmp_path):
    """Killed twice; the outcome is that of one run."""
    out, kept = tmp_path / "out", tmp_path / "out" / "checkpoint.h5"
    first = start("simulate", scene, "--out", out, "--device", "cpu", "--photons", "1e11", "--checkpoint", 0.1)
    before = kill_after_checkpoint(first, kept, newer_than=0)
    assert before.partial and before.ledger_report()["exact"] and before.requested == (0, 10**11)
    assert not (out / "result.h5").exists()
    assert f"--resume {out} goes on" in run("simulate", scene, "--out", out, code=2).stderr.replace("\n", " ")
    second = start("simulate", "--resume", out, "--device", "cpu", "--checkpoint", 0.1)
    after = kill_after_checkpoint(second, kept, newer_than=kept.stat().st_mtime_ns)
    assert after.photons > before.photons

    total = after.photons + 50_000
    run("simulate", "--resume", out, "--device", "cpu", "--photons", total)
    result = spadwarp.load_result(out / "result.h5")
    long = spadwarp.simulate(spadwarp.load_scene(scene), photons=total, device="cpu")
    assert np.array_equal(result.tallies, long.tallies) and result.ledger == long.ledger
    assert not result.partial and "the first of 3 parts" in run("info", out).stdout
    assert {path.name for path in out.iterdir()} == FILES


def kill_after_checkpoint(process, kept, *, newer_than):
    while not kept.exists() or kept.stat().st_mtime_ns <= newer_than:
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    process.kill()
    process.communicate(timeout=60)
    return spadwarp.load_result(kept)


def test_shards_are_merged(scene, tmp_path):
    parts = [tmp_path / f"part{number}" for number in (1, 2, 3)]
    for number, out in enumerate(parts, 1):
        run("simulate", scene, "--out", out, "--device", "cpu", "--shard", f"{number}/3", "--uncertainty", "--quiet")
    told = run("merge", *parts, "--out", tmp_path / "all", "--device", "cpu")
    merged = spadwarp.load_result(tmp_path / "all" / "result.h5")
    whole = spadwarp.simulate(spadwarp.load_scene(scene), device="cpu", uncertainty=True)
    assert np.array_equal(merged.tallies, whole.tallies) and np.array_equal(merged.second_moment, whole.second_moment)
    assert f"photon ids  0 to {whole.photons - 1:,}".replace(",", " ") in told.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--shard", "4/3"), "4/3 is outside"),
        (("--shard", "half"), "such as 3/64"),
        (("--engine", "slurm"), "is not local or ray"),
        (("--workers", "2"), "needs --engine ray"),
        (("--shard", "1/2", "--records"), "photon 0"),
        (("--device", "cuda:1", "--engine", "ray"), "cuda:1"),
    ],
)
def test_wrong_parts_and_engines_are_named(scene, tmp_path, arguments, words):
    assert words in run("simulate", scene, "--out", tmp_path / "out", *arguments, code=2).stderr
