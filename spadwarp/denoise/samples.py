"""The samples of a training: where its clean scenes come from, and which noisy crops each step learns from."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from spadwarp.denoise.recipe import Part, TrainingRecipe
from spadwarp.denoise.synthetic_noise import (
    COUNT_BINS,
    SUBPIXELS,
    Batch,
    CleanScenes,
    draw_batch,
    procedural_scenes,
)

_WATER = (0.03, 0.5)  # part of a scene that is target, where it counts as a target in open water


class Samples:
    """Batches of `size` crops, drawn anew in each step; those of histograms of one part of the mixture, and its bins.

    They are cut from scenes `given`, of a dataset, or from new ones, which do not depend on the steps before. `prepare`
    is called before each step; `batch` may then be recorded in a CUDA graph, for steps of the same `kind`.
    """

    def __init__(
        self, recipe: TrainingRecipe, given: CleanScenes | None, crop: int, size: int, generator: torch.Generator
    ) -> None:
        self.recipe, self.crop, self.size, self.generator = recipe, crop, size, generator
        self.histograms = recipe.model == "histograms"
        self.given = None if given is None else given.to(generator.device)
        self.finer = SUBPIXELS if given is None and self.histograms else 1
        self.drawn: tuple[int, CleanScenes] | None = None
        self.parts = recipe.parts()
        self.part, self.bins = self.parts[0], COUNT_BINS[0]
        self.now: CleanScenes | None = None
        self.held: CleanScenes | None = None

    def _scenes(self, step: int) -> CleanScenes:
        if self.given is not None:
            return self.given
        settings = self.recipe.optimiser
        turn = step // settings.redraw
        if self.drawn is None or self.drawn[0] != turn:
            seed = (self.recipe.seed * 1_000_003 + turn) * 4096 % 2**62
            side, place = self.crop + 32, self.generator.device
            scenes = procedural_scenes(settings.scenes, side, seed=seed, device=place, finer=self.finer)
            self.drawn = turn, scenes
        return self.drawn[1]

    def prepare(self, step: int) -> None:
        now = self._scenes(step)
        if self.histograms:
            host = np.random.default_rng((self.recipe.seed, 0, step))
            self.part = self.parts[host.choice(len(self.parts), p=[part.share for part in self.parts])]
            often = 1.0 / np.array(COUNT_BINS)  # many bins take as much more time
            self.bins = int(host.choice(COUNT_BINS, p=often / often.sum()))
            if host.random() < self.part.open_water:
                now = in_open_water(now)
            if host.random() < self.part.crowded:
                now = crowded(now)
        if self.held is not None and now is not self.now:
            for kept, new in zip(self.held, now, strict=True):
                kept.copy_(new)
        self.now = now

    @property
    def kind(self) -> tuple[int, Part, int]:
        """What the operations of a step depend on."""
        return self.crop, self.part, self.bins

    def hold(self) -> None:
        """From now on `batch` reads the same memory in every step."""
        assert self.now is not None
        self.held = self.held or CleanScenes(*(values.clone() for values in self.now))

    def batch(self) -> Batch:
        scenes = self.held or self.now
        assert scenes is not None
        return draw_batch(
            scenes, self.part, size=self.size, crop=self.crop, generator=self.generator,
            histograms=self.histograms, bins=self.bins, finer=self.finer,
        )  # fmt: skip


class Sizes:
    """The samples of a training by the size of their crops: each step takes a batch of one size.

    In `optimiser.wide` of the steps, drawn at random, it is a quarter as many crops of twice the recipe's side: with
    small crops alone, the network would never see a pixel far from the border of its image.
    """

    def __init__(self, recipe: TrainingRecipe, generator: torch.Generator, given: CleanScenes | None) -> None:
        settings = recipe.optimiser
        self.recipe, self.kinds = recipe, list[Samples]()
        for turns, scale in ((1.0 - settings.wide, 1), (settings.wide, 2)):
            if turns > 0.0:
                size = max(1, settings.batch // scale**2)
                self.kinds.append(Samples(recipe, given, scale * settings.crop, size, generator))

    def of(self, step: int) -> Samples:
        """Those of which the step takes a batch."""
        if len(self.kinds) == 1:
            return self.kinds[0]
        return self.kinds[int(np.random.default_rng((self.recipe.seed, step)).random() < self.recipe.optimiser.wide)]


def in_open_water(scenes: CleanScenes) -> CleanScenes:
    """As many, of those that have a target in open water; all if none has."""
    share = scenes.depth.isfinite().flatten(1).float().mean(1)
    some = ((share > _WATER[0]) & (share < _WATER[1])).nonzero()[:, 0]
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
