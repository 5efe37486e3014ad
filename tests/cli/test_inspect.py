"""Commands that look: check, info, list, water, validate; tables; a process."""

import dataclasses
import json
import re
import subprocess
import sys

import pytest
import trimesh

import spadwarp
from helpers.cli import DEVICE, ENVIRONMENT, run, tables
from spadwarp.cli.outputs import show_table


@pytest.mark.slow
def test_validation_says_what_failed(tmp_path, monkeypatch):
    report = tmp_path / "report.json"
    printed = run("validate", "cube60", "--photons", "2e3", "--json", report, "--plots", tmp_path / "plots", *DEVICE)
    found = tables(report)
    assert found["passed"] and found["photons"] == 2000
    assert f"{len(found['results'])} of {len(found['results'])} agree" in printed.stdout
    assert (tmp_path / "plots" / "cube60.png").is_file()

    wrong = [spadwarp.validate.CaseResult("ledger", "its sum", 1.0, 2.0, 0.1, -10.0, 1e-20, False)]
    monkeypatch.setattr("spadwarp.validate.run", lambda *_, **__: wrong)
    failed = run("validate", "ledger", code=1)
    assert "0 of 1 agree" in failed.stdout and "its sum: z = -10.00" in failed.stderr


def test_what_there_is_is_listed(tmp_path, monkeypatch):
    """Targets, drawn too; presets; cases of validation and benchmarks."""
    summary, out = tmp_path / "printed.json", tmp_path / "out"
    monkeypatch.setattr("spadwarp.viz.scenes.builtin_names", lambda: ("plane", "staircase"))
    printed = run("list", "targets", "--out", out, "--json", summary, *DEVICE)
    assert "staircase" in printed.stdout and "4.00 x 4.00 x 0.70 m" in printed.stdout
    assert (out / "targets.png").read_bytes().startswith(b"\x89PNG")
    assert tables(summary)["targets"][0] == {"name": "plane", "faces": 2, "extent": [1.0, 1.0, 0.0]}
    assert "not empty" in run("list", "targets", "--out", out, code=2).stderr

    printed = run("list", "presets", "medium", "--json", summary, "--overwrite").stdout
    names = [preset["name"] for preset in tables(summary)["presets"]]
    assert names == list(spadwarp.scene.presets("medium"))
    assert all(name in printed for name in names) and "picoquant" not in printed
    assert "picoquant-visuv-532" in run("list", "presets").stdout
    assert "ledger" in run("list", "validation").stdout and "scaling" in run("list", "benchmarks").stdout


def test_water_is_that_of_python(tmp_path):
    options = ("--chlorophyll", 0.5, "--temperature", 10, "--salinity", 35, "--json", tmp_path / "water.json")
    printed = run("water", 532, *options).stdout
    optics = spadwarp.water.water_optics(532.0, chlorophyll=0.5, temperature=10.0, salinity=35.0)
    assert f"{optics.extinction:.4g} 1/m" in printed and f"{optics.group_index:.4g}" in printed
    assert tables(tmp_path / "water.json")["absorption"] == optics.absorption


def test_check_warns_with_numbers(scene, tmp_path):
    """And names each water of the scene."""
    changes = ["targets[0].translation=[0, 0, 9]", "medium.layers=[{start=1, extinction=1, albedo=0.5}]"]
    summary = tmp_path / "summary.json"
    printed = run("check", scene, *(f"--set={change}" for change in changes), "--json", summary).stdout
    assert "warning: targets[0]: outside the gate" in printed
    assert printed.count("attenuation length") == printed.count("albedo") == 2
    found = tables(summary)["messages"]
    assert found[0]["values"]["stop_ns"] == pytest.approx(21.0)
    messages = spadwarp.check(spadwarp.load_scene(scene, changes))
    assert [message["text"] for message in found] == [message.text for message in messages]
    assert all(str(message) in printed for message in messages)


def test_info_tells_what_the_result_holds(done, tmp_path):
    summary = tmp_path / "summary.json"
    printed = run("info", done / "result.h5", "--json", summary).stdout
    assert run("info", done).stdout == printed  # the directory stands for the result in it
    assert "20 000" in printed and "100.000000 %" in printed
    assert re.search(r"energy balance\n +verdict +exact", printed)
    result = spadwarp.load(done / "result.h5")
    assert tables(summary) == json.loads(json.dumps({"kind": "result", **result.summary()}))
    # One that says little about its origin is shown too.
    dataclasses.replace(result, provenance={}, timing={}, counters={}).save(tmp_path / "result.h5")
    run("info", tmp_path / "result.h5")
    for command in ("merge", "reconstruct"):  # of few photons, which both say first
        printed = run(command, tmp_path / "result.h5", "--out", tmp_path / command, *DEVICE).stdout
        assert spadwarp.load(tmp_path / command).target_noise_ratio > 0.1
        assert printed.startswith("not enough photons")
    run("view", tmp_path, "--out", tmp_path / "view.html")


def test_info_and_view_take_mesh_files(tmp_path):
    trimesh.creation.box((400, 300, 200)).export(tmp_path / "box.stl")
    summary = tmp_path / "printed.json"
    printed = run("info", tmp_path / "box.stl", "--json", summary).stdout
    assert re.search(r"unit +mm", printed) and re.search(r"faces +12\n", printed) and "400, 300, 200 m" in printed
    found = tables(summary)
    assert found["scale"] == 0.001 and found["hints"]
    run("view", tmp_path / "box.stl", "--out", tmp_path / "pictures" / "box.png", *DEVICE)
    assert (tmp_path / "pictures" / "box.png").read_bytes().startswith(b"\x89PNG")
    assert "is a mesh" in run("view", tmp_path / "box.stl", "--out", tmp_path / "page.html", code=2).stderr


def test_a_table_wider_than_the_terminal_is_printed_in_parts(monkeypatch, capsys):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "45")
    titles = [f"quantity {i}" for i in range(6)]
    values = {title: f"{i}.23e-05" for i, title in enumerate(titles)}
    show_table([{"water": name, "range [m]": "5 [ps]", **values} for name in ("clear", "coastal")], keys=2)
    printed = capsys.readouterr().out
    assert all(title in printed for title in titles)
    assert max(map(len, printed.splitlines())) <= 45
    assert printed.count("coastal") == printed.count("range [m]") == 3 and printed.count("5 [ps]") == 6


@pytest.mark.slow
def test_a_process_loads_nothing_heavy_and_keeps_stdout_for_the_answer():
    """Also on a machine without a GPU, of which Warp's native code would complain."""
    code = "import sys, spadwarp.cli; print(*sys.modules); from spadwarp.__main__ import main; main()"
    command = [sys.executable, "-c", code, "doctor", "--no-self-test"]
    process = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=True)
    modules, printed = process.stdout.split("\n", 1)
    heavy = {"warp", "h5py", "matplotlib", "trimesh", "torch", "OpenEXR", "pydantic", "numpy", "scipy", "manifold3d"}
    assert heavy.isdisjoint(modules.split()) and "spadwarp.cli" in modules
    assert process.stderr == "" and "\n  cpu" in printed


@pytest.mark.slow
def test_scenes_of_built_ins_need_no_library_for_meshes():
    """What is imported is waited for by every command that reads a scene."""
    code = "import sys, spadwarp; spadwarp.check('configs/scenes/staircase_15m.toml'); print(*sys.modules)"
    process = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    loaded, cameras = set(process.stdout.split()), {"spadwarp_kernels.worlds", "spadwarp_kernels.detection"}
    assert loaded.isdisjoint({"trimesh", "scipy", "matplotlib", "torch", *cameras})
