"""Recipes: what a dataset is drawn from. TOML in, frozen and validated models out.

A recipe holds a scene, given as in a scene file, and distributions of what changes from scene to scene. A distribution
is a number (a constant), a list (each value equally likely), or a table `{low = , high = }` (uniform; with `log = true`
uniform in the logarithm).
"""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Mapping
from typing import Annotated, Any, ClassVar, Literal

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field

from spadwarp.frames import Method
from spadwarp.io.paths import example_or_path
from spadwarp.io.text import read_toml
from spadwarp.result import Channel
from spadwarp.scene import Scene
from spadwarp.scene.sections import Document, FilePath, Section, Whole, field
from spadwarp.values import ArgumentError, ConfigError, check_real, shown

__all__ = ["SPLITS", "Distribution", "Recipe", "load_recipe"]

Names = tuple[str, ...]
Paths = Annotated[Names, FilePath()]


class Distribution(Section):
    """One of `choices`, equally likely, or uniform between `low` and `high`."""

    numeric: ClassVar[bool] = True
    choices: tuple[Any, ...] = ()
    low: float | None = field(None, "lowest value", "[-1e19, 1e19]")
    high: float | None = field(None, "highest value", "[-1e19, 1e19]")
    log: bool = field(False, "whether uniform in the logarithm")

    def _problems(self) -> Iterator[str]:
        if bool(self.choices) == (self.low is not None and self.high is not None):
            yield "needs a number, a list of choices, or low and high"
        if self.low is not None and self.high is not None:
            if not self.low <= self.high:
                yield f"low = {self.low} is outside (-inf, {self.high}], {self.high} being high"
            if self.log and not self.low > 0:
                yield f"low = {self.low} is outside (0, inf), the range of a logarithm"
            if not math.isfinite(self.high / self.low if self.log else self.high - self.low):
                yield f"low = {self.low} and high = {self.high} are too far apart"
        if not all(map(_is_finite, self.choices)):
            yield f"holds {shown(self.choices)}, not all of which are finite"

    @classmethod
    def merged(cls, base: Mapping[str, Any], layer: Mapping[str, Any], *, at: str = "") -> dict[str, Any]:
        """A distribution replaces an earlier one as a whole."""
        return dict(layer)

    @property
    def limits(self) -> tuple[float, float]:
        """Lowest and highest value that can be drawn."""
        if self.choices:
            return min(self.choices), max(self.choices)
        assert self.low is not None and self.high is not None
        return self.low, self.high

    def draw(self, generator: np.random.Generator) -> Any:
        """One value."""
        if self.choices:
            return self.choices[int(generator.integers(len(self.choices)))]
        low, high = self.limits
        u = float(generator.random())
        return low * (high / low) ** u if self.log else low + (high - low) * u

    def to_dict(self) -> Any:
        """As TOML has it: a number, a list or a table."""
        if self.choices:
            single = len(self.choices) == 1 and not isinstance(self.choices[0], (list, tuple))
            return self.choices[0] if single else list(self.choices)
        return {"low": self.low, "high": self.high, **({"log": True} if self.log else {})}


def _is_finite(value: Any, depth: int = 0) -> bool:
    """Whether a choice, a number or a list of them, is free of NaN and infinity; words are."""
    if isinstance(value, list | tuple):
        return depth < 9 and all(_is_finite(item, depth + 1) for item in value)
    return not isinstance(value, float) or math.isfinite(value)


def distribution(value: Any) -> Any:
    """A number or a list as the table of a distribution."""
    if isinstance(value, (Mapping, Distribution)):
        return value
    return {"choices": list(value) if isinstance(value, (list, tuple)) else [value]}


def within(interval: str) -> AfterValidator:
    """A distribution of numbers in a range."""

    def check(value: Distribution) -> Distribution:
        values = value.choices or value.limits
        for number in values:
            try:
                check_real("value", number, interval)
            except ArgumentError:
                problem = f"is no number in {interval}"
                raise ValueError(problem if len(values) == 1 else f"holds {shown(number)}, which {problem}") from None
        return value

    return AfterValidator(check)


