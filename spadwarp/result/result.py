"""The result of a simulation: photon histograms with their errors and channels, energy balance and truth maps."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import Floats
from spadwarp.io.hdf5 import Coordinate, image_coordinates
from spadwarp.io.text import read_toml
from spadwarp.result.photon_ids import count, photons_per_position
from spadwarp.result.tallies import (
    GRID,
    NO_BATCHES,
    Tallies,
    block_parameters,
    check_flux,
    flux_arrays,
    is_block_name,
    part_of,
)
from spadwarp.scene import Scene, noise_rate
from spadwarp.scene.medium import NOTABLE_UNSEEN
from spadwarp.scene.scene import Component
from spadwarp.scene.sight import lines_of_sight
from spadwarp.values import ArgumentError, ConfigError, FileError, Shown, check_choice, check_real, percent

__all__ = ["CHANNELS", "COMPONENTS", "POLARISED", "Channel", "Component", "Half", "Reconstruction", "Result", "Truth"]
__all__ += ["NOISE_GOAL", "FluxValues", "PhotonsNeeded", "component_errors", "photons_needed"]

COMPONENTS: tuple[Component, ...] = get_args(Component)[:3]
"""Those of every result; `Scene.components` are those of a scene."""

Channel = Literal["I", "co", "cross", "raman", "fluorescence"]
CHANNELS: tuple[Channel, ...] = get_args(Channel)
"""What a receiver may record: light of the laser's wavelength, all of it or what an analyser passes at its angle or
across it; or light of other wavelengths."""
POLARISED: tuple[Channel, ...] = ("co", "cross")
"""Those of an analyser."""

# Share of the variance between batches from which one batch is said to decide a standard error. Chance alone exceeds
# it with a probability of _FALSE_ALARM at most, see `_threshold`.
_DECIDING_SHARE = 0.9
_FALSE_ALARM = 1e-4
# Relative standard errors that are smaller are good enough whatever carries them.
_SMALL_ERROR = 0.005

NOISE_GOAL = 0.1
"""`Result.target_noise_ratio` up to which a result's noise does not show beside that of a frame's photons: it adds 5 %
to their standard deviation."""

_FWHM_PER_SIGMA = math.sqrt(8.0 * math.log(2.0))
_NARROW = 0.2  # standard deviation [bins] of a response that leaves light in its bin
_PART_VOXELS = 1 << 22
_SAMPLE = 1024  # pixels whose median stands for the target

DIMENSION_OF = {"derivatives": "parameter", "channels": "channel"}

TABLES = read_toml(Path(__file__).with_name("arrays.toml"))
ARRAYS: dict[str, tuple[Any, tuple[str, ...], str, str]] = {
    name: (np.dtype(entry["type"]).type, tuple(entry["dimensions"]), entry["unit"], entry["meaning"])
    for name, entry in TABLES["arrays"].items()
}
"""Those of a result by their names in its file: type, dimensions, unit, meaning."""


def shape_of(name: str, height: int, width: int, **counts: int) -> tuple[int, ...]:
    """Of an array, from the size of the image and those of time, parameter and channel."""
    sizes = {"component": len(COMPONENTS), "word": 2, "axis": 3, "y": height, "x": width, **counts}
    return tuple(sizes[dimension] for dimension in ARRAYS[name][1])


def _check_array(name: str, array: NDArray[Any], shape: tuple[int, ...]) -> None:
    kind = np.dtype(ARRAYS[name][0])
    if array.dtype != kind or array.shape != shape:
        raise ArgumentError(f"{name.replace('/', '.')}: {array.dtype} {array.shape}; {kind} {shape} is needed")


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Truth:
    """What the camera would see through clear water, at pixel centres; NaN where the line of sight hits nothing."""

    depth: NDArray[np.float32]  # float32 `[H, W]`, planar depth z [m]
    range: NDArray[np.float32]  # float32 `[H, W]`, distance along the line of sight [m]
    normal: NDArray[np.float32]  # float32 `[H, W, 3]`, unit normal on the camera's side, in the camera frame
    reflectance: NDArray[np.float32]  # float32 `[H, W]`, Lambertian reflectance in [0, 1]

    def __post_init__(self) -> None:
        if self.depth.ndim != 2:
            raise ArgumentError(f"truth.depth has {self.depth.ndim} dimensions; 2 are needed")
        for name, array in vars(self).items():
            _check_array(f"truth/{name}", array, shape_of(f"truth/{name}", *self.depth.shape))

    def __repr__(self) -> str:
        height, width = self.depth.shape
        known = self.depth[np.isfinite(self.depth)]
        depth = f"{known.min():.4g} to {known.max():.4g} m in {known.size}" if known.size else "nothing is hit, 0"
        return f"Truth({width} x {height} pixels: depth {depth} pixels)"


@dataclass(frozen=True, eq=False, kw_only=True)
class ResultHead:
    """Which photons of which run a result holds: its fields without arrays, as in `Result`."""

    scene: Scene  # the scene that was simulated
    unit: float  # fraction of one emitted photon per tally unit, a power of two
    photons: int  # emitted photons, > 0
    seed: int  # 64-bit seed of the run
    energy_balance_unit: float  # photons per unit of `energy_balance`, a power of two
    partial: bool = False  # whether the run was interrupted; `photons` then counts those that were done
    photon_ranges: Sequence[tuple[int, int]] = ()
    """The ids of the photons as [start, stop) pairs; runs with disjoint ids can be added by `merge`."""
    batch_size: int = 0  # photons of a batch, the first and last of a run aside; 0: no errors are kept
    requested: tuple[int, int] = (0, 0)  # ids [start, stop) that were asked for; an interrupted run has a part of them
    focus_distance: float | None = None  # depth that the lens images sharply [m]; None: all of them, for a pinhole
    file_hashes: tuple[str, ...] = ()  # SHA-256 of each of `scene.files` when the photons were traced


class Half(NamedTuple):
    """One of two independent halves of a run."""

    tallies: NDArray[np.int64]  # int64 `[3, H, W, T]`, as of `Tallies`
    photons: int  # emitted
    tally_value: Floats  # expected fraction of emitted photons per tally unit, float64 `[H, W]`


@dataclass(frozen=True, eq=False, kw_only=True)
class Reconstruction:
    """The light of a result without most of its noise, see `spadwarp.reconstruct`."""

    histogram: NDArray[np.float32]  # float32 `[3, H, W, T]`, fraction of the emitted photons by component
    error: NDArray[np.float32]  # float32 `[H, W, T]`, of the sum over components: standard deviation and bias


@dataclass(frozen=True, eq=False, kw_only=True)
class FluxValues:
    """One array of a section, float64, with an axis for each dimension: "fluence" `[gate, x, y, z]` [1/m²],
    "irradiance" `[position, kind]` or "radiance" `[position, polar, azimuth]` [1/sr], of planes with a radius by m².

    By emitted photon: times the energy of a pulse, or the irradiance of the sun, it is that in joules or watts.
    """

    values: Floats
    errors: Floats | None  # standard errors; None without batches
    dimensions: Mapping[str, Coordinate]  # values, unit and meaning of each axis
    unit: str

    def rate(self) -> Floats:
        """Of a fluence the fluence rate [1/(m²·s)]: over the width of the gates.

        Raises `ConfigError` for anything else, and for a fluence of all times.
        """
        gates = np.asarray(self.dimensions.get("gate", ((),))[0], np.float64)
        if len(gates) < 2:
            raise ConfigError("a rate needs a volume with two gates or more")
        return self.values / (gates[1] - gates[0])


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Result(Shown, ResultHead, Tallies):
    """Expected photon histograms of one scene in fixed point, value = tally · unit / photons, see `tally_value`, and
    all that is needed to interpret them; with the attributes of `Tallies`."""

    truth: Truth  # depth, range, normal and reflectance at pixel centres
    reconstruction: Reconstruction | None = None  # beside the tallies, never instead of them
    timing: Mapping[str, float] = field(default_factory=dict)  # seconds of each stage
    provenance: Mapping[str, Any] = field(default_factory=dict)  # versions, device and date

    def __post_init__(self) -> None:
        if not self.photon_ranges:
            object.__setattr__(self, "photon_ranges", ((0, self.photons),))
        if self.requested == (0, 0):
            object.__setattr__(self, "requested", (self.photon_ranges[0][0], self.photon_ranges[-1][1]))
        if self.second_moment is None:
            object.__setattr__(self, "batches", 0)
        ids = self.photon_ranges
        if self.photons <= 0 or count(ids) != self.photons:
            text = f"the {count(ids)} ids of photon_ranges, more than 0, are needed"
            raise ArgumentError(f"photons = {self.photons}; {text}")
        if self.second_moment is not None and not (self.batch_size > 0 and 1 <= self.batches <= self.photons):
            raise ArgumentError(f"batches = {self.batches} of {self.batch_size} photons cannot be those of the run")
        if not 0 <= self.half_photons <= self.photons:
            raise ArgumentError(f"half_photons = {self.half_photons} is outside [0, {self.photons}]")
        signed, expected = self.signed_tallies, self.scene.tallied_channels
        channels = signed.names if signed is not None and signed.group == "channels" else ()
        if channels != expected:
            text = f"channels are {', '.join(channels) or 'none'}; those of the scene's camera are"
            raise ArgumentError(f"{text} {', '.join(expected) or 'none'}")
        camera, counts = self.scene.camera, {} if signed is None else {DIMENSION_OF[signed.group]: len(signed.names)}
        counts |= {"component": len(self.scene.components), "time": self.scene.gate.bins}
        for name, array in arrays_of(self).items():
            _check_array(name, array, shape_of(name, camera.height, camera.width, **counts))
        check_flux(self.scene, self.flux_tallies, self.batches)
        units = {"unit": self.unit, "energy_balance_unit": self.energy_balance_unit}
        if signed is not None:
            if (signed.second_moment is None) != (self.second_moment is None):
                raise ArgumentError(f"{signed.group} and tallies: both have a second moment, or none of them")
            named = zip(signed.names, signed.units, strict=True)
            units |= {f"{signed.group}: unit of {name}": unit for name, unit in named}
        for name, unit in units.items():
            if not (unit > 0 and math.frexp(unit)[0] == 0.5):
                raise ArgumentError(f"{name} = {unit} is not a power of two")

    def __repr__(self) -> str:
        name = self.scene.source.stem if self.scene.source else "Python"
        height, width, bins = self.tallies.shape[1:]
        photons = f"{self.photons} photons" + (", interrupted" if self.partial else "")
        return f"Result({name}: {photons}, seed {self.seed}, {width} x {height} pixels x {bins} bins)"

    # Histograms

    @cached_property
    def histogram(self) -> Floats:
        """Expected fraction of emitted photons that arrive in each pixel and bin: float64 `[H, W, T]`, read-only."""
        total = self._fraction(self.tallies.sum(axis=0))
        total.flags.writeable = False
        return total

    def component(self, name: Component) -> Floats:
        """One part of the histogram, float64 `[H, W, T]`.

        `"ballistic"`: one surface and no collision. `"forward_scattered"`: every other history with a surface.
        `"backscatter"`: water alone. `"surface"`: the surface of the sea alone, where there is one. Their sum is the
        histogram (eq 2).
        """
        return self._fraction(self.tallies[_number(self, name)])

    def expected(self, name: Component | None = None) -> Floats:
        """The best estimate of the histogram or of a component, float64 `[H, W, T]`: of `reconstruction`, where there
        is one, else of the tallies."""
        if self.reconstruction is None:
            return self.histogram if name is None else self.component(name)
        parts = self.reconstruction.histogram
        if name is None:
            return parts.sum(axis=0, dtype=np.float64)
        return parts[_number(self, name)].astype(np.float64)

    @property
    def expected_error(self) -> Floats:
        """Standard error of `expected()`, float64 `[H, W, T]`; of the reconstruction with its bias. Raises as
        `standard_error` does."""
        return self.standard_error if self.reconstruction is None else self.reconstruction.error.astype(np.float64)

    @property
    def detections(self) -> Floats:
        """Expected detections per pulse, float64 `[H, W, T]`: histogram · photons per pulse · PDE."""
        return self.histogram * np.float64(self.scene.detectable_photons_per_pulse)

    @cached_property
    def tally_value(self) -> Floats:
        """Expected fraction of emitted photons per tally unit, float64 `[H, W]`: unit / photons.

        In a scan, of the photons that were emitted while the beam was at the pixel's own position.
        """
        return self.unit / photons_per_position(self.scene, self.photon_ranges)

    @property
    def intensity(self) -> Floats:
        """Expected fraction of emitted photons that arrive in each pixel within the gate, of the reconstruction where
        there is one: float64 `[H, W]`."""
        if self.reconstruction is not None:
            return self.reconstruction.histogram.sum(axis=(0, 3), dtype=np.float64)
        return self.tallies.sum(axis=(0, 3), dtype=np.float64) * self.tally_value

    def _fraction(self, tallies: NDArray[np.int64]) -> Floats:
        return tallies * self.tally_value[..., None]

    @property
    def derivatives(self) -> Mapping[str, Floats]:
        """Parameter → ∂histogram/∂parameter by component, float64 `[3, H, W, T]`; of those that `simulate` was asked
        for, "medium.absorption" [per 1/m] and others, with all other parameters fixed. Those by block of a grid's
        cells, "medium.grid.absorption[0,0,0]" and others, are also there together: "medium.grid.absorption" is
        `[x, y, z, 3, H, W, T]`."""
        return _SignedValues(self, "derivatives")

    @property
    def channels(self) -> Mapping[str, Floats]:
        """Channel: "co" and "cross" of an analyser, "I", "Q", "U" and "V", or "raman" and "fluorescence" → its light,
        as `derivatives`; the histogram is of light without an analyser."""
        return _SignedValues(self, "channels")

    @cached_property
    def flux(self) -> Mapping[str, Mapping[str, FluxValues]]:
        """Section of `[[flux]]` → its arrays, "fluence" of a volume, "irradiance" and "radiance" of planes."""
        sections = dict[str, dict[str, FluxValues]]()
        for name, array in flux_arrays(self.scene).items():
            assert self.flux_tallies is not None
            section, _, kind = name.partition("/")
            value, errors = array.value / self.photons, None
            counts, moments = part_of(self.flux_tallies.tallies, array), self.flux_tallies.second_moment
            if moments is not None and self.batches > 1:
                errors = self.batch_error(counts[None], part_of(moments, array)) * value
            made = FluxValues(values=counts * value, errors=errors, dimensions=array.dimensions, unit=array.unit)
            sections.setdefault(section, {})[kind] = made
        return sections

    # Errors

    @cached_property
    def standard_error(self) -> Floats:
        """Standard error of `histogram` from the spread between batches, float64 `[H, W, T]`.

        Raises `ConfigError`: the run has no batches, or only one.
        """
        return self.batch_error(self.tallies, self.known_moment) * self.tally_value[..., None]

    def batch_error(self, tallies: NDArray[np.int64], second_moment: NDArray[np.uint64]) -> Floats:
        """Standard error of the sum over components of tallies `[3, ...]`, in their unit, from the spread of batches.

        With x of a batch of n photons, N photons and X in all B batches, Σ (x - n X/N)²/n = Σ x²/n - X²/N has the mean
        (B - 1) times the variance of a photon's light, whatever the sizes of the batches.
        """
        if self.batches < 2:
            raise ConfigError(NO_BATCHES)
        total = tallies.sum(axis=0).astype(np.float64)
        squares = (second_moment[1] * 2.0**64 + second_moment[0]) * (self.photons / self.batch_size)
        return np.sqrt(np.maximum(squares - total**2, 0.0) / (self.batches - 1))

    @property
    def derivative_errors(self) -> Mapping[str, Floats]:
        """Parameter → standard error of its derivative, of all components together, float64 `[H, W, T]`; raises as
        `standard_error` does."""
        return _SignedValues(self, "derivatives", errors=True)

    @property
    def channel_errors(self) -> Mapping[str, Floats]:
        """Channel → standard error, as `derivative_errors`."""
        return _SignedValues(self, "channels", errors=True)

    @cached_property
    def _unseen_peak(self) -> tuple[float, float]:
        try:
            return self.scene.unseen_peak(self.photons, self.truth.range)
        except (ConfigError, FileError):
            return math.pi, 1.0

    @property
    def unseen_share(self) -> float:
        """Part of the light scattered in the water, in [0, 1], that the run may have missed: that of a forward peak
        which its photons are too few to see (`Scene.unseen_peak`). No standard error holds it. 1 where the table of
        the phase function is gone."""
        return self._unseen_peak[1]

    @property
    def halves(self) -> tuple[Half, Half]:
        """Two independent runs, of the batches with even and odd numbers, whose sum the result is.

        Raises `ConfigError`: the run has no batches, or only one.
        """
        if self.half is None or not 0 < self.half_photons < self.photons:
            raise ConfigError(NO_BATCHES)
        parts = (self.half, self.half_photons), (self.tallies - self.half, self.photons - self.half_photons)
        even, odd = (Half(part, photons, self.tally_value * (self.photons / photons)) for part, photons in parts)
        return even, odd

    @cached_property
    def noise_ratio(self) -> Floats:
        """Noise of the simulation against that of the camera: float64 `[H, W]`, NaN where nothing returned.

        The variance that too few traced photons give the return of a pixel, over that which the photons of a frame of
        `Scene.pulses_per_depth_frame` pulses have. The return is that of the target, or of all light where there is
        none, as a matched filter adds it up: each bin with its expected light as the weight. Below 0.1 noise of the
        simulation does not show; above 1 it is all that shows. It falls as 1/photons.

        Raises as `standard_error` does.
        """
        return _noise_ratios(self, np.arange(self.truth.depth.size)).reshape(self.truth.depth.shape)

    @cached_property
    def target_noise_ratio(self) -> float:
        """Median of `noise_ratio` over the pixels of the target in which light returned, or over all without a target;
        of 1024 of them spread over the image where there are more. Infinite if nothing returned. Raises as
        `standard_error` does."""
        target = np.isfinite(self.truth.depth)
        returned = self.tallies.any(axis=(0, 3)) & (target | ~target.any())
        pixels = np.flatnonzero(returned)
        pixels = pixels[np.linspace(0, len(pixels) - 1, min(len(pixels), _SAMPLE)).astype(np.intp)]
        ratios = _noise_ratios(self, pixels)
        ratios = ratios[np.isfinite(ratios)]
        return float(np.median(ratios)) if ratios.size else math.inf

    @property
    def relative_error(self) -> float:
        """Relative error of the bins that decide the depth: each pixel's brightest, at the 95th percentile of the
        pixels that hold a target, or of all without any, in which anything returned. The standard error, plus what is
        missing if `unseen_share` of the scattered light is. Infinite if nothing returned."""
        moments = self.known_moment
        # Row by row: of a large histogram nothing is copied.
        peak = np.stack([row.sum(axis=0).argmax(axis=1) for row in self.tallies.swapaxes(0, 1)])[None, ..., None]
        tallies = np.take_along_axis(self.tallies, peak, axis=3)[..., 0]
        value, unseen = tallies.sum(axis=0), self.unseen_share
        missing = tallies[1:].sum(axis=0) * (unseen / max(1.0 - unseen, 1e-12))
        error = missing + self.batch_error(tallies, np.take_along_axis(moments, peak, axis=3)[..., 0])
        target = np.isfinite(self.truth.depth)
        returned = (value > 0) & (target | ~target.any())
        return float(np.quantile(error[returned] / value[returned], 0.95)) if returned.any() else math.inf

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to mistrust the errors: a forward peak that the photons have not seen; components whose standard
        error rests on few heavy photons."""
        texts = unseen_warnings(self)
        for name, (error, share) in component_errors(self).items():
            if error > _SMALL_ERROR and share > _threshold(self.batches):
                texts += (
                    f"{name}: one of {self.batches} batches has {100 * share:.0f} % of the variance of its light "
                    f"(relative standard error {percent(error)} %): few heavy photons decide it, and errors may be "
                    f"larger than they seem; what helps: {', '.join(_ways(self.scene))}",
                )
        return texts

    @property
    def rounding_error(self) -> dict[str, float]:
        """Relative standard error that rounding to the tally's unit adds to an average illuminated bin, at most, by
        component; infinite where light came but none was left. Values of one unit or more round without notice."""
        errors: dict[str, float] = {}
        for name, tally in zip(self.scene.components, self.tallies, strict=True):
            small, total = self.counters.get(f"below_unit_{name}", 0), float(tally.sum(dtype=np.float64))
            # A value f < 1 has the variance f (1 - f), of at most 1/4 and f.
            variance = min(0.25 * small, total) * np.count_nonzero(tally)
            errors[name] = math.sqrt(variance) / total if total else math.inf if small else 0.0
        return errors

    # The time axis

    @property
    def bin_edges(self) -> Floats:
        """Edges of the bins in time of flight [s], `[T + 1]`; bin k covers [edge k, edge k + 1)."""
        gate = self.scene.gate
        return gate.start + gate.bin_width * np.arange(gate.bins + 1, dtype=np.float64)

    @property
    def bin_centres(self) -> Floats:
        """Centres of the bins in time of flight [s], `[T]`."""
        gate = self.scene.gate
        return gate.start + gate.bin_width * (np.arange(gate.bins, dtype=np.float64) + 0.5)

    @property
    def path_edges(self) -> Floats:
        """Edges of the bins in geometric path, laser to target to lens [m], `[T + 1]`."""
        return self.bin_edges * np.float64(self.pulse_speed)

    @property
    def pulse_speed(self) -> float:
        """Speed of a pulse, c0 over the group index [m/s]."""
        return self.scene.medium.pulse_speed

    def depth(
        self, *, method: Any = "centroid", quantity: Literal["depth", "range"] = "depth", **options: Any
    ) -> Floats:
        """Depth frame [m], float64 `[H, W]`, NaN where nothing returned: see `spadwarp.frames.depth_frame`."""
        import spadwarp

        return spadwarp.frames.depth_frame(self, method=method, quantity=quantity, **options)

    def true_path(self) -> Floats:
        """Geometric path laser to target to lens by the truth maps [m], float64 `[H, W]`; NaN without a target."""
        return lines_of_sight(self.scene).path_from_range(self.truth.range)

    # Accounts

    def energy_report(self) -> dict[str, Any]:
        """The energy balance as fractions of the emitted weight, and whether it is exact.

        Returns `emitted` (photons, each of weight 1), `fractions` (name → signed fraction), `difference` (emitted − sum
        of the entries, in their units, from integers) and `exact` (whether it is 0).
        """
        emitted = round(self.photons / self.energy_balance_unit)
        difference = emitted - sum(self.energy_balance.values())
        return {
            "emitted": self.photons,
            "fractions": {name: entry / emitted for name, entry in self.energy_balance.items()},
            "difference": difference,
            "exact": difference == 0,
        }

    def summary(self) -> dict[str, Any]:
        """The result and its origin in numbers and text that JSON can hold."""
        scene, truth = self.scene, self.truth.depth
        seen = np.isfinite(truth)
        # In floating point: the unit keeps each bin below 2^62, not their sum.
        fractions = self.tallies.sum(axis=(1, 2, 3), dtype=np.float64) * (self.unit / self.photons)
        return {
            "scene": str(scene.source) if scene.source else None,
            "photons": self.photons,
            "seed": self.seed,
            "partial": self.partial,
            "image": {"width": scene.camera.width, "height": scene.camera.height},
            "gate": {
                "start_ns": scene.gate.start * 1e9,
                "bin_width_ps": scene.gate.bin_width * 1e12,
                "bins": scene.gate.bins,
                "path_m": [float(self.path_edges[0]), float(self.path_edges[-1])],
            },
            "medium": {
                **water_of(scene),
                **({"layers": len(scene.medium.layers)} if scene.medium.layers else {}),
                **({} if scene.medium.grid is None else {"grid": scene.medium.grid.shape or scene.medium.grid.file}),
            },
            "collected_fraction": dict(zip(scene.components, map(float, fractions), strict=True)),
            "detections_per_pulse": float(fractions.sum() * scene.detectable_photons_per_pulse),
            "pixels_with_return": int(np.count_nonzero(self.tallies.any(axis=(0, 3)))),
            "truth": {
                "pixels": int(seen.sum()),
                "depth_m": [float(truth[seen].min()), float(truth[seen].max())] if seen.any() else None,
            },
            "energy_balance": self.energy_report(),
            "counters": dict(self.counters),
            "rounding_error": {name: x if x < math.inf else None for name, x in self.rounding_error.items()},
            "unseen_share": self.unseen_share,
            "warnings": list(self.warnings),
            **self._noise_summary(),
            **({"derivatives": _short_names(list(self.derivatives))} if self.derivatives else {}),
            **_polarisation_summary(self),
            **({"flux": list(flux_arrays(scene))} if scene.flux else {}),
            "timing": dict(self.timing),
            "provenance": dict(self.provenance),
        }

    def _noise_summary(self) -> dict[str, Any]:
        if self.batches < 2:
            return {"noise_ratio": None, "relative_error": None}
        numbers = {"noise_ratio": self.target_noise_ratio, "relative_error": self.relative_error}
        photons, seconds = photons_needed(self)
        numbers |= {"photons_needed": photons, "seconds_needed": seconds}
        return {name: number if math.isfinite(number) else None for name, number in numbers.items()}

    def to_xarray(self) -> Any:
        """Histograms, depth and truth with coordinates and units: see `spadwarp.result.to_xarray`."""
        import spadwarp

        return spadwarp.result.to_xarray(self)

    def save(self, path: str | Path) -> Path:
        """Writes everything to one HDF5 file that `spadwarp.load` reads back bit for bit; returns its path."""
        import spadwarp

        return spadwarp.result.save_result(self, path)


