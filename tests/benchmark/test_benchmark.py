"""The benchmark: that its cases are what they say, and that what it writes can be kept. Speed itself is not tested."""

import json
import runpy
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scipy import stats

import spadwarp
from helpers.cli import run
from spadwarp.benchmark import CASES, compare, history, load_report, newest_report, report
from spadwarp.mesh import build_mesh
from spadwarp.scene import Scene
from spadwarp.values import FileError

PEERS = Path(__file__).parents[2] / "bench" / "peers"


def scene(name):
    return Scene.from_dict(CASES[name].scene)


@pytest.fixture(scope="module")
def staircase():
    (result,) = spadwarp.benchmark.run(["staircase_5m"], device="cpu", photons=4000, repeats=2)
    return result


def test_cases_have_the_faces_they_promise():
    faces = {name: build_mesh(scene(name)) for name in ("water", "plane_5m", "staircase_5m", "staircase_5m_dense")}
    assert faces["water"] is None and faces["plane_5m"].face_count == 2
    assert faces["staircase_5m"].face_count == 120 and faces["staircase_5m_dense"].face_count >= 100_000
    # A million by the arithmetic of subdivision.
    assert sum(1280 * 4**one.subdivisions for one in scene("spheres").targets) == pytest.approx(1e6, rel=0.02)


@pytest.mark.slow
def test_cube60_absorbs_what_mcx_says():
    """17.69 % (MCX's own figure); 20 000 photons know it to 0.2 %."""
    (result,) = spadwarp.benchmark.run(["cube60"], device="cpu", photons=20_000, repeats=1)
    assert result.check["passed"] and result.check["standard_error"] < 0.003
    # Optical depth of the mean path: 78 collisions a photon.
    assert result.rates["collisions"] / result.rates["photons"] == pytest.approx(78, rel=0.05)


def test_report_says_what_it_was_measured_on(staircase):
    kept = json.loads(json.dumps(report([staircase])))
    made, (row,) = kept["provenance"], kept["results"]
    assert kept["format"] == "spadwarp bench" and (made["device"], made["driver"]) == ("cpu", None)
    assert {"device_name", "warp", "spadwarp", "numpy", "python", "commit", "date"} <= made.keys()
    assert row["case"] == "staircase_5m" and row["rates"] == pytest.approx(staircase.rates)


def timed(result, *seconds, case="staircase_5m"):
    return replace(result, case=case, seconds=seconds, rates={unit: 1.0 for unit in result.rates})


@pytest.mark.parametrize(
    ("seconds", "verdict"),
    [
        ((0.500, 0.502, 0.498), "faster"),
        ((2.00, 2.01, 1.99), "slower"),
        ((1.02, 1.021, 1.019), "same"),  # two per cent: processes differ by as much
        ((1.3, 0.8, 1.1), "unclear"),
        ((2.0,), "unclear"),
    ],
)
def test_a_comparison_is_welchs_test(staircase, seconds, verdict):
    earlier = (1.00, 1.004, 0.996)
    other = replace(staircase, case="water")
    now, before = report([timed(staircase, *seconds), other]), report([timed(staircase, *earlier)])
    (one,) = compare(now, before)
    assert (one.case, one.unit, one.verdict) == ("staircase_5m", "photons", verdict)
    assert one.before == pytest.approx(4000.0, rel=1e-4)
    if len(seconds) > 1:
        new, old = -np.log(seconds), -np.log(earlier)
        expected = stats.ttest_ind(new, old, equal_var=False).confidence_interval(0.99)
        assert np.log(one.interval) == pytest.approx([expected.low, expected.high], rel=1e-9, abs=1e-4)
        assert one.spread_now == pytest.approx(new.std(ddof=1))


def test_the_newest_report_of_such_a_device_is_taken(staircase, tmp_path):
    made = report([staircase])
    changes = {"a": {}, "b": {}, "c": {"device_name": "another"}, "d": {"threads": 999}}
    for month, (name, changed) in enumerate(changes.items(), start=1):
        stored = {**made, "provenance": {**made["provenance"], "date": f"2026-0{month}-01", **changed}}
        (tmp_path / f"{name}.json").write_text(json.dumps(stored))
    assert [path.stem for path, _ in history(tmp_path)] == ["a", "b", "c", "d"]
    like = made["provenance"]
    assert newest_report(tmp_path, like=like, cases=["staircase_5m", "water"]).stem == "b"
    with pytest.raises(FileError, match=r"no report of water from .* threads"):
        newest_report(tmp_path, like=like, cases=["water"])
    with pytest.raises(FileError, match="holds no report"):
        history(tmp_path / "none")


