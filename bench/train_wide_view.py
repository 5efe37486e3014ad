"""Trains the wide view of the network for histograms, all its other layers frozen: how the package's weights were made.

    python bench/train_wide_view.py --out wide/ --new --mix dim --steps 3860   # a new wide view
    python bench/train_wide_view.py --out wide/ --mix bright --steps 4680      # the one of --weights, trained on

Examples are drawn in chunks, and each chunk is used several times, since the features of histograms take longer than a
step. A seed gives the same weights each time on one kind of GPU. On a CPU use --chunk 2 --steps 30 to see that it runs.
"""

from __future__ import annotations

import argparse
import copy
import math
import time
from pathlib import Path
from typing import NamedTuple

import numpy as np
import torch
import torch.nn.functional as F
from torch import Tensor, nn

from spadwarp.denoise.context import Context, answer
from spadwarp.denoise.network_files import load_network
from spadwarp.denoise.networks import build_network
from spadwarp.denoise.recipe import Noise, load_training_recipe
from spadwarp.denoise.repeatable import fixed_order
from spadwarp.denoise.synthetic_noise import CleanScenes, draw_batch, procedural_scenes
from spadwarp.denoise.training_steps import save_weights

RECIPE = Path(__file__).parents[1] / "configs/training/histograms.toml"
FEW = {
    "photons": (0.8, 6.0),
    "sbr": (0.04, 0.6),
    "ambient": 0.8,
    "resampled": 0.6,
    "scattered": 0.1,
    "two_returns": 0.15,
}
TWO = {"photons": (8.0, 200.0), "two_returns": 0.9, "resampled": 0.1, "scattered": 0.1}
HALO = {
    "photons": (20.0, 3000.0), "sbr": (1.0, 300.0), "scattered": 1.0, "halo": 1.0, "spread": (3.0, 40.0),
    "delay": (0.004, 0.15), "ambient": 0.1, "two_returns": 0.15, "resampled": 0.2,
}  # fmt: skip
BRIGHT = {
    "photons": (50.0, 3000.0), "sbr": (0.5, 300.0), "scattered": 0.4, "halo": 0.7, "resampled": 0.2, "ambient": 0.3,
}  # fmt: skip
ALL = {"resampled": 0.25, "ambient": 0.5}
MIXES = {
    "dim": [(0.42, ALL, 0.0), (0.36, FEW, 0.0), (0.22, TWO, 0.0)],
    "bright": [(0.27, ALL, 0.0), (0.25, FEW, 0.0), (0.14, TWO, 0.0), (0.26, HALO, 0.85), (0.08, BRIGHT, 0.0)],
    "crowded": [(0.24, ALL, 0.0), (0.30, FEW, 0.0), (0.12, TWO, 0.0), (0.26, HALO, 0.85), (0.08, BRIGHT, 0.0)],
}
"""Part of the chunks, changes of the recipe's noise, and how often the scenes have open water."""

CROWDED = 0.5  # with the last mix, chunks of which each scene is two, one before the other; not those of open water
RATES = {"dim": 1.5e-3, "bright": 7e-4, "crowded": 7e-4}
KEPT, STEPS = 24, 10  # chunks at hand; steps for each chunk that is drawn


class Examples(NamedTuple):
    """What the wide view sees of crops: the answer before it and its delay `[B, 1, H, W]`, logits, features; truth; and
    1 where the crop counts for the target's probability, else 0, `[B]`: crowded scenes have too little water."""

    before: Tensor
    delay: Tensor
    logits: Tensor
    features: Tensor
    clean: Tensor
    hit: Tensor
    judged: Tensor