Positive = Annotated[Distribution, BeforeValidator(distribution), within("[1e-9, 1e9]")]
NotNegative = Annotated[Distribution, BeforeValidator(distribution), within("[0, 1e9]")]
PulseCount = Annotated[Distribution, BeforeValidator(distribution), within("[0.5, 9e18]")]
Share = Annotated[Distribution, BeforeValidator(distribution), within("[0, 1]")]
Angle = Annotated[Distribution, BeforeValidator(distribution), within("[-360, 360]")]
Real = Annotated[Distribution, BeforeValidator(distribution), within("[-1e9, 1e9]")]


def constant(value: float) -> Distribution:
    """The distribution of one value."""
    return Distribution(choices=(value,))


Shape = Literal["cloud", "plume", "sediment"]

UNIFORM = Distribution(low=0.0, high=1.0)


class Plume(Section):
    """Suspended matter between camera and target in part of the scenes."""

    probability: float = field(0.0, "part of the scenes that have one", "[0, 1]")
    shape: Annotated[tuple[Shape, ...], Field(min_length=1)] = ("cloud", "plume", "sediment")
    """shapes of medium.grid, equally likely"""
    optical_depth: Positive = field(constant(1.0), "that it adds on the optical axis, one way")
    place: Share = field(Distribution(low=0.3, high=0.8), "of its middle, as part of the target's distance")
    shift: Real = field(constant(0.0), "sideways, drawn for x and for y [m]")
    size: Positive = field(constant(1.0), "edge of its box [m]")
    albedo: Share = field(constant(0.8), "single-scattering albedo of its matter")
    turbulence: NotNegative = field(constant(0.5), "deviation of the logarithm of its density, up to 3")
    cells: Whole = field(32, "cells along the edges of its box", "[1, 256]")


_EXTINCTION = ("medium.preset", "medium.extinction", "medium.absorption", "medium.scattering")
_MOST_TRIED = 1000  # values of a field that varies

SPLITS = ("train", "validation", "test")


class Targets(Section):
    """The targets, and which of them are for validation and test; all others are for training."""

    builtin: Names | Literal["all"] = "all"
    """names from `spadwarp list targets`; "all" objects, or none if meshes or exports are given"""
    meshes: Paths = field((), "mesh files, or folders of them, relative to the recipe")
    mesh_size: float | None = field(None, "longest side that meshes are scaled to, if at all [m]", "[1e-6, 1e6]")
    mesh_scale: float = field(1.0, "metres per unit of the mesh files; 0.001 for mm", "[1e-9, 1e9]")
    orientation: Literal["camera", "y_up", "z_up"] = "camera"
    """axes of the mesh files: "camera" (+x right, +y down, +z away), "y_up" (glTF, +z to the viewer), "z_up" (CAD, ROS;
    -y to the viewer)"""
    exports: Paths = field((), "*_RGBD.EXR of a game engine, or folders of them, rendered with the camera")
    export_preset: Literal["unreal", "blender"] = field("unreal", "program that wrote the exports")
    validation: Names = field((), "targets of the validation split")
    test: Names = field((), "targets of the test split")


class Pose(Section):
    """Position, rotation, size and reflectance of a target."""

    distance: Positive = field(constant(15.0), "of the target's centre, along the optical axis [m]")
    shift: Real = field(constant(0.0), "sideways, drawn for x and for y [m]")
    yaw_deg: Angle = field(constant(0.0), "rotation about the vertical axis [°]")
    pitch_deg: Angle = field(constant(0.0), "rotation about the horizontal axis across the view [°]")
    roll_deg: Angle = field(constant(0.0), "rotation about the optical axis [°]")
    size: Positive = field(constant(1.0), "scale of the target")
    fill: Positive | None = field(None, "part of the view that it fills without rotation; replaces size")
    reflectance: Share = field(constant(0.5), "Lambertian reflectance of the target")


