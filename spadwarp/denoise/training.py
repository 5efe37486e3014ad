"""Training: one loop for every network, on a CPU, a GPU or several.

Several GPUs: `torchrun --nproc-per-node 4 -m spadwarp train RECIPE --out DIR`. An interrupted run resumes from its last
checkpoint when the command is repeated.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import torch
from torch import nn

from spadwarp.denoise.networks import reads_histograms
from spadwarp.denoise.recipe import LEAST_CROP, Noise, TrainingRecipe
from spadwarp.denoise.repeatable import fixed_order
from spadwarp.denoise.synthetic_noise import CleanScenes, draw_batch, procedural_scenes
from spadwarp.denoise.training_steps import Run, Trained, Workers
from spadwarp.parallel.worker import interruptible
from spadwarp.values import ConfigError

__all__ = ["LEVELS", "Trained", "fit"]

LEVELS = (0.042, 0.183, 0.264, 0.337, 0.394, 0.480)
"""Backscatter fractions at which the paper, and validation here, measures."""

PHOTONS = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Signal photons per pixel, a third of the background, at which networks that read histograms are validated."""

_TIMED = 5  # steps after which the duration is foretold
_PATIENCE = 3.0  # seconds before the first message on how long the samples still take
_AGAIN = 30.0  # seconds from one such message to the next
_VALIDATION_SEED = 2**40  # of drawn scenes, far from those of training


@fixed_order()
def fit(
    recipe: TrainingRecipe,
    training: CleanScenes | None,
    validation: CleanScenes | None,
    out: str | Path,
    *,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
    notify: Callable[[str], None] | None = None,
) -> Trained:
    """Trains a network, or resumes an interrupted run of the same recipe.

    Args:
        recipe: Model, noise and optimiser.
        training, validation: Clean scenes, on any device; without them, scenes are drawn.
        out: Folder for `checkpoint.pt`, `log.jsonl` and the weights.
        device: "cpu", "cuda" or "cuda:N"; default: the GPU of this process, else the CPU.
        progress: Called with ("steps", done, total) after each step.
        notify: Called with how long the training will take, once the first steps show it.

    Each process draws crops and noise of its own. A run of N processes equals, to the rounding of sums, a run of a
    single process whose batches are the N parts together; only batch normalisation, in DnCNN, sees its own part alone.
    Ctrl-C or SIGTERM end the run after the step at hand with a checkpoint and a KeyboardInterrupt that names it.

    Raises:
        ConfigError: The folder holds a run of another recipe, or a crop is larger than the scenes.
        DeviceError: No such device.
        FileError: The weights cannot be written.
    """
    workers = Workers(device)
    settings = recipe.optimiser
    if training is not None:
        height, width = training.depth.shape[1:]
        scale, why = (2, f" with optimiser.wide = {settings.wide}") if settings.wide else (1, "")
        most, given = min(height, width) // scale, f"scenes of {width} x {height} pixels"
        if most < LEAST_CROP:
            raise ConfigError(f"data: {given}{why}; at least {scale * LEAST_CROP} x {scale * LEAST_CROP} are needed")
        if settings.crop > most:
            raise ConfigError(f"optimiser.crop = {settings.crop}{why} is outside [{LEAST_CROP}, {most}]: {given}")
    if settings.batch % workers.size:
        raise ConfigError(f"optimiser.batch = {settings.batch} cannot be shared evenly by {workers.size} processes")
    Path(out).mkdir(parents=True, exist_ok=True)
    if validation is None:
        validation = procedural_scenes(
            64 if workers.is_cuda else 8, settings.crop + 32, seed=_VALIDATION_SEED, device=workers.device
        )
    validation = validation.to(workers.device)
    run = Run(recipe, Path(out), workers, training)
    first, spent = run.step, 0.0
    psnr: dict[float, float] = {}
    with interruptible() as interrupted:
        while run.step < settings.steps and not workers.any(interrupted.is_set()):
            if not _prepared(run, interrupted, notify):
                break
            began = time.monotonic()
            run.update()
            spent += time.monotonic() - began
            if run.step % settings.report_every == 0 or run.step == settings.steps:
                psnr = validation_psnr(run.average, validation, recipe)
                run.report(psnr)
            if workers.rank == 0:
                if notify is not None and run.step == first + _TIMED:
                    seconds = spent / _TIMED + run.samples.seconds
                    notify(_duration(workers, seconds, settings.steps - run.step))
                if progress is not None:
                    progress("steps", run.step, settings.steps)
        if run.step < settings.steps:
            run.save_checkpoint()
            workers.close()
            raise KeyboardInterrupt(
                f"interrupted at step {run.step} of {settings.steps}; the same command resumes from {run.checkpoint}; "
                "another number of steps needs a new folder"
            )
    trained = run.finish(psnr or validation_psnr(run.average, validation, recipe))
    workers.close()
    return trained


