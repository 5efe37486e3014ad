"""Random plumes between camera and target."""

import pytest

import spadwarp
from spadwarp.dataset import Recipe, load_recipe
from spadwarp.dataset.plan import Plan

PLUME = {"probability": 0.5, "optical_depth": {"low": 0.5, "high": 2.0}, "cells": 12, "size": 1.5}


@pytest.fixture(scope="module")
def small():
    return load_recipe("small")


def test_part_of_the_scenes_have_a_plume_of_the_optical_depth_that_was_drawn(small):
    recipe = Recipe.from_dict({**small.to_dict(), "plume": PLUME}, source=small.source)
    plan, plain = Plan(recipe), Plan(small)
    found = []
    for index in range(min(plan.scene_count, 24)):
        drawn, without = plan.scene(index), plain.scene(index)
        grid, depth = drawn.scene.medium.grid, drawn.scene.medium.extinction * drawn.distance
        # Everything else is as it was.
        assert drawn.scene.with_overrides({"medium.grid": None}) == without.scene and drawn.seed == without.seed
        if grid is not None:
            found.append(drawn.scene.optical_depth((0.0, 0.0, 0.0), (0.0, 0.0, drawn.distance)) - depth)
            assert 0.3 * drawn.distance <= grid.translation[2] <= 0.8 * drawn.distance
            assert plan.scene(index).scene == drawn.scene
    assert 4 <= len(found) <= 20
    assert 0.49 < min(found) < max(found) < 2.01


def test_plumes_that_cannot_be_are_refused(small):
    tables = small.to_dict()
    layers = {"layers": [{"start": 1.0, "extinction": 1.0, "albedo": 0.5}]}
    layered = {**tables["scene"], "medium": tables["scene"]["medium"] | layers}
    for change, problem in (
        ({"plume": {**PLUME, "shape": ["fog"]}}, "plume.shape"),
        ({"plume": {**PLUME, "probability": 1.5}}, "plume.probability = 1.5 is outside"),
        ({"plume": PLUME, "scene": layered}, "cannot be combined with layers"),
    ):
        with pytest.raises(spadwarp.ConfigError, match=problem):
            Recipe.from_dict({**tables, **change}, source=small.source)
