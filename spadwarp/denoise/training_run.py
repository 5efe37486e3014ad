"""`spadwarp train`: a recipe and a dataset in, weights, log and learning curves out."""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from spadwarp.dataset.make import read_manifest
from spadwarp.denoise.inference import _torch
from spadwarp.denoise.recipe import TrainingRecipe, load_training_recipe
from spadwarp.errors import FileError
from spadwarp.io.atomic import atomic_path

if TYPE_CHECKING:
    from spadwarp.denoise.synthetic_noise import CleanScenes
    from spadwarp.denoise.training import Trained

__all__ = ["draw_learning_curves", "read_scenes", "train"]


def train(
    recipe: TrainingRecipe | str | os.PathLike[str],
    out: str | os.PathLike[str],
    *,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Trained:
    """Trains a denoiser, or goes on with a training that was cut short.

    Writes `MODEL.safetensors`, `log.jsonl`, `curves.png` and `checkpoint.pt` to the folder `out`.

    Args:
        recipe: From `spadwarp.denoise.recipe.load_training_recipe`, or its path.
        out: The run's folder; new, or that of the same recipe.
        device: torch device; default: the GPU of this process (torchrun gives one each), else the CPU.
        progress: Called with ("steps", done, total).

    Raises:
        ConfigError: A recipe that cannot be used, or another one's run in the folder.
        FileError: The dataset or a file cannot be read, or not be written.
        SpadwarpError: A package of the extra `denoise` is missing.
    """
    _torch()
    from spadwarp.denoise.training import fit

    if not isinstance(recipe, TrainingRecipe):
        recipe = load_training_recipe(recipe)
    training, validation = (read_scenes(recipe.data, split) for split in ("train", "validation"))
    trained = fit(recipe, training, validation, Path(out), device=device, progress=progress)
    if int(os.environ.get("RANK", 0)) == 0:
        draw_learning_curves(trained.log, Path(out) / "curves.png", title=f"{recipe.model}, seed {recipe.seed}")
    return trained


def read_scenes(folder: str | os.PathLike[str], split: str) -> CleanScenes:
    """The clean scenes of a split of a dataset. Raises `FileError`."""
    import h5py
    import torch

    from spadwarp.denoise.synthetic_noise import CleanScenes

    parts: dict[str, list[Any]] = {name: [] for name in ("depth", "bound", "gate", "profile")}
    for name in read_manifest(folder)["splits"][split]["shards"]:
        path = Path(folder) / "scenes" / name.replace("frames-", "scenes-")
        try:
            with h5py.File(path, "r") as file:
                parts["depth"].append(file["depth"][...])
                parts["bound"].append(file["bound"][...])
                parts["gate"].append(np.stack([file["gate_near"][...], file["gate_far"][...]], axis=1))
                parts["profile"].append(file["backscatter_profile"][...])
        except (OSError, KeyError) as error:
            raise FileError(f"{path}: damaged or not readable: {error}") from error
    if not parts["depth"]:
        raise FileError(f"{folder}: the dataset has no scenes for {split}")
    depth, bound, gate, profile = (np.concatenate(one).astype(np.float32) for one in parts.values())
    profile /= np.maximum(profile.mean(axis=1, keepdims=True), 1e-12)
    return CleanScenes(*map(torch.from_numpy, (depth, bound, gate, profile)))


def draw_learning_curves(log: str | Path, path: str | Path, *, title: str) -> Path:
    """Loss and validation PSNR against steps, from a log of JSON lines; returns the picture's path."""
    from matplotlib.figure import Figure

    lines = [json.loads(line) for line in Path(log).read_text().splitlines()]
    steps = [line["step"] for line in lines]
    size = 6.0 if len(lines) == 1 else 3.0  # a single point has no line to be seen by
    figure = Figure(figsize=(9.6, 3.4), layout="constrained", facecolor="white")
    loss, psnr = figure.subplots(1, 2)
    losses = [line["loss"] for line in lines]
    loss.plot(steps, losses, color="#0072B2", marker="o", markersize=size)
    loss.set(yscale="log" if min(losses) > 0 else "linear", xlabel="step", ylabel="loss")  # "psnr" is a logarithm
    for level, shade in zip(lines[-1]["psnr"], np.linspace(0.75, 0.0, len(lines[-1]["psnr"])), strict=True):
        values = [line["psnr"][level] for line in lines]
        name = f"BS {level}" if float(level) < 1 else f"{float(level):g} photons"
        psnr.plot(steps, values, color=str(shade), marker="o", markersize=size, label=name)
    psnr.set(xlabel="step", ylabel="validation PSNR [dB]")
    psnr.legend(frameon=False, fontsize=8, loc="center left", bbox_to_anchor=(1.0, 0.5))
    for axis in (loss, psnr):
        axis.spines[["top", "right"]].set_visible(False)
        axis.grid(color="0.92")
        axis.set_axisbelow(True)
    figure.suptitle(title, fontsize=10, color="0.25")
    with atomic_path(path) as temporary:
        figure.savefig(temporary, dpi=150, format="png")
    return Path(path)
