"""`analytic`, `sweep` and `plan` say what Python says."""

import math
import re
from contextlib import ExitStack

import h5py
import numpy as np
import pytest

import spadwarp
from helpers.cli import DEVICE, run, tables
from spadwarp.cli.options import from_to
from spadwarp.result.file import save_truth_maps


def test_analytic_frames_are_those_of_python(scene, tmp_path):
    options = ("--frames", 7, "--seed", 3, "--set", "analytic.backscatter_fraction=0.2", *DEVICE)
    printed = run("analytic", scene, "--out", tmp_path, *options, "--json", tmp_path / "printed.json")
    changed = spadwarp.load_scene(scene, {"analytic.backscatter_fraction": 0.2})
    twin = spadwarp.simulate_analytic(changed, frames=7, seed=3, device="cpu")
    with h5py.File(tmp_path / "analytic.h5") as file:
        assert np.array_equal(file["depth"], twin.depth, equal_nan=True)
        assert np.array_equal(file["labels"], twin.labels)
        assert np.array_equal(file["maps/sigma_depth"], twin.sigma_depth, equal_nan=True)
    assert tables(tmp_path / "printed.json")["sigma_depth"] == np.median(twin.sigma_depth)
    assert re.search(r"background probability +0\.2\n", printed.stdout) and (tmp_path / "analytic.png").is_file()


@pytest.mark.slow
def test_analytic_takes_truth_and_profile_from_files(scene, done, tmp_path):
    result = spadwarp.load(done / "result.h5")
    exported = save_truth_maps(result, tmp_path / "truth.exr")
    rendered = ("--rendered", f"depth={exported},depth_channel=Z,depth_scale=1,albedo=0.7")
    monte_carlo = ("--set", "analytic.backscatter=monte_carlo", "--profile", done)
    for name, options in (("a", rendered), ("b", ()), ("c", monte_carlo)):
        run("analytic", scene, "--out", tmp_path / name, *options, "--frames", 0, "--quiet", *DEVICE)
    with ExitStack() as stack:
        a, b, c = (stack.enter_context(h5py.File(tmp_path / name / "analytic.h5")) for name in "abc")
        assert np.allclose(a["truth/range"], b["truth/range"], rtol=1e-6)
        # Without normals every surface faces the camera.
        assert (a["maps/signal"][...] >= b["maps/signal"][...] * (1 - 1e-6)).all()
        scale = result.scene.laser.photons_per_pulse * result.scene.detector.pde
        assert np.allclose(c["maps/backscatter"], result.component("backscatter").sum(-1) * scale, rtol=1e-5)
    unknown = ("--rendered", f"depth={exported},depth_channel=Q")
    assert "no channel 'Q'" in run("analytic", scene, "--out", tmp_path / "x", *unknown, code=1).stderr


def test_budget_is_that_of_python(scene, tmp_path):
    summary, out = tmp_path / "printed.json", tmp_path / "out"
    waters = ("--medium", "uwoc-clear", "--medium", "uwoc-harbour")
    printed = run("sweep", scene, "--vary", "range=1:3:3", *waters, "--out", out, "--json", summary, "--quiet", *DEVICE)
    twin = spadwarp.budget(scene, [1, 2, 3], ["uwoc-clear", "uwoc-harbour"], device="cpu")
    assert [row["signal"] for row in tables(summary)["rows"]] == [row.signal for row in twin]
    assert "uwoc-harbour" in printed.stdout and "gate [ns]" in printed.stdout and "σ* [mm]" in printed.stdout
    assert "* not the scene's gate, 6-21 ns" in printed.stdout and "5e+03" in printed.stdout
    csv = (out / "budget.csv").read_text().splitlines()
    assert len(csv) == 7 and csv[0].startswith("medium,extinction,range")
    assert (out / "budget.png").is_file()


def test_a_budget_of_polarised_light_says_what_is_left_out(scene, tmp_path):
    polarised = ("--set", "laser.polarisation=linear", "--set", "medium.scattering_matrix=voss_fry")
    printed = run("sweep", scene, "--vary", "range=1:2:2", *polarised, "--json", tmp_path / "a.json", *DEVICE)
    (note,) = tables(tmp_path / "a.json")["notes"]
    assert printed.stderr.count("has no polarisation") == 1 and f"warning: {note}" in printed.stderr


@pytest.mark.slow
@pytest.mark.parametrize(
    "vary", [["medium.extinction=0.1:2:3"], ["laser.pulse_energy=1 nJ,4 nJ", "detector.mode=first_photon,free_running"]]
)
def test_sweep_is_that_of_python(scene, tmp_path, vary):
    summary, few = tmp_path / "printed.json", () if len(vary) == 1 else ("--photons", "4000", "--no-range")
    words = [word for one in vary for word in ("--vary", one)]
    run("sweep", scene, *words, *few, "--out", tmp_path / "out", "--json", summary, *DEVICE)
    planned = {"of": "plan", "photons": 4000, "largest_range": False} if few else {}
    twin = spadwarp.sweep(scene, vary=vary, device="cpu", **planned)
    found = tables(summary)
    assert tuple(found["fields"]) == twin.fields and tuple(map(tuple, found["values"])) == twin.values
    sigmas = [None if math.isnan(row.sigma_depth) else row.sigma_depth for row in twin.rows]  # too few photons to judge
    assert [row["sigma_depth"] for row in found["rows"]] == sigmas
    assert {path.name for path in (tmp_path / "out").iterdir()} == {"sweep.png", "sweep.csv"}


def test_plan_is_that_of_python_and_writes_a_scene(scene, tmp_path):
    summary, written = tmp_path / "printed.json", tmp_path / "planned.toml"
    options = ("--depth-error", "5cm", "--time", "100ms", "--photons", "2e4", "--no-range", "--write", written)
    printed = run("plan", scene, *options, "--json", summary, *DEVICE)
    twin = spadwarp.plan(scene, depth_error="5 cm", time="100 ms", photons=20_000, largest_range=False, device="cpu")
    found = tables(summary)
    assert found["values"] == twin.values and found["terms"] == twin.terms and found["limit"] == twin.limit
    assert spadwarp.load_scene(written) == twin.scene
    words = ("gate.start_ns", "hazard distance", "IEC 60825-1", "Cramér–Rao bound", "forward scattering", twin.limit)
    assert all(word in printed.stdout for word in words)


def test_plan_warns_of_targets_before_it_traces(scene):
    behind = ("--set", "targets[0].translation=[0, 0, -3]")
    lines = run("plan", scene, *behind, "--photons", "1e3", *DEVICE, code=2).stderr.splitlines()
    assert lines[0].startswith("warning: targets[0]: behind the camera") and "no target is in view" in lines[-1]


@pytest.mark.parametrize(
    ("text", "unit", "values"),
    [
        ("2:3", "m", (2.0, 3.0)),
        ("1m:10m", "m", (1.0, 10.0)),
        ("80cm,1.2m", "m", (0.8, 1.2)),
        ("10ns,60ns", "ns", (10.0, 60.0)),
        ("0.04 us : 55 ns", "ns", (40.0, 55.0)),
    ],
)
def test_two_numbers_take_units(text, unit, values):
    assert from_to(unit)(text) == pytest.approx(values)
