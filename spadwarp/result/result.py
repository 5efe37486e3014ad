"""The result of a simulation: photon histograms with their errors and channels, energy balance and truth maps."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.limits import check_choice
from spadwarp.result.photon_ids import photons_per_position
from spadwarp.result.tallies import SignedTallies, Tallies, standard_error
from spadwarp.scene.sight import lines_of_sight
from spadwarp.units import percent

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["CHANNELS", "COMPONENTS", "Channel", "Component", "ComponentError", "Result", "Truth"]
__all__ += ["analyser_channel", "component_errors", "degree_of_polarisation", "dominance_warnings"]

Component = Literal["ballistic", "forward_scattered", "backscatter"]
COMPONENTS: tuple[Component, ...] = get_args(Component)

Channel = Literal["I", "co", "cross"]
CHANNELS: tuple[Channel, ...] = get_args(Channel)
"""What a camera may record of polarised light: all of it, or what an analyser passes at its angle or across it."""

Floats = NDArray[np.float64]

# Share of the variance between batches from which one batch is said to decide a standard error. Chance alone exceeds
# it with a probability of _FALSE_ALARM at most, see `_threshold`.
_DECIDING_SHARE = 0.9
_FALSE_ALARM = 1e-4
# Relative standard errors that are smaller are good enough whatever carries them.
_SMALL_ERROR = 0.005

_NO_BATCHES = "the result holds no batches; simulate with uncertainty=True and more photons"
_CAMERAS = "simulate with camera.polarisation = 'analyser' or 'stokes'"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Truth:
    """What the camera would see through clear water, at pixel centres; NaN where the line of sight hits nothing.

    Attributes:
        depth: float32 `[H, W]`, planar depth z [m].
        range: float32 `[H, W]`, distance along the line of sight [m].
        normal: float32 `[H, W, 3]`, unit normal on the camera's side, in the camera frame.
        reflectance: float32 `[H, W]`, Lambertian reflectance in [0, 1].
    """

    depth: NDArray[np.float32]
    range: NDArray[np.float32]
    normal: NDArray[np.float32]
    reflectance: NDArray[np.float32]

    def __post_init__(self) -> None:
        shape = self.depth.shape
        if len(shape) != 2:
            raise ArgumentError(f"truth.depth has {len(shape)} dimensions; 2 are needed")
        for name, expected in {"depth": shape, "range": shape, "normal": (*shape, 3), "reflectance": shape}.items():
            _check_array(f"truth.{name}", getattr(self, name), np.float32, expected)

    def __repr__(self) -> str:
        height, width = self.depth.shape
        known = self.depth[np.isfinite(self.depth)]
        depth = f"{known.min():.4g} to {known.max():.4g} m in {known.size}" if known.size else "nothing is hit, 0"
        return f"Truth({width} x {height} pixels: depth {depth} pixels)"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Result(Tallies):
    """Expected photon histograms of one scene in fixed point, and all that is needed to interpret them.

    The attributes of `Tallies`, of which value = tally · unit / photons, see `tally_value`, and:

    Attributes:
        scene: The scene that was simulated.
        unit: Fraction of one emitted photon per tally unit, a power of two.
        photons: Emitted photons, > 0.
        seed: 64-bit seed of the run.
        focus_distance: Depth that the lens images sharply [m], None if it is all of them, for a pinhole.
        energy_balance_unit: Photons per unit of `energy_balance`, a power of two.
        truth: Depth, range, normal and reflectance at pixel centres.
        timing: Seconds of each stage.
        provenance: Versions, device and date.
        partial: Whether the run was interrupted; `photons` then counts those that were done.
        photon_ranges: The ids of the photons as [start, stop) pairs; runs with disjoint ids can be added by `merge`.
        requested: The ids [start, stop) that were asked for; an interrupted run has only a part of them.
        batch_size: Photons of a batch where errors were asked for, else 0; every range is whole batches then.
    """

    scene: Scene
    unit: float
    photons: int
    seed: int
    energy_balance_unit: float
    truth: Truth
    timing: Mapping[str, float] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    partial: bool = False
    photon_ranges: Sequence[tuple[int, int]] = ()
    batch_size: int = 0
    requested: tuple[int, int] = (0, 0)
    focus_distance: float | None = None

    def __post_init__(self) -> None:
        if not self.photon_ranges:
            object.__setattr__(self, "photon_ranges", ((0, self.photons),))
        if self.requested == (0, 0):
            object.__setattr__(self, "requested", (self.photon_ranges[0][0], self.photon_ranges[-1][1]))
        camera, gate = self.scene.camera, self.scene.gate
        shape = (len(COMPONENTS), camera.height, camera.width, gate.bins)
        _check_array("tallies", self.tallies, np.int64, shape)
        _check_array("truth.depth", self.truth.depth, np.float32, shape[1:3])
        counted = sum(stop - start for start, stop in self.photon_ranges)
        if self.photons <= 0 or counted != self.photons:
            raise ArgumentError(
                f"photons = {self.photons}; the {counted} ids of photon_ranges, more than 0, are needed"
            )
        if self.second_moment is not None:
            _check_array("second_moment", self.second_moment, np.uint64, (2, *shape[1:]))
            if self.batch_size <= 0 or any((stop - start) % self.batch_size for start, stop in self.photon_ranges):
                raise ArgumentError(f"photon_ranges = {self.photon_ranges} are not whole batches of {self.batch_size}")
        channels = () if self.channel_tallies is None else self.channel_tallies.names
        if channels != camera.tallied_channels:
            raise ArgumentError(f"channel_tallies are of {channels}; {camera.tallied_channels} are the camera's")
        for name in ("derivative_tallies", "channel_tallies"):
            self._check_signed(name, getattr(self, name), shape)
        for name in ("unit", "energy_balance_unit"):
            value = getattr(self, name)
            if not (value > 0 and math.frexp(value)[0] == 0.5):
                raise ArgumentError(f"{name} = {value} is not a power of two")

    def _check_signed(self, name: str, found: SignedTallies | None, shape: tuple[int, ...]) -> None:
        if found is None:
            return
        count = len(found.names)
        _check_array(f"{name}.tallies", found.tallies, np.int64, (count, *shape))
        if len(found.units) != count:
            raise ArgumentError(f"{name}: {len(found.units)} units; {count} are needed")
        if (found.second_moment is None) != (self.second_moment is None):
            raise ArgumentError(f"{name} and tallies: both have a second moment, or none of them")
        if found.second_moment is not None:
            _check_array(f"{name}.second_moment", found.second_moment, np.uint64, (2, count, *shape[1:]))

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
        `"backscatter"`: water alone. Their sum is the histogram (eq 2).
        """
        return self._fraction(self.tallies[COMPONENTS.index(check_choice("component", name, COMPONENTS))])

    @property
    def detections(self) -> Floats:
        """Expected detections per pulse, float64 `[H, W, T]`: histogram · photons per pulse · PDE."""
        return self.histogram * np.float64(self.scene.laser.photons_per_pulse * self.scene.detections_per_photon)

    @cached_property
    def tally_value(self) -> Floats:
        """Expected fraction of emitted photons per tally unit, float64 `[H, W]`: unit / photons.

        In a scan, of the photons that were emitted while the beam was at the pixel's own position.
        """
        return self.unit / photons_per_position(self.scene, self.photon_ranges)

    @property
    def intensity(self) -> Floats:
        """Expected fraction of emitted photons that arrive in each pixel within the gate: float64 `[H, W]`."""
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
        """Channel of the camera, "co" and "cross" of an analyser or "I", "Q", "U" and "V", → what it gets, as
        `derivatives`; the histogram is of light without an analyser."""
        return _SignedValues(self, "channels")

    # Errors

    @cached_property
    def standard_error(self) -> Floats:
        """Standard error of `histogram` from the spread between batches, float64 `[H, W, T]`.

        Raises:
            ConfigError: The run has no batches, or only one.
        """
        moments, count = _batches_of(self)
        return standard_error(self.tallies, moments, count) * self.tally_value[..., None]

    @property
    def derivative_errors(self) -> Mapping[str, Floats]:
        """Parameter → standard error of its derivative, of all components together, float64 `[H, W, T]`; raises as
        `standard_error` does."""
        return _SignedValues(self, "derivatives", errors=True)

    @property
    def channel_errors(self) -> Mapping[str, Floats]:
        """Channel → standard error, as `derivative_errors`."""
        return _SignedValues(self, "channels", errors=True)

    @property
    def relative_error(self) -> float:
        """Relative standard error of the bins that decide the depth: each pixel's brightest, at the 95th percentile of
        the pixels that hold a target, or of all without any, in which anything returned. Infinite if nothing did."""
        moments, count = _batches_of(self)
        # Row by row: of a large histogram nothing is copied.
        peak = np.stack([row.sum(axis=0).argmax(axis=1) for row in self.tallies.swapaxes(0, 1)])[None, ..., None]
        tallies = np.take_along_axis(self.tallies, peak, axis=3)[..., 0]
        value = tallies.sum(axis=0)
        error = standard_error(tallies, np.take_along_axis(moments, peak, axis=3)[..., 0], count)
        target = np.isfinite(self.truth.depth)
        returned = (value > 0) & (target | ~target.any())
        return float(np.quantile(error[returned] / value[returned], 0.95)) if returned.any() else math.inf

    @property
    def warnings(self) -> tuple[str, ...]:
        """Reasons to mistrust the errors: components whose standard error rests on few heavy photons.

        They show in results with batches (`uncertainty=True`, or `relative_error`).
        """
        return tuple(dominance_warnings(self))

    @property
    def rounding_error(self) -> dict[str, float]:
        """Relative standard error that rounding to the tally's unit adds to an average illuminated bin, at most, by
        component; infinite where light came but none was left. Values of one unit or more round without notice."""
        errors: dict[str, float] = {}
        for name, tally in zip(COMPONENTS, self.tallies, strict=True):
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

    # Depth

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

        Returns:
            `emitted` (photons, each of weight 1), `fractions` (name → signed fraction), `difference` (emitted − sum of
            the entries, in their units, from integers) and `exact` (whether it is 0).
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
                "absorption": scene.medium.absorption,
                "scattering": scene.medium.scattering,
                "extinction": scene.medium.extinction,
                "albedo": scene.medium.albedo,
                "phase_function": scene.medium.phase_function,
                **scene.medium.phase_parameters,
                "group_index": scene.medium.group_index,
                **({"layers": len(scene.medium.layers)} if scene.medium.layers else {}),
                **({} if scene.medium.grid is None else {"grid": scene.medium.grid.shape or scene.medium.grid.file}),
            },
            "collected_fraction": dict(zip(COMPONENTS, map(float, fractions), strict=True)),
            "detections_per_pulse": float(
                fractions.sum() * scene.laser.photons_per_pulse * scene.detections_per_photon
            ),
            "pixels_with_return": int(np.count_nonzero(self.tallies.any(axis=(0, 3)))),
            "truth": {
                "pixels": int(seen.sum()),
                "depth_m": [float(truth[seen].min()), float(truth[seen].max())] if seen.any() else None,
            },
            "energy_balance": self.energy_report(),
            "counters": dict(self.counters),
            "rounding_error": {name: x if x < math.inf else None for name, x in self.rounding_error.items()},
            "warnings": list(self.warnings),
            **({"derivatives": _short_names(tuple(self.derivatives))} if self.derivatives else {}),
            **_polarisation_summary(self),
            "timing": dict(self.timing),
            "provenance": dict(self.provenance),
        }

    def plot(self, kind: Any = None, **options: Any) -> Any:
        """A figure: "depth", "intensity", "histogram" or "truth"; see `spadwarp.viz.plot`."""
        import spadwarp

        return spadwarp.viz.plot(self, kind, **options)

    def _repr_html_(self) -> str:
        import spadwarp

        return spadwarp.viz.html(self)

    def to_xarray(self) -> Any:
        """Histograms, depth and truth with coordinates and units: see `spadwarp.result.to_xarray`."""
        import spadwarp

        return spadwarp.result.to_xarray(self)

    def save(self, path: str | Path) -> Path:
        """Writes everything to one HDF5 file that `spadwarp.load_result` reads back bit for bit; returns its path."""
        import spadwarp

        return spadwarp.result.save_result(self, path)


