"""Rays through ports in the frame of the camera, in float64: what truth maps, depths and focus are computed from."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

if TYPE_CHECKING:
    from spadwarp.scene import Scene
    from spadwarp.scene.port import Port

__all__ = ["PortGeometry", "camera_port", "laser_port"]

Floats = NDArray[np.float64]

# Steps of Newton's method: it has converged after 4 to 12.
_STEPS = 30


@dataclass(frozen=True)
class PortGeometry:
    """A port: a window between two planes across `normal`, or between two spheres about `centre`.

    Attributes:
        shape: "flat" or "dome".
        distance: flat: from the camera's lens centre along the normal to the inner face [m].
        normal: flat: unit vector into the water.
        radius, centre: dome: of the inner face [m].
        thickness: Of the window [m].
        index, group_index: Of what is inside, of the window, of the water.
    """

    shape: str
    distance: float
    normal: tuple[float, float, float]
    radius: float
    centre: tuple[float, float, float]
    thickness: float
    index: tuple[float, float, float]
    group_index: tuple[float, float, float]

    @property
    def delays(self) -> tuple[float, float]:
        """Group indices inside and in the window over that of the water."""
        inside, window, water = self.group_index
        return inside / water, window / water

    @property
    def nearest(self) -> float:
        """Distance from the lens centre to the water [m]."""
        if self.shape == "flat":
            return self.distance + self.thickness
        return self.radius + self.thickness - math.hypot(*self.centre)

    def outside(self, x: ArrayLike) -> str:
        """Why a point is not inside; empty where it is."""
        if self.shape == "flat":
            ahead = self.distance - float(np.asarray(x) @ np.array(self.normal))
            return "" if ahead > 0.0 else f"it is {-ahead:.4g} m beyond the window's inner face"
        away = math.dist(np.ravel(x), self.centre)
        return (
            "" if away < self.radius else f"it is {away:.4g} m from the dome's centre, the radius is {self.radius:g} m"
        )

    def enter(self, x: ArrayLike, u: ArrayLike) -> tuple[Floats, Floats, Floats, Floats]:
        """Rays from x inside along unit vectors u, `[..., 3]`, up to where they enter the water.

        Returns where and in which direction they do, `[..., 3]`; the length of the way up to there, and the length in
        water that takes as long [m]. NaN for rays that do not get through.
        """
        y, v = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(u, np.float64))
        lengths = []
        with np.errstate(invalid="ignore"):
            for k, outward in enumerate((0.0, self.thickness)):
                length = self._to_face(y, v, outward)
                y = y + length[..., None] * v
                v = _refracted(v, self._normals(y), self.index[k] / self.index[k + 1])
                lengths.append(np.where(length > 0.0, length, np.nan) if k == 0 else length)
        inside, window = lengths
        return y, v, inside + window, self.delays[0] * inside + self.delays[1] * window

    def transmission(self, x: ArrayLike, u: ArrayLike) -> Floats:
        """Fraction of unpolarised light that gets through, of rays from x inside along unit vectors u; 0: none."""
        y, v = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(u, np.float64))
        s = p = 1.0
        with np.errstate(invalid="ignore"):
            for k, outward in enumerate((0.0, self.thickness)):
                before, behind = self.index[k], self.index[k + 1]
                y = y + self._to_face(y, v, outward)[..., None] * v
                normals = self._normals(y)
                q0 = (v * normals).sum(axis=-1)
                v = _refracted(v, normals, before / behind)
                q1 = (v * normals).sum(axis=-1)
                s = s * (4.0 * before * q0 * behind * q1 / (before * q0 + behind * q1) ** 2)
                p = p * (4.0 * before * q0 * behind * q1 / (behind * q0 + before * q1) ** 2)
        return np.nan_to_num(0.5 * (s + p))

    def spread(self, x: ArrayLike, u: ArrayLike, distance: float) -> float:
        """Irradiance across a ray from x inside along the unit vector u, for an intensity of 1 in clear water, where it
        has gone a distance beyond the port [1/m²]; by differences. 1/distance² without a port."""
        x, u = np.asarray(x, np.float64), np.asarray(u, np.float64)
        start, direction, lead, _ = self.enter(x, u)
        middle = start + (distance - lead) * direction
        aside = np.linalg.svd(u[None])[2][1:]
        step = 1e-4
        sides = []
        for axis in aside:
            ends = []
            for sign in (1.0, -1.0):
                y, v, _, _ = self.enter(x, math.cos(step) * u + sign * math.sin(step) * axis)
                ends.append(y + ((middle - y) @ direction / (v @ direction)) * v)
            sides.append((ends[0] - ends[1]) / (2.0 * step))
        area = float(np.linalg.norm(np.cross(sides[0], sides[1])))
        return float(self.transmission(x, u)) / area

    def _to_face(self, x: Floats, u: Floats, outward: float) -> Floats:
        if self.shape == "flat":
            climb = u @ np.array(self.normal)
            return (self.distance + outward - x @ np.array(self.normal)) / np.where(climb > 0.0, climb, np.nan)
        y = x - np.array(self.centre)
        b = (y * u).sum(axis=-1)
        return np.sqrt(b * b - (y * y).sum(axis=-1) + (self.radius + outward) ** 2) - b

    def _normals(self, x: Floats) -> Floats:
        if self.shape == "flat":
            return np.broadcast_to(np.array(self.normal), x.shape)
        y = x - np.array(self.centre)
        return y / np.linalg.norm(y, axis=-1, keepdims=True)

    def connect(self, points: ArrayLike, origin: ArrayLike) -> tuple[Floats, Floats, Floats, Floats]:
        """The ways from a point inside to points in the water, `[..., 3]`.

        Returns the directions inside and in the water, `[..., 3]`; the length of the way, and the length in water that
        takes as long [m]. NaN for points behind the port.
        """
        points, origin = np.asarray(points, np.float64), np.asarray(origin, np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = self._start_flat(points, origin) if self.shape == "flat" else self._start_dome(points, origin)
        start, v, length, path = self.enter(origin, u)
        water = np.linalg.norm(points - start, axis=-1)
        return u, v, length + water, path + water

    def _start_flat(self, points: Floats, origin: Floats) -> Floats:
        """Directions inside, by Newton's method in t = k/√(m² − k²), k Snell's invariant, m the least index."""
        normal = np.array(self.normal)
        y = points - origin
        along = y @ normal
        across = y - along[..., None] * normal
        aside = np.linalg.norm(across, axis=-1)
        inside = self.distance - float(origin @ normal)
        water = along - inside - self.thickness
        h: list[Any] = [inside, self.thickness, np.where(water > 0.0, water, np.nan)]
        n = (self.index[0], self.index[1] if self.thickness > 0.0 else self.index[0], self.index[2])
        m = min(n)
        t = np.zeros_like(aside)
        for _ in range(_STEPS):
            roots = [np.sqrt(k * k + (k - m) * (k + m) * t * t) for k in n]
            value = np.sum([m * t * d / root for d, root in zip(h, roots, strict=True)], axis=0)
            slope = np.sum([m * d * k * k / root**3 for d, k, root in zip(h, n, roots, strict=True)], axis=0)
            t = t + (aside - value) / slope
        sine = m / n[0] * t / np.sqrt(1.0 + t * t)
        sideways = across / np.maximum(aside, 1e-300)[..., None]
        return sine[..., None] * sideways + np.sqrt(1.0 - sine * sine)[..., None] * normal

    def _start_dome(self, points: Floats, origin: Floats) -> Floats:
        """Directions inside, by Newton's method in the angle i to the radius."""
        z = origin - np.array(self.centre)
        d = float(np.linalg.norm(z))
        y = points - np.array(self.centre)
        r = np.linalg.norm(y, axis=-1)
        to_point = y / r[..., None]
        e = z / d if d > 0.0 else np.array([0.0, 0.0, 1.0])
        cosine = to_point @ e
        across = to_point - cosine[..., None] * e
        sine = np.linalg.norm(across, axis=-1)
        beta = np.arctan2(sine, cosine)
        n, outer = self.index, self.radius + self.thickness
        r = np.where(r > outer, r, np.nan)
        faces = ((n[0] * self.radius, -1.0), (n[1] * self.radius, 1.0), (n[1] * outer, -1.0), (n[2] * outer, 1.0))
        i = np.arctan2(r * sine, r * cosine - d)
        for _ in range(_STEPS):
            p = n[0] * d * np.sin(i)
            angle, slope = i - np.arcsin(p / (n[2] * r)), -1.0 / np.sqrt((n[2] * r) ** 2 - p * p)
            for size, sign in faces:
                angle = angle + sign * np.arcsin(p / size)
                slope = slope + sign / np.sqrt(size * size - p * p)
            i = i + (beta - angle) / (1.0 + n[0] * d * np.cos(i) * slope)
        sideways = across / np.maximum(sine, 1e-300)[..., None]
        return np.cos(i)[..., None] * e + np.sin(i)[..., None] * sideways

    def apparent_distance(self, point: ArrayLike) -> float:
        """Distance from the lens centre at which it sees a point in the water, by the spread of its rays there [m].

        The mean curvature of two sections: behind a tilted port, and off the axis, they differ (astigmatism).
        """
        step, at = 1e-4, np.asarray(point, np.float64)
        curvature = 0.0
        for axis in np.eye(3)[:2]:
            ends = [self.connect(at, sign * step * axis)[0] for sign in (-1.0, 1.0)]
            slopes = [u @ axis / u[2] for u in ends]
            curvature += 0.5 * (slopes[0] - slopes[1]) / (2.0 * step)
        return math.inf if curvature <= 1e-9 else 1.0 / curvature


