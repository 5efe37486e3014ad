"""One rule for what commands write: nothing is replaced that was not named for output, and nothing that is read. On a
full disk, nothing is lost."""

import os
import subprocess
import sys
import threading

import numpy as np
import pytest

import spadwarp
from helpers.cli import DEVICE, ENVIRONMENT, run, small_files, tables
from helpers.datasets import make, recipe
from spadwarp.io.paths import lock


def refused(*arguments, words=()):
    outcome = run(*arguments, code=2)
    printed = " ".join(outcome.stderr.replace("│", "").split())
    assert all(str(word) in printed for word in words), printed


@pytest.mark.parametrize(
    "command",
    [
        ("info", "RUN"),
        ("water", "532"),
        ("list", "presets"),
        ("check", "SCENE"),
        ("doctor", "--no-self-test", "--quiet"),
    ],
    ids=lambda command: command[0],
)
def test_a_file_that_exists_is_replaced_only_when_asked(command, scene, done, tmp_path):
    words = [{"RUN": done, "SCENE": scene}.get(word, word) for word in command]
    mine = tmp_path / "mine.json"
    mine.write_text("mine")
    refused(*words, "--json", mine, words=("--json", "mine.json exists", "--overwrite"))
    assert mine.read_text() == "mine"
    run(*words, "--json", mine, "--overwrite")
    assert tables(mine)


def test_refused_before_the_work_begins(scene, tmp_path, monkeypatch):
    monkeypatch.setattr(spadwarp, "simulate", lambda *_, **__: pytest.fail("it ran"))
    out, mine = tmp_path / "out", tmp_path / "mine.json"
    mine.write_text("mine")
    refused("simulate", scene, "--out", out, "--json", mine, words=("--json", "exists"))
    # Nor what the run itself writes, and what it reads; not even with --overwrite.
    refused("simulate", scene, "--out", out, "--json", out / "scene.toml", words=("scene.toml", "also written"))
    options = ("--out", scene.parent, "--overwrite")
    refused("simulate", scene, *options, words=("--out", scene.name, "is read by this command"))
    refused("simulate", scene, "--out", out, "--json", tmp_path, words=("--json", "is a directory"))
    assert mine.read_text() == "mine" and not list(out.glob("*"))


def test_a_command_that_fails_leaves_no_empty_folder(tmp_path):
    (tmp_path / "bad.npy").write_bytes(b"junk")
    kept = tmp_path / "kept"
    kept.mkdir()
    for out in (tmp_path / "new" / "out", kept):
        run("denoise", tmp_path / "bad.npy", "--out", out, "--json", tmp_path / "other" / "a.json", code=1)
    assert sorted(path.name for path in tmp_path.iterdir()) == ["bad.npy", "kept"] and not list(kept.iterdir())


def test_what_is_read_is_never_replaced(done, tmp_path):
    pytest.importorskip("plotly")
    source = done / "result.h5"
    run("export", done, "--format", "npy", "--out", tmp_path)
    depth = (tmp_path / "result.npy").rename(tmp_path / "depth.npy")
    before = source.read_bytes(), depth.read_bytes()
    (tmp_path / "link").symlink_to(done)
    refused("view", done, "--out", source, words=("--out", "result.h5"))
    refused("view", tmp_path / "link", "--out", source, "--overwrite", words=("does not end in .html",))
    for command in (("merge", done, "--out", done), ("depth", depth, "--out", tmp_path, "--input", "bin_width=100ps")):
        refused(*command, "--overwrite", words=("is read by this command",))
    (tmp_path / "points.ply").touch()
    refused("depth", done, "--out", tmp_path / "out", "--ply", tmp_path / "points.ply", words=("--ply", "exists"))
    assert (source.read_bytes(), depth.read_bytes()) == before
    for name, options in {"page.html": (), "light.gif": ("--pictures", 3)}.items():
        path = tmp_path / name
        path.write_text("mine")
        refused("view", done, "--out", path, words=("--out", "exists"))
        run("view", done, "--out", path, *options, "--overwrite")
        assert path.read_bytes()[:4] != b"mine"


def test_what_appears_while_a_command_runs_is_not_replaced(done, tmp_path, monkeypatch):
    mine, load = tmp_path / "mine.json", spadwarp.load
    monkeypatch.setattr(spadwarp, "load", lambda path: mine.write_text("mine") and load(path))
    assert "appeared" in run("info", done, "--json", mine, code=1).stderr
    assert mine.read_text() == "mine"


def test_links_are_replaced_and_never_written_through(scene, tmp_path):
    out, mine = tmp_path / "out", tmp_path / "mine.toml"
    (tmp_path / "folder").mkdir()
    out.symlink_to("folder")
    mine.write_text("mine")
    for name in ("scene.toml", "summary.json"):
        (out / name).symlink_to(mine)
    summary = tmp_path / "summary.json"
    summary.symlink_to(mine)
    refused("simulate", scene, "--out", out, words=("not empty",))
    options = ("--json", summary, "--quiet", *DEVICE)
    refused("simulate", scene, "--out", out, *options, words=("summary.json exists",))
    run("simulate", scene, "--out", out, "--overwrite", *options)
    assert mine.read_text() == "mine" and out.is_symlink()
    assert (tmp_path / "folder" / "scene.toml").is_file() and not (out / "scene.toml").is_symlink()
    assert tables(summary)["photons"] == 20_000


