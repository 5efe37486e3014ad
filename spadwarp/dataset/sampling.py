"""What is in a dataset: its targets and splits, scenes, samples and shards, and how each value is drawn.

Numbers follow from the recipe alone. Scene `j` of target `t` has the index t · scenes_per_target + j, and its frame `k`
the sample id index · frames.per_scene + k. Every value is drawn by Philox with a key of (seed of the split, name of the
value, id): no draw depends on another, on the order, or on which machine makes the shard.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from spadwarp.dataset.distributions import Distribution
from spadwarp.dataset.plumes import with_plume
from spadwarp.dataset.recipe import SPLITS, Recipe
from spadwarp.dataset.targets import TargetSource, check_extents, find_targets
from spadwarp.errors import ConfigError
from spadwarp.scene import Camera, Scene, Trajectory, load_trajectory
from spadwarp.scene.sight import port_advance
from spadwarp.units import time_from_range

__all__ = ["Plan", "SceneDraw", "Shard"]

_SHORTEST_RANGE = 0.05  # [m], the nearest at which a gate opens
_UNIFORM = Distribution(low=0.0, high=1.0)

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
        self.split_seeds = {split: _split_seed(recipe.seed, split) for split in SPLITS}
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
        """Raises `ConfigError` for mesh files that cannot be seen where the recipe puts them."""
        check_extents(self.recipe, self.targets, self._template.camera)

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
            scene = with_plume(scene, recipe.plume, draw, distance)
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
        if draw("backdrop.probability", _UNIFORM) < wall.probability:
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


def _word(text: str) -> int:
    return zlib.crc32(text.encode())


def _split_seed(seed: int, split: str) -> int:
    return int(np.random.SeedSequence([seed, _word(split)]).generate_state(1, np.uint64)[0])
