"""Daylight that the pixels detect: radiance in the water and on targets, through aperture, filter and detector.

Quasi-single scattering (Gordon 1973): light scattered forward counts as not scattered, so that radiance along a line of
sight is attenuated by κ = a + b_b, and all of the light field falls with depth as the downwelling irradiance,
exp(−K_d·z). What a stretch ds of water sends to the lens is then J ds, J = ∫ b·p(Θ)·L dΩ over the sun and the sky in
the water. Surfaces reflect sun, sky and the light of the water.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike

from spadwarp.arrays import Floats
from spadwarp.scene.camera import pixel_directions
from spadwarp.scene.laser import filter_band, filter_transmission, widths_of
from spadwarp.scene.medium import Medium, PhaseFunction, phase_function
from spadwarp.scene.pose import rotation_matrix
from spadwarp.scene.scene import Scene, camera_port
from spadwarp.values import PLANCK, SPEED_OF_LIGHT, ConfigError, Interval
from spadwarp.water import daylight as skylight
from spadwarp.water.seawater import RANGES

__all__ = ["daylight_radiance", "daylight_rate", "downwelling_irradiance", "noise_rate"]

_ANGLES = np.linspace(0.0, math.pi, 1441)  # of scattering
_BAND_NODES = 13
_PART_PIXELS = 1 << 16


class _Field:
    """The light at the lens at one wavelength, per nm; directions in the camera frame."""

    def __init__(self, scene: Scene, wavelength_nm: float) -> None:
        daylight, turn = _daylight(scene), rotation_matrix(scene.camera.rotation_deg)
        direct, diffuse, decay, medium, phase = _irradiance(scene, wavelength_nm, daylight.depth)
        index = medium.phase_index
        self.depth, self.decay = daylight.depth, decay  # of the lens [m]; K_d [1/m]
        # κ = a + b_b along a line of sight [1/m].
        self.attenuation = medium.absorption + phase.backscatter_fraction * medium.scattering
        # Irradiance across the sun's light [W/m²]; radiance within Snell's window, even: E = π L sin² [W/m²/sr].
        self.sun = direct / skylight.refracted_cosine(daylight.sun_elevation_deg, index)
        self.sky = diffuse / (math.pi / index**2)
        self.window = math.sqrt(1.0 - 1.0 / index**2)  # cosine of its half angle
        self.towards, self.down = daylight.sun_direction(index) @ turn, daylight.down @ turn  # of the sun's light
        self.scattered = medium.scattering * phase.density(np.maximum(_ANGLES, 2e-5))  # b·p(Θ) over `_ANGLES` [1/m/sr]
        # What the sky sends into directions of propagation, over the cosine with `down` from -1 to 1.
        self.by_sky = self.sky * _window_average(self.scattered, self.window)

    def of_water(self, view: Floats, distance: Floats, depth: Floats | float) -> Floats:
        """Radiance of the water up to a distance on lines of sight `[..., 3]`; up to the surface at most [W/m²/sr]."""
        downwards = view @ self.down
        to_surface = np.where(downwards < -1e-9, depth / np.maximum(-downwards, 1e-9), np.inf)
        length = np.minimum(distance, to_surface)
        rate = self.attenuation + self.decay * downwards
        # ∫ exp(-rate s) ds; level or downwards the water may go on for ever.
        product = np.where(np.isinf(length), np.inf, rate * np.where(np.isinf(length), 0.0, length))
        small = np.abs(product) < 1e-8
        safe = np.where(np.abs(rate) < 1e-12, 1e-12, rate)
        # J towards the lens [W/m³/sr].
        angle = np.arccos(np.clip(view @ -self.towards, -1.0, 1.0))
        of_sky = np.interp(-downwards, np.linspace(-1.0, 1.0, self.by_sky.size), self.by_sky)
        source = self.sun * np.interp(angle, _ANGLES, self.scattered) + of_sky
        return source * np.where(small, length, -np.expm1(-np.where(small, 0.0, product)) / safe)

    def radiance(self, seen: _Seen) -> Floats:
        """Radiance that comes to the lens [W/m²/nm/sr], `[P]`."""
        hit, begin = np.isfinite(seen.distance), np.maximum(self.depth + seen.deeper, 0.0)
        of_sky = np.where(-(seen.view @ self.down) > self.window, self.sky, 0.0)  # within Snell's window
        total = self.of_water(seen.view, seen.distance, begin) + np.where(hit, 0.0, of_sky)
        if hit.any():
            below = seen.distance[hit] * (seen.view[hit] @ self.down)
            along = np.exp(-self.attenuation * seen.distance[hit] - self.decay * np.maximum(below, -begin[hit]))
            total[hit] += seen.reflectance[hit] / math.pi * self._on_faces(seen.normal[hit]) * along
        return total * np.exp(-self.decay * seen.deeper) * seen.passed

    def _on_faces(self, normals: Floats) -> Floats:
        """Irradiance at the depth of the lens on unit normals `[P, 3]` [W/m²/nm]: sun, sky, and light of the water."""
        rings, azimuths, down = 16, 24, self.down
        first = np.cross(down, [1.0, 0.0, 0.0] if abs(down[0]) < 0.9 else [0.0, 1.0, 0.0])
        first /= np.linalg.norm(first)
        second = np.cross(down, first)
        z = (2.0 * np.arange(rings) + 1.0) / rings - 1.0
        phi = 2.0 * math.pi * (np.arange(azimuths) + 0.5) / azimuths
        across = np.cos(phi)[:, None] * first + np.sin(phi)[:, None] * second
        seen = (z[:, None, None] * down + np.sqrt(1.0 - z**2)[:, None, None] * across).reshape(-1, 3)
        water = self.of_water(seen, np.full(len(seen), np.inf), self.depth)
        # All light that goes down, scattered or not, is in what K_d leaves of sun and sky.
        water[seen @ down < 0.0] = 0.0
        # The window's edge is not on the rings: its own irradiance sets the scale.
        inside = -seen @ down > self.window
        whole = math.pi * (1.0 - self.window**2) * self.sky
        sky = np.where(inside, whole / max((-seen @ down)[inside].sum(), 1e-9), 0.0)
        # Faces of a mesh share normals.
        kinds, index = np.unique(np.round(normals, 4), axis=0, return_inverse=True)
        total = np.maximum(kinds @ seen.T, 0.0) @ (water * (4.0 * math.pi / len(seen)) + sky)
        return (total + self.sun * np.maximum(kinds @ -self.towards, 0.0))[index.reshape(-1)]


class _Seen(NamedTuple):
    """Pixels and what is before them, `[P]` each."""

    view: Floats  # lines of sight in the water `[P, 3]`
    distance: Floats  # along them [m], infinite in open water
    normal: Floats  # of surfaces `[P, 3]`
    reflectance: Floats
    deeper: Floats  # by how much deeper than the lens the lines begin [m]
    passed: Floats  # radiance in front of the lens over that in the water


def downwelling_irradiance(scene: Scene, wavelength_nm: ArrayLike, depth: float | None = None) -> Any:
    """Spectral irradiance from above on a horizontal surface in the water [W/m²/nm], at the lens or another depth [m].

    Raises `ConfigError` for a scene without `[daylight]`, `ArgumentError` outside 400 to 700 nm.
    """
    daylight = _daylight(scene)
    nm = np.asarray(wavelength_nm, np.float64)
    values = [_irradiance(scene, float(one), daylight.depth if depth is None else depth) for one in nm.ravel()]
    total = np.array([direct + diffuse for direct, diffuse, *_ in values]).reshape(nm.shape)
    return total if nm.ndim else float(total)


def daylight_radiance(
    scene: Scene,
    wavelength_nm: float,
    view: ArrayLike,
    *,
    distance: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    reflectance: ArrayLike | None = None,
) -> Floats:
    """Spectral radiance that comes to the lens along lines of sight [W/m²/nm/sr].

    Behind a port that is the transmission times (n_0/n_w)² of the radiance in the water, n_0 being the index inside.
    Raises `ConfigError` for a scene without `[daylight]`, `ArgumentError` outside 400 to 700 nm.

    Args:
        scene, wavelength_nm: With `[daylight]`; 400 to 700 [nm].
        view: Unit vectors in the camera frame in which the lens sees `[..., 3]`.
        distance: Range of a surface `[...]` [m]; NaN or 0 for open water; default: open water.
        normal, reflectance: Of the surface: unit vectors towards the camera `[..., 3]`, Lambertian `[...]`.
    """
    view = np.asarray(view, np.float64)
    seen = _seen(scene, view, distance, normal, reflectance)
    return _Field(scene, wavelength_nm).radiance(seen).reshape(view.shape[:-1])


def daylight_rate(
    scene: Scene,
    *,
    view: ArrayLike | None = None,
    distance: ArrayLike | None = None,
    normal: ArrayLike | None = None,
    reflectance: ArrayLike | None = None,
) -> Floats:
    """Daylight detected per second and pixel [1/s]: aperture, a pixel's solid angle, filter, PDE.

    Without a filter all light from 400 to 700 nm counts, with the PDP of the laser's wavelength. 0 without
    `[daylight]`. `view`: unit vectors of pixels `[..., 3]`, default those of the camera `[H, W, 3]`; the others as in
    `daylight_radiance`, which says what is raised.
    """
    camera = scene.camera
    view = pixel_directions(camera) if view is None else np.asarray(view, np.float64)
    if scene.daylight is None:
        return np.zeros(view.shape[:-1])
    nodes = _band(scene)
    passed = widths_of(nodes) * filter_transmission(scene.laser, scene.detector, nodes)
    photons = passed * nodes * 1e-9 / (PLANCK * SPEED_OF_LIGHT)
    fields = [(_Field(scene, float(nm)), weight) for nm, weight in zip(nodes, photons, strict=True) if weight > 0.0]
    seen = _seen(scene, view, distance, normal, reflectance)
    total = np.zeros(len(seen.view))
    for first in range(0, len(total), _PART_PIXELS):
        part = slice(first, first + _PART_PIXELS)
        pixels = _Seen(*(values[part] for values in seen))
        for field, weight in fields:
            total[part] += field.radiance(pixels) * weight
    etendue = camera.aperture_area * camera.pixel_tangent**2 * view[..., 2] ** 4
    return total.reshape(view.shape[:-1]) * etendue * scene.detector.pde


def noise_rate(scene: Scene, truth: Any = None) -> Any:
    """Mean counts per second without light of the laser: dark counts, ambient light, daylight [1/s].

    A number without `[daylight]`, else `[H, W, 1]`; `truth`: what the pixels see, open water if not given.
    """
    if scene.daylight is None:
        return scene.detector.noise_rate
    seen = {} if truth is None else {"distance": truth.range, "normal": truth.normal, "reflectance": truth.reflectance}
    return (daylight_rate(scene, **seen) + scene.detector.noise_rate)[..., None]


# Parts


def _seen(scene: Scene, view: Floats, distance: Any, normal: Any, reflectance: Any) -> _Seen:
    """What pixels see along unit vectors `[..., 3]`, through the camera's port."""
    view, port = view.reshape(-1, 3), camera_port(scene)
    far, faces, shade = np.full(len(view), np.inf), np.zeros(view.shape), np.zeros(len(view))
    if distance is not None:
        given = np.nan_to_num(np.asarray(distance, np.float64), nan=0.0).reshape(-1)
        far = np.where(given > 0.0, given, np.inf)
        faces = np.nan_to_num(np.asarray(normal, np.float64)).reshape(-1, 3)
        shade = np.nan_to_num(np.asarray(reflectance, np.float64)).reshape(-1)
    if port is None:
        return _Seen(view, far, faces, shade, np.zeros(len(view)), np.ones(len(view)))
    down = _daylight(scene).down @ rotation_matrix(scene.camera.rotation_deg)
    start, direction, lead, _ = port.enter(np.zeros(3), view)
    passed = port.transmission(np.zeros(3), view) * (port.index[0] / port.index[2]) ** 2
    passes = np.isfinite(lead)  # rays that do not get through see nothing
    direction = np.where(passes[:, None], direction, view)
    along = np.maximum(far - np.where(passes, lead, 0.0), 0.0)
    deeper = np.where(passes, start @ down, 0.0)
    return _Seen(direction, along, faces, shade, deeper, np.where(passes, passed, 0.0))