def _refracted(u: Floats, normals: Floats, ratio: float) -> Floats:
    cosine = (u * normals).sum(axis=-1, keepdims=True)
    across = ratio * (u - cosine * normals)
    return across + np.sqrt(1.0 - (across * across).sum(axis=-1, keepdims=True)) * normals


def camera_port(scene: Scene) -> PortGeometry | None:
    """What a scene's camera looks through; None: it is in the water."""
    port = scene.camera.port
    return None if port is None else _geometry(scene, port, np.zeros(3), port.axis)


def laser_port(scene: Scene) -> PortGeometry | None:
    """What a scene's laser shines through; None: it is in the water."""
    port: Any = scene.laser.port
    if port is None:
        return None
    if port == "camera":
        return camera_port(scene)
    from spadwarp.scene.pose import rotation_matrix

    normal = np.array(port.axis)
    if scene.laser.frame == "world" and scene.camera.is_posed:
        normal = normal @ rotation_matrix(scene.camera.rotation_deg)
    return _geometry(scene, port, np.array(scene.beam.position), normal)


def _geometry(scene: Scene, port: Port, origin: Floats, normal: ArrayLike) -> PortGeometry:
    """A port whose lengths start at `origin`."""
    (n_inside, g_inside), (n_window, g_window) = port.indices(scene.laser.wavelength_nm)
    normal = np.asarray(normal, np.float64)
    centre = origin + np.array(port.offset)
    return PortGeometry(
        shape=port.shape,
        distance=(port.distance or 0.0) + float(origin @ normal),
        normal=(float(normal[0]), float(normal[1]), float(normal[2])),
        radius=port.radius or 0.0,
        centre=(float(centre[0]), float(centre[1]), float(centre[2])),
        thickness=port.thickness,
        index=(n_inside, n_window, scene.medium.phase_index),
        group_index=(g_inside, g_window, scene.medium.group_index),
    )
