"""Runs that are interrupted, resumed and added up."""

import dataclasses
import os
import signal
import time

import numpy as np
import pytest

import spadwarp
from helpers.cli import DEVICE, FILES, PICTURES, run, start, tables
from spadwarp.files.run import load_resumable


def test_a_resumed_run_is_the_long_run(spad_scene, tmp_path):
    """Also of one that stopped early because it was good enough."""
    out = tmp_path / "out"
    options = ("--relative-error", 0.3, "--photons", 200_000, "--quiet", *DEVICE)
    run("simulate", spad_scene, "--out", out, *options, "--json", tmp_path / "first.json")
    first = spadwarp.load_result(out / "result.h5")
    assert 0 < tables(tmp_path / "first.json")["relative_error"] == first.relative_error <= 0.3
    assert first.photons < 200_000 and not first.partial

    total = 2 * first.photons
    printed = run("simulate", "--resume", out, "--photons", total, *DEVICE)
    result = spadwarp.load_result(out / "result.h5")
    long = spadwarp.simulate(spadwarp.load_scene(spad_scene), photons=total, device="cpu")
    assert np.array_equal(result.tallies, long.tallies) and result.energy_balance == long.energy_balance
    assert result.photons == total == spadwarp.load_scene(out / "scene.toml").transport.photons
    assert f"relative error {result.relative_error:.4g}" in " ".join(printed.stdout.split())


def test_merged_runs_are_one_run(spad_scene, done, tmp_path):
    one, two, both = (tmp_path / name for name in ("one", "two", "both"))
    size = spadwarp.load_result(done / "result.h5").batch_size
    first, second = 16 * size, 16 * size
    for out, photons, begin in ((one, first, 0), (two, second, first)):
        options = ("--photons", photons, "--first-photon", begin, "--quiet", *DEVICE)
        run("simulate", spad_scene, "--out", out, *options)
    printed = run("merge", one, two / "result.h5", "--out", both, "--json", tmp_path / "both.json", *DEVICE)
    merged = spadwarp.load_result(both / "result.h5")
    long = spadwarp.simulate(spadwarp.load_scene(spad_scene), photons=first + second, device="cpu")
    assert np.array_equal(merged.tallies, long.tallies) and merged.energy_balance == long.energy_balance
    assert tables(tmp_path / "both.json")["photon_ranges"] == [[0, first + second]]
    assert "energy balance exact" in " ".join(printed.stdout.split()) and (both / "depth.exr").is_file()
    assert "photon ids 0 to" in run("merge", one, one, "--out", tmp_path / "twice", code=2).stderr


def test_what_does_not_go_with_resume(spad_scene, done, tmp_path):
    assert "--seed" in run("simulate", "--resume", done, "--seed", 3, code=2).stderr
    assert "SCENE" in run("simulate", spad_scene, "--resume", done, code=2).stderr
    photons = spadwarp.load_result(done / "result.h5").photons
    assert f"no more than the {photons}" in run("simulate", "--resume", done, code=2).stderr
    run("simulate", "--resume", tmp_path, code=1)
    assert (
        "outside (0, 1)" in run("simulate", spad_scene, "--out", tmp_path / "x", "--relative-error", 2, code=2).stderr
    )


