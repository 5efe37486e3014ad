"""Runs that are interrupted, resumed and added up."""

import contextlib
import dataclasses
import os
import shutil
import signal
import threading
import time

import numpy as np
import pytest

import spadwarp
from helpers.cli import DEVICE, FILES, PICTURES, run, start, tables
from spadwarp.files.run import load_resumable


def assert_same(result, long):
    assert np.array_equal(result.tallies, long.tallies) and result.energy_balance == long.energy_balance
    assert result.photons == long.photons and not result.partial


def test_a_resumed_run_is_the_long_run(scene, tmp_path):
    """Also of one that stopped early because it was good enough."""
    out = tmp_path / "out"
    options = ("--relative-error", 0.3, "--photons", 200_000, "--quiet", *DEVICE)
    run("simulate", scene, "--out", out, *options, "--json", tmp_path / "first.json")
    first = spadwarp.load(out / "result.h5")
    assert 0 < tables(tmp_path / "first.json")["relative_error"] == first.relative_error <= 0.3
    assert first.photons < 200_000 and not first.partial

    total = 2 * first.photons
    printed = run("simulate", "--resume", out, "--photons", total, *DEVICE)
    result = spadwarp.load(out / "result.h5")
    assert_same(result, spadwarp.simulate(scene, photons=total, device="cpu"))
    assert result.photons == spadwarp.load_scene(out / "scene.toml").transport.photons
    assert f"relative error {result.relative_error:.4g}" in " ".join(printed.stdout.split())


@pytest.mark.parametrize(
    "parts",
    [
        [("--photons", 10_000), ("--photons", 10_000, "--first-photon", 10_000)],
        [("--shard", f"{number}/3") for number in (1, 2, 3)],
    ],
    ids=["runs", "shards"],
)
def test_parts_are_merged_to_one_run(parts, scene, tmp_path):
    folders = [tmp_path / str(number) for number in range(len(parts))]
    for options, out in zip(parts, folders, strict=True):
        run("simulate", scene, "--out", out, *options, "--quiet", *DEVICE)
    both = tmp_path / "both"
    printed = run("merge", *folders[:-1], folders[-1] / "result.h5", "--out", both, "--json", both / "a.json", *DEVICE)
    merged = spadwarp.load(both / "result.h5")
    whole = spadwarp.simulate(scene, device="cpu")
    assert_same(merged, whole)
    if len(parts) == 3:  # shards are cut between batches
        assert np.array_equal(merged.half, whole.half)
        assert np.array_equal(merged.second_moment, whole.second_moment)
    assert tables(both / "a.json")["photon_ranges"] == [[0, whole.photons]]
    words, last = " ".join(printed.stdout.split()), f"{whole.photons - 1:,}".replace(",", " ")
    assert f"photon ids 0 to {last}" in words and "energy balance exact" in words and (both / "depth.exr").is_file()
    twice = run("merge", folders[0], folders[0], "--out", tmp_path / "twice", code=2)
    assert "photon ids 0 to" in twice.stderr


def test_the_number_of_photons_decides_what_is_resumed(scene, tmp_path):
    """Not the time of the files: a clock that was in the future must not throw photons away."""
    out = tmp_path / "out"
    out.mkdir()

    def put(name, photons, *, age, changes=()):
        whole = spadwarp.simulate(spadwarp.load_scene(scene, changes), photons=photons, device="cpu")
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
    put("checkpoint.h5", 5_000, age=2, changes=["medium.extinction=0.7"])
    assert load_resumable(out)[1].name == "checkpoint.h5"

    put("checkpoint.h5", 30_000, age=2)
    run("simulate", "--resume", out, "--quiet", *DEVICE)
    assert_same(spadwarp.load(out / "result.h5"), spadwarp.simulate(scene, photons=40_000, device="cpu"))
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

    result = spadwarp.load(out / "result.h5")
    assert result.partial and 0 < result.photons < 10**11
    assert result.energy_report()["exact"]
    assert {path.name for path in out.iterdir()} == FILES | pictures
    assert "partial yes" in " ".join(run("info", out).stdout.split())


@pytest.mark.slow
@pytest.mark.skipif(os.name == "nt", reason="sends SIGKILL")
def test_a_killed_run_resumes_from_its_checkpoint(scene, tmp_path):
    """Killed, then interrupted; the outcome is that of one run."""
    out, kept = tmp_path / "out", tmp_path / "out" / "checkpoint.h5"
    process = start("simulate", scene, "--out", out, *DEVICE, "--photons", "1e11", "--checkpoint", 0.1)
    while not kept.exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    process.kill()
    process.communicate()
    before = spadwarp.load(kept)
    assert before.partial and before.energy_report()["exact"] and before.requested == (0, 10**11)
    assert not (out / "result.h5").exists()
    assert f"--resume {out} resumes it" in run("simulate", scene, "--out", out, code=2).stderr.replace("\n", " ")

    with interrupt_at_checkpoint(kept):
        run("simulate", "--resume", out, *DEVICE, "--checkpoint", 0.1, code=130)
    after = spadwarp.load(out / "result.h5")
    assert after.partial and after.photons > before.photons
    total = after.photons + 50_000
    run("simulate", "--resume", out, *DEVICE, "--photons", total)
    assert_same(spadwarp.load(out / "result.h5"), spadwarp.simulate(scene, photons=total, device="cpu"))
    assert "photon ranges" in run("info", out).stdout and {path.name for path in out.iterdir()} == FILES


@pytest.mark.slow
def test_a_run_whose_directory_is_removed_is_written_all_the_same(scene, tmp_path):
    out = tmp_path / "out"

    def remove():
        while out.exists():
            shutil.rmtree(out, ignore_errors=True)

    with interrupt_at_checkpoint(out / "checkpoint.h5", first=remove):
        run("simulate", scene, "--out", out, *DEVICE, "--photons", "1e11", "--checkpoint", 0.1, code=130)
    result = spadwarp.load(out / "result.h5")
    assert result.partial and result.energy_report()["exact"]
    again = spadwarp.simulate(scene, photons=min(result.photons, 50_000), device="cpu")
    assert again.tallies.sum() <= result.tallies.sum()


@contextlib.contextmanager
def interrupt_at_checkpoint(path, first=lambda: None):
    """Ctrl-C when a run in this process has written a checkpoint, and something else before."""
    before, ended = path.stat().st_mtime_ns if path.exists() else 0, threading.Event()

    def wait():
        while not path.exists() or path.stat().st_mtime_ns == before:
            if ended.wait(0.01):
                return
        first()
        signal.raise_signal(signal.SIGINT)

    thread = threading.Thread(target=wait)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()