@pytest.mark.skipif(os.name != "posix", reason="pipes and devices of POSIX")
def test_pipes_and_devices_are_written_to_as_they_are(tmp_path):
    command = [sys.executable, "-m", "spadwarp", "water", "532", "--json", "/dev/stdout"]
    piped = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert '"extinction"' in piped.stdout and "group index" in piped.stdout
    with (tmp_path / "file").open("w") as file:  # as a shell does for `> file`
        subprocess.run(command, env=ENVIRONMENT, stdout=file, check=True)
    assert (tmp_path / "file").read_text() == piped.stdout

    pipe, read = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: read.append(pipe.read_text()), daemon=True)
    reader.start()
    run("water", "532", "--json", pipe)
    reader.join(60)
    assert '"extinction"' in read[0] and pipe.is_fifo()
    assert "/dev/full: cannot be written" in run("water", "532", "--json", "/dev/full", code=1).stderr


def test_two_commands_do_not_write_to_one_directory(scene, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with lock(out / ".spadwarp.lock"):
        outcome = run("simulate", scene, "--out", out, *DEVICE, code=1)
    assert f"{out}: another process is writing" in outcome.stderr
    run("simulate", scene, "--out", out, "--quiet", *DEVICE)
    assert not list(out.glob(".*"))


@pytest.mark.slow
def test_a_dataset_is_no_output(tmp_path):
    folder = tmp_path / "data"
    small = {"targets.builtin": ["staircase"], "targets.validation": [], "frames.per_scene": 1, "scenes_per_target": 1}
    make(recipe(**small), folder)
    before = (folder / "manifest.json").read_bytes()
    for words in (("info", folder, "--json"), ("info", folder, "--verify", "--json")):
        refused(*words, folder / "manifest.json", "--overwrite", words=("is read by this command",))
    refused("dataset", folder / "recipe.toml", "--out", folder, "--json", folder / "x.json", words=("folder",))
    preview = ("view", folder, "--pictures", 1, "--out", folder / "preview.png")
    run(*preview)
    refused(*preview, words=("preview.png exists",))
    run(*preview, "--overwrite")
    assert (folder / "manifest.json").read_bytes() == before and not (folder / "x.json").exists()
    run("view", tmp_path / "nosuch", "--out", tmp_path / "nosuch" / "preview.png", code=2)
    assert not (tmp_path / "nosuch").exists()


@pytest.mark.filterwarnings("ignore:not enough photons")
@pytest.mark.skipif(os.name != "posix", reason="limits of POSIX")
@pytest.mark.parametrize(
    "words",
    [
        ("view", "--out", "old.html", "--overwrite"),
        ("export", "--format", "npy", "--out", ".", "--overwrite"),
        ("detect", "--pulses", "1000", "--out", ".", "--overwrite", *DEVICE),
    ],
    ids=lambda words: words[0],
)
def test_a_full_disk_leaves_the_old_files(words, done, tmp_path, monkeypatch):
    if words[0] == "detect":  # its kernels are loaded then: in the cache there is no room for them either
        run("detect", done, "--pulses", "1000", "--out", tmp_path / "before", *DEVICE)
    place = tmp_path / "place"
    place.mkdir()
    monkeypatch.chdir(place)
    old = dict.fromkeys(("old", "old.html", "result.npy", "frames.h5"), "old")
    for name, text in old.items():
        (place / name).write_text(text)
    command, *rest = words
    with small_files(2000):
        last = run(command, done, *rest, code=1).stderr.splitlines()[-1]
    assert last.startswith("error: ") and "cannot be written" in last
    assert {path.name: path.read_text() for path in place.iterdir()} == old


def test_a_directory_below_a_file_or_of_too_long_a_name_is_refused(done, tmp_path):
    (tmp_path / "file").write_text("mine")
    for words in (
        ("view", done, "--out", tmp_path / "file" / "page.html"),
        ("detect", done, "--out", tmp_path / "file" / "frames"),
        ("info", done, "--json", tmp_path / "file" / "info.json"),
    ):
        assert "cannot be written" in run(*words, code=1).stderr
    assert (tmp_path / "file").read_text() == "mine"
    for words in (("info", tmp_path / ("x" * 300)), ("view", done, "--out", tmp_path / ("x" * 300 + ".html"))):
        assert run(*words, code=1).stderr.startswith("error: ")


def test_arrays_that_are_not_what_their_name_says(tmp_path):
    histograms = np.zeros((2, 2, 8))
    np.save(tmp_path / "good.npy", histograms)
    content = (tmp_path / "good.npy").read_bytes()
    with (tmp_path / "zip.npy").open("wb") as file:
        np.savez(file, histograms)
    np.save(tmp_path / "pickle.npy", np.array([{"a": 1}], object))
    np.save(tmp_path / "text.npy", np.array(["a", "b"]))
    (tmp_path / "cut.npy").write_bytes(content[:-8])
    (tmp_path / "bomb.npy").write_bytes(content.replace(b"(2, 2, 8), }" + b" " * 10, b"(2, 99999999999, 8), }"))
    (tmp_path / "deep.npy").write_bytes(content.replace(b"(2, 2, 8)", b"((((((((("))
    words = {"zip": ".npz archive", "pickle": "object", "text": "<U1", "cut": "cut", "bomb": "", "deep": ""}
    options = ("--input", "bin_width=100ps,gate_start=0,group_index=1", "--out", tmp_path / "out")
    for name, expected in words.items():
        complaint = run("depth", tmp_path / f"{name}.npy", *options, code=1).stderr
        assert f"{name}.npy" in complaint and expected in complaint, complaint
