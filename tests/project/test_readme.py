"""Every code block in the READMEs runs as it stands."""

import os
import re
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


def python_blocks(readme):
    return re.findall(r"^```python\n(.*?)^```", (ROOT / readme).read_text(), flags=re.DOTALL | re.MULTILINE)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("readme", "roots", "printed"),
    [
        ("README.md", (".", "kernels"), "depth"),
        ("kernels/README.md", ("kernels",), "reach the plate without a collision"),
    ],
)
def test_python_blocks_run(readme, roots, printed, tmp_path):
    """One after the other, as one program, from the checkout; the kernels' without `spadwarp` in reach."""
    blocks = python_blocks(readme)
    assert blocks
    program = tmp_path / "program.py"  # a file, since Warp reads the source of kernels
    program.write_text("\n".join(blocks))
    folder = tmp_path / "checkout"
    folder.mkdir()
    (folder / "configs").symlink_to(ROOT / "configs")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(str(ROOT / root) for root in roots)}
    process = subprocess.run([sys.executable, program], cwd=folder, env=environment, capture_output=True, text=True)
    assert process.returncode == 0, process.stderr
    assert printed in process.stdout
