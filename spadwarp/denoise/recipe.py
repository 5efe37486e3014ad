"""Training recipes: TOML in, frozen and validated out."""

from __future__ import annotations

import os
from collections.abc import Mapping, Sequence
from typing import Annotated, Any, Literal, Self

import pydantic
from pydantic import AfterValidator, Field

from spadwarp.io.paths import example_or_path
from spadwarp.io.text import read_toml
from spadwarp.scene.sections import Document, Section, Whole, field

__all__ = ["TrainingRecipe", "load_training_recipe"]

LEAST_CROP = 32
"""Side of the smallest crop that a network learns from [pixels]."""

LEVELS = (0.042, 0.183, 0.264, 0.337, 0.394, 0.480)
"""The paper's backscatter fractions, at which denoisers are compared and validated."""


def _ordered(limits: tuple[float, float]) -> tuple[float, float]:
    if not limits[0] <= limits[1]:
        raise ValueError("is not (lowest, highest)")
    return limits


Share = Annotated[float, Field(ge=0, le=1)]
Above0 = Annotated[float, Field(ge=1e-9, le=1e9)]
Positive = Annotated[tuple[Above0, Above0], AfterValidator(_ordered)]
Shares = Annotated[tuple[Share, Share], AfterValidator(_ordered)]


class Noise(Section):
    """The noise of a training: `[lowest, highest]`, or a part of the samples."""

    backscatter: Shares = field((0.0, 0.6), "part of the pixels that report backscatter; low ones are drawn more often")
    sigma_scale: Positive = field((0.3, 8.0), "factor on a scene's Cramér–Rao bound, uniform in the logarithm")
    decay: Positive = (0.3, 40.0)
    """rate at which backscatter falls over the gate [1/gate], uniform in the logarithm"""
    own_gate: Share = field(0.5, "samples with the scene's own gate; the others have one of gate_width")
    own_profile: Share = field(0.7, "of these, samples with the scene's own backscatter profile")
    gate_width: Positive = field((1.0, 8.0), "width of other gates [m], uniform in the logarithm")
    cut: Share = field(0.0, "samples whose gate ends within the scene: what is behind has no depth")
    wide_gate: Share = field(0.5, "samples whose camera's gate is wider than what the network is given")
    behind: Share = field(0.55, "samples with backscatter from behind the target too: multiple scattering")
    slanted_gate: Share = field(0.5, "samples whose gate opens up to 15 % of its width nearer in depth")
    counting: Share = field(0.2, "samples whose depth was estimated from histograms of few photons")
    photons: Positive = field((0.7, 150.0), "of these, signal counts per pixel, uniform in the logarithm")
    sbr: Positive = field((0.03, 8.0), "of these, signal over background counts, uniform in the logarithm")
    scattered: Share = field(0.0, "of these, samples with forward-scattered light, delayed and spread")
    delay: Positive = (0.004, 0.12)
    """its mean delay [gate widths], uniform in the logarithm; on the way back less"""
    spread: Positive = field((0.5, 20.0), "its spread over the image [pixels], uniform in the logarithm")
    halo: Share = field(0.0, "of these, samples with an optical depth of 0.01 to 3, mostly a halo")
    events: Positive = (1e6, 1e6)
    """of that light in a pixel, uniform in the logarithm: few in Monte Carlo histograms"""
    ambient: Share = field(0.0, "of these, samples with ambient light, which follows the reflectance")
    two_returns: Share = field(0.4, "of these, samples in which pixels see a weaker second surface")
    wrong: Share = field(0.0, "of these, samples with a background, and with a response, that are not known well")
    halves: Share = field(0.0, "of these, samples of a camera with wider bins, each given as two halves")
    resampled: Share = 0.0
    """samples whose depth is the mean over each pixel: at edges it lies between both surfaces"""
    sparse: Share = field(0.25, "samples in which only 3 to 100 % of the pixels report anything")
    tail: Share = field(0.15, "samples whose jitter has a late tail, as avalanche photodiodes have")
    hot: Share = field(0.01, "highest part of the pixels that report any depth because they are defective")
    dead: Share = field(0.1, "highest part of the pixels that report nothing because they are defective")
    unknown_water: Share = field(0.2, "samples whose backscatter profile is hidden from the network")


class Part(Noise):
    """A part of the samples with noise of its own: these fields and those of `[noise]`, by default as there."""

    share: float = Field(..., gt=0, le=1, description="part of the samples; all shares together are 1")
    crowded: Share = field(0.0, "of these, samples whose scene is two scenes, one before the other")
    open_water: Share = field(0.0, "of these, samples with a target in open water for certain")