def _number(result: Result, name: Component) -> int:
    """That of a component."""
    names = result.scene.components
    return names.index(check_choice("component", name, names))


def arrays_of(result: Result) -> dict[str, NDArray[Any]]:
    """The arrays of a result, of those of `ARRAYS`."""
    found: dict[str, Any] = {name: getattr(result, name) for name in ("tallies", "half", "second_moment")}
    if result.reconstruction is not None:
        found |= {f"reconstruction/{name}": values for name, values in vars(result.reconstruction).items()}
    if (signed := result.signed_tallies) is not None:
        parts = {"tallies": signed.tallies, "second_moment": signed.second_moment, "unit": np.array(signed.units)}
        found |= {f"{signed.group}/{name}": values for name, values in parts.items()}
    found |= {f"truth/{name}": values for name, values in vars(result.truth).items()}
    return {name: array for name, array in found.items() if array is not None}


def coordinates_of(result: Result) -> dict[str, Coordinate]:
    """Values, unit and meaning of the dimensions of `ARRAYS`."""
    return {
        "component": (list(result.scene.components), "1", "history of the light"),
        **image_coordinates(*result.truth.depth.shape),
        "time": (result.bin_centres, "s", "time of flight at the centre of the bin"),
        "parameter": (list(result.derivatives), "1", "by which the histogram is differentiated"),
        "channel": (list(result.scene.tallied_channels), "1", "of the receiver"),
    }