def _check_array(name: str, array: NDArray[Any], kind: type, shape: tuple[int, ...]) -> None:
    if array.dtype != kind or array.shape != shape:
        raise ArgumentError(f"{name}: {array.dtype} {array.shape}; {np.dtype(kind)} {shape} is needed")


def physics_of(scene: Scene) -> Scene:
    """The scene without what does not change a photon's history."""
    transport = scene.transport.model_copy(update={"photons": 1, "seed": 0})
    return scene.model_copy(update={"transport": transport, "output": type(scene.output)()})


# Derivatives and channels

_BLOCK = re.compile(r"\[(\d+),(\d+),(\d+)\]")


class _SignedValues(Mapping[str, Floats]):
    """Name → array, made from integers when it is asked for; that of a derivative without its block stands for all of
    them, `[x, y, z, ...]`. With `errors` standard errors of the sum over components."""

    def __init__(self, result: Result, kind: Literal["derivatives", "channels"], *, errors: bool = False) -> None:
        self._result, self._kind, self._errors = result, kind, errors
        self._tallies = result.derivative_tallies if kind == "derivatives" else result.channel_tallies
        self._names: tuple[str, ...] = () if self._tallies is None else self._tallies.names
        if kind == "channels":
            self._names = result.scene.camera.channels

    def __iter__(self) -> Iterator[str]:
        return iter(self._names)

    def __len__(self) -> int:
        return len(self._names)

    def __getitem__(self, name: str) -> Floats:
        result, tallies = self._result, self._tallies
        if blocks := _blocks(self._names, name):
            parts = np.stack([self[f"{name}[{i},{j},{k}]"] for i, j, k in blocks])
            return parts.reshape(*_shape(blocks), *parts.shape[1:])
        if name not in self._names:
            raise KeyError(f"{name!r} is not one of the {self._kind}: {', '.join(self) or 'none were asked for'}")
        if tallies is None or name not in tallies.names:  # the intensity, which is the histogram
            return result.standard_error if self._errors else result.tallies * result.tally_value[..., None]
        p = tallies.names.index(name)
        value = (tallies.units[p] / result.unit * result.tally_value)[..., None]
        if not self._errors:
            return tallies.tallies[p] * value
        _, count = _batches_of(result)
        assert tallies.second_moment is not None
        return standard_error(tallies.tallies[p], tallies.second_moment[:, p], count) * value

    def __repr__(self) -> str:
        return f"{{{', '.join(map(repr, self))}}}"