def _daylight(scene: Scene) -> Any:
    if scene.daylight is None:
        raise ConfigError("daylight: the scene has no such section")
    return scene.daylight


def _band(scene: Scene) -> Floats:
    """Wavelengths of the light that passes the filter, from 400 to 700 nm [nm]."""
    least, most, *_ = Interval.read(RANGES["wavelength_nm"])
    band = filter_band(scene.laser, scene.detector)
    if band is None:
        return np.linspace(least, most, 31)
    open_at = band[filter_transmission(scene.laser, scene.detector, band) > 0.0]
    first, last = (float(open_at[0]), float(open_at[-1])) if open_at.size else (0.0, 0.0)
    low, high = max(float(least), first), min(float(most), last)
    if not low < high:
        raise ConfigError(
            f"detector: the filter passes nothing from {least} to {most} nm, where daylight is known; it is open from "
            f"{first:g} to {last:g} nm"
        )
    coarse = np.linspace(low, high, _BAND_NODES)
    # A table with steep sides keeps its own points.
    inside = band[(band >= low) & (band <= high)]
    return np.unique(np.concatenate([coarse, inside])) if inside.size <= 4 * _BAND_NODES else coarse


def _irradiance(scene: Scene, wavelength_nm: float, depth: float) -> tuple[float, float, float, Medium, PhaseFunction]:
    """Of the sun and of the sky on a horizontal surface at a depth [W/m²/nm], K_d [1/m], the water and its law."""
    daylight, medium = _daylight(scene), scene.medium
    medium = medium.at_wavelength(wavelength_nm) if medium.follows_wavelength else medium
    phase, elevation = phase_function(medium), daylight.sun_elevation_deg
    above = skylight.clear_sky_irradiance(
        wavelength_nm, sun_elevation_deg=elevation, aerosol_optical_depth=daylight.aerosol_optical_depth
    )
    backward = phase.backscatter_fraction * medium.scattering
    decay = skylight.daylight_attenuation(medium.absorption, backward, sun_elevation_deg=elevation)
    factor = daylight.cloud_factor * math.exp(-decay * depth)
    direct = factor * (above.direct * (1.0 - skylight.surface_reflectance(elevation, medium.phase_index)))
    return direct, factor * above.diffuse * (1.0 - skylight.SKY_REFLECTANCE), decay, medium, phase


def _window_average(scattered: Floats, window: float) -> Floats:
    """∫ b·p over the directions in which the sky's light goes, for directions of propagation by their cosine with down.

    Rings of equal solid angle; the forward peak within the window is light that goes on, and is left out.
    """
    cosines, rings, azimuths = np.linspace(-1.0, 1.0, 121), 12, 32
    mu = window + (1.0 - window) * (np.arange(rings) + 0.5) / rings
    phi = 2.0 * math.pi * (np.arange(azimuths) + 0.5) / azimuths
    weight = 2.0 * math.pi * (1.0 - window) / (rings * azimuths)
    sines = np.sqrt(1.0 - cosines**2)[:, None, None] * np.sqrt(1.0 - mu**2)[None, :, None]
    angles = np.arccos(np.clip(cosines[:, None, None] * mu[None, :, None] + sines * np.cos(phi), -1.0, 1.0))
    return np.interp(np.maximum(angles, 0.1), _ANGLES, scattered).sum(axis=(1, 2)) * weight
