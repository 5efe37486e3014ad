"""Derivatives of expected light by the place of the targets: differences with the same photons."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from spadwarp.inverse.unknowns import moved
from spadwarp.transport import ExpectedLight, LightTracer

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["DepthDifference"]


class DepthDifference:
    """Derivative by the depth of the targets [1/m], from two runs with the same photons and the targets at ± `step`.

    Args:
        scene: With the targets in the middle.
        step: [m].
        mesh_cache: Meshes of earlier scenes.
        choices: Other arguments of `LightTracer`.
    """

    def __init__(self, scene: Scene, step: float, *, mesh_cache: dict[str, Any], **choices: Any) -> None:
        self._step = step
        self._far, self._near = (
            LightTracer(moved(scene, sign * step), mesh_cache=mesh_cache.setdefault(name, {}), **choices)
            for name, sign in (("far", 1.0), ("near", -1.0))
        )

    def __call__(self, first: int, photons: int) -> ExpectedLight:
        """By the photons `first` … `first + photons`."""
        far, near = (tracer(first, photons)[0] for tracer in (self._far, self._near))
        return ExpectedLight(_slope(far.total, near.total, self._step), _slope(far.target, near.target, self._step))


def _slope(far: Any, near: Any, step: float) -> Any:
    import warp as wp

    if far is None:
        return None
    return wp.array((far.numpy() - near.numpy()) * (0.5 / step), dtype=wp.float32, device=far.device)
