"""Runs at several wavelengths with the same photons: an axis of wavelength, and the light of a broad laser."""

from __future__ import annotations

import math
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.io.hdf5 import Coordinate, name_dimensions, write_hdf5
from spadwarp.result import Result
from spadwarp.result.result import Cube, coordinates_of, cubes_of
from spadwarp.scene import Scene, SceneLike, as_scene, spectral_lines
from spadwarp.transport.simulation import simulate
from spadwarp.values import ArgumentError, ConfigError, check_choice, check_real

if TYPE_CHECKING:
    import xarray

__all__ = ["Spectrum", "simulate_spectrum"]

_MOST_LINES = 64
_MOST_TOGETHER = 5  # the kernels take four lines beside that of the photons
_MOST_APART = 1.0  # optical depths of path between lines that share photons
_CUBE = ("wavelength", "component", "y", "x", "time")
_ARRAYS = {
    "share": (("wavelength",), "1", "photons of the laser that are of this line and pass the filter"),
    "histogram": (_CUBE, "1", "fraction of the emitted photons per pixel and bin"),
    "depth": (("wavelength", "y", "x"), "m", "depth z of the return"),
}


@dataclass(frozen=True, eq=False)
class Spectrum:
    """Results by wavelength, of `simulate_spectrum`."""

    scene: Scene
    """The scene with its laser and filter; those of the results have lasers of one line."""
    results: Mapping[float, Result]
    """Wavelength in vacuum [nm], ascending → the run at it, with the photons of all the others. Lines that ride
    together have the energy balance and the counters of one of them."""
    partial: bool = False
    """Whether the runs were interrupted: lines are missing, or have fewer photons."""

    @property
    def shares(self) -> dict[float, float]:
        """Part of the laser's photons that is of each line and passes the filter; where the lines are not those of the
        laser's spectrum, what the filter passes of a laser of this line alone."""
        shares = {line.wavelength_nm: line.share for line in spectral_lines(self.scene.laser, self.scene.detector)}
        if set(shares) == set(self.results):
            return shares
        scenes = {wavelength: one.scene for wavelength, one in self.results.items()}
        return {wavelength: spectral_lines(one.laser, one.detector)[0].share for wavelength, one in scenes.items()}

    def combined(self) -> Result:
        """The result of the scene's laser: the sum of the lines by what the spectrum and the filter leave of each, for
        all that takes a result (eq 7 of the paper by Monte Carlo).

        It has no standard errors: those of runs with the same photons are not independent. Raises `ConfigError` where
        the wavelengths are others than those of the spectrum, the runs were interrupted, or there is flux.
        """
        if self.scene.flux:
            raise ConfigError("flux is not summed over the lines of a spectrum; each of `results` has its own")
        if self.partial:
            raise ConfigError("laser.spectrum: the runs were interrupted, so that lines lack photons")
        lines = spectral_lines(self.scene.laser, self.scene.detector)
        if {line.wavelength_nm for line in lines} != set(self.results):
            text = f"{len(self.results)} wavelengths are not the {len(lines)} lines of the spectrum"
            raise ConfigError(f"laser.spectrum: {text}; wavelengths = 'spectrum' takes those")
        shares, runs, summed = self.shares, [*self.results.values()], list[tuple[NDArray[np.int64], float]]()
        whole, first, signed = math.fsum(shares.values()), runs[0], runs[0].signed_tallies
        # Of each histogram, channel or derivative the lines. A bin is as long at all wavelengths; what a tally unit
        # stands for may differ from line to line.
        for cubes in zip(*map(_tallies_and_units, runs), strict=True):
            light, unit = np.zeros(first.tallies.shape), min(own for _, own in cubes)
            for (wavelength, one), (tallies, own) in zip(self.results.items(), cubes, strict=True):
                light += shares[wavelength] / max(whole, 1e-300) * (own * one.photons) * tallies
            summed.append((np.rint(light / (unit * first.photons)).astype(np.int64), unit))
        histograms, units = zip(*summed, strict=True)
        if signed is not None:
            signed = replace(signed, tallies=np.stack(histograms[1:]), units=units[1:], second_moment=None)
        none: dict[str, Any] = dict.fromkeys(("half", "second_moment", "reconstruction"))
        new: dict[str, Any] = {"tallies": histograms[0], "unit": units[0], "signed_tallies": signed}
        return replace(first, scene=self.scene, **new, batches=0, batch_size=0, batch_moments={}, **none)

    def to_xarray(self) -> xarray.Dataset:
        """`Result.to_xarray` of all lines along `wavelength` [nm]; the path of a bin differs with the group index.

        Raises `FileError`: xarray is not installed.
        """
        sets = [one.to_xarray().drop_vars("path") for one in self.results.values()]
        import xarray

        axis = xarray.DataArray([*self.results], dims="wavelength", attrs={"units": "nm"}, name="wavelength")
        return xarray.concat(sets, dim=axis, combine_attrs="drop_conflicts")

    def save(self, path: str | Path, *, depth: Mapping[float, NDArray[np.float64]] | None = None) -> Path:
        """Writes histograms and depth by line to one HDF5 file with an axis of wavelength, for
        `xarray.open_dataset(path, engine="h5netcdf")`; returns its path.

        `depth`: frames by wavelength [m]; by default `Result.depth`. Raises `FileError`.
        """
        first = next(iter(self.results.values()))
        frames = {line: one.depth() for line, one in self.results.items()} if depth is None else depth
        # As large as the histograms, so that only one line is held at a time.
        with write_hdf5(path) as file:
            file.attrs.update({"photons": first.photons, "seed": str(first.seed), "scene": self.scene.to_toml()})
            file["share"] = [*self.shares.values()]
            file["depth"] = np.stack([frames[line] for line in self.results]).astype(np.float32)
            cubes = (np.stack([one.component(name) for name in one.scene.components]) for one in self.results.values())
            shape = (len(self.results), *first.tallies.shape)
            chunks = (1, 1, *shape[2:]) if first.tallies[0].size < 1 << 17 else (1, 1, 1, *shape[3:])
            light = file.create_dataset("histogram", shape, np.float32, chunks=chunks, compression="gzip", shuffle=True)
            for number, cube in enumerate(cubes):
                light[number] = cube
            axis: dict[str, Coordinate | int | None] = {"wavelength": ([*self.results], "nm", "in vacuum")}
            name_dimensions(file, {**coordinates_of(first), **axis}, _ARRAYS)
        return Path(path)

    def plot(self, path: str | Path, *, depth: Mapping[float, NDArray[np.float64]]) -> Path:
        """Writes a picture: see `spadwarp.viz.draw_spectrum`."""
        import spadwarp

        return spadwarp.viz.draw_spectrum(self, path, depth=depth)