class Backdrop(Section):
    """A wall behind the target."""

    probability: float = field(0.0, "part of the scenes that have one", "[0, 1]")
    behind: NotNegative = field(constant(0.5), "distance of the wall behind the target's centre [m]")
    tilt_deg: Angle = field(constant(0.0), "its yaw and pitch, each drawn [°]")
    reflectance: Share = field(constant(0.3), "Lambertian reflectance of the wall")


class Water(Section):
    """Turbidity of the water; other values are those of the scene."""

    attenuation_lengths: Positive | None = field(None, "extinction times distance, one way")


class Window(Section):
    """The gate, as ranges."""

    before: Positive = field(constant(1.5), "from where it opens to the target's centre [m]")
    behind: Positive = field(constant(1.0), "from the target's centre to where it closes [m]")
    bins: Whole = field(1024, "time bins in it", "[1, 1000000]")


class Exposure(Section):
    """Exposure of a frame: its pulses, or the photons that the median pixel records from the target."""

    signal_photons: Positive | None = field(None, "recorded from the target by the median pixel of it")
    pulses_per_depth_frame: PulseCount | None = field(None, "of a frame; the scene's if neither is given")

    def _problems(self) -> Iterator[str]:
        if self.signal_photons is not None and self.pulses_per_depth_frame is not None:
            yield "needs either signal_photons or pulses_per_depth_frame"


class Frames(Section):
    """The depth frames of a scene."""

    per_scene: Whole = field(20, "frames of each scene", "[1, 1000000]")
    backscatter_fraction: Literal["rates"] | Share = constant(0.183)
    """part of the pixels that report backscatter; "rates": the photon rates decide"""
    compression: Literal["none", "gzip"] = field("none", 'of the frames; "none" reads fastest')


class MonteCarlo(Section):
    """Scenes that are traced photon by photon; their depth frames come from the counts of the camera."""

    share: float = field(0.0, "part of the scenes that are traced; the others are analytic", "[0, 1]")
    photons: Annotated[Whole, Field(ge=1, le=10**12)] | Literal["auto"] = 100_000_000
    """photons of a scene; "auto": until their noise is small beside that of a frame, or `time` is over; a number gives
    the same bits again"""
    time: float = field(60.0, 'seconds of a scene at most with "auto" [s]', "(0, 1e9]")
    reconstruct: bool | None = None
    """whether frames come from the reconstructed light (`spadwarp.reconstruct`); by default with "auto" and channel "I"
    """
    depth_method: Method = field("matched", "how depth is found in counts")
    counts: Literal["none", "sparse", "dense", "smaller"] = field("smaller", "how the counts of frames are stored")
    channel: Channel = field("I", "light that counts: all, or what an analyser passes at or across its angle")

    def _problems(self) -> Iterator[str]:
        if self.model_fields_set and "share" not in self.model_fields_set:
            yield "share is missing: 1 traces all scenes, 0.5 half of them; without it none is traced"
        if self.channel != "I" and self.share < 1.0:
            yield f"channel = {self.channel!r} needs share = 1: the analytic simulator has no polarisation"
        if self.reconstruct and self.channel != "I":
            yield f"reconstruct = true cannot be combined with channel = {self.channel!r}: it is of all light"