def test_kept_files_are_compared_and_a_slower_case_fails_the_command(staircase, tmp_path):
    fast, slow, out = (tmp_path / f"{name}.json" for name in ("fast", "slow", "c"))
    fast.write_text(json.dumps(report([timed(staircase, 1.0, 1.001, 0.999)])))
    slow.write_text(json.dumps(report([timed(staircase, 2.0, 2.001, 1.999)])))
    result = run("bench", "--compare", fast, slow, "--json", out, code=1)
    assert "staircase_5m: slower than in" in result.output and "0.500" in result.output
    assert json.loads(out.read_text())["comparison"][0]["ratio"] == pytest.approx(0.5, rel=1e-3)
    assert "faster" in run("bench", fast, "--compare", slow).output
    assert "same" in run("bench", fast, "--compare", fast).output
    run("bench", fast, "water", "--compare", slow, code=2)
    # Nothing to compare with: what was measured is written all the same.
    (tmp_path / "others").mkdir()
    others = report([staircase])
    others["provenance"]["device_name"] = "another"
    (tmp_path / "others" / "a.json").write_text(json.dumps(others))
    result = run("bench", fast, "--compare", tmp_path / "others", "--json", tmp_path / "d.json", code=1)
    assert "no report of staircase_5m" in result.output and load_report(tmp_path / "d.json")["results"]


def finds(*results):
    """A run of the benchmark that finds these, and is interrupted."""

    def run(*_, found, **__):
        for one in results:
            found(one)
        raise KeyboardInterrupt

    return run


def test_an_interrupted_command_keeps_what_was_measured(monkeypatch, staircase, tmp_path):
    monkeypatch.setattr(spadwarp.benchmark, "run", finds(staircase))
    result = run("bench", "staircase_5m", "water", "--json", tmp_path / "part.json", code=130)
    assert "staircase_5m" in result.stdout
    assert [row["case"] for row in load_report(tmp_path / "part.json")["results"]] == ["staircase_5m"]


def test_a_missed_mean_fails_the_command(monkeypatch, staircase):
    check = {"name": "absorbed fraction", "value": 0.2, "standard_error": 1e-3, "reference": 0.1769, "passed": False}
    cube60 = replace(staircase, case="cube60", check=check)
    monkeypatch.setattr(spadwarp.benchmark, "run", lambda *_, found, **__: found(cube60))
    assert "cube60: a mean is not what it should be" in run("bench", "cube60", code=1).output


@pytest.mark.slow
def test_scaling_says_how_cost_grows(monkeypatch, staircase):
    def like(photons, rate):
        size = {"photons": photons}
        return replace(staircase, case=f"photons_{photons}", size=size, rates={"photons": rate}, memory=1 << 30)

    cases = [like(10**6, 4e8), like(10**7, 8e8), like(10**8, 8.8e8)]
    monkeypatch.setattr(spadwarp.benchmark, "run", lambda *_, found, **__: [found(case) for case in cases])
    printed = run("bench", "scaling").stdout
    assert "photons_10000000 -> photons_100000000: 0.909 times the time of a photon, 1 times the memory" in printed


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "cannot be read"),
        ("{}", "not a file that `spadwarp bench --json` wrote"),
        ("not json", "not JSON"),
        ('{"format": "spadwarp bench", "format_version": 2, "results": []}', "format_version = 2 is not 1"),
        ('{"format": "spadwarp bench", "format_version": 1, "results": [{}]}', "a result lacks one of"),
    ],
)
def test_unsuitable_files_are_refused(tmp_path, text, message):
    if text is not None:
        (tmp_path / "other.json").write_text(text)
    with pytest.raises(FileError, match=rf"other\.json: .*{message}"):
        load_report(tmp_path / "other.json")


@pytest.mark.parametrize("script", ["run_pmcx", "run_pmcxcl", "run_pmmc", "run_mitransient"])
def test_a_missing_peer_is_reported_and_is_no_failure(script, monkeypatch, capsys):
    for module in ("pmcx", "pmcxcl", "pmmc", "mitsuba"):
        monkeypatch.setitem(sys.modules, module, None)
    monkeypatch.setattr(sys, "argv", [script])
    monkeypatch.syspath_prepend(PEERS)
    try:
        runpy.run_path(str(PEERS / f"{script}.py"), run_name="__main__")
    except SystemExit as end:
        assert not end.code
    printed = capsys.readouterr().out
    assert printed.startswith("not run: ") and "pip install" in printed
