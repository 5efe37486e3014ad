"""Previews: four readable pictures of any result, without warnings and without a display."""

from __future__ import annotations

import dataclasses
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from matplotlib.image import imread

from helpers.synthetic_result import make_result, make_scene
from spadwarp.errors import FileError
from spadwarp.result.result import Result
from spadwarp.viz import draw_result

NAMES = ["depth.png", "intensity.png", "histogram.png", "truth.png"]


def check_pictures(result: Result, directory: Path, **options: object) -> list[np.ndarray]:
    paths = draw_result(result, directory, **options)  # type: ignore[arg-type]
    assert paths == [directory / name for name in NAMES]
    assert sorted(path.name for path in directory.iterdir()) == sorted(NAMES)
    images = [imread(path) for path in paths]
    for image in images:
        height, width, _ = image.shape
        assert 200 < height < 4000
        assert 200 < width < 4000
    return images


@pytest.mark.slow
def test_previews_show_the_target(tmp_path: Path) -> None:
    result = make_result(make_scene())
    depth, *_ = check_pictures(result, tmp_path / "run", method="peak")
    # The nearest and the farthest bar have the ends of the colour map: near is yellow, far is violet.
    width = depth.shape[1]
    truth = depth[:, width // 3 : 2 * width // 3, :3]
    assert (np.linalg.norm(truth - [0.88, 0.89, 0.1], axis=-1) < 0.1).mean() > 0.05
    assert (np.linalg.norm(truth - [0.28, 0.14, 0.46], axis=-1) < 0.15).mean() > 0.02


@pytest.mark.parametrize(
    "result",
    [
        make_result(make_scene(targets=[]), empty=True),
        dataclasses.replace(make_result(make_scene(distance=1000.0)), partial=True, seed=2**64 - 1),
        make_result(make_scene(width=1, height=1, bins=8)),
        make_result(make_scene(width=48, height=1, bins=8)),
    ],
    ids=["empty", "far away", "a pixel", "a line"],
)
def test_every_result_is_shown(result: Result, tmp_path: Path) -> None:
    check_pictures(result, tmp_path, method="peak")


@pytest.mark.slow
def test_a_given_depth_frame_is_shown_as_it_is(tmp_path: Path) -> None:
    result = make_result(make_scene())
    frame = np.full(result.truth.depth.shape, np.nan)
    depth, *_ = check_pictures(result, tmp_path, depth=frame)
    measured = depth[depth.shape[0] // 3 : depth.shape[0] // 2, : depth.shape[1] // 3, :3]
    assert (np.ptp(measured, axis=-1) < 0.02).all()  # grey, white and black: no return anywhere


def test_folders_that_cannot_be_written_are_named(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(FileError, match=r"depth\.png: cannot be written"):
        draw_result(make_result(make_scene()), tmp_path / "file", method="peak")


def test_pictures_need_no_pyplot() -> None:
    # pyplot would choose a window system for the caller.
    code = "import sys, spadwarp.viz; assert 'matplotlib.pyplot' not in sys.modules"
    subprocess.run([sys.executable, "-c", code], check=True, env={"PYTHONPATH": ":".join(sys.path)})


@pytest.mark.slow
def test_pictures_for_print_are_vectors_and_the_same_again(tmp_path: Path) -> None:
    result = make_result(make_scene())
    first, second = (draw_result(result, tmp_path / run, method="peak", formats=["pdf"]) for run in ("a", "b"))
    assert [path.name for path in first] == [name.replace("png", "pdf") for name in NAMES]
    for path, other in zip(first, second, strict=True):
        content = path.read_bytes()
        assert content.startswith(b"%PDF")
        assert content == other.read_bytes()