def water_of(scene: Scene) -> dict[str, Any]:
    """Coefficients of a scene's medium, by name."""
    names = ("absorption", "scattering", "extinction", "albedo", "phase_function", "group_index")
    return {**{name: getattr(scene.medium, name) for name in names}, **scene.medium.phase_parameters}


# Derivatives and channels


class Cube(NamedTuple):
    """Tallies of light or of a derivative by component, their unit, and their second moment, if there is one."""

    tallies: NDArray[np.int64]
    unit: float
    second_moment: Any


def cubes_of(result: Result, group: str) -> dict[str, Cube]:
    """Of derivatives or of the camera's channels, by name; the channel "I" is the histogram."""
    found, cubes = result.signed_tallies, dict[str, Cube]()
    if group == "channels" and "I" in result.scene.camera.channels:
        cubes["I"] = Cube(result.tallies, result.unit, result.second_moment)
    if found is not None and found.group == group:
        moments = [None] * len(found.names) if found.second_moment is None else found.second_moment.swapaxes(0, 1)
        parts = zip(found.names, found.tallies, found.units, moments, strict=True)
        cubes |= {name: Cube(*cube) for name, *cube in parts}
    for one in result.scene.medium.inelastic if group == "channels" else ():
        if one.decay_time_ns > 0.0 and one.process in cubes:
            cubes[one.process] = _decayed(cubes[one.process], one.decay_time_ns * 1e-9 / result.scene.gate.bin_width)
    return cubes


