"""One rule for what commands write: nothing is replaced that was not named for output, and nothing that is read."""

import os
import subprocess
import sys

import pytest

import spadwarp
from helpers.cli import DEVICE, ENVIRONMENT, run, tables
from spadwarp.io.paths import lock


def refused(*arguments, words=()):
    outcome = run(*arguments, code=2)
    printed = " ".join(outcome.stderr.replace("│", "").split())
    assert all(str(word) in printed for word in words), printed
    return printed


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


@pytest.mark.parametrize("name", ["page.html", "light.gif"])
def test_a_page_or_a_video_never_replaces_what_it_shows(name, done, tmp_path):
    pytest.importorskip("plotly")
    command, before = ("view",), (done / "result.h5").read_bytes()
    for overwrite in ((), ("--overwrite",)):
        refused(*command, done, "--out", done / "result.h5", *overwrite, words=("--out", "result.h5"))
    link = tmp_path / "link"
    link.symlink_to(done)
    refused(*command, link, "--out", done / "result.h5", "--overwrite", words=("is read by this command",))
    assert (done / "result.h5").read_bytes() == before

    path = tmp_path / name
    path.write_text("mine")
    refused(*command, done, "--out", path, words=("--out", "exists"))
    run(*command, done, "--out", path, "--overwrite")
    assert path.read_bytes()[:4] != b"mine"


def test_a_run_is_not_merged_into_one_of_its_parts(done):
    before = (done / "result.h5").read_bytes()
    refused("merge", done, "--out", done, "--overwrite", words=("result.h5", "is read by this command"))
    assert (done / "result.h5").read_bytes() == before


def test_depth_is_not_written_over_what_it_is_estimated_from(done, tmp_path):
    run("export", done, "--format", "npy", "--out", tmp_path)
    source = (tmp_path / "result.npy").rename(tmp_path / "depth.npy")
    before = source.read_bytes()
    options = ("--input", "bin_width=100ps", "--overwrite")
    refused("depth", source, "--out", tmp_path, *options, words=("depth.npy", "is read by this command"))
    refused("depth", done, "--out", tmp_path / "out", "--ply", source, words=("--ply", "exists"))
    assert source.read_bytes() == before


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
    command = [sys.executable, "-m", "spadwarp", "water", "532", "--json"]
    piped = subprocess.run([*command, "/dev/stdout"], env=ENVIRONMENT, capture_output=True, text=True, check=True)
    assert '"extinction"' in piped.stdout and "group index" in piped.stdout
    with (tmp_path / "file").open("w") as file:  # as a shell does for `> file`
        subprocess.run([*command, "/dev/stdout"], env=ENVIRONMENT, stdout=file, check=True)
    assert (tmp_path / "file").read_text() == piped.stdout

    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    process = subprocess.Popen([*command, pipe], env=ENVIRONMENT, stdout=subprocess.DEVNULL)
    assert '"extinction"' in pipe.read_text()
    assert process.wait() == 0 and pipe.is_fifo()
    full = subprocess.run([*command, "/dev/full"], env=ENVIRONMENT, capture_output=True, text=True)
    assert full.returncode == 1 and "/dev/full: cannot be written" in full.stderr


def test_two_commands_do_not_write_to_one_directory(scene, tmp_path):
    out = tmp_path / "out"
    out.mkdir()
    with lock(out / ".spadwarp.lock"):
        outcome = run("simulate", scene, "--out", out, *DEVICE, code=1)
    assert f"{out}: another process is writing" in outcome.stderr
    run("simulate", scene, "--out", out, "--quiet", *DEVICE)
    assert not list(out.glob(".*"))


def test_a_dataset_is_no_output(tmp_path):
    from helpers.datasets import make, recipe

    folder = tmp_path / "data"
    small = {"targets.builtin": ["staircase"], "targets.validation": [], "frames.per_scene": 1, "scenes_per_target": 1}
    make(recipe(**small), folder)
    before = (folder / "manifest.json").read_bytes()
    for words in (("info", folder, "--json"), ("view", folder, "--out"), ("info", folder, "--verify", "--json")):
        refused(*words, folder / "manifest.json", "--overwrite", words=("is read by this command",))
    refused("dataset", folder / "recipe.toml", "--out", folder, "--json", folder / "x.json", words=("folder",))
    preview = ("view", folder, "--pictures", 1, "--out", folder / "preview.png")
    run(*preview)
    refused(*preview, words=("preview.png exists",))
    run(*preview, "--overwrite")
    assert (folder / "manifest.json").read_bytes() == before and not (folder / "x.json").exists()
    run("view", tmp_path / "nosuch", "--out", tmp_path / "nosuch" / "preview.png", code=1)
    assert not (tmp_path / "nosuch").exists()
