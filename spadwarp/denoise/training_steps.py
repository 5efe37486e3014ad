"""A training's processes, steps and files, and its loss: the error of depth, and of the network's other answers."""

from __future__ import annotations

import copy
import json
import math
import os
import time
import warnings
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spadwarp.denoise.context import ANSWERS
from spadwarp.denoise.frames import POOLED
from spadwarp.denoise.network_files import load_network, torch_device
from spadwarp.denoise.networks import build_network, reads_histograms
from spadwarp.denoise.pyramid import CLOSE
from spadwarp.denoise.recipe import TrainingRecipe
from spadwarp.denoise.samples import Samples, Sizes
from spadwarp.denoise.selection import CHOICES
from spadwarp.denoise.synthetic_noise import Batch, CleanScenes
from spadwarp.io.paths import atomic_path
from spadwarp.values import ConfigError, FileError, environment_integer

__all__ = ["Run", "Trained", "Workers", "save_weights"]

_FLOOR = 3e-6  # mean square over the gate below which a crop is good enough: 55 dB
_FINE_FLOOR = 1e-7  # the same for histograms, whose many photons give finer depths
_WATER = 0.001  # weight of depth where nothing is hit
_TARGET, _OTHERS = 0.3, 0.04  # weights of the cross-entropies of "sees a target" and of the other two logits
_NEAR = 0.015  # part of the gate within which a reported depth counts as the target's
_CHOICE = 0.005  # weight of the cross-entropy of the wide view's depths with those next to the truth
_TYPICAL = 1.5  # depths count as next to the truth within this times the median error of the answer before
_LEAST = 5e-4  # or within this [gate widths]


def loss_of(output: Tensor, batch: Batch, *, kind: str) -> Tensor:
    """Error of depth where a target is seen, and of the network's other outputs; a scalar.

    Where nothing is hit the true depth is 1, the end of the gate, with a thousandth of the weight. Crops without a
    target do not count for depth: the network would learn to answer 1 for targets that it can hardly see.
    """
    depth, logits, chosen, learnt = output.tensor_split([1, 4, 4 + 2 + POOLED], dim=1)
    weight = _WATER + (1.0 - _WATER) * batch.hit
    floor = _FINE_FLOOR if chosen.shape[1] else _FLOOR

    def error_of(square: Tensor) -> Tensor:
        return _depth_error(square, batch.hit, weight, kind, floor)

    error = error_of((depth - batch.clean).square())
    if logits.shape[1]:
        reported = chosen[:, :1].detach() if chosen.shape[1] else batch.frame[:, :1]
        right = batch.hit * ((depth.detach() - batch.clean).abs() < CLOSE)
        true = batch.hit * ((reported - batch.clean).abs() < _NEAR)
        error = error + _TARGET * _target_error(logits[:, :1], batch)
        for part, truth in ((logits[:, 1:2], right), (logits[:, 2:], true)):
            error = error + _OTHERS * F.binary_cross_entropy_with_logits(part, truth)
    if chosen.shape[1]:  # the candidates' errors, so that one is chosen and not a mean of several
        candidates = torch.cat([batch.frame[:, :1], 0.5 + batch.frame[:, 3 : 3 + POOLED]], dim=1)
        square = (candidates - batch.clean).square() * torch.softmax(chosen[:, 1:], dim=1)
        error = error + 0.5 * error_of(square.sum(dim=1, keepdim=True))
    if learnt.shape[1]:  # the same of the selection, and the wide view; neither changes what is before it
        candidates, scores, depths, weights, last, target = learnt.split([CHOICES] * 2 + [ANSWERS] * 2 + [1, 1], dim=1)
        square = (candidates - batch.clean).square() * torch.softmax(scores, dim=1)
        error = error + 0.5 * error_of(square.sum(dim=1, keepdim=True))
        error = error + error_of((last - batch.clean).square()) + _CHOICE * _choice_error(depths, weights, batch)
        error = error + _TARGET * _target_error(target, batch)
    return error