def _decayed(cube: Cube, bins: float) -> Cube:
    """Light given off after an exponential time, `bins` on average, if all bins are lit evenly."""
    from scipy.signal import lfilter

    rest = math.exp(-1.0 / bins)
    first = 1.0 - bins * (1.0 - rest)  # what is left in its own bin; of each later one `rest` of that before
    later = bins * (1.0 - rest) ** 2
    light = lfilter([first, later - first * rest], [1.0, -rest], cube.tallies.astype(np.float64), axis=-1)
    return Cube(np.rint(light).astype(np.int64), cube.unit, None)


class _SignedValues(Mapping[str, Floats]):
    """Name → array, made from integers when it is asked for; that of a derivative without its block stands for all of
    them, `[x, y, z, ...]`. With `errors` standard errors of the sum over components."""

    def __init__(self, result: Result, group: str, *, errors: bool = False) -> None:
        self._result, self._group, self._errors = result, group, errors
        cubes = cubes_of(result, group)
        self._cubes = {name: one for name, one in cubes.items() if not errors or one.second_moment is not None}
        self._blocks = block_parameters(list(self._cubes))

    def __iter__(self) -> Iterator[str]:
        return iter(self._cubes)

    def __len__(self) -> int:
        return len(self._cubes)

    def __getitem__(self, name: str) -> Floats:
        if name in [f"{GRID}{kind}" for kind in self._blocks.kinds]:
            parts = np.stack([self[one] for one in self if one.startswith(f"{name}[")])
            return parts.reshape(*self._blocks.shape, *parts.shape[1:])
        if name not in self._cubes:
            raise KeyError(f"{name!r} is not one of the {self._group}: {', '.join(self) or 'none were asked for'}")
        result, (tallies, unit, moments) = self._result, self._cubes[name]
        value = (unit / result.unit * result.tally_value)[..., None]
        return tallies * value if not self._errors else result.batch_error(tallies, moments) * value

    def __repr__(self) -> str:
        return f"{{{', '.join(map(repr, self))}}}"


