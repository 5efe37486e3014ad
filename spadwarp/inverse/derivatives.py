"""Derivatives of expected light by the place of the targets: differences with the same photons."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

from spadwarp.inverse.unknowns import moved
from spadwarp.transport import ExpectedLight, LightTracer

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["central_difference"]


def central_difference(
    scene: Scene, step: float, *, first: int, photons: int, kept: dict[str, Any], **choices: Any
) -> ExpectedLight:
    """Derivative by the depth of the targets [1/m], from two runs with the same photons and the targets at ± `step`.

    `choices`: arguments of `LightTracer`.
    """
    far, near = (
        LightTracer(moved(scene, sign * step), photons=photons, kept=kept.setdefault(name, {}), **choices)(
            first, photons
        )[0]
        for name, sign in (("far", 1.0), ("near", -1.0))
    )
    return ExpectedLight(_slope(far.total, near.total, step), _slope(far.target, near.target, step))


def _slope(far: Any, near: Any, step: float) -> Any:
    import warp as wp

    if far is None:
        return None
    return wp.array((far.numpy() - near.numpy()) * (0.5 / step), dtype=wp.float32, device=far.device)
