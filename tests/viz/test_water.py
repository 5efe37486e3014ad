"""The water of a scene cut open."""

import re

import numpy as np
import pytest
from PIL import Image

import spadwarp
from helpers.cli import run
from helpers.scenes import scene

CLOUD = {"shape": "cloud", "size": [1.0, 1.0, 1.0], "cells": 16, "extinction": 4.0, "translation": [0.0, 0.0, 1.2]}
LAYERS = [{"start": 1.0, "extinction": 2.0, "albedo": 0.5}]


@pytest.mark.parametrize("medium", [{}, {"layers": LAYERS}], ids=["one", "layers"])
def test_slices_show_the_extinction(medium, tmp_path):
    path = spadwarp.viz.draw_water(scene(medium=medium), tmp_path / "water.png")
    colours = len(np.unique(np.asarray(Image.open(path).convert("L"))[50:-80, 100:600]))
    assert colours > (10 if medium else 1)


def test_check_draws_the_cells(tmp_path):
    (tmp_path / "scene.toml").write_text(scene(medium={"grid": CLOUD}).to_toml())
    text = run("check", tmp_path / "scene.toml", "--picture", tmp_path / "water.png")
    assert len(np.unique(np.asarray(Image.open(tmp_path / "water.png").convert("L"))[50:-80, 100:600])) > 10
    assert re.search(r"cells +16, 16, 16\n +size +1, 1, 1\n", text.output)
