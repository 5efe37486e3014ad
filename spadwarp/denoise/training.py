"""Training: one loop for every network, on a CPU, a GPU or several.

Several GPUs: `torchrun --nproc-per-node 4 -m spadwarp train RECIPE --out DIR`. An interrupted run resumes from its last
checkpoint when the command is repeated.
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

from spadwarp.denoise.inference import load_network, torch_device
from spadwarp.denoise.networks import build_network, reads_histograms
from spadwarp.denoise.recipe import Noise, TrainingRecipe
from spadwarp.denoise.synthetic_noise import Batch, CleanScenes, draw_batch
from spadwarp.errors import ConfigError, FileError
from spadwarp.io.atomic import atomic_path
from spadwarp.limits import environment_integer
from spadwarp.parallel.worker import interruptible

__all__ = ["LEVELS", "Trained", "fit"]

LEVELS = (0.042, 0.183, 0.264, 0.337, 0.394, 0.480)
"""Backscatter fractions at which the paper, and validation here, measures."""

PHOTONS = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Signal photons per pixel, a third of the background, at which networks that read histograms are validated."""

_FLOOR = 3e-6  # mean square over the gate below which a crop is good enough: 55 dB
_NEAR = 0.015  # part of the gate within which a reported depth counts as the target's


@dataclass(frozen=True, kw_only=True)
class Trained:
    """Files and validation of a training.

    Attributes:
        weights: The network, safetensors.
        log: JSON lines: step, loss, validation PSNR [dB] at each of `LEVELS` or `PHOTONS`, pairs per second, seconds.
        psnr: Validation PSNR, mean over the levels [dB].
        seconds: Duration of all parts of the run together [s].
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
    """Trains a network, or resumes an interrupted run of the same recipe.

    Args:
        recipe: Model, noise and optimiser.
        training, validation: Clean scenes, on any device.
        out: Folder for `checkpoint.pt`, `log.jsonl` and the weights.
        device: "cpu", "cuda" or "cuda:N"; default: the GPU of this process, else the CPU.
        progress: Called with ("steps", done, total) after every step.

    Ctrl-C or SIGTERM end the run after the step at hand with a checkpoint and a KeyboardInterrupt that names it.

    Each process draws crops and noise of its own. A run of N processes equals, to the rounding of sums, a run of a
    single process whose batches are the N parts together; only batch normalisation, in DnCNN, sees its own part alone.

    Raises:
        ConfigError: The folder holds a run of another recipe, or a crop is larger than the scenes.
        DeviceError: No such device.
        FileError: The weights cannot be written.
    """
    workers = _Workers(device)
    settings = recipe.optimiser
    if settings.crop > min(training.depth.shape[1:]):
        raise ConfigError(f"optimiser.crop = {settings.crop} is outside [32, {min(training.depth.shape[1:])}]")
    if settings.batch % workers.size:
        raise ConfigError(f"optimiser.batch = {settings.batch} cannot be shared evenly by {workers.size} processes")
    Path(out).mkdir(parents=True, exist_ok=True)
    training, validation = training.to(workers.device), validation.to(workers.device)
    run = _Run(recipe, Path(out), workers)
    psnr: dict[float, float] = {}

    with interruptible() as interrupted:
        while run.step < settings.steps and not workers.any(interrupted.is_set()):
            for group in run.optimiser.param_groups:
                group["lr"] = _learning_rate(run.step, recipe)
            batch = draw_batch(
                training, recipe.noise, size=settings.batch // workers.size, crop=settings.crop,
                generator=run.generator, histograms=reads_histograms(run.network),
            )  # fmt: skip
            run.update(batch)
            if run.step % settings.report_every == 0 or run.step == settings.steps:
                psnr = validation_psnr(run.average, validation, recipe)
                run.report(psnr)
            if progress is not None and workers.rank == 0:
                progress("steps", run.step, settings.steps)

        if run.step < settings.steps:
            run.save_checkpoint()
            workers.close()
            raise KeyboardInterrupt(
                f"interrupted at step {run.step} of {settings.steps}; the same command resumes from {run.checkpoint}"
            )

    trained = run.finish(psnr or validation_psnr(run.average, validation, recipe))
    workers.close()
    return trained


def loss_of(output: Tensor, batch: Batch, *, kind: str) -> Tensor:
    """Error of depth where a target is seen, and of the network's other outputs; a scalar.

    Where nothing is hit the true depth is 1, the end of the gate, with a fiftieth of the weight. Crops without a target
    do not count for depth: the network would learn to answer 1 for targets that it can hardly see.
    """
    depth, logits = output[:, :1], output[:, 1:]
    weight = 0.02 + 0.98 * batch.hit
    square = (weight * (depth - batch.clean).square()).flatten(1).sum(dim=1) / weight.flatten(1).sum(dim=1)
    error = square if kind == "mse" else 0.1 * torch.log(square + _FLOOR)
    with_target = (batch.hit.flatten(1).mean(dim=1) > 0.02).float()
    error = (with_target * error).sum() / with_target.sum().clamp_min(1.0)
    if logits.shape[1]:
        reported = logits[:, 2:].detach() if logits.shape[1] > 2 else batch.frame[:, :1]
        true = batch.hit * ((reported - batch.clean).abs() < _NEAR)
        error = error + 0.02 * F.binary_cross_entropy_with_logits(logits[:, :1], batch.hit)
        error = error + 0.02 * F.binary_cross_entropy_with_logits(logits[:, 1:2], true)
    return error


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


def save_weights(network: nn.Module, path: str | Path, metadata: dict[str, str]) -> Path:
    """Weights as float16 safetensors, with metadata (text by name) in the file's header."""
    from safetensors.torch import save

    values = {
        name: (value.half() if value.is_floating_point() else value).contiguous().cpu()
        for name, value in network.state_dict().items()
    }
    with atomic_path(path) as temporary:
        temporary.write_bytes(save(values, metadata=metadata))
    return Path(path)


