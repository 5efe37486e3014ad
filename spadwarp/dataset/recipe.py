"""Recipes: what a dataset is drawn from. TOML in, frozen and validated models out.

A recipe holds a scene, given as in a scene file, and distributions of what changes from scene to scene. A distribution
is a number (a constant), a list (each value equally likely), or a table `{low = , high = }` (uniform; with `log = true`
uniform in the logarithm).
"""

from __future__ import annotations

import math
import os
from collections.abc import Mapping
from typing import Annotated, Any, ClassVar, Literal, Self

import numpy as np
from pydantic import AfterValidator, BeforeValidator, Field, model_validator

from spadwarp.io.paths import example_or_path
from spadwarp.io.text import read_toml
from spadwarp.scene import Scene
from spadwarp.scene.sections import Document, FilePath, Section, Whole, listed
from spadwarp.values import ArgumentError, ConfigError, check_real, shown

__all__ = ["SPLITS", "Distribution", "Recipe", "load_recipe"]

Names = Annotated[tuple[str, ...], BeforeValidator(listed)]
Paths = Annotated[Names, FilePath()]


class Distribution(Section):
    """One of `choices`, equally likely, or uniform between `low` and `high`."""

    choices: Annotated[tuple[Any, ...], BeforeValidator(listed)] = ()
    low: float | None = Field(None, ge=-1e19, le=1e19, description="lowest value")
    high: float | None = Field(None, ge=-1e19, le=1e19, description="highest value")
    log: bool = Field(False, description="whether uniform in the logarithm")

    @model_validator(mode="after")
    def _whole(self) -> Self:
        if bool(self.choices) == (self.low is not None and self.high is not None):
            raise ValueError("needs a number, a list of choices, or low and high")
        if self.low is not None and self.high is not None:
            if not self.low <= self.high:
                raise ValueError(f"low = {self.low} is outside (-inf, {self.high}], {self.high} being high")
            if self.log and not self.low > 0:
                raise ValueError(f"low = {self.low} is outside (0, inf), the range of a logarithm")
            if not math.isfinite(self.high / self.low if self.log else self.high - self.low):
                raise ValueError(f"low = {self.low} and high = {self.high} are too far apart")
        if not all(map(_is_finite, self.choices)):
            raise ValueError(f"holds {shown(self.choices)}, not all of which are finite")
        return self

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

    probability: float = Field(0.0, ge=0, le=1, description="part of the scenes that have one")
    shape: Annotated[tuple[Shape, ...], BeforeValidator(listed), Field(min_length=1)] = Field(
        ("cloud", "plume", "sediment"), description="shapes of medium.grid, equally likely"
    )
    optical_depth: Positive = Field(constant(1.0), description="that it adds on the optical axis, one way")
    place: Share = Field(Distribution(low=0.3, high=0.8), description="of its middle, as part of the target's distance")
    shift: Real = Field(constant(0.0), description="sideways, drawn for x and for y [m]")
    size: Positive = Field(constant(1.0), description="edge of its box [m]")
    albedo: Share = Field(constant(0.8), description="single-scattering albedo of its matter")
    turbulence: NotNegative = Field(constant(0.5), description="deviation of the logarithm of its density, up to 3")
    cells: Whole = Field(32, ge=1, le=256, description="cells along the edges of its box")


_MOST_TRIED = 1000  # values of a field that varies

SPLITS = ("train", "validation", "test")


class Targets(Section):
    """The targets, and which of them are for validation and test; all others are for training."""

    builtin: Names | Literal["all"] = Field(
        "all", description='names from `spadwarp list targets`; "all" objects, or none if meshes or exports are given'
    )
    meshes: Paths = Field((), description="mesh files, or folders of them, relative to the recipe")
    mesh_size: float | None = Field(
        None, ge=1e-6, le=1e6, description="longest side that meshes are scaled to [m]; else they stay as they are"
    )
    mesh_scale: float = Field(1.0, ge=1e-9, le=1e9, description="metres per unit of the mesh files; 0.001 for mm")
    orientation: Literal["camera", "y_up", "z_up"] = Field(
        "camera",
        description='axes of the mesh files: "camera" (+x right, +y down, +z away), "y_up" (glTF, +z to the viewer) '
        'or "z_up" (CAD, ROS; -y to the viewer)',
    )
    exports: Paths = Field((), description="*_RGBD.EXR of a game engine, or folders of them, rendered with the camera")
    export_preset: Literal["unreal", "blender"] = Field("unreal", description="program that wrote the exports")
    validation: Names = Field((), description="targets of the validation split")
    test: Names = Field((), description="targets of the test split")


class Pose(Section):
    """Position, rotation, size and reflectance of a target."""

    distance: Positive = Field(constant(15.0), description="of the target's centre, along the optical axis [m]")
    shift: Real = Field(constant(0.0), description="sideways, drawn for x and for y [m]")
    yaw_deg: Angle = Field(constant(0.0), description="rotation about the vertical axis [°]")
    pitch_deg: Angle = Field(constant(0.0), description="rotation about the horizontal axis across the view [°]")
    roll_deg: Angle = Field(constant(0.0), description="rotation about the optical axis [°]")
    size: Positive = Field(constant(1.0), description="scale of the target")
    fill: Positive | None = Field(None, description="part of the view that it fills without rotation; replaces size")
    reflectance: Share = Field(constant(0.5), description="Lambertian reflectance of the target")