class Recorder(nn.Module):
    """Takes the place of the wide view in the frozen network and keeps what it is given."""

    def forward(self, before: Tensor, logits: Tensor, features: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        self.seen = before, logits, features
        return before, torch.zeros_like(before), torch.zeros_like(before)


def examples(
    frozen: nn.Module, scenes: CleanScenes, noise: Noise, size: int, generator: torch.Generator, judged: bool
) -> Examples:
    batch = draw_batch(scenes, noise, size=size, crop=64, generator=generator, histograms=True)
    recorder = frozen.context
    assert isinstance(recorder, Recorder)
    found = frozen(batch.frame.contiguous(memory_format=torch.channels_last)).float()
    before, logits, features = (part.detach().float() for part in recorder.seen)
    counted = torch.full_like(batch.clean[:, 0, 0, 0], float(judged))
    return Examples(before, before - found[:, :1], logits, features.contiguous(), batch.clean, batch.hit, counted)


def loss_of(context: Context, part: Examples, done: float, *, target: bool) -> Tensor:
    """Logarithm of the mean square of each crop, cross-entropy with the nearest candidates, and that of the target."""
    with torch.autocast("cuda", torch.bfloat16, enabled=part.clean.is_cuda):
        depths, scores, more = (values.float() for values in context(part.before, part.logits, part.features))
    weight = 0.001 + 0.999 * part.hit
    square = (answer(depths, scores, part.features) - part.delay - part.clean).square()
    mean = (weight * square).flatten(1).sum(1) / weight.flatten(1).sum(1)
    away = (depths - part.delay - part.clean).abs()
    typical = torch.where(part.hit > 0, away[:, :1], torch.nan).flatten(1).nanmedian(1).values.nan_to_num(0.01)
    near = (1.5 * typical).clamp_min(5e-4)[:, None, None, None]
    share = torch.softmax((-0.5 * (away / near).square()).clamp_min(-1e4), 1)
    choice = (-(share * scores.log_softmax(1)).sum(1, keepdim=True) * part.hit).flatten(1).sum(1)
    choice = choice / part.hit.flatten(1).sum(1).clamp_min(1.0)
    counts = (part.hit.flatten(1).mean(1) > 0.005).float()  # crops with a target
    at_first = 0.02 if target else 0.06
    each = 0.1 * (mean + 1e-7).log() + (at_first * (1.0 - done) ** 2 + 0.002) * choice
    loss = (each * counts).sum() / counts.sum().clamp_min(1.0)
    if target:
        entropy = F.binary_cross_entropy_with_logits(part.logits[:, :1] + more, part.hit, reduction="none")
        loss = loss + 0.3 * (entropy.flatten(1).mean(1) * part.judged).mean()
    return loss


def drawn(chunk: int, seed: int, device: str) -> tuple[CleanScenes, CleanScenes]:
    """All scenes, and those of them with a target in open water."""
    scenes = procedural_scenes(8 * chunk, 96, seed=seed, device=device)
    share = scenes.depth.isfinite().flatten(1).float().mean(1)
    some = ((share > 0.03) & (share < 0.85)).nonzero()[:, 0]
    return scenes, CleanScenes(*(values[some] for values in scenes)) if len(some) else scenes


def crowded(scenes: CleanScenes) -> CleanScenes:
    """Each scene with the next: of both, each pixel sees the nearer surface."""
    other = CleanScenes(*(values.roll(1, 0) for values in scenes))
    before = (scenes.depth <= other.depth) | other.depth.isnan()
    depth, sigma = (torch.where(before, *pair) for pair in zip(scenes[:2], other[:2], strict=True))
    gate = torch.stack([torch.minimum(scenes.gate, other.gate)[:, 0], torch.maximum(scenes.gate, other.gate)[:, 1]], 1)
    return CleanScenes(depth, sigma, gate, scenes.profile)


@fixed_order()
def train(frozen: nn.Module, context: Context, mix: str, *, steps: int, chunk: int, seed: int) -> Context:
    """The running mean of the weights after `steps`; the learning rate falls along a cosine."""
    device = next(context.parameters()).device
    generator, host = torch.Generator(device).manual_seed(seed), np.random.default_rng(seed)
    recipe = load_training_recipe(RECIPE).noise
    parts = [part for part, _, _ in MIXES[mix]]
    new = ("light.", "target.")
    groups = [
        [one for name, one in context.named_parameters() if name.startswith(new) == late] for late in (False, True)
    ]
    optimiser = torch.optim.AdamW([{"params": group} for group in groups], weight_decay=1e-3, betas=(0.9, 0.99))
    average, pool, step, cycle, began = copy.deepcopy(context), [], 0, 0, time.perf_counter()
    while step < steps:
        if cycle % 10 == 0:
            scenes = drawn(chunk, 10_000 * seed + cycle, str(device))
        _, changes, water = MIXES[mix][host.choice(len(parts), p=parts)]
        chosen = scenes[int(host.random() < water)]
        is_crowded = mix == "crowded" and not water and host.random() < CROWDED
        chosen = crowded(chosen) if is_crowded else chosen
        with torch.no_grad():
            pool.append(examples(frozen, chosen, recipe.model_copy(update=changes), chunk, generator, not is_crowded))
        pool, cycle = pool[-KEPT:], cycle + 1
        for _ in range(min(STEPS, steps - step) if cycle >= min(8, KEPT) else 0):
            done = step / steps
            fall = min(1.0, (step + 1) / 100) * (0.01 + 0.99 * 0.5 * (1 + math.cos(math.pi * done)))
            for group, rate in zip(optimiser.param_groups, (RATES[mix], 2e-3), strict=True):
                group["lr"] = rate * fall
            some = [pool[place] for place in host.choice(len(pool), min(4, len(pool)), replace=False)]
            index = [torch.randint(chunk, (max(1, chunk // 8),), generator=generator, device=device) for _ in some]
            batch = (
                torch.cat([one[place] for one, place in zip(values, index, strict=True)])
                for values in zip(*some, strict=True)
            )
            loss = loss_of(context, Examples(*batch), done, target=mix != "dim")
            optimiser.zero_grad(set_to_none=True)
            loss.backward()
            nn.utils.clip_grad_norm_(context.parameters(), 1.0)
            optimiser.step()
            with torch.no_grad():
                for kept, one in zip(average.parameters(), context.parameters(), strict=True):
                    kept.lerp_(one, 1.0 - min(0.998, (step + 1) / (step + 10)))
            step += 1
        if cycle % 20 == 0:
            print(f"{step} of {steps} steps, {time.perf_counter() - began:.0f} s, loss {loss.item():.3f}", flush=True)
    return average


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--out", type=Path, required=True, help="folder of the weights")
    parser.add_argument("--weights", type=Path, help="to start from; default: the package's")
    parser.add_argument("--new", action="store_true", help="begin with a new wide view")
    parser.add_argument("--mix", choices=MIXES, default="bright", help="light of the examples")
    parser.add_argument("--steps", type=int, default=4000)
    parser.add_argument("--chunk", type=int, default=128, help="crops drawn at once")
    parser.add_argument("--seed", type=int, default=1)
    given = parser.parse_args()
    device = "cuda" if torch.cuda.is_available() else "cpu"
    torch.manual_seed(given.seed)
    whole = build_network("histograms")
    before = load_network("histograms", given.weights, "cpu").state_dict()
    kept = {name: value for name, value in before.items() if not (given.new and name.startswith("context."))}
    whole.load_state_dict({**whole.state_dict(), **kept})
    frozen = copy.deepcopy(whole).to(device).to(memory_format=torch.channels_last).requires_grad_(False).eval()
    context, frozen.context = frozen.context, Recorder()
    assert isinstance(context, Context)
    context.requires_grad_(True)
    found = train(frozen, context, given.mix, steps=given.steps, chunk=given.chunk, seed=given.seed)
    whole.context.load_state_dict(found.state_dict())
    given.out.mkdir(parents=True, exist_ok=True)
    print(save_weights(whole, given.out / "histograms.safetensors", {"model": "histograms", "recipe": "{}"}))


if __name__ == "__main__":
    main()