def _tallies_and_units(result: Result) -> list[tuple[NDArray[np.int64], float]]:
    signed = result.signed_tallies
    others = () if signed is None else zip(signed.tallies, signed.units, strict=True)
    return [(result.tallies, result.unit), *others]


def simulate_spectrum(
    scene: SceneLike, wavelengths: Iterable[float] | Literal["spectrum"] | None = None, **options: Any
) -> Spectrum:
    """Runs of one scene at several wavelengths, each with the same photons (common random numbers), so that differences
    between lines are known better than the lines.

    Water by chlorophyll, temperature or salinity follows the wavelength, and so do colours of meshes; coefficients
    given as numbers, or by a preset, hold for all.

    Args:
        scene: From `spadwarp.load_scene`, or the path of its file.
        wavelengths: In vacuum, up to 64 [nm], or "spectrum": the lines of the laser's spectrum that the filter passes;
            by default `scene.laser.wavelengths_nm`, or else "spectrum".
        options: As in `simulate`; the seed is that of all runs.

    Raises:
        ArgumentError: No wavelengths, too many, one twice or out of range; ConfigError and others as `simulate`.
        KeyboardInterrupt: Ctrl-C before the first launch was done. Later it ends all lines, and the lines so far are
            returned, marked `partial`.
    """
    scene = as_scene(scene)
    options = {"mesh_cache": {}, **options} if options.get("engine") is None else options
    left = scenes_of_lines(scene, wavelengths)
    results, partial = dict[float, Result](), False
    alone = any(options.get(name) is not None for name in ("derivatives", "blocks", "tallies"))
    most = 1 if alone else _MOST_TOGETHER
    while left and not partial:
        # As many neighbours as ride on the photons of the one in their middle.
        sizes = range(min(len(left), most), 0, -1)
        size = next(size for size in sizes if size == 1 or _ride_together(left[:size]))
        group, left = left[:size], left[size:]
        try:
            found = _simulate_together(group, **options) if size > 1 else [simulate(group[0], **options)]
        except KeyboardInterrupt:
            if not results:
                raise
            return Spectrum(scene, MappingProxyType(results), partial=True)
        results |= {line.laser.wavelength_nm: one for line, one in zip(group, found, strict=True)}
        partial = any(one.partial for one in found)
    return Spectrum(scene, MappingProxyType(results), partial)