class Backdrop(Section):
    """A wall behind the target."""

    probability: float = Field(0.0, ge=0, le=1, description="part of the scenes that have one")
    behind: NotNegative = Field(constant(0.5), description="distance of the wall behind the target's centre [m]")
    tilt_deg: Angle = Field(constant(0.0), description="its yaw and pitch, each drawn [°]")
    reflectance: Share = Field(constant(0.3), description="Lambertian reflectance of the wall")


class Water(Section):
    """Turbidity of the water; other values are those of the scene."""

    attenuation_lengths: Positive | None = Field(None, description="extinction times distance, one way")


class Window(Section):
    """The gate, as ranges."""

    before: Positive = Field(constant(1.5), description="from where it opens to the target's centre [m]")
    behind: Positive = Field(constant(1.0), description="from the target's centre to where it closes [m]")
    bins: Whole = Field(1024, ge=1, le=1_000_000, description="time bins in it")


class Exposure(Section):
    """Exposure of a frame: its pulses, or the photons that the median pixel records from the target."""

    signal_photons: Positive | None = Field(None, description="recorded from the target by the median pixel of it")
    pulses_per_depth_frame: PulseCount | None = Field(None, description="of a frame; the scene's if neither is given")

    @model_validator(mode="after")
    def _one(self) -> Self:
        if self.signal_photons is not None and self.pulses_per_depth_frame is not None:
            raise ValueError("needs either signal_photons or pulses_per_depth_frame")
        return self


class Frames(Section):
    """The depth frames of a scene."""

    per_scene: Whole = Field(20, ge=1, le=1_000_000, description="frames of each scene")
    backscatter_fraction: Literal["rates"] | Share = Field(
        constant(0.183), description='part of the pixels that report backscatter; "rates": the photon rates decide'
    )
    compression: Literal["none", "gzip"] = Field("none", description='of the frames; "none" reads fastest')


class MonteCarlo(Section):
    """Scenes that are traced photon by photon; their depth frames come from the counts of the camera."""

    share: float = Field(0.0, ge=0, le=1, description="part of the scenes that are traced; the others are analytic")
    photons: Whole = Field(100_000_000, ge=1, le=10**12, description="photons of a scene")
    depth_method: Literal["peak", "centroid", "matched", "likelihood"] = Field(
        "matched", description="how depth is found in counts"
    )
    counts: Literal["none", "sparse", "dense", "smaller"] = Field(
        "smaller", description="how the counts of frames are stored, if at all"
    )
    channel: Literal["I", "co", "cross"] = Field(
        "I", description="light that the camera counts: all, or what an analyser passes at or across its angle"
    )

    @model_validator(mode="after")
    def _traced(self) -> Self:
        if self.model_fields_set and "share" not in self.model_fields_set:
            raise ValueError("share is missing: 1 traces all scenes, 0.5 half of them; without it none is traced")
        if self.channel != "I" and self.share < 1.0:
            raise ValueError(f"channel = {self.channel!r} needs share = 1: the analytic simulator has no polarisation")
        return self


class Recipe(Document):
    """Everything a dataset depends on, checked and frozen."""

    name: str = Field(..., min_length=1, description="what the dataset is called")
    description: str = Field("", description="one or two sentences for its card")
    license: str = Field("", max_length=200, description='SPDX identifier, such as "CC-BY-4.0", for its card')
    seed: Whole = Field(0, ge=0, le=2**64 - 1, description="key of every draw; one seed gives the same dataset")
    scenes_per_target: Whole = Field(50, ge=1, le=1_000_000, description="scenes, each with its own pose and water")
    scenes_per_shard: Whole = Field(25, ge=1, le=1_000_000, description="scenes in one file, all of one target")
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
    trajectory: Annotated[str, FilePath()] = Field(
        "",
        description="table of fields of the scene by time (CSV), relative to the recipe: scene n of a target has row n",
    )
    scene: dict[str, Any] = Field(..., description="the scene without targets and gate, as in a scene file")
    overrides_beside_file: ClassVar[bool] = True

    @model_validator(mode="after")
    def _consistent(self) -> Self:
        for name in ("targets", "gate"):
            if name in self.scene:
                raise ValueError(f"scene.{name} does not belong to the scene: it is in the recipe's own [{name}]")
        medium = self.scene.get("medium")
        if self.plume.probability > 0 and isinstance(medium, Mapping) and {"layers", "grid"} & set(medium):
            raise ValueError("plume.probability > 0 cannot be combined with layers or a grid in scene.medium")
        if self.plume.probability > 0 and "daylight" in self.scene:
            raise ValueError("plume.probability > 0 cannot be combined with scene.daylight, which takes one water")
        camera = self.scene.get("camera")
        polarisation = camera.get("polarisation", "none") if isinstance(camera, Mapping) else "none"
        if self.monte_carlo.channel != "I" and polarisation == "none" and "camera.polarisation" not in self.vary:
            raise ValueError(
                f"monte_carlo.channel = {self.monte_carlo.channel!r} needs scene.camera.polarisation = 'analyser' or "
                "'stokes'"
            )
        for field in self.vary:
            if field in ("camera.width", "camera.height") or field.split(".")[0] in ("gate", "targets"):
                raise ValueError(f"vary.{field} cannot vary")
        return self

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
        values = {field: drawn.choices or drawn.limits for field, drawn in self.vary.items()}
        first = {field: some[0] for field, some in values.items()}
        for field, some in values.items():
            for value in some[:_MOST_TRIED]:
                template.with_overrides({**first, field: value})

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
    tables = read_toml(path)
    if {"laser", "camera"} <= set(tables) and "scene" not in tables:
        raise ConfigError(
            "a scene, not a recipe; a recipe has such tables in [scene], see `spadwarp list datasets`", source=str(path)
        )
    return Recipe.from_dict(tables, source=path)
