"""The result of a simulation: photon histograms, the energy ledger and the truth maps of the scene."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError
from spadwarp.result.batch_moments import batches_of, dominance_warnings, relative_error
from spadwarp.result.photon_ids import photons_per_position
from spadwarp.result.received import polarisation_summary
from spadwarp.result.signed_tallies import (
    SignedTallies,
    channel_values,
    check_signed,
    derivative_values,
    short_names,
    standard_error,
)
from spadwarp.scene.sight import lines_of_sight

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["COMPONENTS", "Component", "Result", "Truth"]

Component = Literal["ballistic", "forward_scattered", "backscatter"]
COMPONENTS: tuple[Component, ...] = ("ballistic", "forward_scattered", "backscatter")


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
        for name, expected in {"depth": shape, "range": shape, "normal": (*shape, 3), "reflectance": shape}.items():
            array = getattr(self, name)
            if len(shape) != 2 or array.shape != expected or array.dtype != np.float32:
                raise ArgumentError(f"truth.{name} is {array.dtype} {array.shape}; float32 {expected} is needed")

    def __repr__(self) -> str:
        height, width = self.depth.shape
        known = self.depth[np.isfinite(self.depth)]
        depth = f"{known.min():.4g} to {known.max():.4g} m in {known.size}" if known.size else "nothing is hit, 0"
        return f"Truth({width} x {height} pixels: depth {depth} pixels)"


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class Result:
    """Expected photon histograms of one scene in fixed point, and all that is needed to interpret them.

    Attributes:
        scene: The scene that was simulated.
        tallies: int64 `[3, H, W, T]` in the order of `COMPONENTS`; value = tally · unit / photons, see `tally_value`.
        unit: Fraction of one emitted photon per tally unit, a power of two.
        photons: Emitted photons, > 0.
        seed: 64-bit seed of the run.
        focus_distance: Depth that the lens images sharply [m], None if it is all of them: for a pinhole, and for the
            disc that was the default of older versions.
        ledger: Where the emitted weight went, in units of `ledger_unit` photons. Entries are differences of fixed-point
            weights (before − after; a gain is negative), so that their sum is exactly the emitted weight.
        ledger_unit: Photons per ledger unit, a power of two.
        counters: Numbers of events, of contributions that were clipped or not a number, and by component of those of
            less than one tally unit, see `rounding_error`; light before and after the gate in tally units (`guided`
            aims inside the gate and counts there what its surfaces score alone).
        truth: Depth, range, normal and reflectance at pixel centres.
        timing: Seconds of each stage.
        provenance: Versions, device and date.
        partial: Whether the run was interrupted; `photons` then counts those that were done.
        photon_ranges: The ids of the photons as [start, stop) pairs; runs with disjoint ids can be added by `merge`.
        requested: The ids [start, stop) that were asked for; an interrupted run has only a part of them.
        batch_size: Photons of a batch where errors were asked for, else 0; every range is whole batches then.
        second_moment: uint64 `[2, H, W, T]`, low and high half of the 128-bit sum over batches of the squared tally of
            all components; None without batches.
        batch_moments: By component, over batches of its tally summed over voxels: `…_squares` (their sum),
            `…_smallest` and `…_largest`; empty without batches, and in results of older versions.
        derivative_tallies: Of the derivatives that were asked for; None if there are none.
        channel_tallies: Of the camera's channels but "I", which is the histogram; None if there are none.
    """

    scene: Scene
    tallies: NDArray[np.int64]
    unit: float
    photons: int
    seed: int
    ledger: Mapping[str, int]
    ledger_unit: float
    counters: Mapping[str, int]
    truth: Truth
    timing: Mapping[str, float] = field(default_factory=dict)
    provenance: Mapping[str, Any] = field(default_factory=dict)
    partial: bool = False
    photon_ranges: Sequence[tuple[int, int]] = ()
    batch_size: int = 0
    second_moment: NDArray[np.uint64] | None = None
    batch_moments: Mapping[str, int] = field(default_factory=dict)
    requested: tuple[int, int] = (0, 0)
    focus_distance: float | None = None
    derivative_tallies: SignedTallies | None = None
    channel_tallies: SignedTallies | None = None

    def __post_init__(self) -> None:
        if not self.photon_ranges:
            object.__setattr__(self, "photon_ranges", ((0, self.photons),))
        if self.requested == (0, 0):
            object.__setattr__(self, "requested", (self.photon_ranges[0][0], self.photon_ranges[-1][1]))
        camera, gate = self.scene.camera, self.scene.gate
        shape = (len(COMPONENTS), camera.height, camera.width, gate.bins)
        if self.tallies.dtype != np.int64 or self.tallies.shape != shape:
            raise ArgumentError(f"tallies are {self.tallies.dtype} {self.tallies.shape}; int64 {shape} is needed")
        if self.truth.depth.shape != shape[1:3]:
            raise ArgumentError(f"truth.depth has shape {self.truth.depth.shape}; {shape[1:3]} is needed")
        counted = sum(stop - start for start, stop in self.photon_ranges)
        if self.photons <= 0 or counted != self.photons:
            raise ArgumentError(
                f"photons = {self.photons}; the {counted} ids of photon_ranges, more than 0, are needed"
            )
        if self.second_moment is not None:
            moment, expected = self.second_moment, (2, *shape[1:])
            if moment.dtype != np.uint64 or moment.shape != expected:
                raise ArgumentError(f"second_moment is {moment.dtype} {moment.shape}; uint64 {expected} is needed")
            if self.batch_size <= 0 or any((stop - start) % self.batch_size for start, stop in self.photon_ranges):
                raise ArgumentError(f"photon_ranges = {self.photon_ranges} are not whole batches of {self.batch_size}")
        check_signed(self, shape)
        for name in ("unit", "ledger_unit"):
            value = getattr(self, name)
            if not (value > 0 and math.frexp(value)[0] == 0.5):
                raise ArgumentError(f"{name} = {value} is not a power of two")

    def __repr__(self) -> str:
        name = self.scene.source.stem if self.scene.source else "Python"
        height, width, bins = self.tallies.shape[1:]
        photons = f"{self.photons} photons" + (", interrupted" if self.partial else "")
        return f"Result({name}: {photons}, seed {self.seed}, {width} x {height} pixels x {bins} bins)"

    # Histograms

    @cached_property
    def histogram(self) -> NDArray[np.float64]:
        """Expected fraction of emitted photons that arrive in each pixel and bin: float64 `[H, W, T]`, read-only."""
        total = self._fraction(self.tallies.sum(axis=0))
        total.flags.writeable = False
        return total

    def component(self, name: Component) -> NDArray[np.float64]:
        """One part of the histogram, float64 `[H, W, T]`.

        `"ballistic"`: one surface and no collision. `"forward_scattered"`: every other history with a surface.
        `"backscatter"`: water alone. Their sum is the histogram (eq 2).
        """
        if name not in COMPONENTS:
            raise ArgumentError(f"component {name!r} is not one of {', '.join(map(repr, COMPONENTS))}")
        return self._fraction(self.tallies[COMPONENTS.index(name)])

    @property
    def detections(self) -> NDArray[np.float64]:
        """Expected detections per pulse, float64 `[H, W, T]`: histogram · photons per pulse · PDE."""
        return self.histogram * np.float64(self.scene.laser.photons_per_pulse * self.scene.detections_per_photon)

    @cached_property
    def tally_value(self) -> NDArray[np.float64]:
        """Expected fraction of emitted photons per tally unit, float64 `[H, W]`: unit / photons.

        In a scan, of the photons that were emitted while the beam was at the pixel's own position.
        """
        return self.unit / photons_per_position(self.scene, self.photon_ranges)

    @property
    def intensity(self) -> NDArray[np.float64]:
        """Expected fraction of emitted photons that arrive in each pixel within the gate: float64 `[H, W]`."""
        return self.tallies.sum(axis=(0, 3), dtype=np.float64) * self.tally_value

    def _fraction(self, tallies: NDArray[np.int64]) -> NDArray[np.float64]:
        return tallies * self.tally_value[..., None]

    @property
    def derivatives(self) -> Mapping[str, NDArray[np.float64]]:
        """Parameter → ∂histogram/∂parameter by component, float64 `[3, H, W, T]`; of those that `simulate` was asked
        for, "medium.absorption" [per 1/m] and others, with all other parameters fixed. Those by block of a grid's
        cells, "medium.grid.absorption[0,0,0]" and others, are also there together: "medium.grid.absorption" is
        `[x, y, z, 3, H, W, T]`."""
        return derivative_values(self)

    # Errors

    @cached_property
    def standard_error(self) -> NDArray[np.float64]:
        """Standard error of `histogram` from the spread between batches, float64 `[H, W, T]`.

        Raises:
            ConfigError: The run kept no batches, or only one.
        """
        moments, count = batches_of(self)
        return standard_error(self.tallies, moments, count) * self.tally_value[..., None]

    @property
    def derivative_errors(self) -> Mapping[str, NDArray[np.float64]]:
        """Parameter → standard error of its derivative, of all components together, float64 `[H, W, T]`; raises as
        `standard_error` does."""
        return derivative_values(self, errors=True)

    @property
    def channels(self) -> Mapping[str, NDArray[np.float64]]:
        """Channel of the camera, "co" and "cross" of an analyser or "I", "Q", "U" and "V", → what it gets, as
        `derivatives`; the histogram is of light without an analyser."""
        return channel_values(self)

    @property
    def channel_errors(self) -> Mapping[str, NDArray[np.float64]]:
        """Channel → standard error, as `derivative_errors`."""
        return channel_values(self, errors=True)

    @property
    def relative_error(self) -> float:
        """Relative standard error of the bins that decide the depth: each pixel's brightest, at the 95th percentile of
        the pixels that hold a target, or of all without any, in which anything returned. Infinite if nothing did."""
        return relative_error(self)

    @property
    def warnings(self) -> tuple[str, ...]:
        """What may mislead in the errors: components whose standard error rests on few heavy photons.

        They show in results with batches (`uncertainty=True`, or `relative_error`).
        """
        return tuple(dominance_warnings(self))

    @property
    def rounding_error(self) -> dict[str, float]:
        """What rounding to the tally's unit adds to the relative standard error of an average lit bin, at most, by
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
    def bin_edges(self) -> NDArray[np.float64]:
        """Edges of the bins in time of flight [s], `[T + 1]`; bin k covers [edge k, edge k + 1)."""
        gate = self.scene.gate
        return gate.start + gate.bin_width * np.arange(gate.bins + 1, dtype=np.float64)

    @property
    def bin_centres(self) -> NDArray[np.float64]:
        """Centres of the bins in time of flight [s], `[T]`."""
        gate = self.scene.gate
        return gate.start + gate.bin_width * (np.arange(gate.bins, dtype=np.float64) + 0.5)

    @property
    def path_edges(self) -> NDArray[np.float64]:
        """Edges of the bins in geometric path, laser to target to lens [m], `[T + 1]`."""
        return self.bin_edges * np.float64(self.pulse_speed)

    @property
    def pulse_speed(self) -> float:
        """Speed of a pulse, c0 over the group index [m/s]."""
        return self.scene.medium.pulse_speed

    # Depth

    def depth(
        self, *, method: Any = "centroid", quantity: Literal["depth", "range"] = "depth", **options: Any
    ) -> NDArray[np.float64]:
        """Depth frame [m], float64 `[H, W]`, NaN where nothing returned: see `spadwarp.frames.depth_frame`."""
        import spadwarp

        return spadwarp.frames.depth_frame(self, method=method, quantity=quantity, **options)

    def true_path(self) -> NDArray[np.float64]:
        """Geometric path laser to target to lens by the truth maps [m], float64 `[H, W]`; NaN without a target."""
        scene = self.scene
        return lines_of_sight(scene).path_from_range(self.truth.range)

    # Accounts

    def ledger_report(self) -> dict[str, Any]:
        """The energy ledger as fractions of the emitted weight, and whether the energy balance is exact.

        Returns:
            `emitted` (photons, each of weight 1), `fractions` (name → signed fraction), `difference` (emitted − sum of
            the entries, in ledger units, from integers) and `exact` (whether it is 0).
        """
        emitted = round(self.photons / self.ledger_unit)
        difference = emitted - sum(self.ledger.values())
        return {
            "emitted": self.photons,
            "fractions": {name: entry / emitted for name, entry in self.ledger.items()},
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
            "ledger": self.ledger_report(),
            "counters": dict(self.counters),
            "rounding_error": {name: x if x < math.inf else None for name, x in self.rounding_error.items()},
            "warnings": list(self.warnings),
            **({"derivatives": short_names(tuple(self.derivatives))} if self.derivatives else {}),
            **polarisation_summary(self),
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


def physics_of(scene: Scene) -> Scene:
    """The scene without what does not change a photon's history."""
    transport = scene.transport.model_copy(update={"photons": 1, "seed": 0})
    return scene.model_copy(update={"transport": transport, "output": type(scene.output)()})
