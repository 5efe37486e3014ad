"""How a command ends when something goes wrong: with a sentence and an exit code, never with a traceback."""

import os
import resource
import shlex
import signal
import subprocess
import sys
import textwrap
import time

import numpy as np
import pytest
from typer.testing import CliRunner

import spadwarp
from helpers.cli import DEVICE, ENVIRONMENT, run, start
from spadwarp.cli import app

CAUSED = RuntimeError("Failed to load the shared library")
CAUSED.__cause__ = OSError("warp.so: failed to map segment from shared object")


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
        (CAUSED, 1, "not enough memory"),
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


def test_a_bug_keeps_its_traceback_in_a_file(monkeypatch, tmp_path):
    monkeypatch.setattr("spadwarp.scene.presets", lambda _: {}["missing"])
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    complaint = run("list", "presets", code=70).stderr
    (kept,) = tmp_path.glob("spadwarp-bug-*.txt")
    assert "error: spadwarp has a bug: KeyError: 'missing'" in complaint and str(kept) in complaint
    assert "Traceback" not in complaint
    assert "Traceback" in kept.read_text() and spadwarp.__version__ in kept.read_text()

    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "none"))
    assert "Traceback" in run("list", "presets", code=70).stderr  # there is no other place for it


# A command, its exit code if it is not 2, and what its complaint says; OUT is not begun.
WRONG = """
simulate SCENE --out OUT --set medium.albedo=1.2 | medium.albedo = 1.2 | [0, 1]
simulate SCENE --out OUT --photons 2.5 | '2.5' | whole number
simulate SCENE --out OUT --photons 0 | transport.photons = 0 | [1,
simulate SCENE --out OUT --photons 3e9 --records | --records | 3000000000
simulate SCENE --out OUT --relative-error 2 | outside (0, 1)
simulate SCENE --out OUT --shard 4/3 | shard = 4/3 is outside [1/3, 3/3]
simulate SCENE --out OUT --shard 1/2 --records | photon 0
simulate SCENE --out OUT --workers 2 | needs --ray
simulate SCENE --out OUT --device cuda:1 --ray start | cuda:1
simulate SCENE --out OUT --device cuda:99 | 1 | cuda:99 | cpu
simulate SCENE --out OUT --mesh missing.stl | 1 | missing.stl | no such file
simulate SCENE | --out
simulate SCENE --out SCENE | is a file
simulate SCENE --out SCENE/below | 1 | cannot be written
simulate SCENE --resume DONE | SCENE
simulate --resume DONE --seed 3 | --seed
simulate --resume DONE | no more than the 20000
simulate --resume TMP | 1 | result.h5
simulate missing.toml --out OUT | 1 | missing.toml
check plane_6m | 1 | did you mean 'plane_5m'?
check SCENE --set medium.typo=1 | medium.typo | not a known field
init other --example staircase_6m | 1 | staircase_5m
list scenes nothing | 'nothing'
water 900 | wavelength_nm = 900.0 is outside [400, 700]
nonsense | nonsense
validate nope | nope
info SCENE | 1 | scene.toml | HDF5
info TMP/nothing.stl | 1 | no such file
export DONE --format npy --split tset --out OUT | did you mean 'test'
detect DONE --out OUT --set medium.extinction=1 | medium.extinction | simulate again
detect DONE --out OUT --frames 0 | frames = 0
analytic SCENE --out OUT --rendered radial | depth=
analytic SCENE --out OUT --profile DONE | monte_carlo
plan SCENE --depth-error 1ns | is a time
plan SCENE --depth-error nan | --depth-error
plan SCENE --range nan:5 | range
plan SCENE --range 1:10m | '1:10m' is ambiguous: 10m has a unit and 1 has none
plan SCENE --range 10ns:60ns | is a time; a length is needed
plan SCENE --depth-error 10 | --depth-error | 10 without a unit is in m; write the unit, such as 10mm or 10m
plan SCENE --range 3 | FROM:TO
plan SCENE --range 9m:8m | 9m is more than 8m
sweep SCENE --vary range=1:10cm:5 | is ambiguous
sweep SCENE --vary range=1,foo,3 | 'foo' is not a number
sweep SCENE --vary range=1:9:3 --vary range=2,3 | range is there twice
sweep SCENE --vary range=1:9:3 --of budget --depth-error 1cm | --depth-error: is for --of plan
evaluate DONE --crop 8 8 | --crop: is for a dataset
sweep SCENE --vary medium.typo=1:2:2 --out OUT | medium.typo
sweep SCENE --vary nonsense --out OUT | from:to:count
sweep SCENE --medium uwoc-cleer | uwoc-clear
depth DONE --out OUT --input bin_width=5ps | the file has its own bin_width
depth SCENE --out OUT --input bin_with=5ps | 'bin_with' is not one of bin_width, gate_start, irf
depth SCENE --out OUT --input image_size=5 | image_size = '5' is not of the form WIDTHxHEIGHT
denoise SCENE --out OUT --gate 110ns:90ns | --gate | 110ns is more than 90ns
fit SCENE --bounds --unknown absorption --prior reflectance=0.5,0.1 --photons 1000 | targets[0].reflectance is not
fit SCENE --unknown depth --prior medium.anisotropy=0.9 | is not NAME=MEAN,SD
"""


