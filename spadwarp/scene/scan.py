"""Scans along a trajectory: when and where each shot is, and what it sees."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import Floats
from spadwarp.scene.camera import pixel_directions
from spadwarp.scene.pose import rotation_angles, rotation_matrix, turned, vector_of
from spadwarp.scene.scene import Scene, load_trajectory
from spadwarp.values import ArgumentError, ConfigError, check_integer

__all__ = ["Shots", "shot_at", "shot_scene", "shots_of"]

_POSE = tuple(f"camera.{name}[{axis}]" for name in ("position", "rotation_deg") for axis in range(3))


@dataclass(frozen=True, eq=False, kw_only=True)
class Shots:
    """The shots of a scan along a trajectory, in the order of its image's rows; R points of a receiver each."""

    time: Floats  # of each shot from the first one on [s], `[N]`
    position: Floats  # of the lens in the world [m], `[N, 3]`
    rotation: Floats  # axes of camera and laser in the world, as columns, `[N, 3, 3]`
    view: Floats  # unit vectors of the receiver's pixels in the camera's frame, `[R, 3]`
    shape: tuple[int, int]  # of the image: N·R pixels

    def __len__(self) -> int:
        return len(self.time)

    @property
    def number(self) -> NDArray[np.int64]:
        """The shot of each pixel, `[H, W]`."""
        return np.repeat(np.arange(len(self)), len(self.view)).reshape(self.shape)

    def lines(self) -> tuple[Floats, Floats]:
        """Where each pixel's line of sight begins in the world [m], and its unit vector, both `[H, W, 3]`."""
        start = np.repeat(self.position, len(self.view), axis=0)
        along = np.einsum("nij,rj->nri", self.rotation, self.view)
        return start.reshape(*self.shape, 3), along.reshape(*self.shape, 3)

    def aside(self, point: Floats) -> Floats:
        """By how far the axis of each shot passes a point of the world [m], `[N]`."""
        to_point, axis = point - self.position, self.rotation[:, :, 2]
        along = np.maximum((to_point * axis).sum(axis=1), 0.0)
        return np.linalg.norm(to_point - along[:, None] * axis, axis=1)


def shots_of(scene: Scene) -> Shots:
    """When and where each shot of a scan along a trajectory is.

    A shot takes `detector.pulses_per_frame` pulses. The platform flies by `scan.velocity`, or as the file `scan.path`
    says: linear in between, attitudes by the shortest turn. The pattern turns the camera's axis in the plane of both
    directions, without a turn of the image about it.

    Raises `ArgumentError`: the scene has no such scan; `FileError` or `ConfigError`: the file of the trajectory cannot
    be read, holds another field than the camera's pose, or ends before the last shot.
    """
    if scene.scan.mode != "trajectory":
        raise ArgumentError(f"scan.mode = {scene.scan.mode!r}; 'trajectory' is needed")
    count, camera = scene.scan_positions, scene.camera
    time: Floats = np.arange(count, dtype=np.float64) * (scene.detector.pulses_per_frame / scene.laser.repetition_rate)
    if scene.scan.path is None:
        position = np.asarray(camera.position) + time[:, None] * np.asarray(scene.scan.velocity)
        platform = np.broadcast_to(rotation_matrix(camera.rotation_deg), (count, 3, 3))
    else:
        position, platform = _platform(scene, time)
    return Shots(
        time=time,
        position=position,
        rotation=platform @ _deflections(scene, count),
        view=pixel_directions(scene.receiver)[0],
        shape=(camera.height, camera.width),
    )


def _platform(scene: Scene, time: Floats) -> tuple[Floats, Floats]:
    """Positions and attitudes by the file of a trajectory; what it lacks is the camera's own."""
    flown = load_trajectory(str(scene.scan.path))
    if other := [name for name in flown.fields if name not in _POSE]:
        raise ConfigError(f"{other[0]} is no part of the camera's pose: {', '.join(_POSE)}", source=flown.source)
    at, last = flown.times[0] + time, float(flown.times[0] + time[-1])
    if last > flown.times[-1]:
        text = f"time = {flown.times[-1]:g} is the last, and the last shot is at {last:g} s"
        raise ConfigError(text, source=flown.source)
    columns = dict(zip(flown.fields, flown.values.T, strict=True))
    own = dict(zip(_POSE, (*scene.camera.position, *scene.camera.rotation_deg), strict=True))
    pose = np.stack([columns.get(name, np.full(len(flown), own[name])) for name in _POSE], axis=1)
    position = np.stack([np.interp(at, flown.times, values) for values in pose[:, :3].T], axis=1)
    return position, turned(at, flown.times, pose[:, 3:])


def _deflections(scene: Scene, count: int) -> Floats:
    """Rotations from the frame of each shot to that of the platform, `[N, 3, 3]`."""
    scan, width = scene.scan, scene.camera.width
    turn = np.arange(count) / width  # rows that have gone by
    azimuth, edge = 2.0 * math.pi * turn, math.tan(math.radians(scan.half_angle_deg))
    x, y = np.zeros(count), np.zeros(count)
    if scan.pattern == "raster":
        part = 2.0 * (np.arange(count) % width + 0.5) / width - 1.0
        x = np.tan(math.radians(scan.half_angle_deg) * part)
    elif scan.pattern in ("conical", "elliptic"):
        along = scan.half_angle_deg if scan.pattern == "conical" else scan.half_angle_y_deg
        x, y = edge * np.cos(azimuth), math.tan(math.radians(along)) * np.sin(azimuth)
    elif scan.pattern == "rosette":
        other = -scan.rosette_ratio * azimuth
        x, y = (0.5 * edge * (of(azimuth) + of(other)) for of in (np.cos, np.sin))
    axis = np.stack([x, y, np.ones(count)], axis=1)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    # By Rodrigues' formula about z × axis, of sine |z × axis| and cosine axis_z.
    cross = np.zeros((count, 3, 3))
    cross[:, 0, 2], cross[:, 1, 2] = axis[:, 0], axis[:, 1]
    cross -= cross.transpose(0, 2, 1)
    return np.eye(3) + cross + cross @ cross / (1.0 + axis[:, 2, None, None])


def shot_scene(scene: Scene, shot: int) -> Scene:
    """The scene of one shot alone: laser and camera stand where they are then.

    Raises `ArgumentError` for a shot that there is not, and what `shots_of` raises.
    """
    shots = shots_of(scene)
    at = check_integer("shot", shot, f"[0, {len(shots) - 1}]")
    receiver = scene.receiver
    pose = {"position": vector_of(shots.position[at]), "rotation_deg": rotation_angles(shots.rotation[at])}
    size = {"width": receiver.width, "height": 1}
    return scene.with_overrides({"camera": {**size, **pose}, "scan": dict.fromkeys(type(scene.scan).model_fields)})


def shot_at(scene: Scene, points: Sequence[Floats]) -> Scene:
    """The scene of the shot, alone and with its part of the photons, whose axis passes nearest to one of some points of
    the world; without points the first."""
    shots, photons = shots_of(scene), scene.transport.photons
    passes = [shots.aside(point) for point in points] or [np.zeros(len(shots))]
    best = min((aside.min(), int(aside.argmin())) for aside in passes)[1]
    share = photons if isinstance(photons, str) else max(photons // scene.scan_positions, 1)
    return shot_scene(scene, best).with_overrides({"transport.photons": share})