def _shape(blocks: list[tuple[int, ...]]) -> list[int]:
    return [max(indices) + 1 for indices in zip(*blocks, strict=True)]


def _blocks(names: Sequence[str], name: str) -> list[tuple[int, ...]]:
    """Indices of the blocks by whose coefficient `name` a histogram is differentiated."""
    matches = [_BLOCK.fullmatch(other.removeprefix(name)) for other in names if other.startswith(f"{name}[")]
    return [tuple(map(int, match.groups())) for match in matches if match is not None]


def _short_names(names: tuple[str, ...]) -> list[str]:
    """For a reader: one text for all blocks, such as "medium.grid.absorption of 4 x 4 x 2 blocks"."""
    texts = dict[str, None]()
    for name in names:
        kind = name.partition("[")[0]
        blocks = _blocks(names, kind)
        texts[f"{kind} of {' x '.join(map(str, _shape(blocks)))} blocks" if blocks else name] = None
    return list(texts)


# Errors


@dataclass(frozen=True)
class ComponentError:
    """How well a component's total is known.

    Attributes:
        relative_error: Relative standard error of the component's light, all pixels and bins together.
        largest_share: Squared deviation of the batch furthest from the mean, over the largest that it could have at the
            same variance, in [0, 1]: about 5/batches where many photons matter equally, near 1 where one decides.
        batches: Number of batches.
    """

    relative_error: float
    largest_share: float
    batches: int

    @property
    def is_dominated(self) -> bool:
        """Whether one batch decides the standard error, so that it may be far too small."""
        return self.relative_error > _SMALL_ERROR and self.largest_share > _threshold(self.batches)