# Parts


@torch.no_grad()
def _update_mean(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Updates the running mean of the weights and of the statistics of batch normalisation."""
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


class _Workers:
    """The processes of a run: this one alone, or those that torchrun started."""

    def __init__(self, device: str | None) -> None:
        self.size, self.rank = environment_integer("WORLD_SIZE", 1), environment_integer("RANK", 0)
        self.is_cuda = torch.cuda.is_available() if device is None else device.startswith("cuda")
        if self.is_cuda and device in (None, "cuda"):
            device = f"cuda:{os.environ.get('LOCAL_RANK', 0)}"
        elif self.is_cuda and self.size > 1:
            raise ConfigError(f"device = {device!r} is one for all {self.size} processes; leave it out")
        self.device = torch_device(device)
        if self.is_cuda:
            torch.cuda.set_device(self.device)
        if self.size > 1:
            torch.distributed.init_process_group("nccl" if self.is_cuda else "gloo")
            self._on_host = torch.distributed.new_group(backend="gloo")

    def any(self, flag: bool) -> bool:
        """Whether the flag is set in any of the processes; asked on the host, so that no GPU has to wait."""
        if self.size == 1:
            return flag
        flags = torch.tensor(int(flag))
        torch.distributed.all_reduce(flags, torch.distributed.ReduceOp.MAX, group=self._on_host)
        return bool(flags)

    def close(self) -> None:
        if self.size > 1:
            torch.distributed.destroy_process_group()


class _Run:
    """Network, optimiser and files of a training; resumes from the checkpoint in its folder."""

    def __init__(self, recipe: TrainingRecipe, folder: Path, workers: _Workers) -> None:
        self.recipe, self.folder, self.workers = recipe, folder, workers
        self.log, self.checkpoint = folder / "log.jsonl", folder / "checkpoint.pt"
        torch.backends.cudnn.benchmark = torch.backends.cuda.matmul.allow_tf32 = workers.is_cuda
        torch.manual_seed(recipe.seed)
        network: Any = build_network(recipe.model)
        if recipe.start is not None:
            keys = network.load_state_dict(load_network(recipe.start).state_dict(), strict=False)
            new = [name for name in keys.missing_keys if not name.startswith(("enter_features.", "leave_features."))]
            if new or keys.unexpected_keys:
                raise FileError(f"start = {recipe.start!r}: its layers are not those of {recipe.model!r}")
        self.network = network.to(workers.device).to(memory_format=torch.channels_last)
        self.learner = self.network
        if workers.size > 1:
            devices = [workers.device.index] if workers.is_cuda else None
            self.learner = nn.parallel.DistributedDataParallel(self.network, device_ids=devices)
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        rate, decay = recipe.optimiser.learning_rate, recipe.optimiser.weight_decay
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=rate, weight_decay=decay, fused=workers.is_cuda
        )
        self.generator = torch.Generator(workers.device).manual_seed(recipe.seed * 1009 + workers.rank)
        self.state = {"network": self.network, "average": self.average, "optimiser": self.optimiser}
        self.loss_sum = torch.zeros((), device=workers.device)  # of the steps since the last report
        self.step, spent = self._resume()
        self.last_report, self.timed_from = time.monotonic(), self.step
        self.began = self.last_report - spent

    def _resume(self) -> tuple[int, float]:
        """Steps done and seconds spent by an earlier part of the run, whose state is restored."""
        rank = self.workers.rank
        if not self.checkpoint.is_file():
            if rank == 0:
                self.log.unlink(missing_ok=True)
            return 0, 0.0
        try:
            kept = torch.load(self.checkpoint, map_location="cpu", weights_only=True)
        except Exception as error:  # what a damaged file raises depends on where it is damaged
            raise FileError(f"{self.checkpoint}: damaged; remove it to start anew ({type(error).__name__})") from error
        if not isinstance(kept, dict) or kept.get("recipe") != self.recipe.model_dump_json():
            raise ConfigError(f"{self.checkpoint} belongs to another recipe; remove it, or choose another folder")
        try:
            for name, part in self.state.items():
                part.load_state_dict(kept[name])
            if rank < len(kept["random"]):
                self.generator.set_state(kept["random"][rank])
            kept = {**kept, "step": int(kept["step"]), "seconds": float(kept["seconds"])}
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            raise FileError(f"{self.checkpoint}: not whole; remove it to start anew: {error}") from error
        if rank == 0 and self.log.is_file():  # a line is written before its checkpoint
            lines = self.log.read_text().splitlines(keepends=True)
            settings = self.recipe.optimiser
            reports = kept["step"] // settings.report_every
            lines = lines[
                : reports if kept["step"] < settings.steps else math.ceil(kept["step"] / settings.report_every)
            ]
            with atomic_path(self.log) as temporary:
                temporary.write_text("".join(lines))
        self.loss_sum += kept.get("loss_sum", 0.0)
        return int(kept["step"]), float(kept["seconds"])

    def update(self, batch: Batch) -> None:
        """One step of the optimiser."""
        settings, device = self.recipe.optimiser, self.workers.device
        lower = settings.precision == "bfloat16" and self.workers.is_cuda
        self.learner.train()
        with torch.autocast(device.type, dtype=torch.bfloat16 if lower else torch.float32, enabled=lower):
            output = self.learner(batch.frame.contiguous(memory_format=torch.channels_last))
        loss = loss_of(output.float(), batch, kind=settings.loss)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        _update_mean(self.average, self.network, settings.averaging if self.step > settings.warm_up else 0.0)
        self.step += 1
        self.loss_sum += loss.detach()

    def report(self, psnr: dict[float, float]) -> None:
        """Writes a line of the log and a checkpoint."""
        settings, now = self.recipe.optimiser, time.monotonic()
        line = {
            "step": self.step,
            "loss": float(self.loss_sum) / (self.step % settings.report_every or settings.report_every),
            "psnr": {f"{level:.3f}": round(value, 3) for level, value in psnr.items()},
            "mean_psnr": round(sum(psnr.values()) / len(psnr), 3),
            "pairs_per_second": round((self.step - self.timed_from) * settings.batch / (now - self.last_report)),
            "seconds": round(now - self.began, 1),
        }
        if self.workers.rank == 0:
            with self.log.open("a") as file:
                file.write(json.dumps(line) + "\n")
        self.loss_sum.zero_()
        self.save_checkpoint()
        self.last_report, self.timed_from = time.monotonic(), self.step

    def save_checkpoint(self) -> None:
        """Writes all from which the run can be resumed; every process has to call it."""
        random: list[Any] = [self.generator.get_state()]
        if self.workers.size > 1:
            random = [None] * self.workers.size
            torch.distributed.all_gather_object(random, self.generator.get_state())
        if self.workers.rank == 0:
            kept = {name: part.state_dict() for name, part in self.state.items()}
            kept.update(recipe=self.recipe.model_dump_json(), random=random, step=self.step)
            kept.update(loss_sum=float(self.loss_sum), seconds=time.monotonic() - self.began)
            with atomic_path(self.checkpoint) as temporary:
                torch.save(kept, temporary)

    def finish(self, psnr: dict[float, float]) -> Trained:
        """Writes the weights, the running mean of the network."""
        recipe, workers, seconds = self.recipe, self.workers, time.monotonic() - self.began
        weights = self.folder / f"{recipe.model}.safetensors"
        if workers.rank == 0:
            metadata = {
                "model": recipe.model,
                "seed": str(recipe.seed),
                "recipe": recipe.model_dump_json(),
                "validation_psnr": json.dumps({f"{level:.3f}": round(value, 2) for level, value in psnr.items()}),
                "hours": f"{seconds / 3600:.3f}",
                "machine": f"{workers.size} x {torch.cuda.get_device_name()}" if workers.is_cuda else "CPU",
            }
            save_weights(self.average, weights, metadata)
        return Trained(weights=weights, log=self.log, psnr=sum(psnr.values()) / len(psnr), seconds=seconds)