def _depth_error(square: Tensor, hit: Tensor, weight: Tensor, kind: str, floor: float) -> Tensor:
    """Mean over crops of their mean square, or of its logarithm."""
    mean = (weight * square).flatten(1).sum(dim=1) / weight.flatten(1).sum(dim=1)
    error = mean if kind == "mse" else 0.1 * torch.log(mean + floor)
    return _mean_with_target(error, hit)


def _mean_with_target(error: Tensor, hit: Tensor) -> Tensor:
    """Mean over the crops that have a target."""
    with_target = (hit.flatten(1).mean(dim=1) > 0.005).float()
    return (with_target * error).sum() / with_target.sum().clamp_min(1.0)


def _target_error(logit: Tensor, batch: Batch) -> Tensor:
    """Cross-entropy of "sees a target", of the crops that count for it."""
    entropy = F.binary_cross_entropy_with_logits(logit, batch.hit, reduction="none")
    return (entropy * batch.judged).mean()


def _choice_error(depths: Tensor, scores: Tensor, batch: Batch) -> Tensor:
    """Cross-entropy of the scores with the depths next to the truth; the first depth is the answer before."""
    away = (depths.detach() - batch.clean).abs()
    typical = torch.where(batch.hit > 0, away[:, :1], torch.nan).flatten(1).nanmedian(dim=1).values.nan_to_num(0.01)
    near = (_TYPICAL * typical).clamp_min(_LEAST)[:, None, None, None]
    share = torch.softmax((-0.5 * (away / near).square()).clamp_min(-1e4), dim=1)
    entropy = -(share * scores.log_softmax(dim=1)).sum(dim=1, keepdim=True) * batch.hit
    return _mean_with_target(entropy.flatten(1).sum(dim=1) / batch.hit.flatten(1).sum(dim=1).clamp_min(1.0), batch.hit)


# Steps


_EAGER = 12  # steps before one is recorded as a CUDA graph


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


@torch.no_grad()
def _update_mean(average: nn.Module, network: nn.Module, decay: float) -> None:
    """Updates the running mean of the weights and of the statistics of batch normalisation."""
    pairs = list(zip(average.state_dict().values(), network.state_dict().values(), strict=True))
    floats = [(kept, new) for kept, new in pairs if kept.is_floating_point()]
    torch._foreach_lerp_([kept for kept, _ in floats], [new for _, new in floats], 1.0 - decay)
    for kept, new in pairs:
        if not kept.is_floating_point():
            kept.copy_(new)


def learning_rate(step: int, recipe: TrainingRecipe) -> float:
    settings = recipe.optimiser
    rise = min(1.0, (step + 1) / max(settings.warm_up, 1))
    fall = 0.5 * (1.0 + math.cos(math.pi * step / settings.steps))
    return settings.learning_rate * rise * (0.01 + 0.99 * fall)


def _difference(stored: Any, recipe: TrainingRecipe) -> str:
    """In which fields the recipe of a checkpoint, a text, differs from this one."""
    try:
        before, now = _fields(json.loads(stored)), _fields(recipe.model_dump(mode="json"))
    except (AttributeError, TypeError, ValueError):  # no recipe of ours
        return ""
    names = [name for name in now if before.get(name) != now[name]]
    parts = [
        f"{name} = {before.get(name)}, here {now[name]}" if name != "mixture" else "mixture" for name in names[:3]
    ] + ["…"] * (len(names) > 3)
    why = "; its learning rate decreases over all steps" if names == ["optimiser.steps"] else ""
    return f" ({'; '.join(parts)}{why})" if parts else ""


def _fields(tables: dict[str, Any]) -> dict[str, Any]:
    """Values by name, those of a table as `optimiser.steps`."""
    named: dict[str, Any] = {}
    for name, value in tables.items():
        named |= {f"{name}.{one}": inner for one, inner in value.items()} if isinstance(value, dict) else {name: value}
    return named


class Workers:
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