def component_errors(result: Result) -> dict[str, ComponentError]:
    """By component; empty without batches, and for components without light."""
    errors = {}
    for name, (count, total, spread, furthest) in _spreads(result).items():
        error = math.sqrt(spread / (count - 1)) / total
        errors[name] = ComponentError(error, furthest * furthest / ((count - 1) * spread), count)
    return errors


def largest_share(result: Result) -> float:
    """As `ComponentError.largest_share`, of the variance of all components together; 1 where nothing is known."""
    spreads = list(_spreads(result).values())
    together = sum(spread for _, _, spread, _ in spreads)
    return max((furthest * furthest / ((count - 1) * together) for count, _, _, furthest in spreads), default=1.0)


def _spreads(result: Result) -> dict[str, tuple[int, int, int, int]]:
    """Of components that vary: number n of batches, total, n times the sum of squared deviations of the batches from
    their mean, n times the largest deviation."""
    moments = result.batch_moments
    if not moments or result.photons < 2 * result.batch_size:
        return {}
    names = [name.removesuffix("_squares") for name in moments if name.endswith("_squares")]
    count, found = result.photons // result.batch_size, {}
    for name, tally in zip(names, result.tallies, strict=True):
        # In rows and halves, since a sum over all voxels may exceed 64 bits.
        total = sum((int((row >> 32).sum()) << 32) + int((row & 0xFFFFFFFF).sum()) for row in tally)
        # count times the sum of squared deviations, in integers: no cancellation.
        spread = count * moments[f"{name}_squares"] - total * total
        furthest = max(count * moments[f"{name}_largest"] - total, total - count * moments[f"{name}_smallest"])
        if total > 0 and spread > 0:
            found[name] = count, total, spread, furthest
    return found


