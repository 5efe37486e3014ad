"""The table `surface`: the surface of the sea between air and water, by the statistics of its slopes and by waves."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from dataclasses import dataclass
from functools import lru_cache
from typing import Annotated, ClassVar, Literal

import numpy as np
from pydantic import Field

from spadwarp.arrays import Floats
from spadwarp.io.arrays import read_npy
from spadwarp.scene.port import air_indices
from spadwarp.scene.pose import unit_vector, vector_of
from spadwarp.scene.sections import Direction, FilePath, Section, Vector, Whole, field, file_of
from spadwarp.values import FileError

_LEAST_VARIANCE = 1e-9
_GRAVITY = 9.81  # [m/s^2]

# Of the variance of slopes on any axis, waves of a spectrum that goes on hold so much: the rest is left to facets.
_RESOLVED = 0.75
# The shortest waves have so many nodes: with fewer a bilinear field has less than 0.8 of their slopes' mean square.
_NODES_OF_A_WAVE = 4.0


class Waves(Section):
    """Resolved waves: a periodic field of heights, drawn from a spectrum or read from a file."""

    size: float = Field(20.0, ge=0.1, le=1e5)
    """period of the field along the waves, and across them unless heights has it [m]"""
    cells: Whole = field(512, "nodes of the field along each side, for a spectrum", "[8, 8192]")
    spectrum: Literal["jonswap"] = field("jonswap", "of the waves that surface.wind makes (Hasselmann et al. 1973)")
    fetch: float = field(10e3, "length of sea over which the wind blows [m]", "[10, 1e7]")
    spreading: float = Field(10.0, ge=0.5, le=200)
    """s of the distribution cos^2s(θ/2) of directions; large: one direction"""
    direction: Direction | None = field(None, "in which the waves go, in the world; default: surface.direction, or any")
    shortest: float | None = Field(None, ge=1e-3, le=1e4)
    """length of the shortest waves [m]; default: four nodes, or more until facets keep a quarter of the slopes"""
    seed: Whole = field(0, "of the phases and heights of the waves", "[0, 9223372036854775807]")
    time: float = field(0.0, "at which the waves are seen [s]", "[-1e9, 1e9]")
    heights: Annotated[str | None, FilePath(".npy")] = field(None, "heights [rows, columns] in place of a spectrum [m]")

    def _problems(self) -> Iterator[str]:
        of_spectrum = "cells", "fetch", "spreading", "shortest", "seed", "time"
        yield from self._only_with("a spectrum, in place of heights,", self.heights is None, *of_spectrum)
        if self.shortest is not None and self.shortest < 2.0 * self.size / self.cells:
            yield f"shortest = {self.shortest} m is less than two nodes, {2.0 * self.size / self.cells:.4g} m"


class Surface(Section):
    """The surface of the sea: a mean plane with air above and water below; camera, laser and targets on either side."""

    section: ClassVar[str] = "surface"
    displaces: ClassVar = {"wind": ("mean_square_slope",), "mean_square_slope": ("wind", "direction")}
    preset: str | None = field(None, "a named state of the sea, see `spadwarp list presets surface`")
    point: Vector = field((0.0, 0.0, 0.0), "a point of the mean plane, in the world [m]")
    up: Direction = field((0.0, -1.0, 0.0), "direction out of the water in the world; any length but 0")
    wind: float | None = field(None, "speed of the wind 12.5 m above the sea, after Cox and Munk [m/s]", "[0, 30]")
    mean_square_slope: float | None = field(None, "of both axes together, in place of wind; 0 is flat", "[0, 0.2]")
    direction: Direction | None = None
    """in which the wind blows, in the world: slopes are steeper along it; without it they are the same all around"""
    air_index: float | None = field(None, "phase index of the air; default: that of dry air", "[1, 1.2]")
    air_group_index: float | None = field(None, "group index of the air; default: dry air's, or air_index", "[1, 1.2]")
    air_extinction: float = field(0.0, "of the air, whose scattered light is lost [1/m]", "[0, 100]")
    waves: Waves | None = field(None, "resolved waves; facets are about those then, with the slopes that they leave")

    def _problems(self) -> Iterator[str]:
        if (self.wind is None) == (self.mean_square_slope is None):
            yield "needs either wind or mean_square_slope"
        yield from self._only_with("wind", self.wind is not None, "direction")
        yield from self._only_with("air_index", self.air_index is not None, "air_group_index")
        waves = self.waves
        ways = {"direction": self.direction, "waves.direction": None if waves is None else waves.direction}
        for name, direction in ways.items():
            if direction is not None and abs(np.dot(unit_vector(direction), self.normal)) > 0.999:
                yield f"{name} = {list(direction)} is that of up: wind and waves go along the sea"
        if waves is None:
            return
        if self.wind == 0.0 or self.mean_square_slope == 0.0:
            yield "waves need wind or mean_square_slope > 0"
        elif waves.heights is None and self.wind is None:
            yield "waves.spectrum needs wind, which raises its waves; mean_square_slope goes with waves.heights"
        elif waves.heights is None and (longest := peak_length(self.wind or 0.0, waves.fetch)) > waves.size:
            yield f"waves.size = {waves.size} m holds no wave of the peak, {longest:.4g} m long"

    @property
    def normal(self) -> tuple[float, float, float]:
        """`up` as a unit vector."""
        return unit_vector(self.up)

    @property
    def slope_variances(self) -> tuple[float, float]:
        """Of the slopes along and across `direction`; equal without one."""
        if self.mean_square_slope is not None:
            even = 0.5 * self.mean_square_slope
            return even, even
        from spadwarp_kernels import slope_variances  # which imports Warp

        along, across = slope_variances(self.wind or 0.0, by_direction=self.direction is not None)
        return max(along, _LEAST_VARIANCE), across

    @property
    def is_flat(self) -> bool:
        """Whether there are no waves."""
        return not any(self.slope_variances)

    def air(self, wavelength_nm: float) -> tuple[float, float]:
        """Phase and group index of the air."""
        if self.air_index is not None:
            return self.air_index, self.air_group_index or self.air_index
        return air_indices(wavelength_nm)

    @property
    def wave_axis(self) -> tuple[float, float, float]:
        """Unit vector along the mean plane in which waves go, along a row of their field, in the world."""
        direction = None if self.waves is None else self.waves.direction
        up = np.array(self.normal)
        along = np.array(direction or self.direction or np.eye(3)[np.argmin(np.abs(up))], np.float64)
        return unit_vector(vector_of(along - (along @ up) * up))

    @property
    def wave_field(self) -> WaveField | None:
        """The resolved waves; None: there are none. Raises `FileError`."""
        waves = self.waves
        if waves is None:
            return None
        if waves.heights is not None:
            path = waves.heights
            return _read_heights(path, waves.size, os.path.getmtime(path) if os.path.exists(path) else 0.0)
        total = self._slopes_along(self.wave_axis)
        return _draw_waves(self.wind or 0.0, total, waves)

    def _slopes_along(self, axis: tuple[float, float, float]) -> tuple[float, float, float]:
        """Variances of all slopes along an axis of the plane and across it, and their covariance."""
        along, across = self.slope_variances
        if self.direction is None:
            return along, across, 0.0
        up = np.array(self.normal)
        wind = np.array(self.direction, np.float64)
        wind -= (wind @ up) * up
        wind /= np.linalg.norm(wind)
        c, s = float(wind @ axis), float(wind @ np.cross(up, axis))
        return along * c * c + across * s * s, along * s * s + across * c * c, (along - across) * c * s

    def height_of(self, point: tuple[float, float, float]) -> float:
        """Height of a point of the world above the mean plane [m]."""
        return math.fsum(n * (x - p) for n, x, p in zip(self.normal, point, self.point, strict=True))


# Resolved waves


@dataclass(frozen=True)
class WaveField:
    """A periodic field of heights above the mean plane; a row goes along `Surface.wave_axis`."""

    heights: Floats  # of the nodes [m], `[rows, columns]`
    size: tuple[float, float]  # length of a row and of a column [m]

    @property
    def amplitude(self) -> float:
        """Largest height or depth [m]."""
        return float(np.abs(self.heights).max())


def _peak_frequency(wind: float, fetch: float) -> float:
    """That of the spectrum's peak [rad/s] (Hasselmann et al. 1973)."""
    return 22.0 * (_GRAVITY**2 / (wind * fetch)) ** (1.0 / 3.0)


