"""Training: one loop for every network, on a CPU, a GPU or several.

Several GPUs: `torchrun --nproc-per-node 4 -m spadwarp train RECIPE --out DIR`. A run that was cut short goes on from
its last checkpoint when the command is repeated.
"""

from __future__ import annotations

import copy
import json
import math
import os
import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spadwarp.denoise.inference import _device, load_network
from spadwarp.denoise.networks import build_network, reads_histograms
from spadwarp.denoise.recipe import Noise, TrainingRecipe
from spadwarp.denoise.synthetic_noise import Batch, CleanScenes, draw_batch
from spadwarp.errors import ConfigError, FileError
from spadwarp.io.atomic import atomic_path

__all__ = ["LEVELS", "Trained", "fit"]

LEVELS = (0.042, 0.183, 0.264, 0.337, 0.394, 0.480)
"""Shares of backscatter pixels at which the paper, and validation here, measures."""

PHOTONS = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Signal photons a pixel, at a third of the background, at which networks that read histograms are validated."""

_CHECKPOINT = "checkpoint.pt"
_FLOOR = 3e-6  # mean square over the gate below which a crop is good enough: 55 dB
_TRUE = 0.015  # part of the gate within which a reported depth is the target's


@dataclass(frozen=True, kw_only=True)
class Trained:
    """What a training left behind.

    Attributes:
        weights: The network, safetensors.
        log: JSON lines: step, loss, validation PSNR [dB] at each of `LEVELS`, pairs per second, seconds.
        psnr: Validation PSNR, mean over the levels [dB].
        seconds: Of all parts of the run together.
    """

    weights: Path
    log: Path
    psnr: float
    seconds: float


def fit(
    recipe: TrainingRecipe,
    training: CleanScenes,
    validation: CleanScenes,
    out: str | Path,
    *,
    device: str | None = None,
    progress: Callable[[str, int, int], None] | None = None,
) -> Trained:
    """Trains a network, or goes on where a run with the same recipe was cut short.

    Args:
        recipe: Model, noise and optimiser.
        training, validation: Clean scenes, on any device.
        out: Folder for `checkpoint.pt`, `log.jsonl` and the weights.
        device: "cpu", "cuda" or "cuda:N"; default: the GPU of this process, else the CPU.
        progress: Called with ("steps", done, total).

    Each process draws crops and noise of its own. A run by N processes is one by a single process whose batches are the
    N parts side by side, to the rounding of sums; batch normalisation alone, DnCNN's, sees only its own part.

    Raises:
        ConfigError: The folder holds a run of another recipe, or a crop is larger than the scenes.
        DeviceError: No such device.
        FileError: The weights cannot be written.
    """
    crew = _Crew(device)
    settings, folder = recipe.optimiser, Path(out)
    if settings.crop > min(training.depth.shape[1:]):
        raise ConfigError(f"optimiser.crop = {settings.crop} is outside [32, {min(training.depth.shape[1:])}]")
    if settings.batch % crew.size:
        raise ConfigError(f"optimiser.batch = {settings.batch} cannot be shared evenly by {crew.size} processes")
    folder.mkdir(parents=True, exist_ok=True)
    training, validation = training.to(crew.device), validation.to(crew.device)
    torch.backends.cudnn.benchmark = torch.backends.cuda.matmul.allow_tf32 = crew.is_cuda
    torch.manual_seed(recipe.seed)
    network: Any = build_network(recipe.model)
    if recipe.start is not None:
        told = network.load_state_dict(load_network(recipe.start)[0].state_dict(), strict=False)
        new = [name for name in told.missing_keys if not name.startswith(("enter_clues.", "leave_clues."))]
        if new or told.unexpected_keys:
            raise FileError(f"start = {recipe.start!r}: its layers are not those of {recipe.model!r}")
    network = network.to(crew.device)
    network = network.to(memory_format=torch.channels_last)
    learner = nn.parallel.DistributedDataParallel(network, **crew.placed) if crew.size > 1 else network
    average = copy.deepcopy(network).requires_grad_(False)
    optimiser = torch.optim.AdamW(
        network.parameters(), lr=settings.learning_rate, weight_decay=settings.weight_decay, fused=crew.is_cuda
    )
    generator = torch.Generator(crew.device).manual_seed(recipe.seed * 1009 + crew.rank)
    state = {"network": network, "average": average, "optimiser": optimiser}
    step, spent = _resume(folder, recipe, state, generator, crew)
    precision = torch.bfloat16 if settings.precision == "bfloat16" and crew.is_cuda else torch.float32
    began, told = time.monotonic() - spent, time.monotonic()
    loss_sum = torch.zeros((), device=crew.device)
    psnr: dict[float, float] = {}

    while step < settings.steps:
        for group in optimiser.param_groups:
            group["lr"] = _learning_rate(step, recipe)
        learner.train()
        batch = draw_batch(
            training, recipe.noise, size=settings.batch // crew.size, crop=settings.crop, generator=generator,
            histograms=reads_histograms(network),
        )  # fmt: skip
        with torch.autocast(crew.device.type, dtype=precision, enabled=precision != torch.float32):
            output = learner(batch.frame.contiguous(memory_format=torch.channels_last))
        loss = loss_of(output.float(), batch, kind=settings.loss)
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(network.parameters(), 1.0)
        optimiser.step()
        _follow(average, network, settings.averaging if step > settings.warm_up else 0.0)
        step += 1
        loss_sum += loss.detach()
        if step % settings.report_every == 0 or step == settings.steps:
            psnr = validation_psnr(average, validation, recipe)
            now = time.monotonic()
            line = {
                "step": step,
                "loss": float(loss_sum) / (step % settings.report_every or settings.report_every),
                "psnr": {f"{level:.3f}": round(value, 3) for level, value in psnr.items()},
                "mean_psnr": round(sum(psnr.values()) / len(psnr), 3),
                "pairs_per_second": round(settings.report_every * settings.batch / (now - told)),
                "seconds": round(now - began, 1),
            }
            if crew.rank == 0:
                _append(folder / "log.jsonl", line)
            _checkpoint(folder, recipe, state, generator, crew, step, now - began)
            told, loss_sum = time.monotonic(), torch.zeros_like(loss_sum)
            if progress is not None and crew.rank == 0:
                progress("steps", step, settings.steps)

    if not psnr:
        psnr = validation_psnr(average, validation, recipe)
    mean, seconds = sum(psnr.values()) / len(psnr), time.monotonic() - began
    weights = folder / f"{recipe.model}.safetensors"
    if crew.rank == 0:
        about = {
            "model": recipe.model,
            "seed": str(recipe.seed),
            "recipe": recipe.model_dump_json(),
            "validation_psnr": json.dumps({f"{level:.3f}": round(value, 2) for level, value in psnr.items()}),
            "hours": f"{seconds / 3600:.3f}",
            "machine": f"{crew.size} x {torch.cuda.get_device_name()}" if crew.is_cuda else "CPU",
        }
        save_weights(average, weights, about)
    crew.close()
    return Trained(weights=weights, log=folder / "log.jsonl", psnr=mean, seconds=seconds)


def loss_of(output: Tensor, batch: Batch, *, kind: str) -> Tensor:
    """Error of depth where a target is seen, and of what else the network says; a scalar.

    Where nothing is hit the depth to learn is 1, the end of the gate, at a fiftieth of the weight. Crops without a
    target teach no depth: a network that cannot tell would learn to answer 1 for what it can hardly see.
    """
    depth, logits = output[:, :1], output[:, 1:]
    weight = 0.02 + 0.98 * batch.hit
    square = (weight * (depth - batch.clean).square()).flatten(1).sum(dim=1) / weight.flatten(1).sum(dim=1)
    error = square if kind == "mse" else 0.1 * torch.log(square + _FLOOR)
    shows = (batch.hit.flatten(1).mean(dim=1) > 0.02).float()
    error = (shows * error).sum() / shows.sum().clamp_min(1.0)
    if logits.shape[1]:
        reported = logits[:, 2:].detach() if logits.shape[1] > 2 else batch.frame[:, :1]
        true = batch.hit * ((reported - batch.clean).abs() < _TRUE)
        error = error + 0.02 * F.binary_cross_entropy_with_logits(logits[:, :1], batch.hit)
        error = error + 0.02 * F.binary_cross_entropy_with_logits(logits[:, 1:2], true)
    return error


@torch.no_grad()
def validation_psnr(network: nn.Module, scenes: CleanScenes, recipe: TrainingRecipe) -> dict[float, float]:
    """PSNR [dB] over the gate, mean over crops with a target, at each of `LEVELS`, or of `PHOTONS` for a network that
    reads histograms; the same crops and photons every time.
    """
    network.eval()
    device = scenes.depth.device
    result = {}
    counting = reads_histograms(network)
    quiet: dict[str, Any] = {
        "own_gate": 1.0,
        "own_profile": 1.0,
        "dead": 0.0,
        "slanted_gate": 0.0,
        "unknown_water": 0.0,
    }
    for level in PHOTONS if counting else LEVELS:
        generator = torch.Generator(device).manual_seed(round(1e4 * level))
        if counting:
            noise = recipe.noise.model_copy(update={**quiet, "photons": (level, level), "sbr": (1 / 3, 1 / 3)})
        else:
            noise = Noise(backscatter=(level, level), sigma_scale=(1.0, 1.0), counting=0.0, behind=0.0, **quiet)
        batch = draw_batch(
            scenes, noise, size=64 if device.type == "cuda" and not counting else 8, crop=recipe.optimiser.crop,
            generator=generator, always_replaced=True, histograms=counting,
        )  # fmt: skip
        depth = network(batch.frame)[:, :1].float()
        square = (batch.hit * (depth.clamp(0, 1) - batch.clean).square()).flatten(1).sum(dim=1)
        pixels = batch.hit.flatten(1).sum(dim=1)
        there = pixels > 100
        error = (square[there] / pixels[there]).clamp_min(1e-7)
        result[level] = float((-10.0 * error.log10()).mean())
    return result


def save_weights(network: nn.Module, path: str | Path, about: dict[str, str]) -> Path:
    """Weights as float16 safetensors; `about` (text by name) goes into the file's header."""
    from safetensors.torch import save

    values = {
        name: (value.half() if value.is_floating_point() else value).contiguous().cpu()
        for name, value in network.state_dict().items()
    }
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(values, metadata=about))
    return Path(path)