class Run:
    """Network, optimiser and files of a training; resumes from the checkpoint in its folder."""

    def __init__(self, recipe: TrainingRecipe, folder: Path, workers: Workers, given: CleanScenes | None) -> None:
        self.recipe, self.folder, self.workers = recipe, folder, workers
        self.log, self.checkpoint = folder / "log.jsonl", folder / "checkpoint.pt"
        torch.manual_seed(recipe.seed)
        network: Any = build_network(recipe.model)
        if recipe.start is not None:
            network.load_state_dict(load_network(recipe.start).state_dict(), strict=False)
        self.network = network.to(workers.device).to(memory_format=torch.channels_last)
        self.learner = self.network
        if workers.size > 1:
            devices = [workers.device.index] if workers.is_cuda else None
            self.learner = nn.parallel.DistributedDataParallel(self.network, device_ids=devices)
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        rate, decay = recipe.optimiser.learning_rate, recipe.optimiser.weight_decay
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), lr=torch.tensor(rate, device=workers.device) if workers.is_cuda else rate,
            weight_decay=decay, betas=(0.9, 0.99), fused=workers.is_cuda, capturable=workers.is_cuda,
        )  # fmt: skip
        self.generator = torch.Generator(workers.device).manual_seed(recipe.seed * 1009 + workers.rank)
        self.samples = Sizes(
            recipe, workers.rank, workers.size, self.generator, given, histograms=reads_histograms(network)
        )
        self.state = {"network": self.network, "average": self.average, "optimiser": self.optimiser}
        self.loss_sum = torch.zeros((), device=workers.device)  # of the steps since the last report
        self.step, spent = self._resume()
        self.steps_here = 0
        self.eager: dict[Samples, int] = {}  # steps that were not replayed
        self.graphs: dict[Samples, tuple[Any, Tensor]] = {}  # the recorded step and its loss
        self.side: Any = torch.cuda.Stream() if workers.is_cuda else None
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
        stored = kept.get("recipe") if isinstance(kept, dict) else None
        if stored != self.recipe.model_dump_json():
            raise ConfigError(
                f"{self.checkpoint} belongs to another recipe{_difference(stored, self.recipe)}; choose another folder "
                "with --out, or remove this file to start anew"
            )
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

    def update(self) -> None:
        """One step, whose samples are prepared. On a single GPU steps are replayed as a CUDA graph: launched faster."""
        rate = learning_rate(self.step, self.recipe)
        for group in self.optimiser.param_groups:
            if isinstance(group["lr"], Tensor):
                group["lr"].fill_(rate)
            else:
                group["lr"] = rate
        samples = self.samples.of(self.step)
        if samples in self.graphs:
            graph, loss = self.graphs[samples]
            graph.replay()
        elif self.workers.is_cuda:
            side = self.side
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                loss = self._work(samples)
            torch.cuda.current_stream().wait_stream(side)
        else:
            loss = self._work(samples)
        settings = self.recipe.optimiser
        _update_mean(self.average, self.network, settings.averaging if self.step > settings.warm_up else 0.0)
        self.loss_sum += loss
        self.step += 1
        self.steps_here += 1
        if samples not in self.graphs:
            self.eager[samples] = self.eager.get(samples, 0) + 1
            if self.side is not None and self.workers.size == 1 and self.eager[samples] == _EAGER:
                self._capture(samples)

    def _capture(self, samples: Samples) -> None:
        """Records a step as a CUDA graph; where that fails, training goes on step by step."""
        samples.hold()
        graph = torch.cuda.CUDAGraph()
        torch.cuda.synchronize()
        try:
            graph.register_generator_state(self.generator)
            self.optimiser.zero_grad(set_to_none=True)
            with torch.cuda.graph(graph):
                loss = self._work(samples)
        except (RuntimeError, AttributeError) as error:
            warnings.warn(f"no CUDA graph of a training step: {error}", stacklevel=2)
            torch.cuda.synchronize()
            return
        self.graphs[samples] = graph, loss

    def _work(self, samples: Samples) -> Tensor:
        settings, workers = self.recipe.optimiser, self.workers
        precision = torch.bfloat16 if settings.precision == "bfloat16" and workers.is_cuda else torch.float32
        self.learner.train()
        batch = samples.batch()
        mixed = precision != torch.float32
        with torch.autocast(workers.device.type, dtype=precision, enabled=mixed, cache_enabled=False):
            output = self.learner(batch.frame.contiguous(memory_format=torch.channels_last))
        loss = loss_of(output.float(), batch, kind=settings.loss)
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        return loss.detach()

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