def peak_length(wind: float, fetch: float) -> float:
    """Length of the waves of the spectrum's peak, in deep water [m]; wind > 0 [m/s], fetch [m]."""
    return 2.0 * math.pi * _GRAVITY / _peak_frequency(wind, fetch) ** 2


def jonswap(frequency: Floats, wind: float, fetch: float) -> Floats:
    """Spectral density of heights [m^2 s/rad] at frequencies > 0 [rad/s]: JONSWAP (Hasselmann et al. 1973, γ = 3.3),
    for a wind > 0 [m/s] and a fetch [m]."""
    peak = _peak_frequency(wind, fetch)
    alpha = 0.076 * (wind**2 / (fetch * _GRAVITY)) ** 0.22
    width = np.where(frequency <= peak, 0.07, 0.09)
    enhanced = 3.3 ** np.exp(-0.5 * ((frequency / peak - 1.0) / width) ** 2)
    density: Floats = alpha * _GRAVITY**2 * frequency**-5.0 * np.exp(-1.25 * (peak / frequency) ** 4) * enhanced
    return density


@lru_cache(8)
def _draw_waves(wind: float, slopes: tuple[float, float, float], waves: Waves) -> WaveField:
    """Waves of deep water, ω² = g k, whose amplitudes are normal numbers about the spectrum."""
    count, size = waves.cells, waves.size
    k = 2.0 * math.pi * np.fft.fftfreq(count, size / count)
    kx, ky = np.meshgrid(k, k)
    length = np.hypot(kx, ky)
    length[0, 0] = math.inf
    frequency = np.sqrt(_GRAVITY * length)
    frequency[0, 0] = 1.0
    s = waves.spreading
    of_direction = np.cos(0.5 * np.arctan2(ky, kx)) ** (2.0 * s)
    of_direction /= 2.0 * math.sqrt(math.pi) * math.exp(math.lgamma(s + 0.5) - math.lgamma(s + 1.0))
    density = jonswap(frequency, wind, waves.fetch) * 0.5 * _GRAVITY / frequency * of_direction / length
    normal = np.random.default_rng(waves.seed).standard_normal((2, count, count))
    amplitude = (normal[0] + 1j * normal[1]) * np.sqrt(density * (2.0 * math.pi / size) ** 2)
    amplitude[length > 2.0 * math.pi / (waves.shortest or _NODES_OF_A_WAVE * size / count)] = 0.0
    if waves.shortest is None:
        amplitude[length > _largest_number(kx, ky, length, 0.5 * np.abs(amplitude) ** 2, slopes)] = 0.0
    amplitude *= np.exp(-1j * frequency * waves.time)
    heights = np.fft.ifft2(amplitude).real * count**2
    return WaveField(heights, (size, size))


