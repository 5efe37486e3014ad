"""The plan of a dataset: its targets and splits, scenes, samples and shards, and how each value is drawn.

Numbers follow from the recipe alone. Scene `j` of target `t` has the index t · scenes_per_target + j, and its frame `k`
the sample id index · frames.per_scene + k. Every value is drawn by Philox with a key of (seed of the split, name of the
value, id): no draw depends on another, on the order, or on which machine makes the shard.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.recipe import SPLITS, UNIFORM, Distribution, Plume, Recipe, Targets
from spadwarp.errors import ConfigError, FileError, MeshError
from spadwarp.mesh import BUILTINS, builtin_names, load_target
from spadwarp.mesh.files import USD_ENDINGS
from spadwarp.mesh.targets import placement
from spadwarp.result import Truth, load_truth_exr
from spadwarp.scene import Camera, Scene, Target, Trajectory, load_trajectory
from spadwarp.scene.pose import rotation_angles
from spadwarp.scene.sight import port_advance
from spadwarp.units import time_from_range

__all__ = ["Plan"]

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


_SHORTEST_RANGE = 0.05  # [m], the nearest at which a gate opens

_Draw = Callable[[str, Distribution | None], Any]


@dataclass(frozen=True)
class Shard:
    """The scenes of one file; all of one target, hence of one split."""

    index: int
    target: int
    split: str
    first_scene: int
    scenes: int

    @property
    def name(self) -> str:
        """`00003`"""
        return f"{self.index:05d}"

    @property
    def frames_file(self) -> str:
        return f"frames-{self.name}.h5"

    @property
    def scenes_file(self) -> str:
        return f"scenes/scenes-{self.name}.h5"

    @property
    def histograms_file(self) -> str:
        return f"histograms-{self.name}.h5"

    @property
    def indices(self) -> range:
        """Of its scenes."""
        return range(self.first_scene, self.first_scene + self.scenes)


@dataclass(frozen=True)
class SceneDraw:
    """One scene as it was drawn; an exposure that depends on the light that returns is found later.

    Attributes:
        index: Of the scene.
        target: Index into `Plan.targets`.
        scene: The scene; where `signal_photons` is given, its number of pulses is not final.
        distance: Of the target's centre [m].
        attenuation_lengths: Extinction times distance.
        signal_photons: Of the median pixel, which decides the pulses; None: those of the scene.
        fractions: Backscatter fraction of each frame; NaN where the photon rates decide, as with traced photons.
        photons: Number to trace; None for the analytic model.
        seed: Of photons and camera.
    """

    index: int
    target: int
    scene: Scene
    distance: float
    attenuation_lengths: float
    signal_photons: float | None
    fractions: tuple[float, ...]
    photons: int | None
    seed: int


class Plan:
    """A recipe's targets, splits, shards and draws."""

    def __init__(self, recipe: Recipe) -> None:
        self.recipe = recipe
        self.targets = find_targets(recipe)
        self.split_seeds = {
            split: int(np.random.SeedSequence([recipe.seed, _word(split)]).generate_state(1, np.uint64)[0])
            for split in SPLITS
        }
        self.frames_per_scene = recipe.frames.per_scene
        self.scene_count = len(self.targets) * recipe.scenes_per_target
        self.sample_count = self.scene_count * self.frames_per_scene
        self.shards = tuple(self._shards())
        self._template = recipe.template()
        self._tables = self._template.to_dict()
        self.shape = (self._template.camera.height, self._template.camera.width)
        self._moves = load_trajectory(recipe.trajectory) if recipe.trajectory else None
        if self._moves is not None:
            self._check_moves(self._moves)
        self.depth_offset, self.depth_step = self._depth_code()

    def check_targets(self) -> None:
        """Raises `ConfigError` that names each mesh file, and its extent, that is too large or too small to be seen
        where the recipe puts it."""
        recipe, camera = self.recipe, self._template.camera
        (nearest, farthest), (smallest, largest) = recipe.pose.distance.limits, recipe.pose.size.limits
        problems = []
        for target in self.targets if recipe.pose.fill is None else ():
            if target.mesh is None:
                continue
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

    def split_of(self, scene_index: int) -> str:
        """The split of a scene."""
        return self.targets[scene_index // self.recipe.scenes_per_target].split

    def generator(self, split: str, field: str, index: int) -> np.random.Generator:
        """The random numbers of one value, named by `field`, of one scene or sample."""
        key = np.random.SeedSequence([self.split_seeds[split], _word(field), index])
        return np.random.Generator(np.random.Philox(key))

    def scene(self, index: int) -> SceneDraw:
        """Draws a scene."""
        recipe, split = self.recipe, self.split_of(index)
        number = index // recipe.scenes_per_target
        source = self.targets[number]

        def draw(field: str, distribution: Distribution | None) -> Any:
            return None if distribution is None else distribution.draw(self.generator(split, field, index))

        if source.export is None:
            distance = float(draw("pose.distance", recipe.pose.distance))
        else:
            distance = self._export_distance(source)
        changes = {name: draw(f"vary.{name}", values) for name, values in recipe.vary.items()}
        scene = Scene.from_dict(self._tables, source=recipe.source).with_overrides(changes)
        lengths = draw("water.attenuation_lengths", recipe.water.attenuation_lengths)
        if lengths is None:
            lengths = scene.medium.extinction * distance
        else:
            scene = scene.with_overrides({"medium.extinction": lengths / distance})
        if recipe.plume.probability > 0.0:
            scene = _with_plume(scene, recipe.plume, draw, distance)
        analytic = scene.analytic.to_dict()
        if (pulses := draw("exposure.pulses", recipe.exposure.pulses_per_depth_frame)) is not None:
            analytic["pulses_per_depth_frame"] = max(1, round(pulses))
        drawn = {
            "gate": self._gate(draw, distance, scene),
            "targets": [] if source.export else self._targets(draw, source, distance, scene.camera),
            "analytic": analytic,
        }
        scene = Scene.from_dict({**scene.to_dict(), **drawn})
        if self._moves is not None:
            scene = self._moves.scene(scene, index % recipe.scenes_per_target)
        first = index * self.frames_per_scene
        return SceneDraw(
            index=index,
            target=number,
            scene=scene,
            distance=distance,
            attenuation_lengths=float(lengths),
            signal_photons=draw("exposure.signal", recipe.exposure.signal_photons),
            fractions=tuple(self.fraction(first + k) for k in range(self.frames_per_scene)),
            photons=recipe.monte_carlo.photons if self.is_traced(index) else None,
            seed=int(self.generator(split, "photons", index).integers(2**63)),
        )

    def _check_moves(self, moves: Trajectory) -> None:
        """Raises `ConfigError` for a trajectory that is too short, or that moves what a recipe draws."""
        own = ("camera.width", "camera.height", "gate.", "analytic.")
        problems = [
            f"{name} is not for a trajectory: the recipe draws it" for name in moves.fields if name.startswith(own)
        ]
        if len(moves) < self.recipe.scenes_per_target:
            problems.append(f"{len(moves)} rows are fewer than scenes_per_target = {self.recipe.scenes_per_target}")
        if any(target.export for target in self.targets):
            problems.append("targets.exports are depth maps, which do not move")
        if problems:
            raise ConfigError(problems, source=moves.source)

    def _targets(self, draw: _Draw, source: TargetSource, distance: float, camera: Camera) -> list[dict[str, Any]]:
        """The target and, in part of the scenes, the wall behind it."""
        pose, wall = self.recipe.pose, self.recipe.backdrop
        placed = {
            "translation": [draw("pose.shift.x", pose.shift), draw("pose.shift.y", pose.shift), distance],
            "rotation_deg": [
                draw(f"pose.{name}", getattr(pose, name)) for name in ("pitch_deg", "yaw_deg", "roll_deg")
            ],
            "reflectance": draw("pose.reflectance", pose.reflectance),
            "scale": draw("pose.size", pose.size),
        }
        fill = draw("pose.fill", pose.fill)
        targets = [source.placed(placed, chosen=self.recipe.targets, fill=fill, camera=camera)]
        if draw("backdrop.probability", UNIFORM) < wall.probability:
            behind = distance + draw("backdrop.behind", wall.behind)
            side = 4.0 * behind * camera.pixel_tangent * max(camera.width, camera.height)
            tilt = [draw("backdrop.tilt.x", wall.tilt_deg), draw("backdrop.tilt.y", wall.tilt_deg), 0.0]
            targets.append(
                {
                    "builtin": "plane",
                    "size": [side, side],
                    "rotation_deg": tilt,
                    "translation": [0.0, 0.0, behind],
                    "reflectance": draw("backdrop.reflectance", wall.reflectance),
                }
            )
        return targets

    def _gate(self, draw: _Draw, distance: float, scene: Scene) -> dict[str, Any]:
        window, group_index = self.recipe.gate, scene.medium.group_index
        near = max(distance - draw("gate.before", window.before), _SHORTEST_RANGE)
        far = distance + draw("gate.behind", window.behind)
        return {
            "start_ns": time_from_range(max(near - port_advance(scene), 0.0), group_index) * 1e9,
            "bin_width_ps": time_from_range(far - near, group_index) / window.bins * 1e12,
            "bins": window.bins,
        }

    def files_of(self, shard: Shard) -> tuple[str, ...]:
        """Names of a shard's files: frames, scenes, and histograms where photons are traced."""
        traced = self.recipe.monte_carlo.share > 0 and any(map(self.is_traced, shard.indices))
        return (shard.frames_file, shard.scenes_file, *((shard.histograms_file,) if traced else ()))

    def is_traced(self, index: int) -> bool:
        """Whether the photons of a scene are traced."""
        share = self.recipe.monte_carlo.share
        return bool(self.generator(self.split_of(index), "monte_carlo.share", index).random() < share)

    def fraction(self, sample: int) -> float:
        """Backscatter fraction of a sample; NaN where the photon rates decide."""
        levels = self.recipe.frames.backscatter_fraction
        scene = sample // self.frames_per_scene
        if levels == "rates" or self.is_traced(scene):
            return math.nan
        split = self.split_of(scene)
        return float(levels.draw(self.generator(split, "frames.backscatter_fraction", sample)))

    def _shards(self) -> Iterator[Shard]:
        per_target, size = self.recipe.scenes_per_target, self.recipe.scenes_per_shard
        index = 0
        for number, target in enumerate(self.targets):
            for first in range(0, per_target, size):
                yield Shard(index, number, target.split, number * per_target + first, min(size, per_target - first))
                index += 1

    def _export_distance(self, source: TargetSource) -> float:
        return float(np.nanmedian(source.truth(self._template.camera).depth))

    def _depth_code(self) -> tuple[float, float]:
        """Offset and step [m] with which 65 535 codes span every gate that can be drawn, the step a round number."""
        recipe, camera = self.recipe, self._template.camera
        tangent = 0.5 * camera.pixel_tangent * math.hypot(camera.width, camera.height)
        ranges = [self._export_distance(source) for source in self.targets if source.export]
        if len(ranges) < len(self.targets):
            ranges += recipe.pose.distance.limits
        near = max(min(ranges) - recipe.gate.before.limits[1], _SHORTEST_RANGE)
        far = max(ranges) + recipe.gate.behind.limits[1]
        near /= math.hypot(1.0, tangent)
        span = (far - near) / 65534.0
        decade = 10.0 ** math.floor(math.log10(span))
        step = next(decade * digit for digit in (1.0, 2.0, 5.0, 10.0) if decade * digit >= span)
        return math.floor(near / step - 1.0) * step, step


def _with_plume(scene: Scene, plume: Plume, draw: _Draw, distance: float) -> Scene:
    """The scene, in part of the draws with a plume before what is at a distance on the axis [m].

    The optical depth is that of the cells on the axis; a box that does not meet it keeps an extinction of 1/m.
    """
    if draw("plume.probability", UNIFORM) >= plume.probability:
        return scene
    grid = {
        "shape": draw("plume.shape", Distribution(choices=plume.shape)),
        "size": [draw("plume.size", plume.size)],
        "cells": [plume.cells],
        "albedo": draw("plume.albedo", plume.albedo),
        "turbulence": min(draw("plume.turbulence", plume.turbulence), 3.0),
        "seed": int(draw("plume.seed", UNIFORM) * 2**53),
        "translation": [
            draw("plume.shift.x", plume.shift),
            draw("plume.shift.y", plume.shift),
            draw("plume.place", plume.place) * distance,
        ],
        "extinction": 1.0,
    }
    unit = scene.with_overrides({"medium.grid": grid})
    end = (0.0, 0.0, distance)
    added = unit.optical_depth((0.0, 0.0, 0.0), end) - scene.medium.extinction * distance
    if added < 1e-3:
        return unit
    wanted = draw("plume.optical_depth", plume.optical_depth)
    return unit.with_overrides({"medium.grid.extinction": min(wanted / added, 1e6)})


def _word(text: str) -> int:
    return zlib.crc32(text.encode())