class Recipe(Document):
    """Everything a dataset depends on, checked and frozen."""

    name: str = Field(..., min_length=1, description="what the dataset is called")
    description: str = field("", "one or two sentences for its card")
    license: str = Field("", max_length=200, description='SPDX identifier, such as "CC-BY-4.0", for its card')
    seed: Whole = field(0, "key of every draw; one seed gives the same dataset", "[0, 18446744073709551615]")
    scenes_per_target: Whole = field(50, "scenes, each with its own pose and water", "[1, 1000000]")
    scenes_per_shard: Whole = field(25, "scenes in one file, all of one target", "[1, 1000000]")
    targets: Targets = Targets()
    pose: Pose = Pose()
    backdrop: Backdrop = Backdrop()
    water: Water = Water()
    plume: Plume = Plume()
    gate: Window = Window()
    exposure: Exposure = Exposure()
    frames: Frames = Frames()
    monte_carlo: MonteCarlo = MonteCarlo()
    vary: dict[str, Annotated[Distribution, BeforeValidator(distribution)]] = Field(
        default_factory=dict, description='further fields of the scene: "laser.preset" = ["lu2024", ...]'
    )
    trajectory: Annotated[str, FilePath()] = ""
    """table of fields of the scene by time (CSV), relative to the recipe: scene n of a target has row n"""
    scene: dict[str, Any] = field(..., "the scene without targets and gate, as in a scene file")
    overrides_beside_file: ClassVar[bool] = True

    def _problems(self) -> Iterator[str]:
        for name in ("targets", "gate"):
            if name in self.scene:
                yield f"scene.{name} does not belong to the scene: it is in the recipe's own [{name}]"
        medium = self.scene.get("medium")
        if self.plume.probability > 0 and isinstance(medium, Mapping) and {"layers", "grid"} & set(medium):
            yield "plume.probability > 0 cannot be combined with layers or a grid in scene.medium"
        if self.plume.probability > 0 and "daylight" in self.scene:
            yield "plume.probability > 0 cannot be combined with scene.daylight, which takes one water"
        camera = self.scene.get("camera")
        polarisation = camera.get("polarisation", "none") if isinstance(camera, Mapping) else "none"
        if self.monte_carlo.channel != "I" and polarisation == "none" and "camera.polarisation" not in self.vary:
            needed = "scene.camera.polarisation = 'analyser' or 'stokes'"
            yield f"monte_carlo.channel = {self.monte_carlo.channel!r} needs {needed}"
        if not self.targets.exports and self.gate.before.limits[1] >= (far := self.pose.distance.limits[1]):
            yield f"gate.before = {self.gate.before.limits[1]:g} is outside (0, {far:g}) m, up to pose.distance"
        for name in self.vary:
            if self.water.attenuation_lengths is not None and name in _EXTINCTION:
                yield f"vary.{name} cannot be combined with water.attenuation_lengths, which replaces its extinction"
            if name in ("camera.width", "camera.height") or name.split(".")[0] in ("gate", "targets"):
                yield f"vary.{name} cannot vary"

    @classmethod
    def merged(cls, base: Mapping[str, Any], layer: Mapping[str, Any], *, at: str = "") -> dict[str, Any]:
        """As of sections; the scene is merged as a scene."""
        merged = super().merged(base, layer, at=at)
        for name, model in (("scene", Scene), ("vary", Section)):
            old, new = base.get(name), layer.get(name)
            if isinstance(old, Mapping) and isinstance(new, Mapping):
                merged[name] = model.merged(old, new, at=name)
        return merged

    def _check(self) -> None:
        """Tries the scene, and what can be drawn for its fields."""
        part = "scene"
        try:
            template = self.template()
            part = "vary"
            self._check_vary(template)
        except ConfigError as error:
            raise ConfigError([f"{part}: {line}" for line in error.problems]) from None

    def _check_vary(self, template: Scene) -> None:
        """Raises `ConfigError` where a value that can be drawn for a field is not one of its values."""
        values = {name: drawn.choices or drawn.limits for name, drawn in self.vary.items()}
        first = {name: some[0] for name, some in values.items()}
        for name, some in values.items():
            for value in some[:_MOST_TRIED]:
                template.with_overrides({**first, name: value})

    def template(self) -> Scene:
        """The scene before anything is drawn, without targets, its gate from 0 to 1 ns."""
        gate = {"start_ns": 0.0, "bin_width_ps": 1000.0 / self.gate.bins, "bins": self.gate.bins}
        return Scene.from_dict({**self.scene, "gate": gate})

    __hash__ = None  # type: ignore[assignment]


def load_recipe(path: str | os.PathLike[str]) -> Recipe:
    """Reads a recipe, or by a bare name one of the package's, such as "small".

    Raises `FileError` if it cannot be read, `ConfigError` with a line for each problem in it.
    """
    path = example_or_path(path, "datasets")
    return Recipe.from_dict(read_toml(path), source=path)