def _batches_of(result: Result) -> tuple[NDArray[np.uint64], int]:
    """The second moments of a result's batches and their number. Raises `ConfigError` where there are too few."""
    if result.second_moment is None or result.photons < 2 * result.batch_size:
        raise ConfigError(_NO_BATCHES)
    return result.second_moment, result.photons // result.batch_size


def pixel_standard_error(result: Result, row: int, column: int) -> Floats:
    """`Result.standard_error` of one pixel, float64 `[T]`, without that of the others."""
    moments, count = _batches_of(result)
    error = standard_error(result.tallies[:, row, column], moments[:, row, column], count)
    return np.asarray(error * result.tally_value[row, column])


def dominance_warnings(result: Result) -> list[str]:
    """A sentence for each component whose standard error rests on one batch."""
    transport, texts = result.scene.transport, []
    ways = ["more photons"]
    if transport.estimator != "guided":
        ways.append('estimator = "guided"')
    elif result.scene.targets:
        ways.append('in clear water between bright surfaces estimator = "next_event"')
    if transport.termination == "roulette":
        ways.append('termination = "cutoff"')
    for name, error in component_errors(result).items():
        if error.is_dominated:
            texts.append(
                f"{name}: one of {error.batches} batches has {100 * error.largest_share:.0f} % of the variance of its "
                f"light (relative standard error {percent(error.relative_error)} %): few heavy photons decide it, and "
                f"errors may be larger than they seem; what helps: {', '.join(ways)}"
            )
    return texts


def _threshold(count: int) -> float:
    """The share that equal batches exceed with a probability of _FALSE_ALARM at most, but _DECIDING_SHARE at least.

    The squared deviation of one of n normal numbers from their mean, over n - 1 times their variance, times n/(n - 1),
    is Beta(1/2, n/2 - 1) (Thompson 1935); the largest of n by Bonferroni, as in the test of Grubbs (1950).
    """
    from scipy.special import betaincinv

    if count < 4:
        return 1.0
    law = float(betaincinv(0.5, 0.5 * count - 1.0, 1.0 - _FALSE_ALARM / count))
    return max(_DECIDING_SHARE, law)


# Channels of polarised light


def analyser_channel(result: Result, channel: Channel) -> Result:
    """The result with the light of one channel alone, for all that takes a result: counts, depth, bounds, pictures.

    "I" is the result itself, without an analyser; "co" passes an analyser at `camera.analyser_angle_deg` of the
    camera's `analyser_extinction_ratio`, "cross" one across it. A camera of four Stokes cubes has both. Ambient light
    counts as unpolarised: ½(1 + 1/E) of it passes, of `detector.ambient_rate` and of daylight.

    The energy balance and the counters stay those of all light; from Stokes cubes the channel has no standard errors.

    Raises:
        ArgumentError: No such channel.
        ConfigError: The result was simulated without channels.
    """
    if check_choice("channel", channel, CHANNELS) == "I":
        return result
    if not result.channels:
        problem = f"the result has none; {_CAMERAS}"
        if own := result.provenance.get("channel"):
            problem = f"the result holds {own!r} alone; take that of the run"
        raise ConfigError(
            f"channel = {channel!r}: {problem}",
            source=None if result.scene.source is None else str(result.scene.source),
        )
    tallies, unit = _channel_tallies(result, channel)
    stored, moments = result.channel_tallies, None
    if stored is not None and stored.second_moment is not None and channel in stored.names:
        moments = stored.second_moment[:, stored.names.index(channel)].copy()
    return replace(
        result,
        scene=_behind_analyser(result.scene),
        tallies=tallies,
        unit=unit,
        second_moment=moments,
        batch_size=0 if moments is None else result.batch_size,
        batch_moments={},
        channel_tallies=None,
        derivative_tallies=None,
        provenance={**result.provenance, "channel": channel},
    )


