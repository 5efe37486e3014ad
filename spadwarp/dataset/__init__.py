"""Datasets of labelled depth frames: recipes, the generator, and readers.

`load_recipe` reads what a dataset is drawn from, `make_dataset` makes it, `verify_dataset` checks its files;
`FrameReader` and `SpadDataset` (for torch) read it; `export_dataset` writes it for other loaders.
"""

from spadwarp.dataset.export import *
from spadwarp.dataset.make import *
from spadwarp.dataset.plan import *
from spadwarp.dataset.read import *
from spadwarp.dataset.recipe import *
from spadwarp.values import guarded

guarded(__name__)
