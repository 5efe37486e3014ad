"""Previews: four readable pictures of any result, without warnings and without a display."""

import dataclasses
import subprocess
import sys

import pytest
from matplotlib.image import imread

from helpers.synthetic_result import make_result, make_scene
from spadwarp.values import FileError
from spadwarp.viz import draw_result

NAMES = ["depth.png", "intensity.png", "histogram.png", "truth.png"]


@pytest.mark.parametrize(
    "result",
    [
        make_result(make_scene(targets=[]), empty=True),
        pytest.param(
            dataclasses.replace(make_result(make_scene(distance=1000.0)), partial=True, seed=2**64 - 1),
            marks=pytest.mark.slow,
        ),
        make_result(make_scene(width=1, height=1, bins=8)),
    ],
    ids=["empty", "far away", "a pixel"],
)
def test_every_result_is_shown(result, tmp_path):
    paths = draw_result(result, tmp_path, method="peak")
    assert paths == [tmp_path / name for name in NAMES] and sorted(tmp_path.iterdir()) == sorted(paths)
    assert all(200 < side < 4000 for path in paths for side in imread(path).shape[:2])


def test_folders_that_cannot_be_written_are_named(tmp_path):
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FileError, match=r"depth\.png: cannot be written"):
        draw_result(make_result(make_scene()), tmp_path / "file", method="peak")


@pytest.mark.slow
def test_pictures_need_no_pyplot():
    # pyplot would choose a window system for the caller.
    code = "import sys, spadwarp.viz; assert 'matplotlib.pyplot' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, env={"PYTHONPATH": ":".join(sys.path)})


@pytest.mark.slow
def test_pictures_for_print_are_vectors_and_the_same_again(tmp_path):
    result = make_result(make_scene())
    first, second = (draw_result(result, tmp_path / run, method="peak", formats=["pdf"]) for run in ("a", "b"))
    assert [path.name for path in first] == [name.replace("png", "pdf") for name in NAMES]
    for path, other in zip(first, second, strict=True):
        content = path.read_bytes()
        assert content.startswith(b"%PDF")
        assert content == other.read_bytes()