def pixel_channel(result: Result, channel: Channel, row: int, column: int) -> Floats:
    """`analyser_channel` of one pixel, by component: fraction of the emitted photons, float64 `[3, T]`."""
    tallies, unit = _channel_tallies(result, channel, (slice(None), row, column))
    return tallies * (result.tally_value[row, column] * unit / result.unit)


def _channel_tallies(result: Result, channel: Channel, at: tuple[Any, ...] = ()) -> tuple[NDArray[np.int64], float]:
    """Tallies of co- or cross-polarised light, or a part of them, and their unit."""
    stored, camera = result.channel_tallies, result.scene.camera
    assert stored is not None
    if channel in stored.names:
        k = stored.names.index(channel)
        return np.maximum(stored.tallies[(k, *at)], 0), stored.units[k]
    leak, angle = 1.0 / camera.analyser_extinction_ratio, 2.0 * math.radians(camera.analyser_angle_deg)
    sign = 1.0 if channel == "co" else -1.0
    light = (1.0 + leak) * result.tallies[at]
    for name, share in {"Q": math.cos(angle), "U": math.sin(angle)}.items():
        k = stored.names.index(name)
        light += sign * (1.0 - leak) * share * (stored.units[k] / result.unit) * stored.tallies[(k, *at)]
    # In halves of a unit.
    return np.rint(np.maximum(light, 0.0)).astype(np.int64), 0.5 * result.unit


def degree_of_polarisation(result: Result, *, gated: bool = False) -> Floats:
    """Part of the light of each pixel and bin that is polarised, float64 `[H, W, T]`; NaN where nothing arrives.

    From four Stokes cubes √(Q² + U² + V²)/I; from co- and cross-polarised light their difference over their sum, which
    is negative where light across the analyser's angle prevails, without the analyser's own leak. `gated`: of all light
    in the gate, `[H, W]`. What rounding and noise put beyond 1 is 1.

    Raises `ConfigError` where the result was simulated without channels.
    """
    if not result.channels:
        raise ConfigError(f"the degree of polarisation needs channels; {_CAMERAS}")
    return _degree(_sums(result, (0, 3) if gated else (0,)), 1.0 / result.scene.camera.analyser_extinction_ratio)


def _polarisation_summary(result: Result) -> dict[str, Any]:
    """Light of a result's channels, as fractions of the emitted light, and the degree of polarisation of all of it; of
    a result of one channel its name. Empty without polarised light."""
    if "channel" in result.provenance:
        return {"channel": result.provenance["channel"]}
    if not result.channels:
        return {}
    sums = _sums(result, (0, 1, 2, 3))
    degree = float(_degree(sums, 1.0 / result.scene.camera.analyser_extinction_ratio))
    light = {name: float(sums[name]) / result.photons for name in result.channels}
    return {"channels": light, "degree_of_polarisation": degree if math.isfinite(degree) else None}


def _sums(result: Result, axes: tuple[int, ...]) -> dict[str, Floats]:
    """Channel → its light, times the photons."""
    stored = result.channel_tallies
    assert stored is not None
    sums = {"I": result.tallies.sum(axis=axes, dtype=np.float64) * result.unit}
    for name, tallies, unit in zip(stored.names, stored.tallies, stored.units, strict=True):
        sums[name] = tallies.sum(axis=axes, dtype=np.float64) * unit
    return sums


def _degree(sums: dict[str, Floats], leak: float) -> Floats:
    with np.errstate(divide="ignore", invalid="ignore"):
        if "Q" in sums:
            return np.minimum(np.sqrt(sums["Q"] ** 2 + sums["U"] ** 2 + sums["V"] ** 2) / sums["I"], 1.0)
        ratio = (sums["co"] - sums["cross"]) / (sums["co"] + sums["cross"])
        degree: Floats = np.clip(ratio * np.divide(1.0 + leak, 1.0 - leak), -1.0, 1.0)
        return degree


def _behind_analyser(scene: Scene) -> Scene:
    """The scene whose camera has no analyser, and as much ambient light as it would pass."""
    passed = 0.5 * (1.0 + 1.0 / scene.camera.analyser_extinction_ratio)
    changed = {"camera.polarisation": "none", "detector.ambient_rate": passed * scene.detector.ambient_rate}
    if scene.daylight is not None:
        changed["daylight.cloud_factor"] = passed * scene.daylight.cloud_factor
    return scene.with_overrides(changed)
