"""Expected light and its derivatives: scored along the photons' histories, or as differences of moved targets."""

from __future__ import annotations

import warnings
from collections.abc import Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.inverse.unknowns import moved
from spadwarp.result import Result
from spadwarp.transport import simulate

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["Light", "central_difference", "traced"]

Rows = NDArray[np.float32]


class Light(NamedTuple):
    """Expected detections per pulse, float32 `[pixel, bin]`: of all light, and of the targets' alone."""

    total: Rows
    target: Rows | None


def traced(scene: Scene, names: Sequence[str], *, apart: bool, **run: Any) -> tuple[Result, Light, dict[str, Light]]:
    """A run of a scene: its result, its light, and the derivatives of this by `names` with the same photons.

    `apart`: also the light of the targets alone; `run`: arguments of `simulate`.
    """
    result = _run(scene, derivatives=list(names), **run) if names else _run(scene, **run)
    rate = _detections(result)
    slopes: dict[str, Light] = {}
    if names:
        stored = result.derivative_tallies
        assert stored is not None
        for name, tallies, unit in zip(stored.names, stored.tallies, stored.units, strict=True):
            slopes[name] = _light(tallies, rate * (unit / result.unit), apart=apart)
    return result, _light(result.tallies, rate, apart=apart), slopes


def central_difference(scene: Scene, step: float, *, kept: dict[str, Any], apart: bool, **run: Any) -> Light:
    """Derivative by the depth of the targets [1/m], from two runs with the same photons and the targets at ± `step`."""
    sides = []
    for sign in (1.0, -1.0):
        place: dict[str, Any] = kept.setdefault("near" if sign < 0 else "far", {})
        result = _run(moved(scene, sign * step), kept=place, **run)
        sides.append(_light(result.tallies, _detections(result), apart=apart))
    far, near = sides
    half = np.float32(0.5 / step)
    target = None if far.target is None or near.target is None else (far.target - near.target) * half
    return Light((far.total - near.total) * half, target)


def _detections(result: Result) -> NDArray[np.float64]:
    """Expected detections per pulse for each tally unit, `[pixel, 1]`."""
    scene = result.scene
    return result.tally_value.reshape(-1, 1) * (scene.laser.photons_per_pulse * scene.detections_per_photon)


def _run(scene: Scene, **run: Any) -> Result:
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of rounding in faint components, once an iteration
        return simulate(scene, **run)


def _light(tallies: NDArray[np.int64], rate: NDArray[np.float64], *, apart: bool) -> Light:
    """Rows of tallies `[component, H, W, T]`; the first two components are of the targets."""
    bins = tallies.shape[-1]

    def rows(part: NDArray[np.int64]) -> Rows:
        return (part.sum(axis=0).reshape(-1, bins) * rate).astype(np.float32)

    if not apart:
        return Light(rows(tallies), None)
    target = rows(tallies[:2])
    return Light(target + rows(tallies[2:]), target)