def _largest_number(
    kx: Floats, ky: Floats, length: Floats, variance: Floats, slopes: tuple[float, float, float]
) -> float:
    """The wave number up to which waves hold no more than `_RESOLVED` of the variance of slopes on any axis [1/m]."""
    order = np.argsort(length, axis=None)[:-1]  # but the mean
    xx, yy, xy = (np.cumsum((p * q * variance).ravel()[order]) for p, q in ((kx, kx), (ky, ky), (kx, ky)))
    root = np.linalg.inv(np.linalg.cholesky([[slopes[0], slopes[2]], [slopes[2], slopes[1]]]))
    part = np.linalg.eigvalsh(root @ np.moveaxis(np.array([[xx, xy], [xy, yy]]), -1, 0) @ root.T)[:, 1]
    kept = int(np.searchsorted(part, _RESOLVED, side="right"))
    return float(length.ravel()[order[kept - 1]]) if kept else 0.0


@lru_cache(2)
def _read_heights(path: str, size: float, changed: float) -> WaveField:
    with file_of("surface.waves.heights"):
        heights = read_npy(path)
        if heights.ndim != 2 or min(heights.shape) < 2 or heights.dtype.kind not in "iuf":
            raise FileError(f"{path}: {heights.dtype} {heights.shape}; real numbers [rows, columns] are needed")
        values = heights.astype(np.float64)
        if not (np.abs(values) <= 1e4).all():
            raise FileError(f"{path}: holds {values.min()} to {values.max()}; heights in [-1e4, 1e4] m are needed")
    return WaveField(values - values.mean(), (size, size * heights.shape[0] / heights.shape[1]))
