"""Training: the samples, the loss, and one loop for every network, on a CPU or a GPU.

An interrupted run resumes from its last checkpoint when the command is repeated.
"""

from __future__ import annotations

import copy
import json
import math
import os
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from statistics import fmean
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spadwarp.denoise.classical import highest, log_likelihood
from spadwarp.denoise.histogram_network import CLOSE, answer, mean_depth
from spadwarp.denoise.network_files import torch_device
from spadwarp.denoise.networks import NETWORKS, load_network
from spadwarp.denoise.recipe import LEAST_CROP, LEVELS, Noise, Part, TrainingRecipe
from spadwarp.denoise.synthetic_noise import COUNT_BINS, SUBPIXELS, Batch, CleanScenes, draw_batch, procedural_scenes
from spadwarp.io.paths import write_file
from spadwarp.io.text import duration, write_text
from spadwarp.parallel import interruptible
from spadwarp.values import ConfigError, FileError

# The samples: clean scenes, and which noisy crops of them each step learns from.

_OPEN = (0.03, 0.5)  # part of a scene that is target, where it counts as a target in open water


class Samples:
    """Batches of crops, drawn anew in each step; those of histograms of one part of the mixture, and its bins.

    In `optimiser.wide` of the steps, drawn at random, it is a quarter as many crops of twice the recipe's side: with
    small crops alone, the network would never see a pixel far from the border of its image. They are cut from scenes
    `given`, of a dataset, or from new ones, which do not depend on the steps before. `prepare` is called before each
    step; `batch` may then be recorded in a CUDA graph, for steps of the same `kind`.
    """

    def __init__(self, recipe: TrainingRecipe, generator: torch.Generator, given: CleanScenes | None) -> None:
        self.recipe, self.generator, self.histograms = recipe, generator, recipe.model == "histograms"
        self.given = None if given is None else given.to(generator.device)
        self.finer = SUBPIXELS if given is None and self.histograms else 1
        self.parts = recipe.parts()
        self.crop, self.size, self.part, self.bins = 0, 0, self.parts[0], COUNT_BINS[0]
        self.drawn = lru_cache(maxsize=1 + (recipe.optimiser.wide > 0))(self._draw)  # for crops of either side
        # By the side of the crops: scenes of the step, and held ones.
        self.now: dict[int, CleanScenes] = {}
        self.held: dict[int, CleanScenes] = {}

    def _draw(self, turn: int, crop: int) -> CleanScenes:
        seed = (self.recipe.seed * 1_000_003 + turn) * 4096 % 2**62
        count, device = self.recipe.optimiser.scenes, self.generator.device
        return procedural_scenes(count, crop + 32, seed=seed, device=device, finer=self.finer)

    def prepare(self, step: int) -> None:
        settings = self.recipe.optimiser
        scale = 2 if np.random.default_rng((self.recipe.seed, step)).random() < settings.wide else 1
        self.crop, self.size = scale * settings.crop, max(1, settings.batch // scale**2)
        now = self.drawn(step // settings.redraw, self.crop) if self.given is None else self.given
        if self.histograms:
            host = np.random.default_rng((self.recipe.seed, 0, step))
            self.part = self.parts[host.choice(len(self.parts), p=[part.share for part in self.parts])]
            often = np.array(COUNT_BINS) ** -0.5  # many bins take more time
            self.bins = int(host.choice(COUNT_BINS, p=often / often.sum()))
            if host.random() < self.part.open_water:
                now = in_open_water(now)
            if host.random() < self.part.crowded:
                now = crowded(now)
        if self.crop in self.held and now is not self.now[self.crop]:
            for kept, new in zip(self.held[self.crop], now, strict=True):
                kept.copy_(new)
        self.now[self.crop] = now

    @property
    def kind(self) -> tuple[int, Part, int]:
        """What the operations of a step depend on."""
        return self.crop, self.part, self.bins

    def hold(self) -> None:
        """From now on `batch` reads the same memory in every step with crops of this side."""
        if self.crop not in self.held:
            self.held[self.crop] = CleanScenes(*(values.clone() for values in self.now[self.crop]))

    def batch(self) -> Batch:
        return draw_batch(
            self.held.get(self.crop, self.now[self.crop]), self.part, size=self.size, crop=self.crop,
            generator=self.generator, histograms=self.histograms, bins=self.bins, finer=self.finer,
        )  # fmt: skip


def in_open_water(scenes: CleanScenes) -> CleanScenes:
    """As many, of those that have a target in open water; all if none has."""
    share = scenes.depth.isfinite().flatten(1).float().mean(1)
    some = ((share > _OPEN[0]) & (share < _OPEN[1])).nonzero()[:, 0]
    if not len(some):
        return scenes
    chosen = some[torch.arange(len(share), device=some.device) % len(some)]
    return CleanScenes(*(values[chosen] for values in scenes))


def crowded(scenes: CleanScenes) -> CleanScenes:
    """Each scene with the next one: of both, each pixel sees the nearer surface."""
    other = CleanScenes(*(values.roll(1, 0) for values in scenes))
    before: Tensor = (scenes.depth <= other.depth) | other.depth.isnan()
    depth, sigma = (torch.where(before, *pair) for pair in zip(scenes[:2], other[:2], strict=True))
    gate = torch.stack([torch.minimum(scenes.gate, other.gate)[:, 0], torch.maximum(scenes.gate, other.gate)[:, 1]], 1)
    return CleanScenes(depth, sigma, gate, scenes.profile)


# The loss: the error of depth, and of the network's other answers.

_FLOOR = 3e-6  # mean square over the gate below which a crop is good enough: 55 dB
_FINE_FLOOR = 1e-7  # the same for histograms, whose many photons give finer depths
_WATER = 0.001  # weight of depth where nothing is hit
_TARGET, _OTHERS = 0.3, 0.04  # weights of the cross-entropies of "sees a target" and of the other two logits
_NEAR = 0.015  # part of the gate within which a reported depth counts as the target's
_OUTLIER = 1e-3  # added to the probability, so that no pixel that nobody can tell outweighs all others
_BINS, _SEEN = 0.2, 1.0  # weights, for histograms, of the cross-entropies of "right" and of "sees a target"


def loss_of(output: Tensor, batch: Batch) -> Tensor:
    """Error of depth where a target is seen, and of the network's other outputs; a scalar.

    Of depth it is the logarithm of the mean square of each crop, so that easy crops count as much as hard ones. Where
    nothing is hit the true depth is 1, the end of the gate, with a thousandth of the weight. Crops without a
    target do not count for depth: the network would learn to answer 1 for targets that it can hardly see.
    """
    depth, logits = output.tensor_split([1], dim=1)
    weight = _WATER + (1.0 - _WATER) * batch.hit
    square = weight * (depth - batch.clean).square()
    mean = square.flatten(1).sum(dim=1) / weight.flatten(1).sum(dim=1)
    error = _mean_with_target(0.1 * torch.log(mean + _FLOOR), batch.hit)
    if logits.shape[1]:
        right = batch.hit * ((depth.detach() - batch.clean).abs() < CLOSE)
        true = batch.hit * ((batch.inputs[0][:, :1] - batch.clean).abs() < _NEAR)
        shares, truths = (_TARGET, _OTHERS, _OTHERS), (batch.hit, right, true)
        for share, logit, truth in zip(shares, logits.split(1, dim=1), truths, strict=True):
            error = error + share * F.binary_cross_entropy_with_logits(logit, truth)
    return error


def histogram_loss(log_probability: Tensor, target: Tensor, batch: Batch) -> Tensor:
    """Of a distribution over bins `[B, H, W, T]` and the target's logit `[B, H, W]`; a scalar.

    Error of the mean depth of each crop, on a logarithmic scale; cross-entropies of "right to 1.5 bins" and of "sees a
    target".
    """
    hit, clean, bins = batch.hit[:, 0], batch.clean[:, 0], log_probability.shape[-1]
    pixels = hit.flatten(1).sum(dim=1).clamp_min(1.0)
    depth = mean_depth(log_probability, log_probability.exp())
    square = (hit * (depth - clean).square()).flatten(1).sum(dim=1) / pixels
    middle = (clean * bins).long().clamp(0, bins - 1)[..., None]
    middle = (middle + torch.arange(-1, 2, device=middle.device)).clamp(0, bins - 1)
    right = log_probability.gather(-1, middle).exp().sum(dim=-1)
    entropy = (hit * -torch.log(right + _OUTLIER)).flatten(1).sum(dim=1) / pixels
    error = _mean_with_target(0.5 * torch.log(square + _FINE_FLOOR) + _BINS * entropy, hit)
    return error + _SEEN * F.binary_cross_entropy_with_logits(target, hit)


def _mean_with_target(error: Tensor, hit: Tensor) -> Tensor:
    """Mean over the crops that have a target."""
    with_target = (hit.flatten(1).mean(dim=1) > 0.005).float()
    return (with_target * error).sum() / with_target.sum().clamp_min(1.0)


# Steps

_MOMENTUM = 0.95  # of Muon
_MATRIX = 8  # rows and columns at least of its matrices


class Muon(torch.optim.Optimizer):
    """Momentum of matrices, orthogonalised: all its singular values become about 1. Filters are matrices of outputs.

    Jordan et al., Muon: an optimizer for hidden layers in neural networks (2024). A step is as large as those of AdamW:
    Liu et al., arXiv:2502.16982 (2025).
    """

    @torch.no_grad()
    def step(self, closure: None = None) -> None:  # type: ignore[override]
        (group,) = self.param_groups
        by_shape: dict[torch.Size, list[tuple[Tensor, Tensor]]] = {}
        for parameter in group["params"]:
            if not (state := self.state[parameter]):
                state["momentum"] = torch.zeros_like(parameter)
            momentum = state["momentum"].lerp_(parameter.grad, 1.0 - _MOMENTUM)
            pair = parameter, torch.lerp(parameter.grad, momentum, _MOMENTUM).flatten(1)  # Nesterov's
            by_shape.setdefault(pair[1].shape, []).append(pair)
        for (rows, columns), pairs in by_shape.items():
            turned = torch.stack([matrix.T if rows > columns else matrix for _, matrix in pairs])
            turned /= turned.norm(dim=(1, 2), keepdim=True) + 1e-7
            for _ in range(5):  # Newton and Schulz: singular values s to 3.4445 s − 4.775 s³ + 2.0315 s⁵
                square = turned @ turned.mT
                factor = torch.baddbmm(square, square, square, beta=-4.775, alpha=2.0315)
                turned = torch.baddbmm(turned, factor, turned, beta=3.4445)
            turned = (turned.mT if rows > columns else turned) * (group["lr"] * 0.2 * max(rows, columns) ** 0.5)
            for (parameter, _), change in zip(pairs, turned, strict=True):
                parameter.mul_(1.0 - group["lr"] * group["weight_decay"]).sub_(change.view_as(parameter))


def _is_matrix(parameter: Tensor) -> bool:
    """Whether `Muon` steps it; the last layers have few outputs."""
    return parameter.dim() > 1 and min(parameter.flatten(1).shape) >= _MATRIX


@dataclass(frozen=True, kw_only=True)
class Trained:
    """Files and validation of a training.

    A line of the log, from step 0 on, is JSON: step, loss (null at 0), validation PSNR [dB] at each of `LEVELS` or
    `PHOTONS`, its mean and that of the noisy input, pairs per second, s.
    """

    weights: Path
    log: Path
    psnr: float  # of the validation, mean over the levels [dB]
    input_psnr: float  # the same of its noisy frames, without a network [dB]
    seconds: float  # of all parts of the run together


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


def _difference(stored: Any, recipe: TrainingRecipe) -> str:
    """In which fields the recipe of a checkpoint, a text, differs from this one."""

    def fields(text: Any) -> dict[str, Any]:  # by name, those of a table as `optimiser.steps`
        tables = {name: one if isinstance(one, dict) else {"": one} for name, one in json.loads(text).items()}
        return {f"{name}.{one}".rstrip("."): value for name, table in tables.items() for one, value in table.items()}

    try:
        before, now = fields(stored), fields(recipe.model_dump_json())
    except (AttributeError, TypeError, ValueError):  # no recipe of ours
        return ""
    names = [name for name in now if before.get(name) != now[name]]
    parts = [f"{one} = {before.get(one)}, here {now[one]}" if one != "mixture" else one for one in names[:3]]
    parts += ["…"] * (len(names) > 3)
    why = "; its learning rate decreases over all steps" if names == ["optimiser.steps"] else ""
    return f" ({'; '.join(parts)}{why})" if parts else ""


class Run:
    """Network, optimiser and files of a training; resumes from the checkpoint in its folder."""

    def __init__(self, recipe: TrainingRecipe, folder: Path, device: torch.device, given: CleanScenes | None) -> None:
        self.recipe, self.folder, self.device, is_cuda = recipe, folder, device, device.type == "cuda"
        self.log, self.checkpoint = folder / "log.jsonl", folder / "checkpoint.pt"
        torch.manual_seed(recipe.seed)
        network: Any = NETWORKS[recipe.model]()
        if recipe.start is not None:
            network.load_state_dict(load_network(recipe.start).state_dict(), strict=False)
        self.counting = recipe.model == "histograms"
        self.network = network.to(device)
        if not self.counting:
            self.network = self.network.to(memory_format=torch.channels_last)
        self.average = copy.deepcopy(self.network).requires_grad_(False)
        self.rate = torch.zeros((), device=device)  # which recorded steps read
        common: dict[str, Any] = {"lr": self.rate if is_cuda else 0.0, "weight_decay": recipe.optimiser.weight_decay}
        matrices, others = ([p for p in network.parameters() if _is_matrix(p) == one] for one in (True, False))
        adam = torch.optim.AdamW(others, betas=(0.9, 0.99), fused=is_cuda, capturable=is_cuda, **common)
        self.optimisers = Muon(matrices, common), adam
        self.generator = torch.Generator(device).manual_seed(recipe.seed * 1009)
        self.samples = Samples(recipe, self.generator, given)
        states = self.network, self.average, *self.optimisers
        self.state = dict(zip(("network", "average", "matrices", "others"), states, strict=True))
        self.loss_sum = torch.zeros((), device=device)  # of the steps since the last report
        self.step, spent = self._resume()
        self.graphs: dict[Any, tuple[Any, Tensor] | None] = {}  # recorded steps and losses, of samples of a kind
        self.pool: Any = None  # memory that recorded steps share
        self.side: Any = torch.cuda.Stream() if is_cuda else None
        self.last_report, self.timed_from = time.monotonic(), self.step
        self.began = self.last_report - spent

    def _resume(self) -> tuple[int, float]:
        """Steps done and seconds spent by an earlier part of the run, whose state is restored."""
        if not self.checkpoint.is_file():
            self.log.unlink(missing_ok=True)
            return 0, 0.0
        try:
            kept = torch.load(self.checkpoint, map_location="cpu", weights_only=True)
        except Exception as error:  # what a damaged file raises depends on where it is damaged
            raise FileError(f"{self.checkpoint}: damaged; remove it to start anew ({type(error).__name__})") from error
        stored = kept.get("recipe") if isinstance(kept, dict) else None
        if stored != self.recipe.model_dump_json():
            text = f"{self.checkpoint} belongs to another recipe{_difference(stored, self.recipe)}"
            raise ConfigError(f"{text}; choose another folder with --out, or remove this file to start anew")
        try:
            for name, part in self.state.items():
                part.load_state_dict(kept[name])
            self.generator.set_state(kept["random"])
            step, spent, log = int(kept["step"]), float(kept["seconds"]), str(kept["log"])
            self.loss_sum += float(kept["loss_sum"])
        except (LookupError, TypeError, ValueError, AttributeError, RuntimeError) as error:
            raise FileError(f"{self.checkpoint}: not whole; remove it to start anew: {error}") from error
        write_text(log, self.log)  # without a line that was written after the checkpoint
        return step, spent

    def report(self, psnr: dict[float, float], input_psnr: float) -> None:
        """Writes a line of the log and a checkpoint."""
        settings, now = self.recipe.optimiser, time.monotonic()
        line = {
            "step": self.step,
            "loss": float(self.loss_sum) / (self.step % settings.interval or settings.interval) if self.step else None,
            "psnr": {f"{level:.3f}": round(value, 3) for level, value in psnr.items()},
            "mean_psnr": round(fmean(psnr.values()), 3),
            "input_psnr": round(input_psnr, 3),
            "pairs_per_second": round((self.step - self.timed_from) * settings.batch / (now - self.last_report)),
            "seconds": round(now - self.began, 1),
        }
        with self.log.open("a") as file:
            file.write(json.dumps(line) + "\n")
        self.loss_sum.zero_()
        self.save_checkpoint()
        self.last_report, self.timed_from = time.monotonic(), self.step

    def update(self) -> None:
        """One step, whose samples are prepared. On a GPU steps are replayed as a CUDA graph: launched faster."""
        rate = _learning_rate(self.step, self.recipe)
        for group in (group for one in self.optimisers for group in one.param_groups):
            group["lr"] = self.rate.fill_(rate) if self.side is not None else rate  # that of a checkpoint is a copy
        kind = self.samples.kind
        if recorded := self.graphs.get(kind):
            graph, loss = recorded
            graph.replay()
        elif (side := self.side) is not None:
            side.wait_stream(torch.cuda.current_stream())
            with torch.cuda.stream(side):
                loss = self._work()
            torch.cuda.current_stream().wait_stream(side)
        else:
            loss = self._work()
        settings = self.recipe.optimiser
        _update_mean(self.average, self.network, settings.averaging if self.step > settings.warm_up else 0.0)
        self.loss_sum += loss
        self.step += 1
        if self.side is not None and kind not in self.graphs:
            self._capture()

    def _capture(self) -> None:
        """Records a step as a CUDA graph; where that fails, training goes on step by step."""
        self.samples.hold()
        kind, graph = self.samples.kind, torch.cuda.CUDAGraph()
        torch.cuda.synchronize()
        self.graphs[kind] = None
        try:
            graph.register_generator_state(self.generator)
            self.network.zero_grad(set_to_none=True)
            with torch.cuda.graph(graph, pool=self.pool):
                loss = self._work()
            self.pool = graph.pool()
            self.graphs[kind] = graph, loss
        except (RuntimeError, AttributeError) as error:
            warnings.warn(f"no CUDA graph of a training step: {error}", stacklevel=2)
            torch.cuda.synchronize()

    def _work(self) -> Tensor:
        self.network.train()
        batch = self.samples.batch()
        with torch.autocast(self.device.type, torch.bfloat16, enabled=self.side is not None, cache_enabled=False):
            output = self.network(*batch.inputs)
        loss = histogram_loss(output[0], output[1], batch) if self.counting else loss_of(output.float(), batch)
        self.network.zero_grad(set_to_none=True)
        loss.backward()
        nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        for optimiser in self.optimisers:
            optimiser.step()
        return loss.detach()

    def save_checkpoint(self) -> None:
        """Writes all from which the run can be resumed."""
        kept = {name: part.state_dict() for name, part in self.state.items()}
        kept.update(recipe=self.recipe.model_dump_json(), random=self.generator.get_state(), step=self.step)
        kept.update(loss_sum=float(self.loss_sum), seconds=time.monotonic() - self.began)
        kept["log"] = self.log.read_text() if self.log.is_file() else ""
        write_file(self.checkpoint, lambda file: torch.save(kept, file))

    def finish(self, psnr: dict[float, float], input_psnr: float) -> Trained:
        """Writes the weights, the running mean of the network, as float16 with metadata in the file's header."""
        from safetensors.torch import save

        recipe, seconds = self.recipe, time.monotonic() - self.began
        metadata = {"model": recipe.model, "seed": str(recipe.seed), "recipe": recipe.model_dump_json()}
        levels = {f"{level:.3f}": round(value, 2) for level, value in psnr.items()}
        metadata |= {"validation_psnr": json.dumps(levels), "hours": f"{seconds / 3600:.3f}"}
        metadata["machine"] = torch.cuda.get_device_name() if self.side is not None else "CPU"
        states = self.average.state_dict().items()
        values = {name: (one.half() if one.is_floating_point() else one).contiguous().cpu() for name, one in states}
        whole = save(values, metadata=metadata)
        weights = write_file(self.folder / f"{recipe.model}.safetensors", lambda file: file.write(whole))
        mean = fmean(psnr.values())
        return Trained(weights=weights, log=self.log, seconds=seconds, psnr=mean, input_psnr=input_psnr)


# The loop.

PHOTONS = (1.0, 3.0, 10.0, 30.0, 100.0)
"""Signal photons per pixel, a third of the background, at which networks that read histograms are validated."""

_TIMED = 5  # steps after which the duration is foretold
_VALIDATION_SEED = 2**40  # of drawn scenes, far from those of training


@contextmanager
def fixed_order() -> Iterator[None]:
    """Convolutions and products of matrices on a GPU by algorithms that give the same bits each time.

    cuDNN otherwise tries several at the first call and keeps the fastest, which differs from one process to the next.
    TF32 stays allowed in products.
    """
    os.environ.setdefault("CUBLAS_WORKSPACE_CONFIG", ":4096:8")  # read when a process first multiplies matrices
    cudnn, products = torch.backends.cudnn, torch.backends.cuda.matmul
    before = cudnn.benchmark, cudnn.deterministic, products.allow_tf32
    cudnn.benchmark, cudnn.deterministic, products.allow_tf32 = False, True, True
    try:
        yield
    finally:
        cudnn.benchmark, cudnn.deterministic, products.allow_tf32 = before


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
    """`spadwarp.denoise.train` on clean scenes, on any device; without them, scenes are drawn.

    Ctrl-C or SIGTERM end the run after the step at hand with a checkpoint and a KeyboardInterrupt that names it. Raises
    `ConfigError`, also where a crop is larger than the scenes.
    """
    place, settings = torch_device(device), recipe.optimiser
    if training is not None:
        height, width = training.depth.shape[1:]
        scale, why = (2, f" with optimiser.wide = {settings.wide}") if settings.wide else (1, "")
        most, given = min(height, width) // scale, f"scenes of {width} x {height} pixels"
        if most < LEAST_CROP:
            raise ConfigError(f"data: {given}{why}; at least {scale * LEAST_CROP} x {scale * LEAST_CROP} are needed")
        if settings.crop > most:
            raise ConfigError(f"optimiser.crop = {settings.crop}{why} is outside [{LEAST_CROP}, {most}]: {given}")
    Path(out).mkdir(parents=True, exist_ok=True)
    if validation is None:
        count = 64 if place.type == "cuda" else 8
        validation = procedural_scenes(count, settings.crop + 32, seed=_VALIDATION_SEED, device=place)
    validation = validation.to(place)
    run = Run(recipe, Path(out), place, training)
    first, spent = run.step, 0.0
    psnr: dict[float, float] = {}
    input_psnr = fmean(validation_psnr(None, validation, recipe).values())
    if run.step == 0 and not run.log.is_file():
        run.report(validation_psnr(run.average, validation, recipe), input_psnr)
    with interruptible() as interrupted:
        while run.step < settings.steps and not interrupted.is_set():
            began = time.monotonic()
            run.samples.prepare(run.step)
            run.update()
            spent += time.monotonic() - began
            if run.step % settings.interval == 0 or run.step == settings.steps:
                psnr = validation_psnr(run.average, validation, recipe)
                run.report(psnr, input_psnr)
            if notify is not None and run.step == first + _TIMED:
                notify(_duration(place.type, spent / _TIMED, settings.steps - run.step))
            if progress is not None:
                progress("steps", run.step, settings.steps)
        if run.step < settings.steps:
            run.save_checkpoint()
            text = f"interrupted at step {run.step} of {settings.steps}; the same command resumes from {run.checkpoint}"
            raise KeyboardInterrupt(f"{text}; another number of steps needs a new folder")
    return run.finish(psnr or validation_psnr(run.average, validation, recipe), input_psnr)


def _duration(device: str, seconds: float, steps: int) -> str:
    """How long the rest of a training takes; on a CPU, what to do instead."""
    left = seconds * steps
    text = f"{steps} step{'s' * (steps != 1)} to go, about {duration(max(left, 1.0))}"
    if device != "cpu" or left <= 120:
        return text
    return (
        f"{text} on this CPU; a data-centre GPU trains in minutes. The package has trained weights, which `spadwarp "
        "denoise` uses; fewer steps (optimiser.steps, in a new folder), or start from these weights (start in the "
        "recipe), take less. Ctrl-C keeps a checkpoint, from which the same command resumes"
    )


@torch.no_grad()
def validation_psnr(network: nn.Module | None, scenes: CleanScenes, recipe: TrainingRecipe) -> dict[float, float]:
    """PSNR [dB] over the gate at each of `LEVELS`, or of `PHOTONS` for a recipe of histograms.

    Mean over crops with a target; the same crops and photons every time. Without a network, of its input.
    """
    if network is not None:
        network.eval()
    device, counting, result = scenes.depth.device, recipe.model == "histograms", {}
    plain: dict[str, Any] = {"own_gate": 1.0, "own_profile": 1.0}
    plain |= dict.fromkeys(("dead", "slanted_gate", "unknown_water", "wrong"), 0.0)
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
        if network is None:
            depth = highest(log_likelihood(*batch.inputs))[:, None] if counting else batch.inputs[0][:, :1]
        else:
            output = network(*batch.inputs)
            depth = answer(output[0])[0][:, None] if counting else output[:, :1].float()
        square = (batch.hit * (depth.clamp(0, 1) - batch.clean).square()).flatten(1).sum(dim=1)
        pixels = batch.hit.flatten(1).sum(dim=1)
        valid = pixels > 100
        error = (square[valid] / pixels[valid]).clamp_min(1e-7)
        result[level] = float((-10.0 * error.log10()).mean())
    return result
