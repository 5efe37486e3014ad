"""The samples of a training: where its clean scenes come from, and which noisy crops each step learns from."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, nullcontext
from typing import Any

import numpy as np
import torch
from torch import Tensor

from spadwarp.denoise.histogram_features import FEATURES
from spadwarp.denoise.recipe import TrainingRecipe
from spadwarp.denoise.synthetic_noise import COUNT_BINS, Batch, CleanScenes, draw_batch, procedural_scenes
from spadwarp.device import physical_memory
from spadwarp.values import DeviceError

PORTIONS = 24
"""Portions of which a pool consists; each is drawn at once."""

_FIRST = 8  # portions that are drawn before the first step
_PIECE = 8  # samples that are drawn at once on a CPU, which takes half a second each
_WATER = (0.03, 0.85)  # part of a scene that is target, where it counts as a target in open water


class Scenes:
    """The clean scenes of each step: those `given`, of a dataset, or new ones that each process draws for itself.

    `crop`: side of the crops that are cut from them [pixels]; default: the recipe's.
    """

    def __init__(
        self,
        recipe: TrainingRecipe,
        rank: int,
        device: torch.device,
        given: CleanScenes | None,
        crop: int | None = None,
    ) -> None:
        self.recipe, self.rank, self.device = recipe, rank, device
        self.crop = recipe.optimiser.crop if crop is None else crop
        self.given = None if given is None else given.to(device)
        self.drawn: tuple[int, CleanScenes] | None = None

    def at(self, step: int) -> CleanScenes:
        """Scenes for a step, which do not depend on the steps before it."""
        if self.given is not None:
            return self.given
        settings = self.recipe.optimiser
        turn = step // settings.redraw
        if self.drawn is None or self.drawn[0] != turn:
            seed = (self.recipe.seed * 1_000_003 + turn) * 4096 + self.rank
            scenes = procedural_scenes(settings.scenes, self.crop + 32, seed=seed % 2**62, device=self.device)
            self.drawn = turn, scenes
        return self.drawn[1]


class Fresh:
    """Samples that are drawn anew in each step.

    `batch` is recorded in a CUDA graph; `prepare` is gone through before each step, and `seconds` is the time that it
    takes, on average over the steps.
    """

    def __init__(
        self, recipe: TrainingRecipe, scenes: Scenes, size: int, generator: torch.Generator, *, histograms: bool
    ) -> None:
        self.recipe, self.scenes, self.size = recipe, scenes, size
        self.generator, self.histograms = generator, histograms
        self.now: CleanScenes | None = None
        self.held: CleanScenes | None = None
        self.seconds = 0.0  # scenes are few, and drawn rarely

    def due(self, step: int) -> int:
        """Samples that are still to be drawn before the step."""
        return 0

    def prepare(self, step: int) -> Iterator[tuple[int, int]]:
        """Draws what the step needs, piece by piece, and yields how many samples of how many are drawn.

        What was drawn of an unfinished one is drawn again by the next.
        """
        now = self.scenes.at(step)
        if self.held is not None and now is not self.now:
            for kept, new in zip(self.held, now, strict=True):
                kept.copy_(new)
        self.now = now
        yield from ()

    def hold(self) -> None:
        """From now on `batch` reads the same memory in every step."""
        assert self.now is not None
        self.held = CleanScenes(*(values.clone() for values in self.now))

    def batch(self) -> Batch:
        scenes = self.held or self.now
        assert scenes is not None
        return draw_batch(
            scenes, self.recipe.noise, size=self.size, crop=self.scenes.crop, generator=self.generator,
            histograms=self.histograms,
        )  # fmt: skip


class Pool:
    """Samples that wait in memory, each for several steps: features of histograms take longer to compute than a step.

    The pool has `PORTIONS` of equal size; the oldest one is replaced every so many steps, so that a sample is used
    `optimiser.uses` times on average. All samples of a portion have the noise of one part of the recipe's mixture. A
    portion depends on its number and on the seed alone: a resumed run draws those again that it had. On a GPU portions
    are drawn in a stream of their own: thousands of short launches, which need not wait for the steps before them.

    `generator` chooses the samples of each batch, of `size`; `share`: part of the recipe's number of samples that this
    pool has; `turns`: part of the steps that take a batch of it. Its methods are those of `Fresh`.
    """

    def __init__(
        self, recipe: TrainingRecipe, scenes: Scenes, size: int, generator: torch.Generator, *, share: float = 1.0,
        turns: float = 1.0,
    ) -> None:  # fmt: skip
        settings = recipe.optimiser
        self.recipe, self.scenes, self.size, self.generator = recipe, scenes, size, generator
        self.portion = max(1, round(share * settings.pool / PORTIONS))
        self.interval = max(1, round(settings.uses * self.portion / size / turns))
        self.piece = self.portion if generator.device.type == "cuda" else min(_PIECE, self.portion)
        self.parts = recipe.parts()
        self.drawn, self.seconds = 0, 0.0
        self.filled = torch.zeros((), device=generator.device)
        self.memory: Batch | None = None
        self.stream: Any = None
        if generator.device.type == "cuda":
            self.stream = torch.cuda.Stream(generator.device)
            self.stream.wait_stream(torch.cuda.current_stream(generator.device))

    def due(self, step: int) -> int:
        return len(self._numbers(step)) * self.portion

    def prepare(self, step: int) -> Iterator[tuple[int, int]]:
        numbers, total = self._numbers(step), self.due(step)
        for place, number in enumerate(numbers):
            began = time.monotonic()
            for drawn in self._draw(number):
                yield place * self.portion + drawn, total
            self.seconds = (time.monotonic() - began) / self.interval
        self.drawn = numbers.stop

    def _numbers(self, step: int) -> range:
        """Of the portions that the step still needs."""
        stop = _FIRST + step // self.interval
        return range(max(self.drawn, stop - PORTIONS), stop)

    def hold(self) -> None:
        """Does nothing: the memory is the same from the start."""

    def batch(self) -> Batch:
        chosen = torch.rand(self.size, generator=self.generator, device=self.generator.device)
        index = (chosen * self.filled).long().clamp_max(PORTIONS * self.portion - 1)
        assert self.memory is not None
        return Batch(*(values.index_select(0, index) for values in self.memory))

    @torch.no_grad()
    def _draw(self, number: int) -> Iterator[int]:
        wide = (self.scenes.crop,) if self.scenes.crop != self.recipe.optimiser.crop else ()
        host = np.random.default_rng((self.recipe.seed, self.scenes.rank, number, *wide))
        part = self.parts[host.choice(len(self.parts), p=[part.share for part in self.parts])]
        generator = torch.Generator(self.generator.device).manual_seed(int(host.integers(2**62)))
        is_crowded, bins = host.random() < part.crowded, int(host.choice(COUNT_BINS))
        with self._apart():
            scenes = self.scenes.at(max(0, number - _FIRST) * self.interval)
            if host.random() < part.open_water:
                scenes = in_open_water(scenes)
            if is_crowded:
                scenes = crowded(scenes)
        first = number % PORTIONS * self.portion
        for done in range(0, self.portion, self.piece):
            with self._apart():
                new = draw_batch(
                    scenes, part, size=min(self.piece, self.portion - done), crop=self.scenes.crop,
                    generator=generator, histograms=True, bins=bins,
                )  # fmt: skip
                if is_crowded:
                    new = new._replace(judged=torch.zeros_like(new.judged))
            self._keep(new, first + done)
            yield done + len(new.frame)
        self.filled.fill_(min(number + 1, PORTIONS) * self.portion)

    def _apart(self) -> AbstractContextManager[Any]:
        """The stream in which samples are drawn. On a CPU none: `torch.cuda.stream(None)`, too, takes up a GPU."""
        return nullcontext() if self.stream is None else torch.cuda.stream(self.stream)

    def _keep(self, new: Batch, first: int) -> None:
        """Copies samples to the pool's memory, after the steps that still read it."""
        if self.stream is not None:
            here = torch.cuda.current_stream(self.generator.device)
            here.wait_stream(self.stream)
            for values in new:  # whose memory the next drawing may have only when they have been copied
                values.record_stream(here)
        if self.memory is None:
            size = PORTIONS * self.portion
            self.memory = Batch(*(values.new_empty(size, *values.shape[1:]) for values in new))
        for kept, values in zip(self.memory, new, strict=True):
            kept[first : first + len(values)] = values


