"""Random plumes between camera and target, as augmentation."""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import BeforeValidator, Field

from spadwarp.dataset.distributions import Distribution, NotNegative, Positive, Real, Share, Table, constant
from spadwarp.scene import Scene
from spadwarp.scene.sections import Whole, listed

__all__ = ["Plume", "with_plume"]

Shape = Literal["cloud", "plume", "sediment"]

_SEEDS = Distribution(low=0.0, high=1.0)


class Plume(Table):
    """Suspended matter between camera and target in part of the scenes."""

    probability: float = Field(0.0, ge=0, le=1, description="part of the scenes that have one")
    shape: Annotated[tuple[Shape, ...], BeforeValidator(listed), Field(min_length=1)] = Field(
        ("cloud", "plume", "sediment"), description="shapes of medium.grid, equally likely"
    )
    optical_depth: Positive = Field(constant(1.0), description="that it adds on the optical axis, one way")
    place: Share = Field(
        Distribution(low=0.3, high=0.8), description="of its middle, as part of the distance of the target's centre"
    )
    shift: Real = Field(constant(0.0), description="sideways, drawn for x and for y [m]")
    size: Positive = Field(constant(1.0), description="edge of its box [m]")
    albedo: Share = Field(constant(0.8), description="single-scattering albedo of its matter")
    turbulence: NotNegative = Field(
        constant(0.5), description="standard deviation of the logarithm of its density, up to 3"
    )
    cells: Whole = Field(32, ge=1, le=256, description="cells along the edges of its box")


def with_plume(scene: Scene, plume: Plume, draw: Callable[[str, Distribution | None], Any], distance: float) -> Scene:
    """The scene, in part of the draws with a plume before what is at a distance on the axis [m].

    The optical depth is that of the cells on the axis; a box that does not meet it keeps an extinction of 1/m.
    """
    if draw("plume.probability", _SEEDS) >= plume.probability:
        return scene
    grid = {
        "shape": draw("plume.shape", Distribution(choices=plume.shape)),
        "size": [draw("plume.size", plume.size)],
        "cells": [plume.cells],
        "albedo": draw("plume.albedo", plume.albedo),
        "turbulence": min(draw("plume.turbulence", plume.turbulence), 3.0),
        "seed": int(draw("plume.seed", _SEEDS) * 2**53),
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
