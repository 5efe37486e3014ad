"""Datasets of labelled depth frames: recipes, the generator, and readers.

`load_recipe` reads what a dataset is drawn from, `make_dataset` makes it, `verify_dataset` checks its files;
`FrameReader`, `SpadDataset` (for torch) and `iterate_dataset` read it; `export_dataset` writes it for other loaders.
"""

from spadwarp.dataset.export import EXPORT_FIELDS, EXPORT_FORMATS, export_dataset
from spadwarp.dataset.make import DatasetReport, make_dataset
from spadwarp.dataset.manifest import read_manifest, verify_dataset
from spadwarp.dataset.read import FIELDS, FrameReader, SpadDataset, iterate_dataset
from spadwarp.dataset.recipe import SPLITS, Distribution, Recipe, load_recipe
from spadwarp.dataset.sampling import Plan

__all__ = ["FIELDS", "SPLITS", "DatasetReport", "Distribution", "FrameReader", "Plan", "Recipe", "SpadDataset"]
__all__ += [
    "EXPORT_FIELDS",
    "EXPORT_FORMATS",
    "export_dataset",
    "iterate_dataset",
    "load_recipe",
    "make_dataset",
    "read_manifest",
    "verify_dataset",
]