Samples = Fresh | Pool


class Sizes:
    """The samples of a training by the size of their crops: each step takes a batch of one size.

    In `optimiser.wide` of the steps, drawn at random, it is a quarter as many crops of twice the recipe's side: with
    small crops alone, the network would never see a pixel far from the border of its image. Raises `DeviceError` where
    a pool is larger than the memory of the device.
    """

    def __init__(
        self, recipe: TrainingRecipe, rank: int, processes: int, generator: torch.Generator,
        given: CleanScenes | None, *, histograms: bool,
    ) -> None:  # fmt: skip
        settings = recipe.optimiser
        self.recipe, self.kinds = recipe, list[Samples]()
        if settings.pool:
            _check_memory(recipe, generator.device, processes)
        for turns, scale in ((1.0 - settings.wide, 1), (settings.wide, 2)):
            if turns > 0.0:
                scenes = Scenes(recipe, rank, generator.device, given, scale * settings.crop)
                size = max(1, settings.batch // processes // scale**2)
                share = turns / scale**2 / processes
                self.kinds.append(
                    Pool(recipe, scenes, size, generator, share=share, turns=turns)
                    if settings.pool
                    else Fresh(recipe, scenes, size, generator, histograms=histograms)
                )

    def prepare(self, step: int) -> Iterator[tuple[int, int]]:
        """See `Fresh`; of all sizes, a crop of twice the side counted as four."""
        due = [(kind.scenes.crop // self.recipe.optimiser.crop) ** 2 * kind.due(step) for kind in self.kinds]
        for place, kind in enumerate(self.kinds):
            for drawn, all_drawn in kind.prepare(step):
                yield sum(due[:place]) + due[place] * drawn // all_drawn, sum(due)

    @property
    def seconds(self) -> float:
        """See `Fresh`; of all sizes together."""
        return sum(kind.seconds for kind in self.kinds)

    def of(self, step: int) -> Samples:
        """Those of which the step takes a batch; the same in every process."""
        if len(self.kinds) == 1:
            return self.kinds[0]
        return self.kinds[int(np.random.default_rng((self.recipe.seed, step)).random() < self.recipe.optimiser.wide)]


def _check_memory(recipe: TrainingRecipe, device: torch.device, processes: int) -> None:
    settings = recipe.optimiser
    needed = 4 * settings.pool / processes * settings.crop**2 * (3 + FEATURES + 2)
    available = torch.cuda.mem_get_info(device)[0] if device.type == "cuda" else physical_memory()
    if available is not None and needed > available:
        raise DeviceError(
            f"optimiser.pool = {settings.pool} with optimiser.crop = {settings.crop} needs {needed / 2**30:.1f} "
            f"GiB on {device}; {available / 2**30:.1f} GiB are available"
        )


def in_open_water(scenes: CleanScenes) -> CleanScenes:
    """Those of the scenes that have a target in open water; all if none has."""
    share = scenes.depth.isfinite().flatten(1).float().mean(1)
    some = ((share > _WATER[0]) & (share < _WATER[1])).nonzero()[:, 0]
    return CleanScenes(*(values[some] for values in scenes)) if len(some) else scenes


def crowded(scenes: CleanScenes) -> CleanScenes:
    """Each scene with the next one: of both, each pixel sees the nearer surface."""
    other = CleanScenes(*(values.roll(1, 0) for values in scenes))
    before: Tensor = (scenes.depth <= other.depth) | other.depth.isnan()
    depth, sigma = (torch.where(before, *pair) for pair in zip(scenes[:2], other[:2], strict=True))
    gate = torch.stack([torch.minimum(scenes.gate, other.gate)[:, 0], torch.maximum(scenes.gate, other.gate)[:, 1]], 1)
    return CleanScenes(depth, sigma, gate, scenes.profile)
