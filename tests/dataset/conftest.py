"""A dataset that several files of tests copy, or make again."""

import pytest

from helpers.datasets import make, recipe


@pytest.fixture(scope="session")
def small():
    """The recipe: six shards of one frame each."""
    return recipe(**{"frames.per_scene": 1})


@pytest.fixture(scope="session")
def whole(small, tmp_path_factory):
    """A finished dataset of it."""
    folder = tmp_path_factory.mktemp("whole") / "data"
    make(small, folder)
    return folder
