"""The targets of a dataset: built-in shapes, mesh files, or depth maps that a game engine rendered."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.recipe import Recipe
from spadwarp.errors import ConfigError, FileError, MeshError
from spadwarp.mesh import BUILTINS, builtin_names, load_target
from spadwarp.mesh.targets import placement
from spadwarp.result import Truth, load_truth_exr
from spadwarp.scene import Camera, Target

__all__ = ["TargetSource", "find_targets"]

_MESH_ENDINGS = (".stl", ".obj", ".ply", ".off", ".glb")
_DEPTH_ENDING, _NORMAL_ENDING, _ALBEDO_ENDING = "_RGBD", "_Surf_Norm", "_Base_Col"


@dataclass(frozen=True)
class TargetSource:
    """A target of a dataset.

    Attributes:
        name: Of the built-in shape, or of the file without its ending.
        split: "train", "validation" or "test".
        mesh, export: The mesh file, or the engine's depth map; neither for a built-in shape.
        export_preset: Conventions of the program that wrote the depth map.
    """

    name: str
    split: str
    mesh: Path | None = None
    export: Path | None = None
    export_preset: Literal["unreal", "blender"] = "unreal"

    def placed(
        self, pose: dict[str, Any], *, longest: float | None, fill: float | None, camera: Camera
    ) -> dict[str, Any]:
        """The fields of a scene's target, its centre at the pose's translation, scaled as the recipe asks.

        Args:
            pose: `translation`, `rotation_deg`, `scale`, `reflectance`.
            longest: Longest side that a mesh file is scaled to first [m].
            fill: Part of the view that the target fills; replaces `scale`.
            camera: Whose view.
        """
        if self.mesh is None and fill is None:
            return {"builtin": self.name, **pose}
        scale, (lower, upper) = pose["scale"], _bounds(self)
        sides = upper - lower
        if fill is not None:
            view = pose["translation"][2] * camera.pixel_tangent * np.array([camera.width, camera.height])
            scale = fill * float((view / sides[:2]).min())
        elif longest is not None:
            scale *= longest / float(sides.max())
        if self.mesh is None:
            return {"builtin": self.name, **pose, "scale": scale}
        matrix = placement(np.full(3, scale), pose["rotation_deg"], (0.0, 0.0, 0.0))[:3, :3]
        shift = np.asarray(pose["translation"]) - matrix @ (0.5 * (lower + upper))
        return {"mesh": str(self.mesh), **pose, "scale": scale, "translation": shift.tolist()}

    def truth(self, camera: Camera) -> Truth:
        """The truth maps of an `export`, with normals and colours where their files lie beside it."""
        return _exported(self, camera)


def find_targets(recipe: Recipe) -> tuple[TargetSource, ...]:
    """The targets of a recipe in order.

    Raises `ConfigError` for names that are unknown or given twice, `MeshError` and `FileError` for missing files.
    """
    chosen = recipe.targets
    problems: list[str] = []
    sources: dict[str, dict[str, Any]] = {name: {} for name in _builtins(recipe, problems)}
    for name, source in _of_files(recipe):
        if name in sources:
            problems.append(f"targets: {next(iter(source.values()))}: there is already a target {name!r}")
        sources[name] = source
    splits = dict.fromkeys(sources, "train")
    for split in ("validation", "test"):
        for name in getattr(chosen, split):
            if splits.get(name) == "train":
                splits[name] = split
            elif name in splits:
                problems.append(f"targets.{split}: {name!r} is already in {splits[name]}")
            else:
                problems.append(f"targets.{split}: {name!r} is not one of the dataset's targets")
    if not sources:
        problems.append("targets: none are given")
    if chosen.exports and recipe.monte_carlo.share > 0:
        problems.append("monte_carlo.share: photons need meshes; targets.exports are depth maps")
    if problems:
        raise ConfigError(problems, source=None if recipe.source is None else str(recipe.source))
    return tuple(TargetSource(name, splits[name], **source) for name, source in sources.items())


def _builtins(recipe: Recipe, problems: list[str]) -> list[str]:
    known, chosen = builtin_names(), recipe.targets
    if chosen.builtin == "all":
        objects = [name for name in known if name not in BUILTINS or name == "staircase"]
        return [] if chosen.meshes or chosen.exports else objects
    listed = ", ".join(map(repr, known))
    problems += [f"targets.builtin: {name!r} is not one of {listed}" for name in chosen.builtin if name not in known]
    return list(chosen.builtin)


def _of_files(recipe: Recipe) -> Iterator[tuple[str, dict[str, Any]]]:
    chosen = recipe.targets
    for place in chosen.meshes:
        files = _files(place, lambda path: path.suffix.lower() in _MESH_ENDINGS)
        if not files:
            raise MeshError(f"targets.meshes: {place}: no mesh file there")
        yield from ((path.stem, {"mesh": path}) for path in files)
    for place in chosen.exports:
        files = _files(place, lambda path: path.stem.endswith(_DEPTH_ENDING) and path.suffix.lower() == ".exr")
        if not files:
            raise FileError(f"targets.exports: {place}: no file *{_DEPTH_ENDING}.EXR there")
        for path in files:
            yield path.stem.removesuffix(_DEPTH_ENDING), {"export": path, "export_preset": chosen.export_preset}


def _files(place: str, wanted: Callable[[Path], bool]) -> list[Path]:
    """The wanted files of a folder, or the file itself; empty where there is neither."""
    path = Path(place)
    return sorted(filter(wanted, path.iterdir())) if path.is_dir() else [path] if path.is_file() else []


@cache
def _bounds(source: TargetSource) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    mesh = load_target(Target(builtin=source.name) if source.mesh is None else Target(mesh=str(source.mesh)))
    lower, upper = np.asarray(mesh.bounds, np.float64)
    return lower, upper


@cache
def _exported(source: TargetSource, camera: Camera) -> Truth:
    path = source.export
    assert path is not None

    def beside(ending: str) -> Path | None:
        neighbour = path.with_name(path.name.replace(_DEPTH_ENDING, ending))
        return neighbour if neighbour.is_file() else None

    return load_truth_exr(
        depth=path,
        camera=camera,
        preset=source.export_preset,
        normal=beside(_NORMAL_ENDING),
        albedo=beside(_ALBEDO_ENDING) or 0.5,
    )
