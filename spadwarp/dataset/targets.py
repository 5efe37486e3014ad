"""Where a dataset's targets come from: built-in shapes, mesh files, or depth maps that a game engine rendered."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.recipe import Recipe
from spadwarp.errors import ConfigError, FileError, MeshError
from spadwarp.result.result import Truth
from spadwarp.scene import Camera, Target

__all__ = ["Origin", "find_targets"]

_MESH_ENDINGS = (".stl", ".obj", ".ply", ".off", ".glb")
_DEPTH_ENDING, _NORMAL_ENDING, _ALBEDO_ENDING = "_RGBD", "_Surf_Norm", "_Base_Col"


@dataclass(frozen=True)
class Origin:
    """A target: its name, the split it belongs to, and a mesh file or an engine's depth map; a built-in without."""

    name: str
    split: str
    mesh: Path | None = None
    export: Path | None = None

    def placed(
        self, pose: dict[str, Any], *, longest: float | None, fill: float | None, camera: Camera
    ) -> dict[str, Any]:
        """The fields of a scene's target: its centre at the pose's translation, scaled as the recipe says.

        Args:
            pose: `translation`, `rotation_deg`, `scale`, `reflectance`.
            longest: Longest side that a mesh file is scaled to first [m].
            fill: Part of the view that the target fills, in place of `scale`.
            camera: Whose view.
        """
        from spadwarp.mesh.targets import placement

        scale = pose["scale"]
        if self.mesh is not None or fill is not None:
            lower, upper = _bounds(self)
            sides = upper - lower
        if fill is not None:
            view = pose["translation"][2] * camera.pixel_tangent * np.array([camera.width, camera.height])
            scale = fill * float((view / sides[:2]).min())
        elif self.mesh is not None and longest is not None:
            scale *= longest / float(sides.max())
        placed: dict[str, Any] = {**pose, "scale": scale}
        if self.mesh is None:
            return {"builtin": self.name, **placed}
        turned = placement(np.full(3, scale), pose["rotation_deg"], (0.0, 0.0, 0.0))[:3, :3]
        shift = np.asarray(pose["translation"]) - turned @ (0.5 * (lower + upper))
        return {"mesh": str(self.mesh), **placed, "translation": [float(one) for one in shift]}

    def truth(self, camera: Camera, preset: Any) -> Truth:
        """What the engine rendered, of an `export`; with its normals and colours where their files lie beside it."""
        assert self.export is not None
        return _exported(self.export, camera, preset)


def find_targets(recipe: Recipe) -> tuple[Origin, ...]:
    """The targets of a recipe in order. Raises `ConfigError`, `MeshError` or `FileError` for what is not there."""
    from spadwarp.mesh import BUILTINS, builtin_names

    known, chosen = builtin_names(), recipe.targets
    objects = [name for name in known if name not in BUILTINS or name == "staircase"]
    names = list(chosen.builtin)
    if chosen.builtin == "all":
        names = [] if chosen.meshes or chosen.exports else objects
    problems = [
        f"targets.builtin: {name!r} is not one of {', '.join(map(repr, known))}" for name in names if name not in known
    ]
    found: list[tuple[str, str, Path]] = []
    for entry in chosen.meshes:
        files = _files(Path(entry), lambda one: one.suffix.lower() in _MESH_ENDINGS)
        if not files:
            raise MeshError(f"targets.meshes: {entry}: no mesh file there")
        found += [(one.stem, "mesh", one) for one in files]
    for entry in chosen.exports:
        files = _files(Path(entry), lambda one: one.stem.endswith(_DEPTH_ENDING) and one.suffix.lower() == ".exr")
        if not files:
            raise FileError(f"targets.exports: {entry}: no file *{_DEPTH_ENDING}.EXR there")
        found += [(one.stem.removesuffix(_DEPTH_ENDING), "export", one) for one in files]
    origins: dict[str, dict[str, Path]] = {name: {} for name in names}
    for name, kind, path in found:
        if name in origins:
            problems.append(f"targets: {path}: a target {name!r} is there already")
        origins[name] = {kind: path}
    splits = dict.fromkeys(origins, "train")
    for split in ("validation", "test"):
        for name in getattr(chosen, split):
            if name not in splits:
                problems.append(f"targets.{split}: {name!r} is not one of the dataset's targets")
            elif splits[name] != "train":
                problems.append(f"targets.{split}: {name!r} is in {splits[name]} already")
            else:
                splits[name] = split
    if not origins:
        problems.append("targets: there are none")
    if chosen.exports and recipe.monte_carlo.share > 0:
        problems.append("monte_carlo.share: photons need meshes; targets.exports are depth maps")
    if problems:
        raise ConfigError(problems, source=None if recipe.source is None else str(recipe.source))
    return tuple(Origin(name, splits[name], **origin) for name, origin in origins.items())


def _files(place: Path, wanted: Any) -> list[Path]:
    if place.is_dir():
        return sorted(one for one in place.iterdir() if wanted(one))
    return [place] if place.is_file() else []


@cache
def _bounds(origin: Origin) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    from spadwarp.mesh import load_target

    mesh = load_target(Target(builtin=origin.name) if origin.mesh is None else Target(mesh=str(origin.mesh)))
    lower, upper = np.asarray(mesh.bounds, np.float64)
    return lower, upper


@cache
def _exported(path: Path, camera: Camera, preset: Any) -> Truth:
    from spadwarp.result.rendered_truth import load_truth_exr

    def beside(ending: str) -> Path | None:
        one = path.with_name(path.name.replace(_DEPTH_ENDING, ending))
        return one if one.is_file() else None

    albedo = beside(_ALBEDO_ENDING)
    return load_truth_exr(
        depth=path,
        camera=camera,
        preset=preset,
        normal=beside(_NORMAL_ENDING),
        albedo=0.5 if albedo is None else albedo,
    )
