"""Sections of a scene for the light inside the water: where it is tallied, and sun and sky as its source."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from spadwarp.io.hdf5 import Coordinate
from spadwarp.scene.pose import sideways, unit_vector
from spadwarp.scene.sections import Corner, Direction, Section, Vector, Whole, field

__all__ = ["Flux", "Sun"]

IRRADIANCES = ("downward", "upward", "scalar_downward", "scalar_upward")
_Edge = Annotated[int, Field(ge=1, le=1024)]
_Position = Annotated[float, Field(ge=-1e9, le=1e9)]


class FluxArray(NamedTuple):
    """An array of a section's tally."""

    entries: slice  # those of its section in the whole tally, the rows one after another
    columns: slice  # its part of each row
    dimensions: dict[str, Coordinate]
    unit: str
    meaning: str
    value: NDArray[np.float64]  # of a tally unit over the photons; of a shape that broadcasts

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(len(coordinate[0]) for coordinate in self.dimensions.values())


class Flux(Section):
    """Where the light in the water is tallied: a box of voxels and gates of time (fluence), or planes (irradiance,
    radiance). Several in one run; in the world's frame."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=64)
    """name in the result, of letters, digits and _"""
    voxels: tuple[_Edge, _Edge, _Edge] | None = None
    """number of voxels of a box along x, y and z; along an edge without bounds 1"""
    lower: Corner = field((-math.inf,) * 3, "lower corner of the box [m]; one number for all three")
    upper: Corner = field((math.inf,) * 3, "upper corner of the box [m]; one number for all three")
    gates: Whole = field(1, "number of gates of time; more than one need gate_width_ps", "[1, 4096]")
    gate_start_ns: float = field(0.0, "begin of the first gate [ns]", "[0, 1e12]")
    gate_width_ps: float | None = field(None, "width of a gate [ps]; not given: all times", "[1e-3, 1e15]")
    estimator: Literal["track", "collision"] = "track"
    """by the way of each photon through the voxels (less noise a photon), or by its collisions (less noise a second on
    a GPU where a voxel is .1 free paths wide or more)"""
    positions: tuple[_Position, ...] | None = Field(None, min_length=1, max_length=65536)
    """of planes along `axis` [m], rising"""
    axis: Direction = field((0.0, 0.0, 1.0), "normal of the planes, downwards; any length but 0")
    radius: float = field(math.inf, "of the part of each plane that is tallied [m]; inf: all of it", "(0, inf]")
    centre: Vector = field((0.0, 0.0, 0.0), "a point of the line through the centres of these discs [m]")
    polar_bins: Whole = field(0, "bins of radiance in the angle between ray and axis, 0 to 180°; 0: none", "[0, 1024]")
    azimuth_bins: Whole = field(1, "bins of radiance in the azimuth, 0 to 360°", "[1, 1024]")

    def _problems(self) -> Iterator[str]:
        if (self.voxels is None) == (self.positions is None):
            yield "needs either voxels or positions"
        for k, (low, high, count) in enumerate(zip(self.lower, self.upper, self.voxels or (), strict=False)):
            if not low < high:
                yield f"lower = {low} is outside (-inf, {high}) m, {high} being upper in {'xyz'[k]}"
            if count > 1 and math.isinf(high - low):
                yield f"voxels[{k}] = {count} needs lower and upper in {'xyz'[k]}"
        if self.gates > 1 and self.gate_width_ps is None:
            yield self._that("gates", "needs gate_width_ps")
        if any(a >= b for a, b in zip(self.positions or (), (self.positions or ())[1:], strict=False)):
            yield "positions do not rise"
        yield from self._only_with(
            "voxels", self.voxels is not None, "lower", "upper", "gates", "gate_start_ns", "gate_width_ps", "estimator"
        )
        yield from self._only_with(
            "positions", self.positions is not None, "axis", "radius", "centre", "polar_bins", "azimuth_bins"
        )

    @property
    def kind(self) -> str:
        """What the kernels call it."""
        return "planes" if self.voxels is None else self.estimator

    @property
    def size(self) -> int:
        """Entries of the tally."""
        if self.voxels is not None:
            return math.prod(self.voxels) * self.gates
        return len(self.positions or ()) * (len(IRRADIANCES) + self.polar_bins * self.azimuth_bins)

    @property
    def edges(self) -> tuple[float, ...]:
        """Of a voxel along x, y and z [m]; infinite without bounds."""
        return tuple((b - a) / n for a, b, n in zip(self.lower, self.upper, self.voxels or (), strict=False))

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit vector of the axis."""
        return np.asarray(unit_vector(self.axis))

    def scale(self, absorption: float) -> float:
        """Tally units per metre of weight times length, or per weight that crosses a plane: a power of two with which
        2^40 photons keep voxels below 2^62 that hold 4 times the longest way across one, or without bounds the mean
        way to absorption. Fewer in large volumes, whose low 16 bits a GPU keeps apart."""
        if self.voxels is None:
            return 2.0**20
        longest = 4.0 * math.hypot(*self.edges)
        longest = min(longest, 4.0 / absorption if absorption > 0.0 else longest)
        return 2.0 ** math.floor((22.0 if self.size < 1 << 22 else 14.0) - math.log2(min(longest, 1e6)))

    def arrays(self, absorption: float, first: int = 0) -> dict[str, FluxArray]:
        """Those of its part of the tally, which begins at an entry, by name; `absorption`: the least [1/m]."""
        unit, entries = 1.0 / self.scale(absorption), slice(first, first + self.size)
        if self.voxels is not None:
            width = self.gate_width_ps
            gates = 0.0 if width is None else self.gate_start_ns * 1e-9 + width * 1e-12 * (np.arange(self.gates) + 0.5)
            meaning = "time of flight, middle of a gate"
            dimensions: dict[str, Coordinate] = {"gate": (np.atleast_1d(gates), "s", meaning)}
            for axis, low, edge, count in zip("xyz", self.lower, self.edges, self.voxels, strict=True):
                centres = low + edge * (np.arange(count) + 0.5) if math.isfinite(edge) else np.zeros(1)
                dimensions[axis] = (centres, "m", f"middle of a voxel in {axis}; 0 without bounds")
            volume = math.prod(edge for edge in self.edges if math.isfinite(edge))
            text = "fluence per emitted photon, times tally units; along edges without bounds its integral"
            value = np.array(unit / volume)
            return {"fluence": FluxArray(entries, slice(None), dimensions, "1/m^2", text, value)}
        area = math.pi * self.radius**2 if math.isfinite(self.radius) else 1.0
        area_unit = "1" if math.isinf(self.radius) else "1/m^2"
        rows: dict[str, Coordinate] = {"position": (np.array(self.positions), "m", "of a plane along its axis")}
        text = "irradiance per emitted photon, of planes without bounds what crosses them"
        kinds: Coordinate = (list(IRRADIANCES), "1", "along the axis or against it; of a plane or scalar")
        columns = slice(len(IRRADIANCES))
        found = FluxArray(entries, columns, {**rows, "kind": kinds}, area_unit, text, np.array(unit / area))
        if not self.polar_bins:
            return {"irradiance": found}
        polar, azimuth = (
            np.linspace(0.0, end, n + 1) for end, n in ((np.pi, self.polar_bins), (2 * np.pi, self.azimuth_bins))
        )
        bins: dict[str, Coordinate] = {
            "polar": (0.5 * (polar[1:] + polar[:-1]), "rad", "angle between ray and axis, middle of a bin"),
            "azimuth": (0.5 * (azimuth[1:] + azimuth[:-1]), "rad", "about the axis, middle of a bin"),
        }
        solid = -np.diff(np.cos(polar))[:, None] * np.diff(azimuth)
        columns, text, value = slice(len(IRRADIANCES), None), "radiance per emitted photon", unit / area / solid
        radiance = FluxArray(entries, columns, rows | bins, f"{area_unit}/sr", text, value)
        return {"irradiance": found, "radiance": radiance}


class Sun(Section):
    """Sun and sky in place of the laser, through the `[surface]` of the sea, calm or rough. All light is emitted above
    one point, or one period of the waves; as the water is the same along the surface, what crosses a plane anywhere
    stands for what crosses a unit of its area."""

    zenith_deg: float = field(..., "angle of the sun from the vertical, in the air [°]", "[0, 90)")
    azimuth_deg: float = field(0.0, "of the sun's light about the vertical, as that of radiance [°]", "[-360, 360]")
    sky: float = field(0.0, "part of the irradiance on the surface that comes from a sky of even radiance", "[0, 1]")
    irradiance: float = field(1.0, "on the surface, in the air [W/m²]", "(0, 1e6]")

    def direction(self, down: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit vector in which the sun's light goes in the air, in the frame of `down`, a unit vector."""
        zenith = math.radians(self.zenith_deg)
        return math.cos(zenith) * down + math.sin(zenith) * sideways(down, self.azimuth_deg)