def _short_names(names: Sequence[str]) -> list[str]:
    """For a reader: one text for all blocks, such as "medium.grid.absorption of 4 x 4 x 2 blocks"."""
    kinds, shape = block_parameters(names)
    plain = [name for name in names if not is_block_name(name)]
    return [*plain, *(f"{GRID}{kind} of {' x '.join(map(str, shape))} blocks" for kind in kinds)]


# Errors


def unseen_warnings(result: Result) -> tuple[str, ...]:
    """Of `Result.warnings` that of a forward peak, which no number of batches tells."""
    if result.unseen_share <= NOTABLE_UNSEEN:
        return ()
    scattered, total = (float(part.sum(dtype=np.float64)) for part in (result.tallies[1:], result.tallies))
    if result.unseen_share * scattered <= NOTABLE_UNSEEN * total:
        return ()
    if result.unseen_share == 1.0:
        return ("medium.phase_table is gone: how much of its forward peak was not seen is not known",)
    return (result.scene.unseen_warning(result.photons, *result._unseen_peak),)


def _ways(scene: Scene) -> list[str]:
    """To better errors."""
    transport, ways = scene.transport, ["more photons"]
    if transport.estimator != "guided":
        ways.append('estimator = "guided"')
    elif scene.targets:
        ways.append('in clear water between bright surfaces estimator = "next_event"')
    return [*ways, 'termination = "cutoff"'] if transport.termination == "roulette" else ways


