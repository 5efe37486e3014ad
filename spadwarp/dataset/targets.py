"""The targets of a dataset: built-in shapes, mesh files, or depth maps that a game engine rendered."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.recipe import Recipe, Targets
from spadwarp.errors import ConfigError, FileError, MeshError
from spadwarp.mesh import BUILTINS, builtin_names, load_target
from spadwarp.mesh.targets import placement
from spadwarp.mesh.usd import USD_ENDINGS
from spadwarp.result import Truth, load_truth_exr
from spadwarp.scene import Camera, Target
from spadwarp.scene.pose import rotation_angles

__all__ = ["TargetSource", "check_extents", "find_targets"]

_MESH_ENDINGS = (".stl", ".obj", ".ply", ".off", ".glb", *USD_ENDINGS)
# The axes of mesh files in those of the camera.
_UPRIGHT = {
    "camera": np.eye(3),
    "y_up": np.diag([1.0, -1.0, -1.0]),
    "z_up": np.array([[1.0, 0.0, 0.0], [0.0, 0.0, -1.0], [0.0, 1.0, 0.0]]),
}
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

    def placed(self, pose: dict[str, Any], *, chosen: Targets, fill: float | None, camera: Camera) -> dict[str, Any]:
        """The fields of a scene's target, its centre at the pose's translation, scaled as the recipe asks.

        Args:
            pose: `translation`, `rotation_deg`, `scale`, `reflectance`.
            chosen: Size, unit and orientation of mesh files.
            fill: Part of the view that the target fills; replaces `scale`.
            camera: Whose view.
        """
        if self.mesh is None and fill is None:
            return {"builtin": self.name, **pose}
        scale, (lower, upper) = pose["scale"], _bounds(self)
        upright = np.eye(3) if self.mesh is None else _UPRIGHT[chosen.orientation]
        sides = np.abs(upright @ (upper - lower))
        if fill is not None:
            view = pose["translation"][2] * camera.pixel_tangent * np.array([camera.width, camera.height])
            scale = fill * float((view / sides[:2]).min())
        else:
            scale *= self.metres_per_unit(chosen)
        if self.mesh is None:
            return {"builtin": self.name, **pose, "scale": scale}
        matrix = placement(np.full(3, scale), pose["rotation_deg"], (0.0, 0.0, 0.0))[:3, :3] @ upright
        shift = np.asarray(pose["translation"]) - matrix @ (0.5 * (lower + upper))
        turned = {"scale": scale, "translation": shift.tolist()}
        if chosen.orientation != "camera":
            turned["rotation_deg"] = list(rotation_angles(matrix / scale))
        return {"mesh": str(self.mesh), **pose, **turned}

    def metres_per_unit(self, chosen: Targets) -> float:
        """Scale of a mesh file before its pose."""
        if chosen.mesh_size is None:
            return chosen.mesh_scale
        lower, upper = _bounds(self)
        return chosen.mesh_size / float((upper - lower).max())

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


def check_extents(recipe: Recipe, targets: tuple[TargetSource, ...], camera: Camera) -> None:
    """Raises `ConfigError` that names each mesh file, and its extent, that is too large or too small to be seen where
    the recipe puts it."""
    if recipe.pose.fill is not None:
        return
    (nearest, farthest), (smallest, largest) = recipe.pose.distance.limits, recipe.pose.size.limits
    problems = []
    for target in (target for target in targets if target.mesh is not None):
        lower, upper = _bounds(target)
        sides = (upper - lower) * target.metres_per_unit(recipe.targets)
        extent = f"targets.meshes: {target.mesh}: " + " x ".join(f"{side:.4g}" for side in sides) + " m"
        advice = "in another unit? targets.mesh_scale is metres per unit, targets.mesh_size the longest side"
        if 0.5 * largest * float(np.linalg.norm(sides)) >= nearest:
            problems.append(f"{extent}: reaches the camera from pose.distance = {nearest:g} m; {advice}")
        elif smallest * float(sides.max()) < farthest * camera.pixel_tangent:
            problems.append(f"{extent}: less than a pixel at pose.distance = {farthest:g} m; {advice}")
    if problems:
        raise ConfigError(problems, source=None if recipe.source is None else str(recipe.source))


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
