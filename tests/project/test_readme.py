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


PAGES = ["README.md", *sorted(f"docs/{path.name}" for path in (ROOT / "docs").glob("*.md"))]


@pytest.mark.parametrize("page", PAGES)
def test_shell_commands_name_what_there_is(page):
    """The options and the scenes that a page shows are those of the command line."""
    from typer.testing import CliRunner

    from spadwarp.cli import app

    text = "\n".join(re.findall(r"^```(?:sh|bash)\n(.*?)^```", (ROOT / page).read_text(), re.DOTALL | re.MULTILINE))
    for path in re.findall(r"configs/\S+\.toml", text):
        assert (ROOT / path).is_file(), path
    for command, arguments in re.findall(r"spadwarp ([a-z]+)([^\n#]*(?:\\\n[^\n#]*)*)", text):
        words = [command]
        if "COMMAND [ARGS]" in CliRunner().invoke(app, [command, "--help"]).stdout:  # a group of commands
            words.append(arguments.split()[0])
        printed = CliRunner().invoke(app, [*words, "--help"])
        assert printed.exit_code == 0, words
        for option in re.findall(r"--[a-z-]+", arguments):
            assert option in printed.stdout, f"{words} {option}"
