"""Training from files: a recipe and a dataset in, weights, log and learning curves out."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.dataset import read_manifest
from spadwarp.dataset.shards import SceneFile
from spadwarp.denoise.network_files import require_torch
from spadwarp.denoise.recipe import TrainingRecipe, load_training_recipe
from spadwarp.values import FileError, environment_integer
from spadwarp.viz import draw_learning_curves

if TYPE_CHECKING:
    from spadwarp.denoise.synthetic_noise import CleanScenes
    from spadwarp.denoise.training import Trained

__all__ = ["read_scenes", "train"]


def train(
    recipe: TrainingRecipe | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    notify: Callable[[str], None] | None = None,
) -> Trained:
    """Trains a denoiser, or resumes an interrupted training.

    Writes `MODEL.safetensors`, `log.jsonl`, `curves.png` and `checkpoint.pt` to the folder `out`. Ctrl-C or SIGTERM
    keep a checkpoint of the last step and raise KeyboardInterrupt.

    Args:
        recipe: From `spadwarp.denoise.load_training_recipe`, or the recipe's path.
        out: The run's folder; new, or with an interrupted run of the same recipe.
        device: torch device; default: the GPU of this process (torchrun gives one each), else the CPU.
        progress: Called with ("steps", done, total) after every step.
        notify: Called with how long the training will take, once the first steps show it.

    Raises:
        ConfigError: A recipe that cannot be used, or a run of another recipe in the folder.
        FileError: The dataset cannot be read, or a file cannot be read or written.
        SpadwarpError: A package of the extra `denoise` is missing.
    """
    require_torch()
    from spadwarp.denoise.training import fit

    if not isinstance(recipe, TrainingRecipe):
        recipe = load_training_recipe(recipe)
    training = validation = None
    if recipe.data is not None:
        training, validation = (read_scenes(recipe.data, split) for split in ("train", "validation"))
    trained = fit(recipe, training, validation, Path(out), device=device, progress=progress, notify=notify)
    if environment_integer("RANK", 0) == 0:
        log = [json.loads(line) for line in trained.log.read_text().splitlines()]
        draw_learning_curves(log, Path(out) / "curves.png", title=f"{recipe.model}, seed {recipe.seed}")
    return trained


def read_scenes(folder: str | os.PathLike[str], split: str) -> CleanScenes:
    """The clean scenes of a split of a dataset. Raises `FileError`."""
    import torch

    from spadwarp.denoise.synthetic_noise import CleanScenes

    parts: list[list[Any]] = []
    manifest = read_manifest(folder)
    for name in manifest["splits"][split]["shards"]:
        scenes = SceneFile(Path(folder), name, (manifest["height"], manifest["width"]))
        with closing(scenes.file):
            columns = [scenes.array(column) for column in ("depth", "bound", "backscatter_profile")]
            parts.append([*columns[:2], scenes.gate(), columns[2]])
    if not parts:
        raise FileError(f"{folder}: the dataset has no scenes for {split}")
    depth, bound, gate, profile = (np.concatenate(arrays).astype(np.float32) for arrays in zip(*parts, strict=True))
    profile /= np.maximum(profile.mean(axis=1, keepdims=True), 1e-12)
    return CleanScenes(*map(torch.from_numpy, (depth, bound, gate, profile)))
