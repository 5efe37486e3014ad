"""How a command ends when something goes wrong: with a sentence and an exit code, never with a traceback."""

import os
import resource
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest

import spadwarp
from helpers.cli import ENVIRONMENT, run, start


@pytest.mark.parametrize(
    ("error", "code", "text"),
    [
        (spadwarp.FileError("a.h5: damaged"), 1, "error: a.h5: damaged"),
        (spadwarp.ConfigError(["a", "b"], source="s.toml"), 2, "error: s.toml: a\nerror: s.toml: b"),
        (spadwarp.ArgumentError("seed = -1 is outside"), 2, "error: seed = -1 is outside"),
        (PermissionError(13, "Permission denied", "/srv/x"), 1, "error: /srv/x: Permission denied"),
        (OSError(36, "File name too long", "a", None, "b"), 1, "error: a and b: File name too long"),
        (OSError(28, "No space left on device"), 1, "error: No space left on device"),
        (MemoryError("Unable to allocate 7 GiB"), 1, "not enough memory"),
        (OSError(12, "Cannot allocate memory"), 1, "not enough memory"),
        (RuntimeError("can't start new thread"), 1, "not enough memory"),
        (ImportError("x.so: failed to map segment from shared object"), 1, "not enough memory"),
        (ImportError("x.so: undefined symbol"), 1, "a package cannot be loaded, see `spadwarp doctor`: x.so"),
        (RecursionError("maximum recursion depth exceeded"), 1, "error: the input is nested too deeply"),
        (UnicodeEncodeError("utf-8", "\ud800", 0, 1, "surrogates"), 1, "text that cannot be read or written"),
        (KeyboardInterrupt(), 130, "error: interrupted"),
    ],
    ids=lambda value: type(value).__name__ if isinstance(value, BaseException) else None,
)
def test_what_can_be_foreseen_is_a_sentence(error, code, text, monkeypatch):
    def fails(*_, **__):
        raise error

    monkeypatch.setattr("spadwarp.scene.presets", fails)
    outcome = run("list", "presets", code=code)
    assert text in outcome.stderr and outcome.stdout == ""
    assert "Traceback" not in outcome.stderr and "bug" not in outcome.stderr


def test_what_caused_an_error_counts(monkeypatch):
    def fails():
        try:
            raise OSError("warp.so: failed to map segment from shared object")
        except OSError as error:
            raise RuntimeError("Failed to load the shared library") from error

    monkeypatch.setattr("spadwarp.scene.presets", fails)
    assert "not enough memory" in run("list", "presets", code=1).stderr


def test_a_bug_keeps_its_traceback_in_a_file(monkeypatch, tmp_path):
    monkeypatch.setattr("spadwarp.scene.presets", lambda: {}["missing"])
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    complaint = run("list", "presets", code=70).stderr
    (kept,) = tmp_path.glob("spadwarp-bug-*.txt")
    assert "error: spadwarp has a bug: KeyError: 'missing'" in complaint and str(kept) in complaint
    assert "Traceback" not in complaint
    assert "Traceback" in kept.read_text() and spadwarp.__version__ in kept.read_text()

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    assert "Traceback" in run("list", "presets", code=70).stderr  # there is no other place for it


def process(*arguments, **options):
    options = {"env": ENVIRONMENT, "stderr": subprocess.PIPE, "text": True, "timeout": 120} | options
    return subprocess.run([sys.executable, "-m", "spadwarp", *map(str, arguments)], check=False, **options)


def test_a_terminal_may_lack_letters(scene):
    options = {"env": ENVIRONMENT | {"PYTHONIOENCODING": "latin-1"}, "encoding": "latin-1", "stdout": subprocess.PIPE}
    done = process("sweep", scene, "--vary", "range=2:3:2", "--device", "cpu", **options)
    assert done.returncode == 0 and "?* [mm]" in done.stdout


def test_an_answer_that_cannot_be_written_is_an_error():
    with open("/dev/full", "w") as full:
        done = process("list", "presets", stdout=full)
    assert (done.returncode, done.stderr) == (1, "error: No space left on device\n")


