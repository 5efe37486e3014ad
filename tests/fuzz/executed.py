"""A case run in a child process: how it ended, what it wrote, and whether something that is not finite got in."""

import contextlib
import hashlib
import io
import math
import os
import re
import subprocess
import sys
import tempfile
import warnings
from pathlib import Path
from typing import Any

import spadwarp
from fuzz import command_lines
from fuzz.cases import Case, write
from fuzz.isolation import Outcome, run_isolated
from spadwarp.dataset.recipe import load_recipe
from spadwarp.denoise.recipe import load_training_recipe
from spadwarp.values import SpadwarpError

BUG = 70  # exit code of a command that met an error nobody thought of
# Fields in which infinity has a meaning.
UNBOUNDED = re.compile(
    r"transport\.lateral_limit|scan\.distance|camera\.(focus_distance|analyser_extinction_ratio)|"
    r".*\.(lower|upper)|medium\.layers.*|.*max_path"
)


def run_case(case: Case, corpus: Path) -> tuple[str, str]:
    """The verdict, "done", "refused" or what went wrong, and a text about it."""
    with tempfile.TemporaryDirectory(prefix="fuzz-") as name:
        folder = Path(name)
        try:
            write(case, folder, corpus)
        except (OSError, ValueError):
            return "refused", "no such file can be written"
        before = _digests(folder)
        outcome = run_isolated(lambda: _child(case, folder))
        return _judge(case, outcome, before, _digests(folder))


def _judge(case: Case, outcome: Outcome, before: dict[str, str], after: dict[str, str]) -> tuple[str, str]:
    if outcome.kind != "done":
        return outcome.kind, f"{outcome.value} after {outcome.seconds:.1f} s\n{outcome.text}"
    code, errors, unbounded = outcome.value
    if code == BUG or "Traceback (most recent call last)" in errors:
        return "traceback", errors[-1500:]
    allowed = [f"{one.rstrip('/')}/" for one in case.outputs]
    changed = {f"{name}/" for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
    # An output, what is in it, and the folders on the way to it.
    fine = {name for name in changed for one in allowed if name.startswith(one) or one.startswith(name)}
    if changed > fine and not {"/", "./"} & set(allowed):  # the folder itself
        return "output", f"{sorted(changed - fine)} changed"
    if unbounded:
        return "non-finite", f"{unbounded} accepted"
    return ("done" if code == 0 else "refused"), errors[-300:]


def _digests(folder: Path) -> dict[str, str]:
    found = {}
    for place in folder.rglob("*"):
        with contextlib.suppress(OSError):
            is_file = place.is_file() and not place.is_symlink()
            content = hashlib.md5(place.read_bytes()).hexdigest() if is_file else "folder"
            found[place.relative_to(folder).as_posix()] = content
    return found


def _child(case: Case, folder: Path) -> tuple[int, str, list[str]]:
    """Exit code, stderr, and fields that are not finite though they should be."""
    os.chdir(folder)
    os.environ["HOME"] = str(folder / "out")
    os.environ["TMPDIR"] = tempfile.tempdir = str(folder.parent)
    warnings.simplefilter("ignore")
    sys.stdin = open(os.devnull)  # noqa: SIM115
    command, *rest = case.arguments
    if command.startswith("load"):
        return _load(command, rest[0])
    if command == "changed":
        return *_changed(*rest), []
    code, text = _command(case.arguments)
    scene = [name for name in case.files if name.endswith("scene.toml") or name == "calibrated.toml"]
    accepted = code == 0 and case.injected and scene
    return code, text, _load("load_scene", scene[0])[2] if accepted else []


def _changed(scene: str, name: str, command: str) -> tuple[int, str]:
    """Runs a scene, puts another file in the place of one of its own, and continues the run, or merges with the next
    part of it: refused by the name of the file, if it is another."""
    same = Path(name).read_bytes() == Path("new", name).read_bytes()
    run = ("simulate", scene, "--photons", "64", "--device", "cpu", "--quiet", "--out")
    assert _command((*run, "out/a"))[0] == 0
    os.replace(f"new/{name}", name)
    goes_on = ("simulate", "--resume", "out/a", "--photons", "128", "--device", "cpu")
    if command == "merge":
        code, text = _command((*run, "out/b", "--first-photon", "64"))
        if code != 0:
            return code, text  # a damaged file
        goes_on = ("merge", "out/a", "out/b", "--out", "out/c")
    code, text = _command(goes_on)
    # A result holds what its camera's calibration said, and the colours of its targets, and compares these.
    compared = name == "camera.yaml" or name.endswith((".mtl", ".png"))
    if (code != 0) if same else (code == 0 and not compared):
        return BUG, f"{'refused' if same else 'accepted'} after {name} {'stayed' if same else 'changed'}: {text}"
    return (
        (code, text)
        if same or compared or name in text or "name too long" in text
        else (BUG, f"does not name {name}: {text}")
    )


def _command(arguments: tuple[str, ...]) -> tuple[int, str]:
    """Exit code and stderr."""
    if arguments[0] == "train":  # after Warp's start, torch's derivatives do not survive a fork
        run = [sys.executable, "-m", "spadwarp", *arguments]
        done = subprocess.run(run, env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)}, capture_output=True)
        text = done.stderr.decode(errors="replace")
        return (done.returncode, text) if done.returncode >= 0 else (BUG, f"signal {-done.returncode}: {text}")
    out, err = io.TextIOWrapper(io.BytesIO()), io.TextIOWrapper(io.BytesIO(), errors="replace")
    code = 0
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            command_lines.program()(list(arguments), prog_name="spadwarp")
        except SystemExit as stop:
            code = stop.code if isinstance(stop.code, int) else 1
        err.flush()
    text = err.buffer.getvalue().decode(errors="replace")
    if bug := re.search(r"report it with (\S+)", text):
        with contextlib.suppress(OSError):
            text += Path(bug[1].rstrip(",")).read_text()[-1200:]
            os.unlink(bug[1].rstrip(","))
    return code, text


def _load(what: str, path: str) -> tuple[int, str, list[str]]:
    """A loader called from Python: its errors are those of spadwarp, and what it returns is finite."""
    loaders = {"load": spadwarp.load, "load_scene": spadwarp.load_scene}
    loaders |= {"load_recipe": load_recipe, "load_training": load_training_recipe}
    try:
        found = loaders[what](path)
    except (SpadwarpError, MemoryError) as error:
        return 1, str(error), []
    numbers = () if what == "load" else _numbers(found.model_dump(), "")
    return 0, "", [name for name, value in numbers if not _is_fine(name, value)]


def _numbers(value: Any, name: str):
    if isinstance(value, dict):
        for key, one in value.items():
            yield from _numbers(one, f"{name}.{key}" if name else str(key))
    elif isinstance(value, (list, tuple)):
        for one in value:
            yield from _numbers(one, name)
    elif isinstance(value, float):
        yield name, value


def _is_fine(name: str, value: float) -> bool:
    return math.isfinite(value) or (math.isinf(value) and UNBOUNDED.fullmatch(name) is not None)
