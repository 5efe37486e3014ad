"""The plan of a dataset: its targets and splits, scenes, samples and shards, and how each value is drawn.

Numbers follow from the recipe alone. Scene `j` of target `t` has the index t · scenes_per_target + j, and its frame `k`
the sample id index · frames.per_scene + k. Every value is drawn by Philox with a key of (seed of the split, name of the
value, id): no draw depends on another, on the order, or on which machine makes the shard.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.dataset.recipe import SPLITS, UNIFORM, Distribution, Plume, Recipe, Targets
from spadwarp.io.paths import similar
from spadwarp.mesh import BUILTINS, builtin_names, load_target
from spadwarp.mesh.files import USD_ENDINGS
from spadwarp.mesh.targets import placement
from spadwarp.result import Truth, load_truth_exr
from spadwarp.scene import Camera, Scene, Target, Trajectory, load_trajectory
from spadwarp.scene.pose import rotation_angles
from spadwarp.scene.sight import port_advance
from spadwarp.values import ConfigError, FileError, MeshError, suggestion, time_from_range

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
    """A target of a dataset."""

    name: str  # of the built-in shape, or of the file without its ending
    split: str  # "train", "validation" or "test"
    mesh: Path | None  # the mesh file
    export: Path | None  # the engine's depth map; a built-in shape has neither
    chosen: Targets  # how the recipe scales and turns mesh files, and which program wrote the depth map

    def placed(self, pose: dict[str, Any], *, fill: float | None, camera: Camera) -> dict[str, Any]:
        """The fields of a scene's target, its centre at the pose's translation, scaled as the recipe asks.

        Args:
            pose: `translation`, `rotation_deg`, `scale`, `reflectance`.
            fill: Part of the view that the target fills; replaces `scale`.
            camera: Whose view.
        """
        if self.mesh is None and fill is None:
            return {"builtin": self.name, **pose}
        lower, upper = _bounds(self.name, self.mesh)
        upright = np.eye(3) if self.mesh is None else _UPRIGHT[self.chosen.orientation]
        scale = pose["scale"] * self.metres_per_unit
        if fill is not None:
            view = pose["translation"][2] * camera.pixel_tangent * np.array([camera.width, camera.height])
            scale = fill * float((view / np.abs(upright @ (upper - lower))[:2]).min())
        if self.mesh is None:
            return {"builtin": self.name, **pose, "scale": scale}
        matrix = placement(np.full(3, scale), pose["rotation_deg"], (0.0, 0.0, 0.0))[:3, :3] @ upright
        shift = np.asarray(pose["translation"]) - matrix @ (0.5 * (lower + upper))
        turned = {"scale": scale, "translation": shift.tolist()}
        if self.chosen.orientation != "camera":
            turned["rotation_deg"] = list(rotation_angles(matrix / scale))
        return {"mesh": str(self.mesh), **pose, **turned}

    @property
    def sides(self) -> NDArray[np.float64]:
        """Extent in the units of its file, `[3]`."""
        lower, upper = _bounds(self.name, self.mesh)
        return upper - lower

    @property
    def metres_per_unit(self) -> float:
        """Scale before the pose."""
        if self.mesh is None:
            return 1.0
        size = self.chosen.mesh_size
        return self.chosen.mesh_scale if size is None else size / float(self.sides.max())

    def truth(self, camera: Camera) -> Truth:
        """The truth maps of an `export`, with normals and colours where their files lie beside it."""
        assert self.export is not None
        return _exported(self.export, self.chosen.export_preset, camera)


@cache
def _bounds(name: str, mesh: Path | None) -> NDArray[np.float64]:
    """Lowest and highest corner, `[2, 3]`."""
    target = Target(builtin=name) if mesh is None else Target(mesh=str(mesh))
    return np.asarray(load_target(target).bounds, np.float64)


@cache
def _exported(path: Path, preset: Literal["unreal", "blender"], camera: Camera) -> Truth:
    normal, albedo = (path.with_name(path.name.replace(_DEPTH_ENDING, end)) for end in (_NORMAL_ENDING, _ALBEDO_ENDING))
    return load_truth_exr(
        depth=path,
        camera=camera,
        preset=preset,
        normal=normal if normal.is_file() else None,
        albedo=albedo if albedo.is_file() else 0.5,
    )


def find_targets(recipe: Recipe) -> tuple[TargetSource, ...]:
    """The targets of a recipe in order.

    Raises `ConfigError` for names that are unknown or given twice, `MeshError` and `FileError` for missing files.
    """
    chosen, known, problems = recipe.targets, builtin_names(), []
    names = [] if chosen.meshes or chosen.exports else [n for n in known if n not in BUILTINS or n == "staircase"]
    if chosen.builtin != "all":
        names, listed = list(chosen.builtin), ", ".join(map(repr, known))
        wrong = [f"{name!r} is not one of {listed}{suggestion(name, known)}" for name in names if name not in known]
        problems += [f"targets.builtin: {text}" for text in wrong]
    sources: dict[str, tuple[Path | None, Path | None]] = dict.fromkeys(names, (None, None))
    meshes = [(path.stem, (path, None)) for path in _files(chosen.meshes, "", _MESH_ENDINGS, MeshError)]
    exports = [
        (path.stem.removesuffix(_DEPTH_ENDING), (None, path))
        for path in _files(chosen.exports, _DEPTH_ENDING, (".exr",), FileError)
    ]
    for name, files in (*meshes, *exports):
        if name in sources:
            problems.append(f"targets: {files[0] or files[1]}: there is already a target {name!r}")
        sources[name] = files
    splits = dict.fromkeys(sources, "train")
    for split in ("validation", "test"):
        for name in getattr(chosen, split):
            if name not in splits:
                listed = f"{', '.join(map(repr, splits))}{suggestion(name, [*splits])}"
                problems.append(f"targets.{split}: {name!r} is not one of the dataset's targets, {listed}")
            elif splits[name] != "train":
                problems.append(f"targets.{split}: {name!r} is already in {splits[name]}")
            else:
                splits[name] = split
    if not sources:
        problems.append("targets: none are given")
    if chosen.exports and recipe.monte_carlo.share > 0:
        problems.append("monte_carlo.share: photons need meshes; targets.exports are depth maps")
    _refuse(problems, recipe.source)
    return tuple(TargetSource(name, splits[name], *files, chosen) for name, files in sources.items())


def _files(
    places: Sequence[str], ending: str, suffixes: Sequence[str], error: type[MeshError | FileError]
) -> Iterator[Path]:
    """The files of these folders whose names end so, and the files that are named themselves."""
    for path in map(Path, places):
        files = [path] if path.is_file() else sorted(path.iterdir()) if path.is_dir() else []
        found = [one for one in files if one == path or (one.stem.endswith(ending) and one.suffix.lower() in suffixes)]
        if not found:
            what = "mesh file" if not ending else f"file *{ending}.EXR"
            problem = f"no {what} there" if path.exists() else f"no such file or folder{similar(path)}"
            raise error(f"targets.{'exports' if ending else 'meshes'} = {path}: {problem}")
        yield from found


def _refuse(problems: Sequence[str], source: Path | str | None) -> None:
    if problems:
        raise ConfigError(list(problems), source=None if source is None else str(source))


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
    def frames_file(self) -> str:
        return f"frames-{self.index:05d}.h5"

    @property
    def scenes_file(self) -> str:
        return f"scenes/scenes-{self.index:05d}.h5"

    @property
    def indices(self) -> range:
        """Of its scenes."""
        return range(self.first_scene, self.first_scene + self.scenes)


@dataclass(frozen=True)
class SceneDraw:
    """One scene as it was drawn; an exposure that depends on the light that returns is found later."""

    index: int  # of the scene
    target: int  # index into `Plan.targets`
    source: TargetSource  # that target
    scene: Scene  # the scene; where `signal_photons` is given, its number of pulses is not final
    distance: float  # of the target's centre [m]
    attenuation_lengths: float  # extinction times distance
    signal_photons: float | None  # of the median pixel, which decides the pulses; None: those of the scene
    fractions: tuple[float, ...]
    """Backscatter fraction of each frame; NaN where the photon rates decide, as with traced photons."""
    photons: int | Literal["auto"] | None  # to trace; None for the analytic model
    seed: int  # of photons and camera
    split_seed: int  # of the frames of the analytic model, together with their sample ids

    @property
    def samples(self) -> NDArray[np.int64]:
        """Ids of its frames."""
        count = len(self.fractions)
        return np.arange(self.index * count, (self.index + 1) * count)

    @property
    def frame_seed(self) -> int:
        """Key of its frames' random numbers."""
        return self.split_seed if self.photons is None else self.seed


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
        self._moves = self._trajectory() if recipe.trajectory else None
        self.depth_offset, self.depth_step = self._depth_code()

    def check_targets(self) -> None:
        """Raises `ConfigError` that names each mesh file, and its extent, that is too large or too small to be seen
        where the recipe puts it."""
        recipe, pixel = self.recipe, self._template.camera.pixel_tangent
        (nearest, farthest), (smallest, largest) = recipe.pose.distance.limits, recipe.pose.size.limits
        advice = "in another unit? targets.mesh_scale is metres per unit, targets.mesh_size the longest side"
        problems = []
        for target in self.targets if recipe.pose.fill is None else ():
            if target.mesh is None:
                continue
            sides, wrong = target.sides * target.metres_per_unit, ""
            if 0.5 * largest * float(np.linalg.norm(sides)) >= nearest:
                wrong = f"reaches the camera from pose.distance = {nearest:g} m"
            elif smallest * float(sides.max()) < farthest * pixel:
                wrong = f"less than a pixel at pose.distance = {farthest:g} m"
            if wrong:
                extent = " x ".join(f"{side:.4g}" for side in sides)
                problems.append(f"targets.meshes: {target.mesh}: {extent} m: {wrong}; {advice}")
        _refuse(problems, recipe.source)

    def split_of(self, scene_index: int) -> str:
        """The split of a scene."""
        return self.targets[scene_index // self.recipe.scenes_per_target].split

    def generator(self, split: str, field: str, index: int) -> np.random.Generator:
        """The random numbers of one value, named by `field`, of one scene or sample."""
        key = np.random.SeedSequence([self.split_seeds[split], _word(field), index])
        return np.random.Generator(np.random.Philox(key))

    def scene(self, index: int) -> SceneDraw:
        """Draws a scene."""
        recipe, pose, split = self.recipe, self.recipe.pose, self.split_of(index)
        number = index // recipe.scenes_per_target
        source = self.targets[number]

        def draw(field: str, distribution: Distribution | None) -> Any:
            return None if distribution is None else distribution.draw(self.generator(split, field, index))

        distance = self._export_distance(source) if source.export else float(draw("pose.distance", pose.distance))
        changes = {name: draw(f"vary.{name}", values) for name, values in recipe.vary.items()}
        scene = Scene.from_dict(self._tables, source=recipe.source).with_overrides(changes)
        if (lengths := draw("water.attenuation_lengths", recipe.water.attenuation_lengths)) is not None:
            scene = scene.with_overrides({"medium.extinction": lengths / distance})
        else:
            lengths = scene.medium.extinction * distance
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
            source=source,
            scene=scene,
            distance=distance,
            attenuation_lengths=float(lengths),
            signal_photons=draw("exposure.signal", recipe.exposure.signal_photons),
            fractions=tuple(self.fraction(first + k) for k in range(self.frames_per_scene)),
            photons=recipe.monte_carlo.photons if self.is_traced(index) else None,
            seed=int(self.generator(split, "photons", index).integers(2**63)),
            split_seed=self.split_seeds[split],
        )

    def _trajectory(self) -> Trajectory:
        """Raises `ConfigError` for one that is too short, or that moves what a recipe draws."""
        moves = load_trajectory(self.recipe.trajectory)
        own = ("camera.width", "camera.height", "gate.", "analytic.")
        drawn = [name for name in moves.fields if name.startswith(own)]
        problems = [f"{name} is not for a trajectory: the recipe draws it" for name in drawn]
        if len(moves) < self.recipe.scenes_per_target:
            problems.append(f"{len(moves)} rows are fewer than scenes_per_target = {self.recipe.scenes_per_target}")
        if any(target.export for target in self.targets):
            problems.append("targets.exports are depth maps, which do not move")
        _refuse(problems, moves.source)
        return moves

    def _targets(self, draw: _Draw, source: TargetSource, distance: float, camera: Camera) -> list[dict[str, Any]]:
        """The target and, in part of the scenes, the wall behind it."""
        pose, wall = self.recipe.pose, self.recipe.backdrop
        placed = {
            "translation": [draw("pose.shift.x", pose.shift), draw("pose.shift.y", pose.shift), distance],
            "rotation_deg": [
                draw(f"pose.{name}_deg", getattr(pose, f"{name}_deg")) for name in ("pitch", "yaw", "roll")
            ],
            "reflectance": draw("pose.reflectance", pose.reflectance),
            "scale": draw("pose.size", pose.size),
        }
        fill = draw("pose.fill", pose.fill)
        targets = [source.placed(placed, fill=fill, camera=camera)]
        if draw("backdrop.probability", UNIFORM) < wall.probability:
            behind = distance + draw("backdrop.behind", wall.behind)
            side = 4.0 * behind * camera.pixel_tangent * max(camera.width, camera.height)
            backdrop = {
                "builtin": "plane",
                "size": [side, side],
                "rotation_deg": [*(draw(f"backdrop.tilt.{axis}", wall.tilt_deg) for axis in "xy"), 0.0],
                "translation": [0.0, 0.0, behind],
                "reflectance": draw("backdrop.reflectance", wall.reflectance),
            }
            targets.append(backdrop)
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
        return (shard.frames_file, shard.scenes_file, *((f"histograms-{shard.index:05d}.h5",) if traced else ()))

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
        parts = [(number, first) for number in range(len(self.targets)) for first in range(0, per_target, size)]
        for index, (number, first) in enumerate(parts):
            scenes, split = min(size, per_target - first), self.targets[number].split
            yield Shard(index, number, split, number * per_target + first, scenes)

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
            *(draw(f"plume.shift.{axis}", plume.shift) for axis in "xy"),
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
