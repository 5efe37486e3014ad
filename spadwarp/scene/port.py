"""Ports between the air of a housing and the water: the table `camera.port` or `laser.port`, and rays through them.

Rays are in the frame of the camera, in float64: truth maps, depths and focus are computed from them. The kernels have
their own, in float32.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field

from spadwarp.arrays import Floats
from spadwarp.io.text import read_toml
from spadwarp.scene.pose import unit_vector
from spadwarp.scene.sections import Direction, Section, Vector, field

# Steps of Newton's method, which has converged after 4 to 12, and the last: the error is its square.
_STEPS, _CONVERGED = 30, 1e-9


MATERIALS = read_toml(Path(__file__).with_name("materials.toml"))
"""Materials of windows."""


def window_indices(material: str, wavelength_nm: float) -> tuple[float, float]:
    """Phase and group index of a material of `MATERIALS` at a vacuum wavelength; n_g = n − λ dn/dλ.

    Raises `ValueError` outside the range of its source.
    """
    glass, micrometres = MATERIALS[material], wavelength_nm * 1e-3
    low, high = glass["range"]
    if not low <= micrometres <= high:
        known = f"[{1e3 * low:g}, {1e3 * high:g}] nm"
        raise ValueError(
            f"material = {material!r} is known for {known}, not for laser.wavelength_nm = {wavelength_nm:g}"
        )
    square, terms = micrometres**2, list(zip(glass["b"], glass["c"], strict=True))
    index = math.sqrt(1.0 + sum(b * square / (square - c) for b, c in terms))
    slope = -sum(b * c * micrometres / (square - c) ** 2 for b, c in terms) / index
    return index, index - micrometres * slope


def air_indices(wavelength_nm: float) -> tuple[float, float]:
    """Phase and group index of dry air at 15 °C and 101 325 Pa (Ciddor, Appl. Opt. 35, 1566 (1996))."""
    s2 = 1.0 / max(wavelength_nm * 1e-3, 0.23) ** 2
    excess, slope = 0.0, 0.0
    for strength, pole in ((0.05792105, 238.0185), (0.00167917, 57.362)):
        excess += strength / (pole - s2)
        slope += strength * 2.0 * s2 / (pole - s2) ** 2  # −λ d/dλ
    return 1.0 + excess, 1.0 + excess + slope


class Port(Section):
    """A flat or dome port between the air of a housing and the water; without thickness and material a calm surface."""

    section: ClassVar[str] = "port"
    displaces: ClassVar = {
        "shape": ("distance", "normal", "radius", "offset"),
        "material": ("index", "group_index"),
        "index": ("material",),
    }
    preset: str | None = field(None, "a named port, see `spadwarp list presets port`")
    shape: Literal["flat", "dome"] = field("flat", "a plane window, or a spherical one")
    distance: float | None = Field(None, ge=1e-6, le=1e6)
    """flat: from the lens centre along `normal` to the window; above a calm surface the altitude [m]"""
    normal: Direction = (0.0, 0.0, 1.0)
    """flat: direction into the water, any length but 0; in the frame of the camera, or of the laser's direction"""
    radius: float | None = field(None, "dome: of its inner face [m]", "[1e-6, 1e6]")
    offset: Vector = field((0.0, 0.0, 0.0), "dome: from the lens centre to the dome's centre [m]")
    thickness: float = field(0.0, "of the window [m]; 0: there is none", "[0, 1000]")
    material: Literal["BK7", "fused silica", "sapphire", "acrylic", "PMMA", "polycarbonate"] | None = None
    """of the window: its indices at the laser's wavelength"""
    index: float | None = field(None, "phase index of the window, in place of material", "[1, 4]")
    group_index: float | None = field(None, "group index of the window; default: its phase index", "[1, 4]")
    inside_index: float | None = field(None, "phase index inside the housing; default: that of air", "[1, 4]")
    inside_group_index: float | None = field(None, "group index inside; default: air's, or inside_index", "[1, 4]")

    def _problems(self) -> Iterator[str]:
        needed = "distance" if self.shape == "flat" else "radius"
        if getattr(self, needed) is None:
            yield f"needs {needed} with shape = {self.shape!r}"
        yield from self._only_with("shape = 'flat'", self.shape == "flat", "distance", "normal")
        yield from self._only_with("shape = 'dome'", self.shape == "dome", "radius", "offset")
        if self.material is not None and self.index is not None:
            yield f"needs either material or index; given: {self.material!r} and {self.index}"
        if (self.thickness > 0.0) != (self.material is not None or self.index is not None):
            yield f"needs material or index and a thickness > 0, or neither; thickness = {self.thickness}"
        yield from self._only_with("index", self.index is not None, "group_index")
        yield from self._only_with("inside_index", self.inside_index is not None, "inside_group_index")

    def indices(self, wavelength_nm: float) -> tuple[tuple[float, float], tuple[float, float]]:
        """(phase, group) index of what is inside, and of the window.

        Raises `ValueError` for a wavelength at which the material is not known.
        """
        inside = air_indices(wavelength_nm)
        if self.inside_index is not None:
            inside = (self.inside_index, self.inside_group_index or self.inside_index)
        if self.material is not None:
            return inside, window_indices(self.material, wavelength_nm)
        return inside, inside if self.index is None else (self.index, self.group_index or self.index)

    @property
    def axis(self) -> tuple[float, float, float]:
        """`normal` as a unit vector."""
        return unit_vector(self.normal)


