"""Runs at several wavelengths with the same photons: an axis of wavelength, and the light of a broad laser."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from types import MappingProxyType
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.result import Result
from spadwarp.scene import SceneLike, as_scene, spectral_lines
from spadwarp.transport.simulation import simulate
from spadwarp.values import ArgumentError, ConfigError, check_real

if TYPE_CHECKING:
    import xarray

    from spadwarp.scene import Scene

__all__ = ["Spectrum", "simulate_spectrum"]

_MOST_LINES = 64


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Results by wavelength, of `simulate_spectrum`."""

    scene: Scene
    """The scene with its laser and filter; those of the results have lasers of one line."""
    results: Mapping[float, Result]
    """Wavelength in vacuum [nm], ascending → the run at it, with the photons of all the others."""

    @property
    def wavelengths(self) -> tuple[float, ...]:
        """In vacuum [nm], ascending."""
        return tuple(self.results)

    def combined(self) -> Result:
        """The result of the scene's laser: the sum of the lines by what the spectrum and the filter leave of each, for
        all that takes a result (eq 7 of the paper by Monte Carlo).

        It has no standard errors: those of runs with the same photons are not independent. Raises `ConfigError` where
        the wavelengths are others than those of the spectrum.
        """
        shares = {line.wavelength_nm: line.share for line in spectral_lines(self.scene.laser, self.scene.detector)}
        if set(shares) != set(self.results):
            text = f"{len(self.results)} wavelengths are not the {len(shares)} lines of the spectrum"
            raise ConfigError(f"laser.spectrum: {text}; simulate_spectrum without wavelengths takes those")
        whole, first = math.fsum(shares.values()), next(iter(self.results.values()))
        light = np.zeros(first.tallies.shape)
        for wavelength, one in self.results.items():
            # A bin is as long at all wavelengths; what a tally unit stands for may differ from line to line.
            light += shares[wavelength] / max(whole, 1e-300) * (one.unit * one.photons) * one.tallies
        unit = min(one.unit for one in self.results.values())
        tallies: NDArray[np.int64] = np.rint(light / (unit * first.photons)).astype(np.int64)
        none: dict[str, Any] = dict.fromkeys(("half", "second_moment", "reconstruction", "derivative_tallies"))
        return replace(
            first, scene=self.scene, tallies=tallies, unit=unit, batches=0, batch_size=0, batch_moments={}, **none
        )

    def to_xarray(self) -> xarray.Dataset:
        """`Result.to_xarray` of all lines along `wavelength` [nm]; the path of a bin differs with the group index.

        Raises `FileError`: xarray is not installed.
        """
        sets = [one.to_xarray().drop_vars("path") for one in self.results.values()]
        import xarray

        axis = xarray.DataArray([*self.results], dims="wavelength", attrs={"units": "nm"}, name="wavelength")
        return xarray.concat(sets, dim=axis, combine_attrs="drop_conflicts")


def simulate_spectrum(scene: SceneLike, wavelengths: Iterable[float] | None = None, **options: Any) -> Spectrum:
    """Runs of one scene at several wavelengths, each with the same photons (common random numbers), so that differences
    between lines are known better than the lines.

    Water by chlorophyll, temperature or salinity follows the wavelength, and so do colours of meshes; coefficients
    given as numbers, or by a preset, hold for all.

    Args:
        scene: From `spadwarp.load_scene`, or the path of its file.
        wavelengths: In vacuum, up to 64 [nm]; default: the lines of the laser's spectrum that the filter passes.
        options: As in `simulate`; the seed is that of all runs.

    Raises:
        ArgumentError: No wavelengths, too many, one twice or out of range; ConfigError and others as `simulate`.
    """
    scene = as_scene(scene)
    given = [line.wavelength_nm for line in spectral_lines(scene.laser, scene.detector)]
    if wavelengths is not None:
        given = [check_real("wavelengths", one, "[1e-9, 1e6] nm") for one in wavelengths]
    if not 1 <= len(given) <= _MOST_LINES or len(set(given)) < len(given):
        raise ArgumentError(f"wavelengths: {len(given)} given; 1 to {_MOST_LINES} different ones are needed")
    changes: dict[str, Any] = {"laser.linewidth_nm": None, "laser.spectrum": None}
    if scene.detector.filter_fwhm_nm is not None and scene.detector.filter_centre_nm is None:
        changes["detector.filter_centre_nm"] = scene.laser.wavelength_nm
    options = {"mesh_cache": {}, **options} if options.get("engine") is None else options
    lines = {one: scene.with_overrides({**changes, "laser.wavelength_nm": one}) for one in sorted(given)}
    return Spectrum(scene, MappingProxyType({one: simulate(line, **options) for one, line in lines.items()}))