def test_the_number_of_photons_decides_what_is_resumed(spad_scene, tmp_path):
    """Not the time of the files: a clock that was in the future must not throw photons away."""
    out, scene = tmp_path / "out", spadwarp.load_scene(spad_scene)
    out.mkdir()

    def put(name, photons, *, age, scene=scene):
        whole = spadwarp.simulate(scene, photons=photons, device="cpu")
        dataclasses.replace(whole, requested=(0, 40_000), partial=True).save(out / name)
        os.utime(out / name, (4e9 - age, 4e9 - age))

    for checkpoint, result in ((10_000, 20_000), (20_000, 10_000)):
        put("result.h5", result, age=1 if result < checkpoint else 2)
        put("checkpoint.h5", checkpoint, age=1 if checkpoint < result else 2)
        earlier, path = load_resumable(out)
        assert earlier.photons == 20_000 and path.name == ("result.h5" if result > checkpoint else "checkpoint.h5")
    # One that cannot be read does not hide the other.
    content = (out / "checkpoint.h5").read_bytes()
    (out / "checkpoint.h5").write_bytes(content[: len(content) // 2])
    with pytest.warns(RuntimeWarning, match=r"checkpoint\.h5: damaged"):
        assert load_resumable(out)[1].name == "result.h5"
    # A checkpoint beside the result of another scene is of the run that replaces this result.
    put("checkpoint.h5", 5_000, age=2, scene=scene.with_overrides({"medium.extinction": 0.7}))
    assert load_resumable(out)[1].name == "checkpoint.h5"

    put("checkpoint.h5", 30_000, age=2)
    run("simulate", "--resume", out, "--quiet", *DEVICE)
    again = spadwarp.load_result(out / "result.h5")
    long = spadwarp.simulate(scene, photons=40_000, device="cpu")
    assert np.array_equal(again.tallies, long.tallies) and again.energy_balance == long.energy_balance
    assert not again.partial
    assert not (out / "checkpoint.h5").exists()


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="sends signals")
@pytest.mark.parametrize(("number", "pictures"), [(signal.SIGINT, PICTURES), (signal.SIGTERM, set())])
def test_interrupt_writes_what_is_done(scene, tmp_path, number, pictures):
    """Ctrl-C, and what a job scheduler sends before it kills."""
    out = tmp_path / "out"
    options = ("--photons", "1e11", "--seed", 3, "--set", f"output.png={'true' if pictures else 'false'}")
    process = start("simulate", scene, "--out", out, *DEVICE, *options)
    for line in process.stderr:
        if " % " in line:
            break
    process.send_signal(number)
    _, complaints = process.communicate(timeout=120)
    assert process.returncode == 130, complaints
    assert "marked partial" in complaints

    result = spadwarp.load_result(out / "result.h5")
    assert result.partial and 0 < result.photons < 10**11
    assert result.energy_report()["exact"]
    assert {path.name for path in out.iterdir()} == FILES | pictures
    assert "partial yes" in " ".join(run("info", out).stdout.split())


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="sends SIGKILL")
def test_a_killed_run_resumes_from_its_checkpoint(scene, tmp_path):
    """Killed twice; the outcome is that of one run."""
    out, kept = tmp_path / "out", tmp_path / "out" / "checkpoint.h5"
    first = start("simulate", scene, "--out", out, *DEVICE, "--photons", "1e11", "--checkpoint", 0.1)
    before = kill_after_checkpoint(first, kept, newer_than=0)
    assert before.partial and before.energy_report()["exact"] and before.requested == (0, 10**11)
    assert not (out / "result.h5").exists()
    assert f"--resume {out} resumes it" in run("simulate", scene, "--out", out, code=2).stderr.replace("\n", " ")
    second = start("simulate", "--resume", out, *DEVICE, "--checkpoint", 0.1)
    after = kill_after_checkpoint(second, kept, newer_than=kept.stat().st_mtime_ns)
    assert after.photons > before.photons

    total = after.photons + 50_000
    run("simulate", "--resume", out, *DEVICE, "--photons", total)
    result = spadwarp.load_result(out / "result.h5")
    long = spadwarp.simulate(spadwarp.load_scene(scene), photons=total, device="cpu")
    assert np.array_equal(result.tallies, long.tallies) and result.energy_balance == long.energy_balance
    assert not result.partial and "photon ranges" in run("info", out).stdout
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
        run("simulate", scene, "--out", out, *DEVICE, "--shard", f"{number}/3", "--uncertainty", "--quiet")
    printed = run("merge", *parts, "--out", tmp_path / "all", *DEVICE)
    merged = spadwarp.load_result(tmp_path / "all" / "result.h5")
    whole = spadwarp.simulate(spadwarp.load_scene(scene), device="cpu", uncertainty=True)
    assert np.array_equal(merged.tallies, whole.tallies) and np.array_equal(merged.second_moment, whole.second_moment)
    assert f"photon ids  0 to {whole.photons - 1:,}".replace(",", " ") in printed.stdout


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        (("--shard", "4/3"), "shard = 4/3 is outside [1/3, 3/3]"),
        (("--shard", "half"), "such as 3/64"),
        (("--workers", "2"), "needs --ray"),
        (("--shard", "1/2", "--records"), "photon 0"),
        (("--device", "cuda:1", "--ray", "start"), "cuda:1"),
    ],
)
def test_wrong_parts_and_engines_are_named(scene, tmp_path, arguments, words):
    assert words in run("simulate", scene, "--out", tmp_path / "out", *arguments, code=2).stderr
