"""Commands that look: check, info, list, water, validate; help, version, processes."""

import dataclasses
import json
import re
import subprocess
import sys
import warnings

import pytest

import spadwarp
from helpers.cli import DEVICE, ENVIRONMENT, ROOT, run, start, tables
from spadwarp.cli import app


@pytest.mark.slow
def test_validation_says_what_failed(tmp_path, monkeypatch):
    report = tmp_path / "report.json"
    printed = run("validate", "ledger", "--photons", "2e3", "--json", report, "--plots", tmp_path / "plots", *DEVICE)
    found = tables(report)
    assert found["passed"] and found["photons"] == 2000
    assert f"{len(found['results'])} of {len(found['results'])} agree" in printed.stdout
    assert (tmp_path / "plots" / "ledger.png").is_file()

    wrong = [spadwarp.validate.CaseResult("ledger", "its sum", 1.0, 2.0, 0.1, -10.0, 1e-20, False)]
    monkeypatch.setattr("spadwarp.validate.run", lambda *_, **__: wrong)
    failed = run("validate", "ledger", code=1)
    assert "0 of 1 agree" in failed.stdout and "its sum: z = -10.00" in failed.stderr
    monkeypatch.undo()
    assert "nope" in run("validate", "nope", code=2).stderr
    assert "cube60" in run("list", "validation").stdout and "scaling" in run("list", "benchmarks").stdout


def test_targets_are_listed_and_drawn(tmp_path, monkeypatch):
    monkeypatch.setattr("spadwarp.viz.scenes.builtin_names", lambda: ("plane", "staircase"))
    printed = run("list", "targets", "--out", tmp_path / "out", "--json", tmp_path / "printed.json", *DEVICE)
    assert "staircase" in printed.stdout and "4.00 x 4.00 x 0.70 m" in printed.stdout
    assert (tmp_path / "out" / "targets.png").read_bytes().startswith(b"\x89PNG")
    assert tables(tmp_path / "printed.json")["targets"][0] == {"name": "plane", "faces": 2, "extent": [1.0, 1.0, 0.0]}
    assert "not empty" in run("list", "targets", "--out", tmp_path / "out", code=2).stderr


def test_check_warns_with_numbers(scene, tmp_path):
    summary = tmp_path / "summary.json"
    outcome = run("check", scene, "--set", "targets[0].translation=[0, 0, 9]", "--json", summary)
    assert "warning: targets[0]: outside the gate" in outcome.stdout
    found = tables(summary)["messages"]
    assert found[0]["values"]["stop_ns"] == pytest.approx(22.0)
    messages = spadwarp.check(spadwarp.load_scene(scene, ["targets[0].translation=[0, 0, 9]"]))
    assert [message["text"] for message in found] == [message.text for message in messages]
    assert all(str(message) in outcome.stdout for message in messages)


def test_check_accepts_every_scene_that_comes_along():
    for path in sorted((ROOT / "configs" / "scenes").glob("*.toml")):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")
            printed = run("check", path).stdout
        waters = spadwarp.load_scene(path).medium.waters
        assert printed.count("attenuation length") == printed.count("albedo") == len(waters), path


def test_info_tells_what_the_result_holds(scene, tmp_path):
    result = spadwarp.simulate(spadwarp.load_scene(scene), device="cpu")
    result.save(tmp_path / "result.h5")
    summary = tmp_path / "summary.json"
    printed = run("info", tmp_path / "result.h5", "--json", summary).stdout
    assert run("info", tmp_path).stdout == printed  # the directory stands for the result in it
    assert "20 000" in printed and "100.000000 %" in printed
    assert re.search(r"energy balance\n +verdict +exact", printed)
    assert tables(summary) == json.loads(json.dumps({"kind": "result", **result.summary()}))


def test_a_result_that_says_little_about_its_origin_is_shown(done, tmp_path):
    result = dataclasses.replace(spadwarp.load_result(done / "result.h5"), provenance={}, timing={}, counters={})
    result.save(tmp_path / "result.h5")
    run("info", tmp_path / "result.h5")
    run("merge", tmp_path / "result.h5", "--out", tmp_path / "out", *DEVICE)
    run("view", tmp_path, "--out", tmp_path / "view.html")


def test_presets_and_water_are_those_of_python(tmp_path):
    summary = tmp_path / "summary.json"
    printed = run("list", "presets", "medium", "--json", summary).stdout
    names = [preset["name"] for preset in tables(summary)["presets"]]
    assert names == list(spadwarp.scene.presets("medium"))
    assert all(name in printed for name in names) and "picoquant" not in printed
    assert "picoquant-visuv-532" in run("list", "presets").stdout

    printed = run(
        "water", 532, "--chlorophyll", 0.5, "--temperature", 10, "--salinity", 35, "--json", tmp_path / "water.json"
    ).stdout
    optics = spadwarp.water.water_optics(532.0, chlorophyll=0.5, temperature=10.0, salinity=35.0)
    assert f"{optics.extinction:.4g} 1/m" in printed and f"{optics.group_index:.4g}" in printed
    assert tables(tmp_path / "water.json")["absorption"] == optics.absorption


def test_every_help_shows_an_example():
    assert "Example" in run("--help").stdout and "--install-completion" in run("--help").stdout
    assert run("--version").stdout == f"spadwarp {spadwarp.__version__}\n"
    for command in app.registered_commands:
        name = command.name or command.callback.__name__
        printed = run(name, "--help").stdout
        assert f"spadwarp {name}" in printed.split("Example", 1)[1], name


def test_importing_the_command_line_loads_nothing_heavy():
    code = "import sys, spadwarp.cli; print(*sys.modules)"
    printed = subprocess.run([sys.executable, "-c", code], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    heavy = {"warp", "h5py", "matplotlib", "trimesh", "torch", "OpenEXR", "pydantic", "numpy", "scipy", "manifold3d"}
    assert heavy.isdisjoint(printed.stdout.split())


def test_a_process_keeps_stdout_for_the_answer(scene):
    """Also on a machine without a GPU, of which Warp's native code would complain."""
    process = start("doctor", "--no-self-test")
    printed, complaints = process.communicate(timeout=120)
    assert process.returncode == 0
    assert complaints == ""
    assert "\n  cpu" in printed


def test_info_and_view_take_mesh_files(tmp_path):
    import trimesh

    trimesh.creation.box((400, 300, 200)).export(tmp_path / "box.stl")
    summary = tmp_path / "printed.json"
    printed = run("info", tmp_path / "box.stl", "--json", summary).stdout
    assert re.search(r"unit +mm", printed) and re.search(r"faces +12\n", printed) and "400, 300, 200 m" in printed
    found = tables(summary)
    assert found["scale"] == 0.001 and found["hints"]
    run("view", tmp_path / "box.stl", "--out", tmp_path / "pictures" / "box.png", *DEVICE)
    assert (tmp_path / "pictures" / "box.png").stat().st_size > 5000
    assert "is a mesh" in run("view", tmp_path / "box.stl", "--out", tmp_path / "page.html", code=2).stderr
    assert "no such file" in run("info", tmp_path / "nothing.stl", code=1).stderr
