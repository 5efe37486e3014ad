"""Code in the pages and notebooks of the documentation runs, at a small size, or there is a reason why not."""

import json
import os
import re
import runpy
import shlex
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import trimesh

import spadwarp
from helpers.cli import ENVIRONMENT, QUICK, run
from helpers.coarse_pictures import coarse_pictures
from helpers.pages import PAGES, README, ROOT, blocks, by_name, commands, lines, text_of

TUTORIAL = ROOT / "docs" / "tutorial.md"
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))

# The same commands at a small size.
SMALLER = {
    r"--photons \S+": "--photons 5e3",
    r"^(spadwarp simulate (?!.*--resume).*)": r"\1 --set camera.width=16 --set camera.height=12",
    r"^(spadwarp simulate (?!.*(--photons|--resume)).*)": r"\1 --photons 5e3",
    r"^(spadwarp fit .*)": r"\1 --set camera.width=16 --set camera.height=12",
    r"^(spadwarp plan .*)": r"\1 --photons 5e3 --no-range",
    r"^(spadwarp sweep .*analyser.*)": r"\1 --photons 5e3",
    r"--pulses 20000": "--pulses 500",
    r"--steps 24": "--steps 3",
    r"=1:40:40": "=1:40:3",
    r"(view .*\.gif)$": r"\1 --pictures 3",
    r"--size 320 240": "--size 64 48",
    r"spadwarp dataset \S+": "spadwarp dataset small --set scenes_per_target=1 --set frames.per_scene=2",
    r"dataset small --set": "dataset small --set scenes_per_shard=1 --set",
    r"train (out/\S+)": r"train \1 --set optimiser.steps=2",
    r"^spadwarp evaluate data": "spadwarp evaluate --frames 1 data",
    r"--device cuda:\w+": "--device cpu",
}

SMALLER_PYTHON = {r"photons=[12]00_000, (frame|seed)": r"photons=20_000, \1", r"range\(60\)": "range(3)"}

# What does not run here, and why.
LEFT_OUT = {
    r"pip install|python3 -m venv|^\.venv/bin": "installs; .ci/run runs the README's two blocks",
    r"^spadwarp doctor": "reports on this machine; tests/doctor",
    r"--ray |out/cluster/": "needs a Ray cluster; tests/parallel runs Ray on this machine",
    r"^sbatch|part\$id|out/part": "needs Slurm; tests/transport runs and merges shards",
    r"train configs/|\bruns/": "recipes for a GPU; tests/denoise trains the networks for a few steps",
    r"^python bench/peers": "needs networks of others",
    r"^python docs/figures/measured": "needs a published capture",
    r"evaluate --(fresh|report)": "take minutes; tests/denoise has them at a small size",
    r"bm3d": "takes minutes; tests/denoise has it on a small frame",
}


# The README's always, those of the other pages with the slow tests.
WITH_PYTHON = [
    pytest.param(page, marks=() if page == README else pytest.mark.slow)
    for page in (README, *PAGES)
    if page != TUTORIAL and blocks(page, "python")
]
WITH_COMMANDS = [page for page in (README, *PAGES) if page != TUTORIAL and commands(page)]


@pytest.fixture
def checkout(tmp_path, monkeypatch):
    """A folder in which configurations and examples lie as in a checkout; afterwards, nothing that git would see."""
    folder = tmp_path / "checkout"
    folder.mkdir()
    for name in ("configs", "kernels"):
        (folder / name).symlink_to(ROOT / name)
    monkeypatch.chdir(folder)
    coarse_pictures(monkeypatch.setattr)
    yield folder
    left = {path.name for path in folder.iterdir()}
    left -= {"configs", "kernels", "out", "data", "runs", "bust.stl", "poses.csv"}
    assert not left, f"{left} would be left in the checkout"


def program_of(page, folder):
    """The Python blocks of a page, one after the other, as a file: Warp reads the source of kernels."""
    code = "\n".join(code for _, code in blocks(page, "python"))
    for pattern, smaller in SMALLER_PYTHON.items():
        code = re.sub(pattern, smaller, code)
    (folder / "program.py").write_text(code, encoding="utf-8")
    return str(folder / "program.py")


