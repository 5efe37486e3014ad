"""Lines of sight of pixels: times, ranges and depths along them, and the view and the beam as regions.

The one place for all conversions between time of flight, path, range and depth in the camera frame. The path of light
goes from the laser by the target to the lens; the range runs along a pixel's line of sight, the depth along the optical
axis (z).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from spadwarp.arrays import Floats
from spadwarp.scene.camera import Camera, pixel_directions, to_camera, to_world
from spadwarp.scene.laser import Laser, profile_axes, profile_extent
from spadwarp.scene.port import PortGeometry
from spadwarp.scene.pose import rotation_matrix, vector_of
from spadwarp.scene.scene import Scene, camera_port, laser_port, shots_of
from spadwarp.scene.sea import Surface
from spadwarp.values import path_from_time

# Nearest to a port that is asked for [m], and steps of Newton's method, which has converged after a few.
_LEAST = 1e-9
_STEPS = 30
_GAUSSIAN_EDGE = 1.5  # tan of the outermost angle over tan θ: holds 98.9 % of a gaussian beam


def scan_axes(scene: Scene) -> Floats:
    """Axis of the beam of a confocal scan at each pixel, unit vectors in the camera frame, float64 `[H, W, 3]`.

    From the laser to the point of the line of sight at `scan.distance`; parallel to it where that is infinite.
    """
    view = pixel_directions(scene.camera)
    if math.isinf(scene.scan.distance):
        return view
    axes = scene.scan.distance * view - np.asarray(scene.beam.position)
    return axes / np.linalg.norm(axes, axis=-1, keepdims=True)


def range_from_path(path: ArrayLike, directions: ArrayLike, laser_position: ArrayLike) -> Floats:
    """Range [m] along unit vectors u from the lens, `[..., 3]`, at which light has gone `path` L [m] from the laser at
    p [m] by the target to the lens; NaN where L is NaN or too short.

    The points of one path lie on an ellipsoid with laser p and lens 0 as foci. |r·u − p| + r = L has one solution along
    u: r = (L² − |p|²) / (2 (L − u·p)). For a laser in the lens it is L/2.
    """
    length, laser = np.asarray(path, np.float64), np.asarray(laser_position, np.float64)
    baseline = np.linalg.norm(laser)
    possible = length > baseline
    safe = np.where(possible, length, baseline + 1.0)  # keeps the unused branch free of 0/0
    distance = (safe - baseline) * (safe + baseline) / (2.0 * (safe - np.asarray(directions) @ laser))
    return np.where(possible, distance, np.nan)


@dataclass(frozen=True)
class LinesOfSight:
    """Straight lines in the water along which pixels see, and the laser's light that is scattered on them.

    A range is the length along the bent ray from the lens centre, a path the length in water that light needs as long
    for as from the laser by the point to the lens.
    """

    start: Floats  # where the lines begin: the lens centre, or where they leave the port [m], `[..., 3]`
    direction: Floats  # unit vectors, `[..., 3]`
    lead: Floats  # length of the way from the lens centre to the start [m]
    delay: Floats  # length in water that takes as long [m]
    laser: Floats  # position of the laser [m]
    laser_port: PortGeometry | None = None  # what it shines through
    pose: tuple[Floats, Floats] | None = None
    """By the sea, of the shot of each pixel of a scan: axes `[..., 3, 3]`, position [m] in the frame of that port."""
    open: bool = False
    """Whether light also comes back from before the start, straight on: above the sea, lens and laser in the air."""

    def __getitem__(self, index: Any) -> LinesOfSight:
        """The lines of some pixels."""
        lines = (self.start[index], self.direction[index], self.lead[index], self.delay[index])
        pose = None if self.pose is None else (self.pose[0][index], self.pose[1][index])
        return LinesOfSight(*lines, self.laser, self.laser_port, pose, self.open)

    def points(self, distance: ArrayLike) -> Floats:
        """Points in the camera frame at ranges [m]."""
        distance = np.asarray(distance, np.float64)
        points: Floats = self.start + (distance - self.lead)[..., None] * self.direction
        if self.open:
            before = (distance / self.lead)[..., None] * self.start
            points = np.where((distance < self.lead)[..., None], before, points)
        return points

    def directions_to(self, distance: Floats) -> Floats:
        """Vectors that, times a range, are the point there: unit vectors without a port."""
        if not self.bent:
            return self.direction
        return self.points(distance) / np.asarray(distance, np.float64)[..., None]

    def depth_from_range(self, distance: Any) -> Any:
        """Depth z [m]."""
        return self.points(distance)[..., 2]

    def range_from_depth(self, depth: Any) -> Any:
        """Range [m] at planar depths."""
        distance = self.lead + (depth - self.start[..., 2]) / self.direction[..., 2]
        if self.open:
            distance = np.where(depth < self.start[..., 2], depth / self.start[..., 2] * self.lead, distance)
        return distance

    def path_from_range(self, distance: ArrayLike) -> Floats:
        """Path [m] at ranges."""
        distance = np.asarray(distance, np.float64)
        path = self.light_at(points := self.points(distance))[2] + (distance - self.lead) + self.delay
        if self.open:
            straight = np.linalg.norm(points - self.laser, axis=-1) + distance
            path = np.where(distance <= self.lead, straight * self.delay / self.lead, path)
        return path

    def range_from_path(self, path: ArrayLike) -> Floats:
        """Range [m] at which light has gone a path; NaN where it is too short."""
        if not self.bent:
            return range_from_path(path, self.direction, self.laser)
        left = np.asarray(path, np.float64) - self.delay
        # Lines that begin where the laser's port hides them have no first point.
        least = np.nan_to_num(self.light_at(self.start + _LEAST * self.direction)[2])
        along = np.maximum(0.5 * (left - least), _LEAST)
        for _ in range(_STEPS):
            light, _, way = self.light_at(self.start + along[..., None] * self.direction)
            # The path rises with the range by 1 + the cosine between both directions of light.
            slope = np.maximum(1.0 + (light * self.direction).sum(axis=-1), 1e-3)
            before, along = along, np.maximum(along - (way + along - left) / slope, _LEAST)
            if not (np.abs(along - before) > 1e-9 * along).any():
                break
        distance = np.where(left > least, along, np.nan) + self.lead
        if self.open:
            straight = np.asarray(path, np.float64) * self.lead / self.delay
            in_air = range_from_path(straight, self.start / self.lead[..., None], self.laser)
            distance = np.where(left > least, distance, np.minimum(in_air, self.lead))
        return distance

    def light_at(self, points: Floats) -> tuple[Floats, Floats, Floats]:
        """Of the light of a laser that is a point, at points in the camera frame: unit vectors, the length of its way
        in the water, and the length in water that takes as long as all of its way [m]; NaN where none comes."""
        if self.laser_port is None:
            way = points - self.laser
            length = np.linalg.norm(way, axis=-1)
            return way / np.maximum(length, 1e-300)[..., None], length, length
        laser = self.laser
        if self.pose is not None:
            points, laser = (self._placed(x) for x in (points, laser))
        inside, light, length, path = self.laser_port.connect(points, laser)
        water = length - self.laser_port.enter(laser, inside)[2]
        return light if self.pose is None else _turned_in(self.pose[0], light), water, path

    def beam_at(self, axis: Floats) -> Floats:
        """The direction in the water of a parallel beam along a unit vector [1]."""
        if self.laser_port is None:
            return axis
        if self.pose is None:
            return self.laser_port.enter(self.laser, axis)[1]
        return _turned_in(self.pose[0], self.laser_port.enter(self._placed(self.laser), self.pose[0] @ axis)[1])

    def _placed(self, x: Floats) -> Floats:
        assert self.pose is not None
        return self.pose[1] + np.einsum("...ij,...j->...i", self.pose[0], x)

    @property
    def bent(self) -> bool:
        """Whether there is a port, of camera or laser."""
        return self.laser_port is not None or bool(np.any(self.delay))


def lines_of_sight(scene: Scene, view: Floats | None = None) -> LinesOfSight:
    """Lines of sight of a scene's pixels `[H, W]`, of a scan by the sea each in the frame of its shot; or those that
    leave the lens centre along unit vectors."""
    port, beyond, laser = camera_port(scene), laser_port(scene), np.array(scene.beam.position, np.float64)
    pose = None
    if view is None and scene.surface is not None and scene.scan.mode == "trajectory":
        shots = shots_of(scene)
        axes = (rotation_matrix(scene.camera.rotation_deg).T @ shots.rotation)[shots.number]
        pose = axes, to_camera(scene.camera, shots.position)[shots.number]
    if view is None:  # of a scan along a trajectory in the frame of each shot
        view = np.broadcast_to(pixel_directions(scene.receiver), (scene.camera.height, scene.camera.width, 3))
    if port is None:
        lines = _in_water(view)
    elif pose is None:
        lines = port.enter(np.zeros(3), view)
    else:
        start, along, *lengths = port.enter(pose[1], np.einsum("hwij,hwj->hwi", pose[0], view))
        lines = _turned_in(pose[0], start - pose[1]), _turned_in(pose[0], along), lengths[0], lengths[1]
    return LinesOfSight(*lines, laser, beyond, pose, open=scene.surface is not None and None not in (port, beyond))


def _turned_in(axes: Floats, vectors: Floats) -> Floats:
    return np.einsum("...ij,...i->...j", axes, vectors)


def lines_of_camera(camera: Camera) -> LinesOfSight:
    """Lines of sight of a camera in the water, with a laser in its lens."""
    return LinesOfSight(*_in_water(pixel_directions(camera)), np.zeros(3))


def _in_water(view: Floats) -> tuple[Floats, Floats, Floats, Floats]:
    """Of unit vectors what `PortGeometry.enter` has of rays, without a port."""
    return np.zeros(view.shape), view, np.zeros(view.shape[:-1]), np.zeros(view.shape[:-1])


def gate_deviation(scene: Scene, directions: Floats) -> Floats:
    """Standard deviation [m] of a depth that is guessed evenly over the gate; unit vectors are those in the water."""
    gate = scene.gate
    return 0.5 * scene.medium.pulse_speed * (gate.stop - gate.start) / math.sqrt(12.0) * directions[..., 2]


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
    beam, lines = scene.beam, lines_of_sight(scene, view)
    if beam.profile != "collimated":
        light = lines.light_at(lines.points(distance))[0]
    else:
        light = lines.beam_at(np.array(beam.axis))
    # The path rises with the range by 1 + the cosine between both directions of light.
    return scene.medium.pulse_speed / (1.0 + (light * lines.direction).sum(axis=-1)) * lines.direction[..., 2]


# The view and the beam as convex regions: planes are rows (n, d) with n·x + d >= 0 inside, `[P, 4]`; triangles are
# `[F, 3, 3]` [m].


def view_planes(camera: Camera) -> Floats:
    """A pyramid that holds what the image shows, its tip at the lens centre."""
    left, top, right, bottom = camera.view_box
    sides = [[1, 0, -left, 0], [-1, 0, right, 0], [0, 1, -top, 0], [0, -1, bottom, 0], [0, 0, 1, 0]]
    return np.array(sides, dtype=np.float64)


def beam_planes(laser: Laser) -> Floats:
    """24 planes around the beam, a pyramid or a prism that just holds it, 5 around a measured one; none if it is wider
    than a half-space."""
    axis, origin = np.array(laser.axis), np.array(laser.position)
    if laser.profile != "collimated" and laser.half_angle_deg >= 90.0:
        return np.zeros((0, 4))
    if laser.profile == "measured":
        wide, tall = profile_extent(laser)
        right, down = profile_axes(laser.axis)
        normals = np.array([wide * axis - right, wide * axis + right, tall * axis - down, tall * axis + down, axis])
        return np.column_stack([normals, -normals @ origin])
    across = np.cross(axis, np.eye(3)[np.argmin(np.abs(axis))])
    b1 = across / np.linalg.norm(across)
    phi = np.arange(24) * (2.0 * math.pi / 24)
    outward = np.cos(phi)[:, None] * b1 + np.sin(phi)[:, None] * np.cross(axis, b1)
    slope, radius = 0.0, max(laser.beam_radius, 1e-6)
    if laser.profile != "collimated":
        slope, radius = math.tan(laser.half_angle) * (_GAUSSIAN_EDGE if laser.profile == "gaussian" else 1.0), 0.0
    normals = np.concatenate([slope * axis - outward, axis[None]])
    return np.column_stack([normals, -normals @ origin + np.append(np.full(24, radius), 0.0)])


def points_inside(triangles: Floats, planes: Floats) -> Floats:
    """Points of the triangles that are inside all planes, or within 1 µm of it, `[N, 3]`: none if and only if no
    triangle reaches in."""
    whole, outside = np.ones(len(triangles), dtype=bool), np.zeros(len(triangles), dtype=bool)
    for plane in planes:
        distance = triangles @ plane[:3] + plane[3]
        whole &= (distance >= 0.0).all(axis=1)
        outside |= (distance < 0.0).all(axis=1)
    cut = triangles[~whole & ~outside]
    for plane in planes:
        cut = _cut(cut, plane / np.linalg.norm(plane[:3]) + [0.0, 0.0, 0.0, 1e-6])
    return np.concatenate([_spread(triangles[whole]), _spread(cut)])


def _cut(triangles: Floats, plane: Floats) -> Floats:
    """The part of the triangles inside a plane, as triangles."""
    distance = triangles @ plane[:3] + plane[3]
    inside = distance >= 0.0
    count = inside.sum(axis=1)
    parts = [triangles[count == 3]]
    for number in (1, 2):
        chosen = count == number
        alone = (inside[chosen] == (number == 1)).argmax(axis=1)  # the corner on a side of its own, first
        order = (alone[:, None] + np.arange(3)) % 3
        a, b, c = np.take_along_axis(triangles[chosen], order[..., None], axis=1).swapaxes(0, 1)
        of_a, of_b, of_c = np.take_along_axis(distance[chosen], order, axis=1).T[..., None]
        to_b, to_c = a + (b - a) * (of_a / (of_a - of_b)), a + (c - a) * (of_a / (of_a - of_c))
        found = [(a, to_b, to_c)] if number == 1 else [(to_b, b, to_c), (b, c, to_c)]
        parts += [np.stack(corners, axis=1) for corners in found]
    return np.concatenate(parts)


def within_port(scene: Scene, triangles: Floats) -> tuple[str, str] | None:
    """What is in the housing or the window of the camera's port and is not meant for it, a laser that shines through no
    port, or parts of triangles: the field, and a text about it."""
    port, camera, laser = camera_port(scene), scene.camera, scene.beam
    if scene.surface is not None:
        return _within_waves(scene, scene.surface) if scene.sun is None else None
    if port is None or len(set(port.index)) == 1:
        return None
    radius = 0.0 if camera.pinhole else camera.aperture_radius
    wide = 0.5 * camera.pixel_tangent * math.hypot(camera.width, camera.height)
    if laser.port is None and port.houses(laser.position, wide, radius):
        return "laser.position", (
            f"{list(laser.position)} is inside camera.port: laser.port = 'camera' lets it shine through that window, a "
            "table [laser.port] through one of its own; in the water it is in front or beside"
        )
    if not len(triangles):
        return None
    if port.shape == "flat":  # but for what touches it, which `points_inside` finds too
        planes = np.vstack([view_planes(camera), [*(-np.array(port.normal)), port.nearest - 2e-6]])
        inside = points_inside(triangles, planes)
    else:
        from trimesh.triangles import closest_point

        found = closest_point(triangles, np.broadcast_to(port.centre, (len(triangles), 3)))
        outer = (port.radius + port.thickness) * (1.0 - 1e-6)
        inside = found[np.linalg.norm(found - port.centre, axis=1) < outer]
    if not len(inside):
        return None
    place = inside[0].round(6).tolist()
    return "camera.port", f"a target is within the housing or the window, at {place} m in the camera's frame"


def _within_waves(scene: Scene, surface: Surface) -> tuple[str, str] | None:
    """As `within_port`, for a lens or a laser that reaches the waves of the sea; or in a shot of a scan their mean
    plane, or stands across it from where the scene's does."""
    camera, beam, normal = scene.camera, scene.beam, np.array(surface.normal)
    position, axes = np.array([camera.position]), rotation_matrix(camera.rotation_deg)[None]
    if scene.scan.mode == "trajectory":
        shots = shots_of(scene)
        position, axes = shots.position, shots.rotation
    tilt = np.sqrt(np.maximum(1.0 - (axes[:, :, 2] @ normal) ** 2, 0.0))
    waves = 0.0 if (field := surface.wave_field) is None else field.amplitude
    ends = {"camera": ((0.0, 0.0, 0.0), camera.aperture_radius)}
    ends["laser"] = beam.position, beam.beam_radius if beam.profile == "collimated" else 0.0
    for section, (place, radius) in ends.items():
        own = surface.height_of(vector_of(to_world(camera, place)))
        height = (position + axes @ np.asarray(place) - surface.point) @ normal * math.copysign(1.0, own)
        low = int((height - radius * tilt).argmin())
        if height[low] <= radius * tilt[low] + waves:
            shot = f" in shot {low}" if len(height) > 1 else ""
            text = f"{height[low]:.4g} m from the surface{shot}, on its side; it must not reach that"
            return f"{section}.position", text + (f", nor waves of up to {waves:.3g} m" if waves else "")
    return None


def _spread(triangles: Floats) -> Floats:
    """Points evenly over each triangle, of many triangles near the corners alone; just inside, where rays meet it."""
    steps = 6 if len(triangles) < 2000 else 1
    weights = [(i, j, steps - i - j) for i in range(steps + 1) for j in range(steps + 1 - i)]
    inside = 1e-5 / 3.0 + (1.0 - 1e-5) * np.array(weights) / steps
    return np.einsum("wc,fcx->fwx", inside, triangles).reshape(-1, 3)
