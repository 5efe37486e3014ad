"""Where things may be in a scene: what only the geometry of camera, laser, ports and domain together can tell."""

from __future__ import annotations

import math

import numpy as np

from spadwarp.errors import ConfigError
from spadwarp.scene import Scene
from spadwarp.scene.camera import to_world
from spadwarp.scene.pose import rotation_matrix
from spadwarp.scene.scene import camera_port, laser_port

__all__ = ["check_discs", "check_domain", "check_gate", "config_error"]


def check_domain(scene: Scene, camera: bool) -> None:
    """Refuses a camera or a laser, or the way out of its port, outside the domain."""
    beam = scene.beam
    ways = {"laser.position": (laser_port(scene), beam.position, beam.axis)}
    if camera:
        ways["camera.position"] = (camera_port(scene), (0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    for name, (port, position, axis_of) in ways.items():
        point, slack = np.asarray(position, np.float64), 0.0
        if port is not None:
            # The water begins behind the port, which may be a face of the domain.
            name, slack = f"{name}, its axis behind the port", 1e-6
            point = port.enter(position, axis_of)[0]
            if not np.isfinite(point).all():
                raise config_error(
                    scene, f"{name}: light along the axis does not get through the port: turn the axis or the port"
                )
        for axis, value, low, high in zip(
            "xyz", to_world(scene.camera, point).tolist(), *scene.domain.bounds, strict=True
        ):
            if not low - slack <= value <= high + slack:
                raise config_error(scene, f"{name}: {axis} = {value} is outside [{low}, {high}], the domain")


def check_discs(scene: Scene, camera: bool) -> None:
    """Refuses a lens or a beam that reaches through a face that reflects: beyond it nothing is mirrored."""
    beam, discs = scene.beam, {}
    if beam.profile == "collimated" and laser_port(scene) is None:
        discs["laser.beam_radius"] = (beam.position, beam.axis, beam.beam_radius)
    if camera and camera_port(scene) is None and not scene.camera.pinhole:
        discs["camera.aperture_diameter"] = ((0.0, 0.0, 0.0), (0.0, 0.0, 1.0), scene.camera.aperture_radius)
    for name, (position, axis, radius) in discs.items():
        centre = to_world(scene.camera, np.asarray(position, np.float64))
        across = rotation_matrix(scene.camera.rotation_deg) @ np.asarray(axis, np.float64)
        for face in scene.domain.reflecting:
            k, high = "xyz".index(face[0]), face.endswith("high")
            beyond = radius * math.sqrt(max(1.0 - across[k] ** 2, 0.0)) - abs(scene.domain.bounds[high][k] - centre[k])
            if beyond > 0.0:
                raise config_error(
                    scene, f"{name}: reaches {beyond:.4g} m through {face} of the domain, which has an outside_index"
                )


def check_gate(scene: Scene) -> None:
    """Refuses a gate that begins after the longest path."""
    begin, max_path = scene.gate.start * scene.medium.pulse_speed, scene.transport.max_path
    if max_path is not None and max_path <= begin:
        raise config_error(
            scene, f"transport.max_path = {max_path} m is outside ({begin:g}, inf), the path at which the gate begins"
        )


def config_error(scene: Scene, problem: str) -> ConfigError:
    """The error, with the file of the scene."""
    return ConfigError(problem, source=None if scene.source is None else str(scene.source))