def _prepared(run: Run, interrupted: threading.Event, notify: Callable[[str], None] | None) -> bool:
    """Draws the samples of the next step; False where it was interrupted. Says now and then how long this takes."""
    silent = notify is None or run.steps_here > 0 or run.workers.rank > 0
    began, due, first, advice = time.monotonic(), _PATIENCE, (0.0, 0), _advice(run.workers)
    for drawn, total in run.samples.prepare(run.step):
        if run.workers.any(interrupted.is_set()):
            return False
        seconds = time.monotonic() - began
        if not first[1]:
            first = seconds, drawn  # which loads what is needed, and takes longer than the others
        elif not silent and notify is not None and seconds > due and drawn < total:
            left = max(1.0, (seconds - first[0]) * (total - drawn) / (drawn - first[1]))
            rest = f"{total - drawn} of {total} samples are still to be drawn before the next step"
            notify(f"{rest}, about {left:.0f} s{advice}")
            due, advice = seconds + _AGAIN, ""
    return True


def _duration(workers: Workers, seconds: float, steps: int) -> str:
    """How long the rest of a training takes."""
    left = seconds * steps
    number, unit = (left, "s") if left < 120 else (left / 60, "minutes") if left < 7200 else (left / 3600, "hours")
    return f"{steps} step{'s' * (steps != 1)} to go, about {max(number, 1):.0f} {unit}{_advice(workers)}"


def _advice(workers: Workers) -> str:
    """On a CPU, what to do instead."""
    if workers.is_cuda:
        return ""
    return (
        " on this CPU; a data-centre GPU trains in minutes. The package has trained weights, which `spadwarp denoise` "
        "uses; fewer steps (optimiser.steps, in a new folder), or start from these weights (start in the recipe), take "
        "less, and fewer samples (optimiser.pool) are drawn sooner. Ctrl-C keeps a checkpoint of the steps, from which "
        "the same command resumes; samples are drawn anew"
    )


@torch.no_grad()
def validation_psnr(network: nn.Module, scenes: CleanScenes, recipe: TrainingRecipe) -> dict[float, float]:
    """PSNR [dB] over the gate at each of `LEVELS`, or of `PHOTONS` for a network that reads histograms.

    Mean over crops with a target; the same crops and photons every time.
    """
    network.eval()
    device = scenes.depth.device
    result = {}
    counting = reads_histograms(network)
    plain: dict[str, Any] = {
        "own_gate": 1.0,
        "own_profile": 1.0,
        "dead": 0.0,
        "slanted_gate": 0.0,
        "unknown_water": 0.0,
    }
    for level in PHOTONS if counting else LEVELS:
        generator = torch.Generator(device).manual_seed(round(1e4 * level))
        if counting:
            noise = recipe.noise.model_copy(update={**plain, "photons": (level, level), "sbr": (1 / 3, 1 / 3)})
        else:
            noise = Noise(backscatter=(level, level), sigma_scale=(1.0, 1.0), counting=0.0, behind=0.0, **plain)
        batch = draw_batch(
            scenes, noise, size=64 if device.type == "cuda" and not counting else 8, crop=recipe.optimiser.crop,
            generator=generator, always_replaced=True, histograms=counting,
        )  # fmt: skip
        depth = network(batch.frame)[:, :1].float()
        square = (batch.hit * (depth.clamp(0, 1) - batch.clean).square()).flatten(1).sum(dim=1)
        pixels = batch.hit.flatten(1).sum(dim=1)
        valid = pixels > 100
        error = (square[valid] / pixels[valid]).clamp_min(1e-7)
        result[level] = float((-10.0 * error.log10()).mean())
    return result