def _given(table: Any) -> Any:
    """Of noise or a part from Python, the fields that were given; anything else as it is."""
    return {name: getattr(table, name) for name in table.model_fields_set} if isinstance(table, Noise) else table


class Optimiser(Section):
    """How the network is trained."""

    steps: Whole = Field(40_000, ge=1, le=10**12, description="updates of the weights")
    batch: Whole = Field(64, ge=1, le=10**6, description="crops per update")
    crop: Whole = Field(96, ge=LEAST_CROP, le=16384, description="side of a crop [pixels]")
    wide: Share = field(0.0, "part of the updates with a quarter as many crops of twice the side")
    scenes: Whole = Field(512, ge=1, le=10**6, description="scenes that are drawn at a time; without a dataset")
    redraw: Whole = Field(200, ge=1, le=10**12, description="updates between two drawings of scenes")
    learning_rate: float = Field(1e-3, ge=1e-12, le=1e3, description="highest; falls along a cosine to a hundredth")
    warm_up: Whole = Field(500, ge=0, le=10**12, description="updates in which the learning rate rises")
    weight_decay: float = Field(0.1, ge=0, le=1e3, description="that of the optimisers, Muon and AdamW")
    averaging: float = Field(0.999, ge=0, lt=1, description="decay of the running mean of the weights, which is saved")
    report_every: Whole | None = Field(
        None, ge=1, le=10**12, description="updates between two lines of the log; default: steps / 20, at most 500"
    )

    @property
    def interval(self) -> int:
        """Updates between two lines of the log and two checkpoints."""
        return self.report_every or min(500, -(-self.steps // 20))


class TrainingRecipe(Document):
    """Everything a training depends on, checked and frozen."""

    model: Literal["pyramid", "histograms", "dncnn", "usdn"] = field(..., "network")
    start: Literal["pyramid", "histograms"] | None = None
    """the same name as model: the training starts from the weights of the package"""
    data: Annotated[str, Field(min_length=1)] | None = field(
        None, "dataset (folder), relative to the working directory; without it, scenes are drawn"
    )
    seed: Whole = Field(0, ge=0, le=2**63 - 1, description="of weights, crops and noise")
    noise: Noise = Noise()
    mixture: tuple[Part, ...] = field((), "parts of the samples of histograms with other noise")
    optimiser: Optimiser = Optimiser()

    @pydantic.model_validator(mode="before")
    @classmethod
    def _with_common_noise(cls, tables: Any) -> Any:
        if not isinstance(tables, Mapping):
            return tables
        noise, mixture = _given(tables.get("noise", {})), tables.get("mixture")
        if not isinstance(noise, Mapping) or not isinstance(mixture, list | tuple):
            return tables
        parts = tuple({**noise, **part} if isinstance(part, Mapping) else part for part in map(_given, mixture))
        return {**tables, "mixture": parts}

    @pydantic.model_validator(mode="after")
    def _is_consistent(self) -> Self:
        reads_histograms = self.model == "histograms"
        for noise in (self.noise, *self.mixture):
            if reads_histograms and noise.counting != 1:
                raise ValueError(f'noise.counting = {noise.counting} with model = "histograms", which needs 1')
        if self.mixture and not reads_histograms:
            raise ValueError(f"mixture with model = {self.model!r}, which has none")
        total = sum(part.share for part in self.mixture)
        if self.mixture and abs(total - 1.0) > 1e-6:
            raise ValueError(f"mixture: the shares add up to {total:g}, not to 1")
        if self.start is not None and self.start != self.model:
            raise ValueError(f"start = {self.start!r}: its layers are not those of {self.model!r}")
        return self

    def parts(self) -> tuple[Part, ...]:
        """The mixture; without one, all samples have the recipe's noise."""
        return self.mixture or (Part(share=1.0, **self.noise.model_dump()),)


def load_training_recipe(path: str | os.PathLike[str], overrides: Sequence[str] = ()) -> TrainingRecipe:
    """Reads a recipe, or by a bare name one of the package's; `overrides` are texts such as "optimiser.steps=2000".

    Raises `FileError` if it cannot be read, `ConfigError` with a line for each problem in it.
    """
    path = example_or_path(path, "training")
    return TrainingRecipe.from_dict(read_toml(path), overrides=overrides, source=path)
