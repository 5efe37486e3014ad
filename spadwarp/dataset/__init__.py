"""Datasets of labelled depth frames: recipes, the generator, and readers.

`load_recipe` reads what a dataset is drawn from, `make_dataset` makes it, `verify_dataset` checks its files;
`FrameReader`, `SpadDataset` (for torch) and `iterate_dataset` read it; `export_dataset` writes it for other loaders.
"""

from typing import TYPE_CHECKING

from spadwarp.dataset.export import *
from spadwarp.dataset.make import *
from spadwarp.dataset.plan import *
from spadwarp.dataset.read import *
from spadwarp.dataset.recipe import *
from spadwarp.values import guarded

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = guarded(__name__, [*recipe.__all__, *plan.__all__, *make.__all__, *read.__all__, *export.__all__])
