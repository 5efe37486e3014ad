"""What is unknown in a scene: names, one value or one for each pixel, and the scale on which a value is searched."""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene import Scene
from spadwarp.scene.camera import to_world
from spadwarp.values import ArgumentError, ConfigError, shown, suggestion

__all__ = ["Unknown", "read_unknowns"]

DEPTH, BACKGROUND = "depth", "detector.ambient_rate"
_SHORT = {name: f"medium.{name}" for name in ("absorption", "scattering", "anisotropy")} | {"background": BACKGROUND}
_FIELD = re.compile(
    r"medium\.(?:absorption|scattering|anisotropy|constituents\[(\d+)\]\.concentration)|targets\[(\d+)\]\.reflectance"
)
_UNITS = {"absorption": "1/m", "scattering": "1/m", DEPTH: "m", "ambient_rate": "1/s"}


@dataclass(frozen=True)
class Unknown:
    """One unknown."""

    name: str
    """"medium.absorption", "medium.scattering", "medium.anisotropy", "medium.constituents[k].concentration",
    "targets[k].reflectance", "detector.ambient_rate", or "depth": where the targets are along the optical axis."""
    per_pixel: bool = False  # whether each pixel has a value of its own

    @property
    def is_positive(self) -> bool:
        """Whether its logarithm is searched, which keeps it positive."""
        return self.name not in (DEPTH, "medium.anisotropy")

    @property
    def largest_step(self) -> float:
        """Of an iteration, on the scale that is searched."""
        return 1.1 if self.is_positive else 0.05

    @property
    def is_light(self) -> bool:
        """Whether its derivative is one of the scored quantities of transport."""
        return self.name not in (DEPTH, BACKGROUND)

    @property
    def unit(self) -> str:
        """SI, "" for a plain number."""
        return _UNITS.get(self.name.rpartition(".")[2], "")

    def __str__(self) -> str:
        return f"{self.name}:pixel" if self.per_pixel else self.name


def read_unknowns(scene: Scene, names: str | Sequence[str]) -> tuple[Unknown, ...]:
    """Unknowns from names: "medium.absorption,depth:pixel", or a list of them.

    `absorption`, `scattering`, `anisotropy`, `background` and, with one target, `reflectance` are short for the fields,
    and a constituent's name for its concentration. ":pixel" behind depth, a reflectance or the background gives each
    pixel its own value.

    Raises:
        ArgumentError: No name, an unknown one, or one twice.
        ConfigError: The scene has no such value to start from: its layers, its albedo, its phase function.
    """
    words = [word.strip() for word in names.split(",")] if isinstance(names, str) else list(names)
    unknowns: dict[str, Unknown] = {}
    for word in words:
        unknown = _read(scene, word)
        if unknown.name in unknowns:
            raise ArgumentError(f"unknown: {unknown.name} is named twice")
        unknowns[unknown.name] = unknown
    if not unknowns:
        raise ArgumentError("unknown: no name is given")
    return tuple(unknowns.values())


def by_name(scene: Scene, values: Mapping[str, Any]) -> dict[str, Any]:
    """Values of unknowns by their full names. Raises what `read_unknowns` raises."""
    return {read_unknowns(scene, [name])[0].name: value for name, value in values.items()}


def _read(scene: Scene, word: str) -> Unknown:
    name, _, spread = word.partition(":")
    if spread not in ("", "pixel"):
        raise ArgumentError(f"unknown: {shown(word)} ends neither with a name nor with ':pixel'")
    name = _SHORT.get(name, name)
    parts = {one.name: f"medium.constituents[{k}].concentration" for k, one in enumerate(scene.medium.constituents)}
    name = parts.get(name, name)
    own = [f"targets[{k}].reflectance" for k in range(len(scene.targets))]
    if name == "reflectance" and len(own) == 1:
        name = own[0]
    if name == "reflectance" and own:
        raise ArgumentError(
            f"unknown: 'reflectance' is that of one target, and the scene has {len(own)}: name {' or '.join(own)}"
        )
    if name == "ambient_rate":
        name = BACKGROUND
    if name.rpartition(".")[2] in ("extinction", "albedo"):
        raise ArgumentError(f"unknown: {shown(name)} follows from absorption and scattering: name these two")
    field = _FIELD.fullmatch(name)
    if field is None and name not in (DEPTH, BACKGROUND):
        known = [*_SHORT, *_SHORT.values(), *parts, *parts.values(), *own, DEPTH]
        raise ArgumentError(f"unknown: {shown(name)} is not one of {', '.join(known)}{suggestion(name, known)}")
    if spread and name.startswith("medium."):
        raise ArgumentError(f"unknown: {name} is one of the whole water, not of a pixel")
    if problem := _without_derivative(scene, name, field):
        raise ConfigError(f"unknown: {name}{problem}")
    return Unknown(name, bool(spread))


def _without_derivative(scene: Scene, name: str, field: re.Match[str] | None) -> str:
    """Why the scene has no derivative by an unknown; empty where it has."""
    constituent, target = field.groups() if field else (None, None)
    if name == DEPTH and not scene.targets:
        return ", but the scene has no targets"
    if constituent is not None:
        if int(constituent) >= (count := len(scene.medium.constituents)):
            return f", but medium has {count} constituents"
        value = scene.medium.constituents[int(constituent)].concentration
        return "" if value > 0.0 else " is 0; start from a little of it"
    if target is not None:
        if int(target) >= len(scene.targets):
            return f", but the scene has {len(scene.targets)} targets"
        if isinstance(scene.targets[int(target)].reflectance, str):
            return " is from_file; a number is needed"
    if name.startswith("medium."):
        if scene.medium.albedo == "lu2024":
            return ", but medium.albedo is 'lu2024', random at each collision"
        if scene.medium.is_mixture:
            return ", but medium has constituents; name those whose concentrations are unknown"
        law = scene.medium.phase_function
        if name == "medium.anisotropy" and law != "henyey_greenstein":
            return f" goes with phase_function = 'henyey_greenstein', not {law!r}"
    return ""


def scene_value(scene: Scene, unknown: Unknown) -> float:
    """The scene's own value; depth counts from where the targets are."""
    if unknown.name == DEPTH:
        return 0.0
    section, _, field = unknown.name.rpartition(".")
    if section.startswith("targets"):
        return float(scene.targets[int(section[8:-1])].reflectance)
    if section.startswith("medium.constituents"):
        return scene.medium.constituents[int(section[20:-1])].concentration
    return float(getattr(scene.medium if section == "medium" else scene.detector, field))


def with_values(scene: Scene, values: Mapping[str, float]) -> Scene:
    """The scene with other values; `depth` is a shift of all targets along the optical axis [m]."""
    fields: dict[str, Any] = {name: float(value) for name, value in values.items() if name != DEPTH}
    if water := {"medium.absorption", "medium.scattering"} & set(fields):
        for name in {"medium.absorption", "medium.scattering"} - water:
            fields[name] = getattr(scene.medium, name.rpartition(".")[2])
    changed = scene.with_overrides(fields) if fields else scene
    return moved(changed, values[DEPTH]) if values.get(DEPTH) else changed


def moved(scene: Scene, shift: float) -> Scene:
    """The scene with all targets moved along the optical axis [m]."""
    origin, ahead = to_world(scene.camera, [[0.0, 0.0, 0.0], [0.0, 0.0, 1.0]])
    step: NDArray[np.float64] = shift * (ahead - origin)
    targets = tuple(
        target.model_copy(update={"translation": tuple(map(float, target.translation + step))})
        for target in scene.targets
    )
    return scene.model_copy(update={"targets": targets})
