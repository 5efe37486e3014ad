"""Previews: four readable pictures of any result, without warnings and without a display."""

import dataclasses
import math
import re
import subprocess
import sys

import numpy as np
import pytest
from matplotlib.figure import Figure
from matplotlib.image import imread
from PIL import Image

import spadwarp
from helpers.cli import run
from helpers.scenes import scene
from helpers.synthetic_result import make_result, make_scene
from spadwarp.scene.scene import camera_port
from spadwarp.values import FileError
from spadwarp.viz import draw_result
from spadwarp.viz.result import merged_edges, merged_means
from spadwarp.viz.scenes import draw_slice

NAMES = ["depth.png", "intensity.png", "histogram.png", "truth.png"]


CASES = {"empty": {"targets": []}, "far away": {"distance": 1000.0}, "a pixel": {"width": 1, "height": 1, "bins": 8}}


@pytest.mark.parametrize(
    "case", [one if one == "empty" else pytest.param(one, marks=pytest.mark.slow) for one in CASES]
)
def test_every_result_is_shown(case, tmp_path):
    result = make_result(make_scene(**CASES[case]), empty=case == "empty")
    paths = draw_result(dataclasses.replace(result, partial=True, seed=2**64 - 1), tmp_path, method="peak")
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


# Bins that are added up where light is sparse


@pytest.mark.parametrize("seed", range(3))
def test_groups_keep_the_light_and_are_known_to_a_third(seed):
    random = np.random.default_rng(seed)
    counts = random.poisson(300 * np.exp(-np.arange(400) / 40.0)) * 1.0
    edges = merged_edges(counts, counts)
    assert edges[0] == 0 and edges[-1] == 400 and (np.diff(edges) > 0).all()
    sums = merged_means(counts, edges) * np.diff(edges)
    assert sums.sum() == counts.sum()
    some = sums > 0
    assert (sums[some] >= 9).mean() > 0.85  # 9 counts are known to a third; a bin between two such bins may hold fewer
    assert (np.diff(edges)[:80] == 1).all() and np.diff(edges)[some][-2:].max() > 20


def test_light_stays_in_its_time_and_a_peak_in_its_bin():
    light = np.zeros(100)
    light[40], light[60] = 1000.0, 1.0
    edges = merged_edges(light, light)
    assert {40, 41, 61} <= set(edges) and not set(range(1, 40)) & set(edges)
    edges = merged_edges(0.0 * light, 0.0 * light)  # nothing is one group of nothing
    assert merged_means(0.0 * light, edges).sum() == 0 and edges[-1] == 100


def test_no_group_of_the_sum_goes_across_the_first_light_of_a_component():
    random, bins = np.random.default_rng(4), np.arange(300)
    water = random.poisson(200 * np.exp(-bins / 30.0)) * 1.0
    target = np.where(bins < 150, 0.0, random.poisson(2 * np.exp(-(bins - 150) / 20.0)))
    total, first = water + target, int((target > 0).argmax())
    edges, of_water = merged_edges(total, total, [first]), merged_edges(water, water)
    assert first in edges and first in merged_edges(target, target)
    assert (np.diff(of_water)[-3:] > 1).any()  # beneath the target's light, its own wide groups


# The water of a scene cut open


CLOUD = {"shape": "cloud", "size": [1.0, 1.0, 1.0], "cells": 16, "extinction": 4.0, "translation": [0.0, 0.0, 1.2]}
LAYERS = [{"start": 1.0, "extinction": 2.0, "albedo": 0.5}]


@pytest.mark.parametrize("medium", [{}, {"layers": LAYERS}], ids=["one", "layers"])
def test_slices_show_the_extinction(medium, tmp_path):
    path = spadwarp.viz.draw_water(scene(medium=medium), tmp_path / "water.png")
    colours = len(np.unique(np.asarray(Image.open(path).convert("L"))[50:-80, 100:600]))
    assert colours > (10 if medium else 1)


def test_view_and_beam_behind_a_port_are_the_refracted_ones():
    behind = scene().with_overrides({"camera.port.preset": "flat-glass", "laser.port": "camera"})
    axis = Figure().subplots()
    draw_slice(axis, behind, None, 0)
    lines = {line.get_label(): line.get_xydata() for line in axis.lines}
    inside, _, water = camera_port(behind).index
    half = 0.5 * behind.camera.pixel_tangent * behind.camera.width
    for name, angle in (("view", math.atan(half)), ("beam", behind.laser.half_angle)):
        z, x = lines[name][-1] - lines[name][-2]
        assert x / z == pytest.approx(math.tan(math.asin(inside / water * math.sin(angle))), rel=1e-6)
    assert lines["camera"].tolist() == [[0.0, 0.0]] and lines["laser"][0, 1] == behind.laser.position[0]


def test_both_pictures_of_a_run_show_the_same_typical_pixel(tmp_path):
    wide = scene().with_overrides(camera={"width": 16, "height": 16})
    run_of = spadwarp.simulate(wide, photons=20_000, seed=1, device="cpu")
    frames = spadwarp.frames.record_frames(run_of, tmp_path / "frames.h5", pulses=100, seed=1, device="cpu").file
    titles = [
        {axis.get_title().partition("\n")[0] for axis in figure.axes if axis.get_title().startswith("Typical")}
        for figure in (run_of.plot("histogram"), frames.plot())
    ]
    assert titles[0] == titles[1] != set()


def test_check_draws_the_cells(tmp_path):
    (tmp_path / "scene.toml").write_text(scene(medium={"grid": CLOUD}).to_toml())
    text = run("check", tmp_path / "scene.toml", "--picture", tmp_path / "water.png")
    assert len(np.unique(np.asarray(Image.open(tmp_path / "water.png").convert("L"))[50:-80, 100:600])) > 10
    assert re.search(r"cells +16, 16, 16\n +size +1, 1, 1\n", text.output)