def component_errors(result: Result) -> dict[str, tuple[float, float]]:
    """How well the total of each component is known; empty without batches, and for components without light.

    Returns by component the relative standard error of its light, all pixels and bins together, and the squared
    deviation of the batch furthest from the mean, over the largest that it could have at the same variance, in [0, 1]:
    about 5/batches where many photons matter equally, near 1 where one decides.
    """
    return {
        name: (math.sqrt(spread / (n - 1)) / total, furthest * furthest / ((n - 1) * spread))
        for name, (n, total, spread, furthest) in _spreads(result).items()
    }


def largest_share(result: Result) -> float:
    """As the second of `component_errors`, of the variance of all components together; 1 where nothing is known."""
    spreads = list(_spreads(result).values())
    together = sum(spread for _, _, spread, _ in spreads)
    return max((furthest * furthest / ((n - 1) * together) for n, _, _, furthest in spreads), default=1.0)


def _spreads(result: Result) -> dict[Component, tuple[int, int, int, int]]:
    """Of components that vary: number n of batches, total, n times the sum of squared deviations of the batches from
    their mean, n times the largest deviation."""
    moments, photons, size, found = result.batch_moments, result.photons, result.batch_size, {}
    if not moments or result.batches < 2:
        return {}
    for name, tally in zip(result.scene.components, result.tallies, strict=True):
        # In rows and halves, since a sum over all voxels may exceed 64 bits.
        total = sum((int((row >> 32).sum()) << 32) + int((row & 0xFFFFFFFF).sum()) for row in tally)
        # In integers: no cancellation. Where no batch has `batch_size` photons, none is known to be far from the mean.
        spread = (photons * moments[f"{name}_squares"] - size * total * total) // size
        ends = [moments[key] for key in (f"{name}_largest", f"{name}_smallest") if key in moments]
        furthest = max((abs(photons * end - size * total) // size for end in ends), default=0)
        if total > 0 and spread > 0:
            found[name] = result.batches, total, spread, furthest
    return found


def _threshold(batches: int) -> float:
    """The share that equal batches exceed with a probability of _FALSE_ALARM at most, but _DECIDING_SHARE at least.

    The squared deviation of one of n normal numbers from their mean, over n - 1 times their variance, times n/(n - 1),
    is Beta(1/2, n/2 - 1) (Thompson 1935); the largest of n by Bonferroni, as in the test of Grubbs (1950).
    """
    if batches < 4:
        return 1.0
    if batches > 10:  # 0.899 of 11, and falls; SciPy takes longer to load than most commands to run
        return _DECIDING_SHARE
    from scipy.special import betaincinv

    return max(_DECIDING_SHARE, float(betaincinv(0.5, 0.5 * batches - 1.0, 1.0 - _FALSE_ALARM / batches)))


def _polarisation_summary(result: Result) -> dict[str, Any]:
    """Light of a result's channels, as fractions of the emitted light, and the degree of polarisation of all of it; of
    a result of one channel its name. Empty without polarised light."""
    if "channel" in result.provenance:
        return {"channel": result.provenance["channel"]}
    if not result.channels:
        return {}
    sums = sums_of(result, (0, 1, 2, 3))
    light = {name: float(total) / result.photons for name, total in sums.items()}
    if not result.scene.camera.channels:
        return {"channels": light}
    degree = float(degree_of(result, sums))
    return {"channels": light, "degree_of_polarisation": degree if math.isfinite(degree) else None}


def sums_of(result: Result, axes: tuple[int, ...]) -> dict[str, Floats]:
    """Channel → its light, times the photons."""
    cubes = cubes_of(result, "channels").items()
    return {name: cube.tallies.sum(axis=axes, dtype=np.float64) * cube.unit for name, cube in cubes}


def degree_of(result: Result, sums: dict[str, Floats]) -> Floats:
    leak = 1.0 / result.scene.camera.analyser_extinction_ratio
    with np.errstate(divide="ignore", invalid="ignore"):
        if "Q" in sums:
            return np.minimum(np.sqrt(sums["Q"] ** 2 + sums["U"] ** 2 + sums["V"] ** 2) / sums["I"], 1.0)
        ratio = (sums["co"] - sums["cross"]) / (sums["co"] + sums["cross"])
        degree: Floats = np.clip(ratio * np.divide(1.0 + leak, 1.0 - leak), -1.0, 1.0)
        return degree


# Noise of the simulation against that of a frame


def _noise_ratios(result: Result, pixels: NDArray[np.intp]) -> Floats:
    """`Result.noise_ratio` of pixels, by their numbers in the image; `[P]`."""
    components, _, _, bins = result.tallies.shape
    tallies, moments = result.tallies.reshape(components, -1, bins), result.known_moment.reshape(2, -1, bins)
    size = max(1, _PART_VOXELS // bins)
    scene, value, better = result.scene, result.tally_value.reshape(-1), result.reconstruction
    per_pulse = scene.detectable_photons_per_pulse
    target = np.isfinite(result.truth.depth).reshape(-1)
    noise = np.broadcast_to(noise_rate(scene, result.truth), (*result.truth.depth.shape, 1)).reshape(-1)
    ratios = np.full(len(pixels), np.nan)
    for first in range(0, len(pixels), size):
        part = pixels[first : first + size]
        if better is None:
            mine, scale = tallies[:, part], (value[part] * per_pulse)[:, None]
            error = result.batch_error(mine, moments[:, part]) * scale
        else:
            scale = np.full((1, 1), per_pulse)
            mine = better.histogram.reshape(components, -1, bins)[:, part].astype(np.float64)
            error = better.error.reshape(-1, bins)[part] * scale
        light = mine.sum(axis=0) * scale
        # The return is the light of the target, where there is one.
        signal = np.where(target[part, None], mine[:2].sum(axis=0) * scale, light)
        background = noise[part, None] * scene.gate.bin_width
        ratios[first : first + size] = _ratios(scene, signal, light, background, error)
    return ratios


def _ratios(scene: Scene, signal: Floats, light: Floats, background: Floats, error: Floats) -> Floats:
    """From detections per pulse `[P, T]`: of the return, of all light, of ambient light and dark counts, and the
    standard errors of all light.

    The matched filter adds up counts c_k with weights w_k, the return after the instrument's response h. Errors σ_j of
    the light move it by M² Σ_j σ_j² (Σ_k h_kj w_k S_k)², the photons of M pulses by M (Σ w_k² p_k - (Σ w_k p_k)²) in a
    first-photon detector, with p_k the probability of a count and S_k that of none until the end of the bin, else by
    M Σ w_k² λ_k with S_k = 1.
    """
    weight, rate = _blurred(scene, signal), _blurred(scene, light) + background
    if scene.detector.mode == "first_photon":
        before = np.cumsum(rate, axis=1) - rate
        counted, none = np.exp(-before) * -np.expm1(-rate), np.exp(-before - rate)
        variance = (np.square(weight) * counted).sum(axis=1) - np.square((weight * counted).sum(axis=1))
        moved = weight * none
    else:
        variance, moved = (np.square(weight) * rate).sum(axis=1), weight
    moved = np.square(error * _blurred(scene, moved)).sum(axis=1) * scene.pulses_per_depth_frame
    return np.divide(moved, variance, out=np.full(len(moved), np.nan), where=variance > 0)


def _blurred(scene: Scene, values: Floats) -> Floats:
    """By a Gaussian response of the width of pulse and jitter, along the bins."""
    fwhm = math.hypot(scene.laser.pulse_fwhm_ps, scene.detector.jitter_fwhm_ps)
    sigma = fwhm / (_FWHM_PER_SIGMA * scene.gate.bin_width_ps)
    if sigma < _NARROW:
        return values
    reach = round(3.0 * sigma)  # not `gaussian_filter1d`: SciPy takes longer to load than most commands to run
    weights = np.exp(-0.5 * np.square(np.arange(-reach, reach + 1) / sigma))
    padded, bins = np.pad(values, ((0, 0), (reach, reach))), values.shape[1]
    return sum(weight * padded[:, k : k + bins] for k, weight in enumerate(weights / weights.sum()))


class PhotonsNeeded(NamedTuple):
    """That would bring a result's noise to a goal."""

    photons: float  # in all; infinite where nothing returned yet
    seconds: float  # that they would take on the devices of the result; NaN where its time is not known


def photons_needed(result: Result, noise_ratio: float = NOISE_GOAL) -> PhotonsNeeded:
    """Photons that would bring `Result.target_noise_ratio` to a goal: it falls as their number.

    `noise_ratio`: the goal, > 0. Where few heavy photons decide, the estimate is too low. Raises `ConfigError` as
    `Result.noise_ratio` does.
    """
    goal = check_real("noise_ratio", noise_ratio, "(0, inf)")
    photons = result.photons * result.target_noise_ratio / goal
    return PhotonsNeeded(photons, photons * result.timing.get("trace", math.nan) / result.photons)
