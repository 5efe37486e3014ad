"""The notebooks of the documentation run from their first cell to their last, and are kept without outputs."""

import hashlib
import json
import os
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
NOTEBOOKS = sorted((ROOT / "docs" / "notebooks").glob("*.ipynb"))


def by_name(path):
    return path.stem


def run(path, folder, *, whole):
    """The notebook with its outputs, executed in `folder`, at a small size or whole; an error in a cell is raised."""
    nbformat, nbclient = pytest.importorskip("nbformat"), pytest.importorskip("nbclient")
    pytest.importorskip("ipykernel")
    notebook = nbformat.read(path, as_version=4)
    for cell in () if whole else notebook.cells:
        photons = re.sub(r"\b\d_000_000\b|\b\d00_000\b", "20_000", cell.source)
        cell.source = photons.replace("optimiser.steps=50", "optimiser.steps=2")
    client = nbclient.NotebookClient(notebook, timeout=600, resources={"metadata": {"path": str(folder)}})
    roots = os.pathsep.join(str(ROOT / name) for name in (".", "kernels"))
    environment = {name: value for name, value in os.environ.items() if name != "MPLBACKEND"}
    return client.execute(env={**environment, "PYTHONPATH": roots})


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore::DeprecationWarning")  # of Jupyter's own packages
@pytest.mark.parametrize("path", NOTEBOOKS, ids=by_name)
def test_notebook_runs(path, tmp_path):
    folder = os.environ.get("SPADWARP_EXECUTED_NOTEBOOKS")  # where docs/hooks.py looks for them
    executed = run(path, tmp_path, whole=bool(folder))
    if folder:
        digest = hashlib.sha256(path.read_bytes()).hexdigest()[:16]
        Path(folder).mkdir(parents=True, exist_ok=True)
        pytest.importorskip("nbformat").write(executed, Path(folder) / f"{path.stem}-{digest}.ipynb")
    outputs = [output for cell in executed.cells for output in cell.get("outputs", [])]
    assert any("image/png" in output.get("data", {}) for output in outputs)
    said = "".join(output["text"] for output in outputs if output.get("name") == "stderr")
    assert "Warning" not in said.replace("SpadwarpWarning: Monte Carlo noise", ""), said


@pytest.mark.parametrize("path", NOTEBOOKS, ids=by_name)
def test_notebook_is_kept_without_outputs_and_leads_somewhere(path):
    """And a page leads to it."""
    cells = json.loads(path.read_text(encoding="utf-8"))["cells"]
    assert not [cell for cell in cells if cell.get("outputs") or cell.get("execution_count")]
    text = "\n".join("".join(cell["source"]) for cell in cells if cell["cell_type"] == "markdown")
    assert '-e ".[notebooks]"' in text
    for link in re.findall(r"\]\(([^)#]+)(?:#[\w-]+)?\)", text):
        assert (path.parent / link).is_file(), link
    pages = [ROOT / "README.md", *(ROOT / "docs").glob("*.md")]
    assert any(f"notebooks/{path.name})" in page.read_text(encoding="utf-8") for page in pages)