def test_streams_may_be_closed():
    done = process("list", "presets", stdout=None, preexec_fn=lambda: os.close(1))
    assert (done.returncode, done.stderr) == (0, "")
    done = process("list", "presets", stderr=None, stdout=subprocess.DEVNULL, preexec_fn=lambda: os.close(2))
    assert done.returncode == 0


def test_an_interrupt_while_commands_are_loaded():
    code = """
        import sys
        class Interrupting:
            def find_spec(self, name, path=None, target=None):
                if name == "spadwarp.cli.results":
                    raise KeyboardInterrupt
        sys.meta_path.insert(0, Interrupting())
        from spadwarp.__main__ import main
        main()
    """
    command = [sys.executable, "-c", textwrap.dedent(code)]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, check=False, timeout=120)
    assert (done.returncode, done.stderr) == (130, "error: interrupted\n")


@pytest.mark.slow
def test_an_interrupt_at_any_moment(scene):
    for moment in (0.2, 0.5, 1.0, 1.5):
        command = start("check", scene)
        time.sleep(moment)
        command.send_signal(signal.SIGINT)
        _, complaints = command.communicate(timeout=120)
        assert command.returncode in (0, 130, -signal.SIGINT)  # the last: before Python itself has begun
        assert "Traceback" not in complaints or "spadwarp" not in complaints


def _limited(mebibytes, *arguments):
    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (mebibytes << 20, mebibytes << 20))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    return process(*arguments, stdout=subprocess.DEVNULL, preexec_fn=limit)


@pytest.mark.parametrize(
    ("mebibytes", "needed", "arguments"),
    [
        (250, "spadwarp needs 0.5 GiB", ("list", "presets")),
        (600, "Warp needs 1 GiB", ("simulate", "plane_5m", "--out", "out")),
        (720, "Warp needs 1 GiB", ("sweep", "plane_5m")),
        (560, "denoising needs 1 GiB", ("denoise", "depth.npy", "--model", "usdn", "--out", "out")),
        (700, "denoising needs 1 GiB", ("denoise", "depth.npy", "--model", "usdn", "--out", "out")),
    ],
)
def test_less_memory_than_the_libraries_need(mebibytes, needed, arguments, tmp_path, monkeypatch):
    """They would end the process, or wait for ever."""
    monkeypatch.chdir(tmp_path)
    np.save("depth.npy", np.ones((8, 8), np.float32))
    done = _limited(mebibytes, *arguments)
    assert done.returncode == 1 and "not enough memory" in done.stderr and needed in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize("mebibytes", [1030, 1100])
@pytest.mark.parametrize("command", ["simulate", "sweep"])
def test_short_memory_is_named(command, mebibytes, scene, tmp_path):
    out = tmp_path / "out"
    done = _limited(mebibytes, command, scene, "--device", "cpu", "--out", out)
    assert done.returncode in (0, 1)
    said = ("not enough memory", "too little memory", "OpenBLAS error: Memory")
    assert done.returncode == 0 or any(text in done.stderr for text in said)
    assert "Traceback" not in done.stderr and "bug" not in done.stderr


def test_a_date_or_rank_of_the_environment_that_is_no_number(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    pdf = ("--set", "output.png=true", "--set", "output.pdf=true", "--photons", "1e3")
    run("simulate", scene, "--out", tmp_path / "out", *pdf, "--device", "cpu")
    assert (tmp_path / "out" / "depth.pdf").is_file() and os.environ["SOURCE_DATE_EPOCH"] == "yesterday"
    monkeypatch.setenv("RANK", "²")
    (tmp_path / "train.toml").write_text('model = "dncnn"\ndata = "none"\n')
    complaint = run("train", tmp_path / "train.toml", "--out", tmp_path / "weights", code=2).stderr
    assert "environment variable RANK = '²' is not an integer" in complaint


def test_a_device_that_is_named_twice_is_told(scene, tmp_path):
    options = ("--device", "cpu,cpu", "--photons", "1e3", "--out", tmp_path / "out")
    assert "cpu is named more than once" in run("simulate", scene, *options).stderr


def test_an_unknown_split_is_refused_for_every_source(done, tmp_path):
    options = ("--format", "npy", "--split", "tset", "--out", tmp_path / "out")
    assert "did you mean 'test'" in run("export", done, *options, code=2).stderr
