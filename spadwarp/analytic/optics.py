"""What camera and laser of a scene are behind: for the analytic kernels, and what it does to the beam."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any, NamedTuple

from spadwarp.analytic.eye_safety import EyeLimit, axis_fluence, eye_limit
from spadwarp.scene.scene import camera_port, laser_port
from spadwarp.transport.model import port_kind, port_parameters

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["SceneOptics", "as_if_bare", "beam_axis_fluence", "scene_eye_limit", "scene_optics"]


class SceneOptics(NamedTuple):
    """Optics of the kernels, and the parameters of the ports."""

    optics: Any
    ports: Any


def scene_optics(scene: Scene) -> SceneOptics:
    """Those of a scene. Raises `ConfigError` for a lens or a laser that reaches through its port."""
    from spadwarp_kernels import analytic as kernels

    camera, laser = camera_port(scene), laser_port(scene)
    ports: Any = kernels.Ports()
    if camera is not None:
        radius = 0.0 if scene.camera.pinhole else scene.camera.aperture_radius
        ports.camera = port_parameters(scene, camera, (0.0, 0.0, 0.0), radius, 0.0)
    if laser is not None:
        ports.laser = port_parameters(scene, laser, scene.beam.position, 0.0, 0.0)
    return SceneOptics(kernels.make_optics(port_kind(camera), port_kind(laser)), ports)


def as_if_bare(scene: Scene, distance: float) -> float:
    """The distance [m] at which the middle of the beam has the irradiance that it has at a distance behind the laser's
    port, if there were none: there it is narrower, and a little light is reflected."""
    port, beam = laser_port(scene), scene.beam
    if port is None or beam.profile == "collimated":
        return distance
    lead = float(port.enter(beam.position, beam.axis)[2])
    return 1.0 / math.sqrt(port.spread(beam.position, beam.axis, max(distance, lead + 1e-6)))


def beam_axis_fluence(scene: Scene, distance: float) -> float:
    """`axis_fluence` of a scene's laser, behind its port if it has one [1/m²]."""
    return axis_fluence(scene.laser, as_if_bare(scene, distance))


def scene_eye_limit(scene: Scene, *, distance: float, exposure: float) -> EyeLimit:
    """`eye_limit` of a scene's laser, for an eye in the water if the laser is behind a port."""
    limit = eye_limit(scene.laser, distance=as_if_bare(scene, distance), exposure=exposure)
    if laser_port(scene) is None:
        return limit
    hazard = limit.hazard_distance
    if 0.0 < hazard < math.inf and scene.beam.profile != "collimated":
        low, high = 1e-6, 1e9
        for _ in range(80):
            middle = math.sqrt(low * high)
            low, high = (middle, high) if as_if_bare(scene, middle) < hazard else (low, middle)
        hazard = high
    return dataclasses.replace(limit, distance=distance, hazard_distance=hazard)