# Parts


@torch.no_grad()
def _follow(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Moves the running mean of the weights, and of what batch normalisation has counted."""
    pairs = list(zip(average.state_dict().values(), network.state_dict().values(), strict=True))
    floats = [(kept, new) for kept, new in pairs if kept.is_floating_point()]
    torch._foreach_lerp_([kept for kept, _ in floats], [new for _, new in floats], 1.0 - decay)
    for kept, new in pairs:
        if not kept.is_floating_point():
            kept.copy_(new)


def _learning_rate(step: int, recipe: TrainingRecipe) -> float:
    settings = recipe.optimiser
    rise = min(1.0, (step + 1) / max(settings.warm_up, 1))
    fall = 0.5 * (1.0 + math.cos(math.pi * step / settings.steps))
    return settings.learning_rate * rise * (0.01 + 0.99 * fall)


class _Crew:
    """The processes of a run: this one alone, or those that torchrun started."""

    def __init__(self, device: str | None) -> None:
        self.size, self.rank = int(os.environ.get("WORLD_SIZE", 1)), int(os.environ.get("RANK", 0))
        self.is_cuda = torch.cuda.is_available() if device is None else device.startswith("cuda")
        if self.is_cuda and device in (None, "cuda"):
            device = f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
        elif self.is_cuda and self.size > 1:
            raise ConfigError(f"device = {device!r} is one for all {self.size} processes; leave it out")
        self.device = _device(torch, device)
        self.placed: dict[str, Any] = {"device_ids": [self.device.index]} if self.is_cuda else {}
        if self.is_cuda:
            torch.cuda.set_device(self.device)
        if self.size > 1:
            torch.distributed.init_process_group("nccl" if self.is_cuda else "gloo")

    def close(self) -> None:
        if self.size > 1:
            torch.distributed.destroy_process_group()


def _resume(
    folder: Path, recipe: TrainingRecipe, state: dict[str, Any], generator: torch.Generator, crew: _Crew
) -> tuple[int, float]:
    """Steps done and seconds spent by an earlier part of the run, whose state is put back."""
    path, log = folder / _CHECKPOINT, folder / "log.jsonl"
    if not path.is_file():
        if crew.rank == 0:
            log.unlink(missing_ok=True)
        return 0, 0.0
    try:
        kept = torch.load(path, map_location="cpu", weights_only=True)
    except Exception as error:  # what a damaged file raises depends on where it is damaged
        raise FileError(f"{path}: damaged; remove it to start anew ({type(error).__name__})") from error
    if kept["recipe"] != recipe.model_dump_json():
        raise ConfigError(f"{path} belongs to another recipe; remove it, or choose another folder")
    for name, part in state.items():
        part.load_state_dict(kept[name])
    if crew.rank < len(kept["random"]):
        generator.set_state(kept["random"][crew.rank])
    if crew.rank == 0 and log.is_file():  # a line is written before its checkpoint
        lines = log.read_text().splitlines(keepends=True)
        lines = lines[: math.ceil(kept["step"] / recipe.optimiser.report_every)]
        with atomic_path(log) as temporary:
            temporary.write_text("".join(lines))
    return int(kept["step"]), float(kept["seconds"])


def _checkpoint(
    folder: Path,
    recipe: TrainingRecipe,
    state: dict[str, Any],
    generator: torch.Generator,
    crew: _Crew,
    step: int,
    seconds: float,
) -> None:
    random: list[Any] = [generator.get_state()]
    if crew.size > 1:
        random = [None] * crew.size
        torch.distributed.all_gather_object(random, generator.get_state())
    if crew.rank == 0:
        kept = {name: part.state_dict() for name, part in state.items()}
        kept.update(recipe=recipe.model_dump_json(), random=random, step=step, seconds=seconds)
        with atomic_path(folder / _CHECKPOINT) as temporary:
            torch.save(kept, temporary)


def _append(path: Path, line: dict[str, Any]) -> None:
    with path.open("a") as file:
        file.write(json.dumps(line) + "\n")
