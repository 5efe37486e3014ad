"""A full disk, an output that is removed, a folder that cannot be written: nothing is lost, and a sentence says why."""

import resource
import shutil
import signal
import subprocess
import sys
import time

import numpy as np
import pytest

import spadwarp
from helpers.cli import DEVICE, ENVIRONMENT, run, start


def small_files(size):
    """A limit on the size of files stands for the full disk: writing beyond it fails in the middle of a file."""

    def limit():
        signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, size))

    return limit


@pytest.mark.slow
@pytest.mark.parametrize(
    "words",
    [
        ("view", "RUN", "--out", "PLACE/old", "--overwrite"),
        ("export", "RUN", "--format", "npy", "--out", "PLACE", "--overwrite"),
        ("detect", "RUN", "--pulses", "1000", "--out", "PLACE", "--overwrite"),
    ],
    ids=lambda words: words[0],
)
def test_a_full_disk_leaves_the_old_files(words, done, tmp_path, tmp_path_factory):
    if words[0] == "detect":  # its kernels are in the cache then, which has no room for them either
        before = ("detect", str(done), "--pulses", "1000", "--out", str(tmp_path_factory.mktemp("before")))
        subprocess.run([sys.executable, "-m", "spadwarp", *before], env=ENVIRONMENT, check=True, capture_output=True)
    for name in ("old", "result.npy", "frames.h5"):
        (tmp_path / name).write_text("old")
    words = [word.replace("RUN", str(done)).replace("PLACE", str(tmp_path)) for word in words]
    command = [sys.executable, "-m", "spadwarp", *words]
    full = subprocess.run(
        command, env=ENVIRONMENT, capture_output=True, text=True, preexec_fn=small_files(2000), timeout=300
    )
    last = full.stderr.splitlines()[-1]
    assert full.returncode == 1 and last.startswith("error: ") and "cannot be written" in last
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == dict.fromkeys(
        ("old", "result.npy", "frames.h5"), "old"
    )


@pytest.mark.slow
def test_a_run_whose_directory_is_removed_is_written_all_the_same(scene, tmp_path):
    out = tmp_path / "out"
    process = start("simulate", scene, "--out", out, *DEVICE, "--photons", "1e11", "--checkpoint", 0.1)
    while not (out / "checkpoint.h5").exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.02)
    while out.exists():
        shutil.rmtree(out, ignore_errors=True)
    process.send_signal(signal.SIGINT)
    _, complaints = process.communicate(timeout=120)
    assert process.returncode == 130, complaints
    result = spadwarp.load_result(out / "result.h5")
    assert result.partial and result.energy_report()["exact"]
    again = spadwarp.simulate(spadwarp.load_scene(scene), photons=min(result.photons, 50_000), device="cpu")
    assert again.tallies.sum() <= result.tallies.sum()


def test_a_directory_below_a_file_is_refused(done, tmp_path):
    (tmp_path / "file").write_text("mine")
    for words in (
        ("view", done, "--out", tmp_path / "file" / "page.html"),
        ("detect", done, "--out", tmp_path / "file" / "frames"),
        ("info", done, "--json", tmp_path / "file" / "info.json"),
    ):
        assert "cannot be written" in run(*words, code=1).stderr
    assert (tmp_path / "file").read_text() == "mine"
    for words in (("info", tmp_path / ("x" * 300)), ("view", done, "--out", tmp_path / ("x" * 300))):  # too long a name
        assert run(*words, code=1).stderr.startswith("error: ")


def test_arrays_that_are_not_what_their_name_says(tmp_path):
    histograms = np.zeros((2, 2, 8))
    np.savez(tmp_path / "a.npz", histograms)
    (tmp_path / "a.npz").rename(tmp_path / "zip.npy")
    np.save(tmp_path / "pickle.npy", np.array([{"a": 1}], object))
    np.save(tmp_path / "text.npy", np.array(["a", "b"]))
    np.save(tmp_path / "good.npy", histograms)
    content = (tmp_path / "good.npy").read_bytes()
    (tmp_path / "cut.npy").write_bytes(content[:-8])
    (tmp_path / "bomb.npy").write_bytes(content.replace(b"(2, 2, 8)", b"(2,99999999999,8)"[:9] + b""))
    (tmp_path / "deep.npy").write_bytes(content.replace(b"(2, 2, 8)", b"(((((((((")[: len(content)])
    words = {"zip": ".npz archive", "pickle": "object", "text": "<U1", "cut": "cut", "bomb": "", "deep": ""}
    for name, expected in words.items():
        options = ("--input", "bin_width=100ps,gate_start=0,group_index=1", "--out", tmp_path / "out")
        complaint = run("depth", tmp_path / f"{name}.npy", *options, code=1).stderr
        assert f"{name}.npy" in complaint and expected in complaint, complaint