def run_small(line):
    """A command in this process, at a small size."""
    if any(re.search(pattern, line) for pattern in LEFT_OUT):
        return
    for pattern, smaller in SMALLER.items():
        line = re.sub(pattern, smaller, line)
    program, *arguments = shlex.split(line)
    if program == "python":
        with pytest.MonkeyPatch.context() as patch:
            patch.setattr(sys, "argv", arguments)
            runpy.run_path(arguments[0], run_name="__main__")
    else:
        assert program == "spadwarp", line
        run(*arguments)


@pytest.mark.filterwarnings("ignore:not enough photons")
@pytest.mark.parametrize("page", WITH_PYTHON, ids=by_name)
def test_python_in_the_text_runs(page, checkout, tmp_path):
    runpy.run_path(program_of(page, tmp_path))


@pytest.mark.slow
def test_python_of_the_kernels_runs_without_spadwarp_in_reach(tmp_path):
    program = program_of(ROOT / "kernels" / "README.md", tmp_path)
    command = [sys.executable, "-c", f"import runpy; runpy.run_path({program!r})"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, (QUICK, ROOT / "kernels")))}
    process = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True)
    assert "reach the plate without a collision" in process.stdout, process.stderr


@pytest.mark.slow
@pytest.mark.parametrize("page", WITH_COMMANDS, ids=by_name)
def test_commands_in_the_text_run(page, checkout, tmp_path):
    """The commands of a page, one after the other. A mesh, poses, a depth frame and a result are the reader's."""
    trimesh.creation.box().export("bust.stl")
    Path("poses.csv").write_text("time,camera.position[2]\n0.0,0.0\n0.1,0.4\n")
    if page.name in ("denoising.md", "comparison.md"):
        Path("out").mkdir()
        np.save("out/depth.npy", np.full((24, 32), 15.0))
        spadwarp.simulate("plane_5m", photons=20_000).save("out/result.h5")
    if page.name == "own_counts.md":
        runpy.run_path(program_of(page, tmp_path))  # which makes the counts
    for line in commands(page):
        run_small(line)


@pytest.mark.slow
def test_tutorial_runs(checkout):
    """From the first command to the last, block by block; installing aside."""
    names = {}
    for language, code in blocks(TUTORIAL):
        if language == "toml":
            Path(re.match(r"# (\S+)", code)[1]).write_text(code)
        elif language == "python":
            exec(compile(code, "tutorial.md", "exec"), names)
        else:
            for line in lines(code):
                run_small(line)


def test_everything_that_is_left_out_stands_in_a_page():
    text = [line for page in (README, *PAGES) for line in commands(page)]
    assert not [pattern for pattern in LEFT_OUT if not any(re.search(pattern, line) for line in text)]


# Notebooks


def execute(path, folder):
    """The notebook with its outputs, executed in `folder` at a small size; an error in a cell is raised."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(path, as_version=4)
    for cell in notebook.cells:
        photons = re.sub(r"\b\d00_000\b", "20_000", cell.source)
        photons = re.sub(r"\b\d_000_000\b", "100_000", photons)
        cell.source = photons.replace("optimiser.steps=50", "optimiser.steps=2")
    client = nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}})
    environment = {name: value for name, value in ENVIRONMENT.items() if name != "MPLBACKEND"}
    client.execute(env=environment)
    return notebook


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of Jupyter's own packages
@pytest.mark.parametrize("path", NOTEBOOKS, ids=by_name)
def test_notebook_runs(path, tmp_path):
    outputs = [output for cell in execute(path, tmp_path).cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    said = "".join(output["text"] for output in outputs if output.get("name") == "stderr")
    assert "Warning" not in said.replace("SpadwarpWarning: not enough photons", ""), said


@pytest.mark.parametrize("path", NOTEBOOKS, ids=by_name)
def test_notebook_is_kept_without_outputs_and_leads_somewhere(path):
    """And a page leads to it."""
    cells = json.loads(text_of(path))["cells"]
    assert not [cell for cell in cells if cell.get("outputs") or cell.get("execution_count")]
    text = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    assert '-e ".[notebooks]"' in text
    for link in re.findall(r"\]\(([^)#]+)(?:#[\w-]+)?\)", text):
        assert (path.parent / link).is_file(), link
    assert any(f"notebooks/{path.name})" in text_of(page) for page in (README, *PAGES))
