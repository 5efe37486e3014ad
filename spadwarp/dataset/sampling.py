"""Who is who in a dataset: targets and splits, scenes, samples, shards, and what each is drawn from.

Numbers follow from the recipe alone. Scene `j` of target `t` has the index t · scenes_per_target + j, and its frame `k`
the sample id index · frames.per_scene + k. Every value is drawn from (seed of the split, what it is, id) by Philox: no
draw depends on another, on the order, or on which machine makes the shard.
"""

from __future__ import annotations

import math
import zlib
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from spadwarp.dataset.recipe import SPLITS, Distribution, Recipe
from spadwarp.dataset.targets import find_targets
from spadwarp.scene import Scene
from spadwarp.scene.renamed import former_path
from spadwarp.units import time_from_range

__all__ = ["Plan", "SceneDraw", "Shard"]

_SHORTEST_RANGE = 0.05  # [m], where a gate opens at the nearest


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
    """One scene as it was drawn; its exposure is found later where it hangs on the light that comes back.

    Attributes:
        index: Of the scene.
        target: Index into `Plan.targets`.
        scene: Without the pulses of `signal_photons`.
        distance: Of the target's centre [m].
        attenuation_lengths: Extinction times distance.
        signal_photons: Of the median pixel; None where the scene's pulses hold.
        fractions: BS of each frame; NaN where the photon rates say, as they do where photons are traced.
        photons: To trace; None for the analytic model.
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
        self.split_seeds = {split: int(_seeds([recipe.seed, _word(split)], 1)[0]) for split in SPLITS}
        self.frames_per_scene = recipe.frames.per_scene
        self.scene_count = len(self.targets) * recipe.scenes_per_target
        self.sample_count = self.scene_count * self.frames_per_scene
        self.shards = tuple(self._shards())
        self._template = template = recipe.template()
        self.shape = (template.camera.height, template.camera.width)
        self._tables = template.to_dict()
        self.depth_offset, self.depth_step = self._depth_code(template)

    def split_of(self, scene_index: int) -> str:
        """The split of a scene."""
        return self.targets[scene_index // self.recipe.scenes_per_target].split

    def generator(self, split: str, what: str, index: int) -> np.random.Generator:
        """The random numbers of one value of one scene or sample."""
        return np.random.Generator(
            np.random.Philox(np.random.SeedSequence([self.split_seeds[split], _word(what), index]))
        )

    def scene(self, index: int) -> SceneDraw:
        """Draws a scene."""
        recipe, split = self.recipe, self.split_of(index)
        target = self.targets[index // recipe.scenes_per_target]

        def draw(what: str, distribution: Distribution) -> Any:
            return distribution.draw(self.generator(split, what, index))

        pose = recipe.pose
        if target.export is None:
            distance = draw("pose.distance", pose.distance)
        else:
            depth = target.truth(self._template.camera, recipe.targets.export_preset).depth
            distance = float(np.nanmedian(depth))
        changes = {name: draw(f"vary.{former_path(name)}", one) for name, one in recipe.vary.items()}
        scene = Scene.from_dict(self._tables, source=recipe.source).with_overrides(changes)
        if recipe.water.attenuation_lengths is not None:
            lengths = draw("water.attenuation_lengths", recipe.water.attenuation_lengths)
            scene = scene.with_overrides({"medium.extinction": lengths / distance})
        else:
            lengths = scene.medium.extinction * distance

        placed = {
            "translation": [draw("pose.shift.x", pose.shift), draw("pose.shift.y", pose.shift), distance],
            "rotation_deg": [
                draw(f"pose.{name}", getattr(pose, name)) for name in ("pitch_deg", "yaw_deg", "roll_deg")
            ],
            "reflectance": draw("pose.reflectance", pose.reflectance),
            "scale": draw("pose.size", pose.size),
        }
        targets = []
        if target.export is None:
            fill = None if pose.fill is None else draw("pose.fill", pose.fill)
            size = recipe.targets.mesh_size
            targets = [target.placed(placed, longest=size, fill=fill, camera=scene.camera)]
        wall = recipe.backdrop
        if targets and self.generator(split, "backdrop.probability", index).random() < wall.probability:
            behind = draw("backdrop.behind", wall.behind)
            wide = 4.0 * (distance + behind) * scene.camera.pixel_tangent * max(scene.camera.width, scene.camera.height)
            tilt = [draw("backdrop.tilt.x", wall.tilt_deg), draw("backdrop.tilt.y", wall.tilt_deg), 0.0]
            targets.append(
                {
                    "builtin": "plane",
                    "size": [wide, wide],
                    "rotation_deg": tilt,
                    "translation": [0.0, 0.0, distance + behind],
                    "reflectance": draw("backdrop.reflectance", wall.reflectance),
                }
            )

        window = recipe.gate
        near = max(distance - draw("gate.before", window.before), _SHORTEST_RANGE)
        far = distance + draw("gate.behind", window.behind)
        group_index = scene.medium.group_index
        gate = {
            "start_ns": time_from_range(near, group_index) * 1e9,
            "bin_width_ps": time_from_range(far - near, group_index) / window.bins * 1e12,
            "bins": window.bins,
        }
        exposure = recipe.exposure
        signal = None if exposure.signal_photons is None else draw("exposure.signal", exposure.signal_photons)
        analytic = scene.analytic.to_dict()
        if exposure.pulses_per_depth_frame is not None:
            analytic["pulses_per_depth_frame"] = max(1, round(draw("exposure.pulses", exposure.pulses_per_depth_frame)))
        first = index * self.frames_per_scene
        return SceneDraw(
            index=index,
            target=index // recipe.scenes_per_target,
            scene=Scene.from_dict({**scene.to_dict(), "gate": gate, "targets": targets, "analytic": analytic}),
            distance=float(distance),
            attenuation_lengths=float(lengths),
            signal_photons=signal,
            fractions=tuple(self.fraction(first + k) for k in range(self.frames_per_scene)),
            photons=recipe.monte_carlo.photons if self.is_traced(index) else None,
            seed=int(self.generator(split, "photons", index).integers(2**63)),
        )

    def files_of(self, shard: Shard) -> tuple[str, ...]:
        """Names of a shard's files: frames, scenes, and histograms where photons are traced."""
        traced = self.recipe.monte_carlo.share > 0 and any(map(self.is_traced, shard.indices))
        return (shard.frames_file, shard.scenes_file, *((shard.histograms_file,) if traced else ()))

    def is_traced(self, index: int) -> bool:
        """Whether the photons of a scene are traced."""
        share = self.recipe.monte_carlo.share
        return bool(self.generator(self.split_of(index), "monte_carlo.share", index).random() < share)

    def fraction(self, sample: int) -> float:
        """BS of a sample; NaN where the photon rates say."""
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

    def _depth_code(self, template: Scene) -> tuple[float, float]:
        """Offset and step [m] with which 65 535 codes span every gate that can be drawn, the step a round number."""
        recipe = self.recipe
        tangent = 0.5 * template.camera.pixel_tangent * math.hypot(template.camera.width, template.camera.height)
        ranges = [] if all(one.export for one in self.targets) else list(recipe.pose.distance.limits)
        for one in self.targets:
            if one.export is not None:
                ranges.append(float(np.nanmedian(one.truth(template.camera, recipe.targets.export_preset).depth)))
        near = max(min(ranges) - recipe.gate.before.limits[1], _SHORTEST_RANGE)
        far = max(ranges) + recipe.gate.behind.limits[1]
        near /= math.hypot(1.0, tangent)
        span = (far - near) / 65534.0
        decade = 10.0 ** math.floor(math.log10(span))
        step = next(decade * one for one in (1.0, 2.0, 5.0, 10.0) if decade * one >= span)
        return math.floor(near / step - 1.0) * step, step


def _word(text: str) -> int:
    return zlib.crc32(text.encode())


def _seeds(entropy: list[int], count: int) -> np.ndarray:
    return np.random.SeedSequence(entropy).generate_state(count, np.uint64)
