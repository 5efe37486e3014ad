"""Lines of sight of the pixels, through a port if there is one: ranges and depths along them, and times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.scene.geometry import path_from_range, pixel_directions, range_from_path
from spadwarp.scene.port_rays import PortGeometry, camera_port, laser_port
from spadwarp.units import path_from_time

if TYPE_CHECKING:
    from spadwarp.scene import Camera, Scene

__all__ = ["LinesOfSight", "depth_from_time", "depth_per_time", "lines_of_camera", "lines_of_sight", "port_advance"]

Floats = NDArray[np.float64]

# Nearest to a port that is asked for [m], and steps of Newton's method, which has converged after a few.
_LEAST = 1e-9
_STEPS = 30


@dataclass(frozen=True)
class LinesOfSight:
    """Straight lines in the water along which pixels see, and the laser's light that is scattered on them.

    A range is the length along the bent ray from the lens centre, a path the length in water that light needs as long
    for as from the laser by the point to the lens.

    Attributes:
        start: Where the lines begin: the lens centre, or where they leave the port [m], `[..., 3]`.
        direction: Unit vectors, `[..., 3]`.
        lead: Length of the way from the lens centre to the start [m].
        delay: Length in water that takes as long [m].
        laser: Position of the laser [m].
        laser_port: What it shines through.
    """

    start: Floats
    direction: Floats
    lead: Floats
    delay: Floats
    laser: Floats
    laser_port: PortGeometry | None = None

    def __getitem__(self, index: Any) -> LinesOfSight:
        """Those of some pixels."""
        parts = (self.start[index], self.direction[index], self.lead[index], self.delay[index])
        return LinesOfSight(*parts, self.laser, self.laser_port)

    def flat(self) -> LinesOfSight:
        """Those of all pixels in one row, `[P, 3]`."""
        parts = (self.start.reshape(-1, 3), self.direction.reshape(-1, 3), self.lead.ravel(), self.delay.ravel())
        return LinesOfSight(*parts, self.laser, self.laser_port)

    def points(self, distance: ArrayLike) -> Floats:
        """Points in the camera frame at ranges [m]."""
        return self.start + (np.asarray(distance, np.float64) - self.lead)[..., None] * self.direction

    def directions_to(self, distance: Floats) -> Floats:
        """Vectors that, times a range, are the point there: unit vectors without a port."""
        if not self.bent:
            return self.direction
        return self.points(distance) / np.asarray(distance, np.float64)[..., None]

    def depth_from_range(self, distance: Any) -> Any:
        """Depth z [m]."""
        return self.start[..., 2] + (distance - self.lead) * self.direction[..., 2]

    def range_from_depth(self, depth: Any) -> Any:
        """Range [m] at planar depths."""
        return self.lead + (depth - self.start[..., 2]) / self.direction[..., 2]

    def path_from_range(self, distance: ArrayLike) -> Floats:
        """Path [m] at ranges."""
        along = np.asarray(distance, np.float64) - self.lead
        if not self.bent:
            return path_from_range(along, self.direction, self.laser)
        return self._path_to(self.points(distance)) + along + self.delay

    def range_from_path(self, path: ArrayLike) -> Floats:
        """Range [m] at which light has gone a path; NaN where it is too short."""
        if not self.bent:
            return range_from_path(path, self.direction, self.laser)
        left = np.asarray(path, np.float64) - self.delay
        # Lines that begin where the laser's port hides them have no first point.
        least = np.nan_to_num(self._path_to(self.start + _LEAST * self.direction))
        along = np.maximum(0.5 * (left - least), _LEAST)
        for _ in range(_STEPS):
            points = self.start + along[..., None] * self.direction
            light = self._light_to(points)
            # The path rises with the range by 1 + the cosine between both directions of light.
            slope = np.maximum(1.0 + (light * self.direction).sum(axis=-1), 1e-3)
            along = np.maximum(along - (self._path_to(points) + along - left) / slope, _LEAST)
        return np.where(left > least, along, np.nan) + self.lead

    def light_to(self, distance: ArrayLike) -> Floats:
        """Unit vectors in which the light of a laser that is a point comes to ranges."""
        return self._light_to(self.points(distance))

    def light_at(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Of the light of a laser that is a point, at points in the camera frame: unit vectors, the length of its way
        in the water, and the length in water that takes as long as all of its way [m]; NaN where none comes."""
        if self.laser_port is None:
            length = np.linalg.norm(points - self.laser, axis=-1)
            return self._light_to(points), length, length
        inside, light, length, path = self.laser_port.connect(points, self.laser)
        return light, length - self.laser_port.enter(self.laser, inside)[2], path

    @property
    def bent(self) -> bool:
        """Whether there is a port, of camera or laser."""
        return self.laser_port is not None or bool(np.any(self.delay))

    def _path_to(self, points: Floats) -> Floats:
        if self.laser_port is not None:
            return self.laser_port.connect(points, self.laser)[3]
        return np.linalg.norm(points - self.laser, axis=-1)

    def _light_to(self, points: Floats) -> Floats:
        if self.laser_port is not None:
            return self.laser_port.connect(points, self.laser)[1]
        y = points - self.laser
        return y / np.maximum(np.linalg.norm(y, axis=-1, keepdims=True), 1e-300)


def lines_of_sight(scene: Scene, view: Floats | None = None) -> LinesOfSight:
    """Lines of sight of a scene's pixels `[H, W]`, or those that leave the lens centre along unit vectors."""
    view = pixel_directions(scene.camera) if view is None else view
    port, laser = camera_port(scene), np.array(scene.beam.position, np.float64)
    if port is None:
        nothing = np.zeros(view.shape[:-1])
        return LinesOfSight(np.zeros(view.shape), view, nothing, nothing, laser, laser_port(scene))
    start, direction, lead, delay = port.enter(np.zeros(3), view)
    return LinesOfSight(start, direction, lead, delay, laser, laser_port(scene))


def lines_of_camera(camera: Camera) -> LinesOfSight:
    """Those of a camera in the water, with a laser in its lens."""
    view = pixel_directions(camera)
    nothing = np.zeros(view.shape[:-1])
    return LinesOfSight(np.zeros(view.shape), view, nothing, nothing, np.zeros(3))


def port_advance(scene: Scene) -> float:
    """By how much farther light gets along the optical axis through the camera's port than through water in the same
    time [m]; 0 without a port."""
    axis = lines_of_sight(scene, np.array([0.0, 0.0, 1.0]))
    return float(axis.lead - axis.delay)


def depth_from_time(time: Floats, *, scene: Scene) -> Floats:
    """Planar depth [m] at which light of a time of flight [s] was reflected; both `[..., H, W]`."""
    lines = lines_of_sight(scene)
    return lines.depth_from_range(lines.range_from_path(path_from_time(time, scene.medium.group_index)))


def depth_per_time(scene: Scene, distance: Floats, view: Floats | None = None) -> Floats:
    """dz/dt at ranges along the lines of sight, `[H, W]` [m/s], or along those of unit vectors `view`."""
    beam = scene.beam
    axis: Floats | None = None
    if beam.profile == "collimated":
        port = laser_port(scene)
        axis = np.array(beam.axis) if port is None else port.enter(beam.position, beam.axis)[1]
    lines = lines_of_sight(scene, view)
    light = lines.light_to(distance) if axis is None else axis
    # The path rises with the range by 1 + the cosine between both directions of light.
    return scene.medium.pulse_speed / (1.0 + (light * lines.direction).sum(axis=-1)) * lines.direction[..., 2]