@pytest.mark.parametrize("line", WRONG.strip().splitlines())
def test_what_is_wrong_with_a_command_is_named(line, scene, done, tmp_path):
    command, *words = line.split(" | ")
    code = int(words.pop(0)) if words[0] == "1" else 2
    for name, place in {"SCENE": scene, "OUT": tmp_path / "out", "DONE": done, "TMP": tmp_path}.items():
        command = command.replace(name, str(place))
    outcome = run(*shlex.split(command), code=code)
    printed = " ".join(outcome.stderr.replace("│", "").split())
    assert outcome.stdout == "" and all(word in printed for word in words), printed
    assert not (tmp_path / "out").exists()


@pytest.mark.slow
def test_a_date_of_the_environment_that_is_no_number(scene, tmp_path, monkeypatch):
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "yesterday")
    pdf = ("--set", "output.png=true", "--set", "output.pdf=true", "--photons", "1e3")
    # And a device that is named twice.
    complaint = run("simulate", scene, "--out", tmp_path / "out", *pdf, "--device", "cpu,cpu").stderr
    assert "cpu is named more than once" in complaint
    assert (tmp_path / "out" / "depth.pdf").is_file() and os.environ["SOURCE_DATE_EPOCH"] == "yesterday"


def test_a_terminal_may_lack_letters(scene):
    words = ["sweep", str(scene), "--vary", "range=2:3:2", *DEVICE]
    assert b"?* [mm]" in CliRunner(charset="latin-1").invoke(app, words).stdout_bytes


# Processes


def process(*arguments, **options):
    options = {"env": ENVIRONMENT, "stderr": subprocess.PIPE, "text": True, "timeout": 120} | options
    return subprocess.run([sys.executable, *map(str, arguments)], check=False, **options)


PRESETS = ("-m", "spadwarp", "list", "presets")


def test_an_answer_that_cannot_be_written_is_an_error():
    with open("/dev/full", "w") as full:
        done = process(*PRESETS, stdout=full)
    assert (done.returncode, done.stderr) == (1, "error: No space left on device\n")


@pytest.mark.slow
def test_streams_may_be_closed():
    done = process(*PRESETS, stdout=None, preexec_fn=lambda: os.close(1))
    assert (done.returncode, done.stderr) == (0, "")
    done = process(*PRESETS, stderr=None, stdout=subprocess.DEVNULL, preexec_fn=lambda: os.close(2))
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
    done = process("-c", textwrap.dedent(code), stdout=subprocess.PIPE)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "error: interrupted\n")


@pytest.mark.slow
@pytest.mark.parametrize("moment", [0.3, 1.0])
def test_an_interrupt_at_any_moment(moment, scene):
    with start("check", scene) as command:
        time.sleep(moment)
        command.send_signal(signal.SIGINT)
        _, complaints = command.communicate(timeout=120)
    assert command.returncode in (0, 130, -signal.SIGINT)  # the last: before Python itself has begun
    assert "Traceback" not in complaints or "spadwarp" not in complaints


def limited(mebibytes, *arguments):
    def limit():
        resource.setrlimit(resource.RLIMIT_AS, (mebibytes << 20, mebibytes << 20))
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))

    return process("-m", "spadwarp", *arguments, stdout=subprocess.DEVNULL, preexec_fn=limit)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("mebibytes", "needed", "arguments"),
    [
        (250, "spadwarp needs 0.5 GiB", ("list", "presets")),
        (600, "Warp needs 1 GiB", ("simulate", "plane_5m", "--out", "out")),
        (720, "Warp needs 1 GiB", ("sweep", "plane_5m")),
        (700, "denoising needs 1 GiB", ("denoise", "depth.npy", "--model", "usdn", "--out", "out")),
    ],
)
def test_less_memory_than_the_libraries_need(mebibytes, needed, arguments, tmp_path, monkeypatch):
    """They would end the process, or wait for ever."""
    monkeypatch.chdir(tmp_path)
    np.save("depth.npy", np.ones((8, 8), np.float32))
    done = limited(mebibytes, *arguments)
    assert done.returncode == 1 and "not enough memory" in done.stderr and needed in done.stderr


@pytest.mark.slow
@pytest.mark.parametrize(("command", "mebibytes"), [("simulate", 1100), ("sweep", 1030)])
def test_short_memory_is_named(command, mebibytes, scene, tmp_path):
    done = limited(mebibytes, command, scene, "--device", "cpu", "--out", tmp_path / "out")
    said = ("not enough memory", "too little memory", "OpenBLAS error: Memory")
    assert done.returncode == 0 or (done.returncode == 1 and any(text in done.stderr for text in said))
    assert "Traceback" not in done.stderr and "bug" not in done.stderr


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (("plan", "scene.toml", "--vary", "range=1,2"), "No such option: --vary; sweep has it"),
        (("sweep", "scene.toml", "--eye-distance", "1"), "No such option: --eye-distance; plan has it"),
        (("plan", "scene.toml", "--time", "10", "ms"), "write 10ms as one word"),
        (("plan", "scene.toml", "--methd", "peak"), "(Possible options: --mesh, --method)"),
    ],
)
def test_options_that_a_command_lacks_are_told_from_misspelt_ones(words, text):
    assert text in run(*words, code=2).stderr


def test_a_command_does_not_write_where_it_reads(done):
    lines = run("detect", done, "--out", done, code=2).stderr
    assert f"{done} is read by this command; name another directory" in lines and "frames.h5" not in lines