def scenes_of_lines(scene: Scene, wavelengths: Iterable[float] | Literal["spectrum"] | None = None) -> list[Scene]:
    """The scene at each wavelength alone, see `simulate_spectrum`, whose `ArgumentError` it raises; shortest first."""
    wavelengths = scene.laser.wavelengths_nm or "spectrum" if wavelengths is None else wavelengths
    if isinstance(wavelengths, str):
        check_choice("wavelengths", wavelengths, ("spectrum",))
        given = [line.wavelength_nm for line in spectral_lines(scene.laser, scene.detector)]
    else:
        given = [check_real("wavelengths", one, "[1e-9, 1e6] nm") for one in wavelengths]
    if not 1 <= len(given) <= _MOST_LINES or len(set(given)) < len(given):
        raise ArgumentError(f"wavelengths: {len(given)} given; 1 to {_MOST_LINES} different ones are needed")
    changes: dict[str, Any] = {f"laser.{name}": None for name in ("linewidth_nm", "spectrum", "wavelengths_nm")}
    if scene.detector.filter_fwhm_nm is not None and scene.detector.filter_centre_nm is None:
        changes["detector.filter_centre_nm"] = scene.laser.wavelength_nm
    return [scene.with_overrides({**changes, "laser.wavelength_nm": one}) for one in sorted(given)]


def _ride_together(lines: Sequence[Scene]) -> bool:
    """Whether photons of the line in the middle carry the light of all: they differ in coefficients of one water alone,
    and by less than one optical depth over the longest path, beyond which weights become so uneven that a run of its
    own is worth its time."""
    one = lines[len(lines) // 2]
    medium = one.medium
    if medium.varies or medium.inelastic or medium.albedo == "lu2024" or one.polarised or one.surface or one.flux:
        return False
    if one.camera.port or one.laser.port or one.sun or one.domain.reflecting or one.transport.max_path is not None:
        return False
    coloured = any(target.reflectance == "from_file" for target in one.targets)
    if coloured or one.transport.estimator == "none" or medium.particle_scattering <= 0.0:
        return False
    apart = max(abs(line.medium.extinction - medium.extinction) for line in lines)
    return apart * one.path_limit <= _MOST_APART


def _simulate_together(lines: Sequence[Scene], **options: Any) -> list[Result]:
    """Runs of lines on the photons of the one in the middle, whose energy balance and counters all have."""
    middle = len(lines) // 2
    one, gate = lines[middle], lines[middle].gate
    others = [line.medium for k, line in enumerate(lines) if k != middle]
    # What is outside the gate at one wavelength may be in it at another.
    apart = max(abs(medium.group_index / one.medium.group_index - 1.0) for medium in others)
    more = math.ceil(apart * gate.stop / gate.bin_width)
    before = min(more, int(gate.start / gate.bin_width))
    start_ns = gate.start_ns - before * 1e-3 * gate.bin_width_ps
    wide = one.with_overrides({"gate.start_ns": start_ns, "gate.bins": gate.bins + before + more})
    run = simulate(wide.model_copy(update={"medium": wide.medium.with_beside(others)}), **options)
    cubes, kept = cubes_of(run, "channels"), slice(before, before + gate.bins)
    found = [*cubes.values()]
    found.insert(middle, Cube(run.tallies, run.unit, run.second_moment))
    none: dict[str, Any] = dict.fromkeys(("half", "signed_tallies"))
    return [
        replace(
            run,
            scene=line,
            tallies=np.ascontiguousarray(cube.tallies[..., kept]),
            unit=cube.unit,
            second_moment=None if cube.second_moment is None else np.ascontiguousarray(cube.second_moment[..., kept]),
            batch_moments={},
            **none,
        )
        for line, cube in zip(lines, found, strict=True)
    ]
