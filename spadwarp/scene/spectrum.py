"""The laser's spectrum and the filter before the detector: how much of the light is detected, and in which lines.

A laser without `linewidth_nm` and `spectrum` is one line at `wavelength_nm`.
"""

from __future__ import annotations

import itertools
import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ConfigError
from spadwarp.scene.detector import Detector
from spadwarp.scene.laser import Laser
from spadwarp.scene.sections import field_range, read_table

__all__ = ["SpectralLine", "detection_efficiency", "filter_transmission", "spectral_lines"]

Floats = NDArray[np.float64]

_WAVELENGTHS = str(field_range(Laser, "wavelength_nm"))
SPECTRUM_COLUMNS = {"wavelength_nm": _WAVELENGTHS, "power": "[0, 1e30]"}
"""Columns of a laser's spectrum: vacuum wavelength [nm] and power per nm of any scale."""
FILTER_COLUMNS = {"wavelength_nm": _WAVELENGTHS, "transmission": "[0, 1]"}
"""Columns of a filter: vacuum wavelength [nm] and transmission."""

_MOST_LINES = 32
_REACH = 2.0  # FWHM to either side, where a Gaussian has fallen to 1.5e-5 of its height
_NODES = 513  # of a Gaussian


class SpectralLine(NamedTuple):
    """A part of a pulse's spectrum.

    Attributes:
        wavelength_nm: Mean over its photons [nm].
        share: Photons that pass the filter, over those of a pulse of one line at `laser.wavelength_nm`.
    """

    wavelength_nm: float
    share: float


def filter_transmission(laser: Laser, detector: Detector, wavelength_nm: ArrayLike) -> Floats:
    """Transmission of the detector's filter at vacuum wavelengths [nm]; 1 without a filter.

    Raises `FileError` or `ConfigError` if its table cannot be read.
    """
    wavelength = np.asarray(wavelength_nm, np.float64)
    if detector.filter_table is not None:
        at, value = _table("detector.filter_table", detector.filter_table, FILTER_COLUMNS)
        return np.interp(wavelength, at, value, left=0.0, right=0.0)
    if detector.filter_fwhm_nm is None:
        return np.ones_like(wavelength)
    centre = laser.wavelength_nm if detector.filter_centre_nm is None else detector.filter_centre_nm
    return detector.filter_peak * _gaussian((wavelength - centre) / detector.filter_fwhm_nm)


def filter_band(laser: Laser, detector: Detector) -> Floats | None:
    """Wavelengths [nm] between which the filter's transmission is as good as straight; None without a filter."""
    if detector.filter_table is not None:
        return _table("detector.filter_table", detector.filter_table, FILTER_COLUMNS)[0]
    if detector.filter_fwhm_nm is None:
        return None
    centre = laser.wavelength_nm if detector.filter_centre_nm is None else detector.filter_centre_nm
    nodes = centre + detector.filter_fwhm_nm * np.linspace(-_REACH, _REACH, _NODES)
    return nodes[nodes > 0.0]


def spectral_lines(laser: Laser, detector: Detector) -> tuple[SpectralLine, ...]:
    """Lines of a pulse's photons that pass the filter, up to 32; one for a laser of one line.

    Raises `FileError` or `ConfigError` if a table cannot be read.
    """
    if laser.spectrum is None and laser.linewidth_nm == 0.0:
        return (SpectralLine(laser.wavelength_nm, float(filter_transmission(laser, detector, laser.wavelength_nm))),)
    wavelength, photons = _passed(laser, detector)
    total = float(photons.sum())
    if not total > 0.0:
        return (SpectralLine(laser.wavelength_nm, 0.0),)
    reached = np.cumsum(photons) / total
    low, high = wavelength[np.searchsorted(reached, [1e-6, 1.0 - 1e-6])]
    group = np.clip((wavelength - low) / max(high - low, 1e-300) * _MOST_LINES, 0, _MOST_LINES - 1).astype(int)
    share = np.bincount(group, photons, _MOST_LINES)
    moment = np.bincount(group, photons * wavelength, _MOST_LINES)
    return tuple(SpectralLine(float(m / s), float(s)) for s, m in zip(share, moment, strict=True) if s > 0.0)


def detection_efficiency(laser: Laser, detector: Detector) -> float:
    """Detections for each photon of the laser that reaches a pixel: PDE, times what the filter passes of the spectrum.

    Photons are counted as if the pulse had the one wavelength `laser.wavelength_nm`. Raises as `spectral_lines` does.
    """
    return detector.pde * math.fsum(line.share for line in spectral_lines(laser, detector))


def _passed(laser: Laser, detector: Detector) -> tuple[Floats, Floats]:
    """Wavelengths [nm] and the photons about each that pass the filter, over those of a pulse of one line."""
    if laser.spectrum is not None:
        at, power = _table("laser.spectrum", laser.spectrum, SPECTRUM_COLUMNS)
    else:
        at = laser.wavelength_nm + laser.linewidth_nm * np.linspace(-_REACH, _REACH, _NODES)
        power = _gaussian((at - laser.wavelength_nm) / laser.linewidth_nm)
    band = filter_band(laser, detector)
    nodes = np.unique(np.concatenate([at, np.empty(0) if band is None else band]))
    # Both may be steep between the nodes of a coarse table.
    nodes = np.unique(np.concatenate([np.linspace(a, b, 9) for a, b in itertools.pairwise(nodes)]))
    density = np.interp(nodes, at, power, left=0.0, right=0.0) / np.trapezoid(power, at)
    passed = filter_transmission(laser, detector, nodes)
    return nodes, density * widths_of(nodes) * passed * nodes / laser.wavelength_nm


def widths_of(nodes: Floats) -> Floats:
    """Widths that ascending wavelengths stand for, half of what is between it and its neighbours."""
    widths = np.gradient(nodes)
    widths[0], widths[-1] = 0.5 * (nodes[1] - nodes[0]), 0.5 * (nodes[-1] - nodes[-2])
    return widths


def _gaussian(offset: Any) -> Any:
    """A Gaussian of unit height and unit full width at half maximum."""
    return np.exp(-4.0 * math.log(2.0) * np.square(offset))


def _table(field: str, path: str, columns: dict[str, str]) -> tuple[Floats, Floats]:
    """Two columns of rising wavelengths and what is not all 0."""
    at, values = read_table(field, path, columns)
    if len(at) < 2 or (np.diff(at) <= 0.0).any():
        raise ConfigError(f"{field}: {path}: two rows or more with rising wavelengths are needed")
    if not values.max() > 0.0:
        raise ConfigError(f"{field}: {path}: holds no {next(reversed(columns))} above 0")
    return at, values
