"""The largest range at which a plane square to the optical axis is measured with the depth error asked for."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING

import numpy as np

from spadwarp.analytic.exposure_proposal import Progress, Question, propose_exposure
from spadwarp.analytic.gate_proposal import propose_gate
from spadwarp.analytic.photon_budget import axis_line
from spadwarp.errors import ConfigError
from spadwarp.scene.camera import to_world

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["largest_range", "with_plane"]

_FARTHEST = 200.0  # [m]
_STEP, _RESOLUTION = 1.35, 1.03  # of the search, as ratios


def with_plane(scene: Scene, distance: float) -> Scene:
    """The scene with a plane square to the optical axis as its only target, larger than the view and the beam, at a
    range on the axis."""
    camera = scene.camera
    given = scene.targets[0].reflectance if scene.targets else 0.5
    widest = max(abs(edge) for edge in camera.view_box)
    if scene.laser.profile != "collimated":
        widest = max(widest, math.tan(min(scene.laser.half_angle, math.radians(80.0))))
    offset = max(map(abs, scene.beam.position)) + scene.laser.beam_radius
    side = 2.4 * (distance * widest + offset)
    point = axis_line(scene).points(distance)[0]  # A tilted port bends the axis.
    side += 2.0 * float(np.abs(point[:2]).max())
    place = to_world(camera, point) if camera.is_posed else point
    plane = {
        "builtin": "plane",
        "size": [side, side],
        "translation": [float(x) for x in place],
        "rotation_deg": list(camera.rotation_deg),
        "reflectance": 0.5 if given == "from_file" else given,
    }
    return scene.with_overrides({"targets": [plane]})


def largest_range(
    scene: Scene, start: float, question: Question, photons: int, progress: Progress | None
) -> tuple[float, str]:
    """The largest range [m], to 3 %, and what limits it there; sought from `start` on, 0 where there is none.

    The repetition rate and the pulse energy are the scene's, the gate follows the plane.
    """
    question = dataclasses.replace(question, full_power=False)
    reason = ""

    def is_reached(distance: float) -> bool:
        nonlocal reason
        if distance <= axis_line(scene).lead[0]:
            reason = "the port"
            return False
        if progress is not None:
            progress(f"a plane at {distance:.3g} m", 0, 0)
        there = with_plane(scene, distance)
        gate = propose_gate(there, (distance, distance), question.margin)
        if scene.detector.wrap and gate.largest_rate < scene.laser.repetition_rate:
            reason = "repetition rate"
            return False
        try:
            exposure = propose_exposure(there, gate, question, photons, even=True)
        except ConfigError:
            reason = "no light of the target"
            return False
        if not exposure.reached:
            reason = exposure.limit
        return exposure.reached

    low, high = (start, 0.0) if is_reached(start) else (0.0, start)
    while not (low and high):
        distance = low * _STEP if low else high / _STEP
        if distance > _FARTHEST:
            return low, "not sought beyond 200 m"
        if distance < start / 40.0:
            return 0.0, reason
        low, high = (distance, high) if is_reached(distance) else (low, distance)
    while high / low > _RESOLUTION:
        middle = math.sqrt(low * high)
        low, high = (middle, high) if is_reached(middle) else (low, middle)
    return low, reason