@dataclass(frozen=True)
class PortGeometry:
    """A port: a window between two planes across `normal`, or between two spheres about `centre`."""

    shape: str  # "flat" or "dome"
    distance: float  # flat: from the camera's lens centre along the normal to the inner face [m]
    normal: tuple[float, float, float]  # flat: unit vector into the water
    radius: float  # dome: of the inner face [m]
    centre: tuple[float, float, float]  # dome [m]
    thickness: float  # of the window [m]
    index: tuple[float, float, float]  # phase index of what is inside, of the window, of the water
    group_index: tuple[float, float, float]

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
        away, radius = math.dist(np.ravel(x), self.centre), self.radius
        return "" if away < radius else f"it is {away:.4g} m from the dome's centre, the radius is {radius:g} m"

    def houses(self, x: ArrayLike, tangent: float, aperture_radius: float) -> bool:
        """Whether a point is in the housing or the window that the camera looks through: of a flat one, as wide as its
        view with that tangent of its half angle; above a calm surface everywhere."""
        if self.shape == "dome":
            return math.dist(np.ravel(x), self.centre) < self.radius + self.thickness
        x, normal = np.asarray(x, np.float64), np.array(self.normal)
        ahead = float(x @ normal)
        wide = tangent * self.nearest + aperture_radius
        return ahead < self.nearest and (not self.thickness or float(np.linalg.norm(x - ahead * normal)) <= wide)

    def enter(self, x: ArrayLike, u: ArrayLike) -> tuple[Floats, Floats, Floats, Floats]:
        """Rays from x inside along unit vectors u, `[..., 3]`, up to where they enter the water.

        Returns where and in which direction they do, `[..., 3]`; the length of the way up to there, and the length in
        water that takes as long [m]. NaN for rays that do not get through.
        """
        with np.errstate(invalid="ignore"):
            (inside, _, _, _, _), (window, _, _, y, v) = self._faces(x, u)
            inside = np.where(inside > 0.0, inside, np.nan)
        g_inside, g_window, g_water = self.group_index
        return y, v, inside + window, g_inside / g_water * inside + g_window / g_water * window

    def transmission(self, x: ArrayLike, u: ArrayLike) -> Floats:
        """Fraction of unpolarised light that gets through, of rays from x inside along unit vectors u; 0: none."""
        s = p = np.ones(())
        with np.errstate(invalid="ignore"):
            for k, (_, q0, q1, _, _) in enumerate(self._faces(x, u)):
                before, behind = self.index[k], self.index[k + 1]
                s = s * (4.0 * before * q0 * behind * q1 / (before * q0 + behind * q1) ** 2)
                p = p * (4.0 * before * q0 * behind * q1 / (behind * q0 + before * q1) ** 2)
        return np.nan_to_num(0.5 * (s + p))

    def _faces(self, x: ArrayLike, u: ArrayLike) -> Iterator[tuple[Floats, Floats, Floats, Floats, Floats]]:
        """At the inner and the outer face: length up to it, cosines before and behind it, place and direction."""
        y, v = np.broadcast_arrays(np.asarray(x, np.float64), np.asarray(u, np.float64))
        normals, centre = np.broadcast_to(self.normal, y.shape), np.array(self.centre)
        for k, outward in enumerate((0.0, self.thickness)):
            if self.shape == "flat":
                climb = v @ np.array(self.normal)
                length = (self.distance + outward - y @ np.array(self.normal)) / np.where(climb > 0.0, climb, np.nan)
            else:
                b = ((y - centre) * v).sum(axis=-1)
                length = np.sqrt(b * b - ((y - centre) ** 2).sum(axis=-1) + (self.radius + outward) ** 2) - b
            y = y + length[..., None] * v
            if self.shape == "dome":
                normals = (y - centre) / np.linalg.norm(y - centre, axis=-1, keepdims=True)
            cosine = (v * normals).sum(axis=-1, keepdims=True)
            across = self.index[k] / self.index[k + 1] * (v - cosine * normals)
            v = across + np.sqrt(1.0 - (across * across).sum(axis=-1, keepdims=True)) * normals
            yield length, cosine[..., 0], (v * normals).sum(axis=-1), y, v

    def spread(self, x: ArrayLike, u: ArrayLike, distance: float) -> float:
        """Irradiance across a ray from x inside along the unit vector u, for an intensity of 1 in clear water, where it
        has gone a distance beyond the port [1/m²]; by differences. 1/distance² without a port."""
        start, direction, lead, _ = self.enter(x, u)
        middle, step, axis = start + (distance - lead) * direction, 1e-4, np.asarray(u, np.float64)
        aside = np.linalg.svd(axis[None])[2][1:]
        y, v, _, _ = self.enter(x, math.cos(step) * axis + math.sin(step) * np.concatenate([aside, -aside]))
        ends = y + ((middle - y) @ direction / (v @ direction))[:, None] * v
        area = float(np.linalg.norm(np.cross(ends[0] - ends[2], ends[1] - ends[3]))) / (2.0 * step) ** 2
        return float(self.transmission(x, u)) / area

    def connect(self, points: ArrayLike, origin: ArrayLike) -> tuple[Floats, Floats, Floats, Floats]:
        """The ways from a point inside to points in the water, `[..., 3]`.

        Returns the directions inside and in the water, `[..., 3]`; the length of the way, and the length in water that
        takes as long [m]. NaN for points behind the port.
        """
        points, origin = np.asarray(points, np.float64), np.asarray(origin, np.float64)
        with np.errstate(divide="ignore", invalid="ignore"):
            u = self._aim(points, origin)
        start, v, length, path = self.enter(origin, u)
        water = np.linalg.norm(points - start, axis=-1)
        return u, v, length + water, path + water

    def _aim(self, points: Floats, origin: Floats) -> Floats:
        """Directions inside, by Newton's method: in t = k/√(m² − k²) of a flat port, k Snell's invariant, m the least
        index; in the angle t to the radius of a dome."""
        flat, n, outer = self.shape == "flat", self.index, self.radius + self.thickness
        z = origin - np.array(self.centre)
        d = 0.0 if flat else float(np.linalg.norm(z))
        axis = np.array(self.normal) if flat else z / d if d > 0.0 else np.array([0.0, 0.0, 1.0])
        y = points - (origin if flat else np.array(self.centre))
        along = y @ axis
        across = y - along[..., None] * axis
        aside, r = np.linalg.norm(across, axis=-1), np.linalg.norm(y, axis=-1)
        sideways = across / np.maximum(aside, 1e-300)[..., None]
        if flat:
            inside = self.distance - origin @ axis
            water = along - inside - self.thickness
            h: list[Any] = [inside, self.thickness, np.where(water > 0.0, water, np.nan)]
            layers = (n[0], n[1] if self.thickness > 0.0 else n[0], n[2])
            t, goal, m = np.zeros_like(aside), aside, min(layers)
        else:
            t, goal = np.arctan2(aside, along - d), np.arctan2(aside, along)
            faces: Any = (
                (n[0] * self.radius, -1.0),
                (n[1] * self.radius, 1.0),
                (n[1] * outer, -1.0),
                (n[2] * outer, 1.0),
            )
            faces += ((n[2] * np.where(r > outer, r, np.nan), -1.0),)
        for _ in range(_STEPS):
            if flat:
                roots = [np.sqrt(k * k + (k - m) * (k + m) * t * t) for k in layers]
                value = np.sum([m * t * d / root for d, root in zip(h, roots, strict=True)], axis=0)
                slope = np.sum([m * d * k * k / root**3 for d, k, root in zip(h, layers, roots, strict=True)], axis=0)
            else:
                p = n[0] * d * np.sin(t)
                value = t + sum(sign * np.arcsin(p / size) for size, sign in faces)
                slope = 1.0 + n[0] * d * np.cos(t) * sum(sign / np.sqrt(size * size - p * p) for size, sign in faces)
            step = (goal - value) / slope
            t = t + step
            if not (np.abs(step) > _CONVERGED * (1.0 + t)).any():
                break
        sine = m / n[0] * t / np.sqrt(1.0 + t * t) if flat else np.sin(t)
        cosine = np.sqrt(1.0 - sine * sine) if flat else np.cos(t)
        return cosine[..., None] * axis + sine[..., None] * sideways

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
