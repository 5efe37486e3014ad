"""Water, the same everywhere or in plane layers, and the three questions that transport asks of any water.

How far does a photon fly, what does a flight let through, and which water is at a point: `HOMOGENEOUS` answers from the
medium alone, `LAYERED` from the layers, `REGULAR_TRACKING` and `DELTA_TRACKING` from a grid of cells. A boundary
between equal extinctions is none: layers of one water give the bits of the homogeneous one. Light passes boundaries
straight on; one index holds for all water.
"""

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

from spadwarp_kernels.base import check
from spadwarp_kernels.base.native import fill
from spadwarp_kernels.base.rotations import OFF_AXIS
from spadwarp_kernels.base.tables import DensityTables

__all__ = ["MOST_CONSTITUENTS", "MOST_LINES", "Grid", "Layers", "Lines", "Medium", "free_path", "make_layers"]
__all__ += ["make_lines", "make_medium"]

MOST_CONSTITUENTS = 4  # of a mixture
MOST_LINES = 4  # at other wavelengths


@wp.struct
class Medium:
    """One water: all there is, or with `Layers` what they share."""

    extinction: float  # c = a + b [1/m], >= 0; 0 is vacuum
    albedo: float  # single-scattering albedo b/c in [0, 1]; with random_albedo, the upper end of the uniform draw
    anisotropy: float  # mean cosine g of the Henyey-Greenstein phase function, in (-1, 1)
    axis_threshold: float
    """|u_z| from which a scattering takes u for the z axis (the near-axis rule), in (0, 1]; 1 switches it off, and
    functions of your own that the transport kernel calls then see 2."""
    phase: DensityTables  # of TABULATED and of mixtures, from `make_phase_tables`; left alone otherwise
    shares: wp.vec4  # of a mixture: the part of the scattering that is each constituent's; their sum is 1


def make_medium(absorption: float, scattering: float, *, anisotropy: float = 0.0) -> Medium:
    """Water from its coefficients [1/m], 0 or more, with the mean cosine g of its phase function in (-1, 1).

    Raises:
        ArgumentError: A number out of range.
    """
    scattering = check.number("scattering", scattering, "[0, inf)")
    extinction = check.number("absorption", absorption, "[0, inf)") + scattering
    g = check.number("anisotropy", anisotropy, "(-1, 1)")
    albedo = scattering / extinction if extinction > 0.0 else 0.0
    return fill(Medium(), extinction=extinction, albedo=albedo, anisotropy=g, axis_threshold=1.0)


def ready_medium(copy: Medium, medium: Medium) -> None:
    """Readies a copy for a kernel: a threshold of 1 is OFF_AXIS."""
    copy.axis_threshold = medium.axis_threshold if np.float32(medium.axis_threshold) < 1.0 else OFF_AXIS


@wp.func
def free_path(xi: float, extinction: float) -> float:
    """Free flight [m] = -ln(xi)/c for uniform xi in (0, 1], from `u01_tail` (eq 12, 13); its mean is 1/c. Infinite
    (1e30) in vacuum."""
    if extinction <= 0.0:
        return 1.0e30
    return -wp.log(xi) / extinction


# ---- Other wavelengths.


@wp.struct
class Lines:
    """Lines at other wavelengths, made by `make_lines`; numbers by line. An elastic one is of the laser, the others the
    water gives off."""

    elastic: wp.vec4  # 1 or 0
    even: wp.vec4  # the phase function of what becomes light of it is even + squared cos^2(theta) [1/sr]
    squared: wp.vec4
    passed: wp.vec4  # part of the line that the receiver's filter passes
    delay: wp.vec4  # group index at the line over that of the medium
    # By water, the medium or the layers:
    source: wp.array[wp.vec4]  # coefficient of what becomes light of the line [1/m]
    more: wp.array[wp.vec4]  # extinction at the line less that of the water [1/m]
    again: wp.array[wp.vec4]  # scattering at the line over that of the water


def make_lines(
    source: ArrayLike,
    anisotropy: Sequence[float],
    extinction: ArrayLike,
    scattering: ArrayLike,
    passed: Sequence[float],
    *,
    media: Sequence[Medium],
    elastic: bool = False,
    delay: Sequence[float] = (),
    device: wp.DeviceLike = None,
) -> Lines:
    """Up to MOST_LINES lines, with the phase function of the medium for what is scattered later.

    Args:
        source: Coefficients of the inelastic scattering [1/m], >= 0, `[water, line]`; the water's absorption has it. Of
            elastic lines what they scatter by another law than the medium's, of any sign.
        anisotropy: A of its phase function, ~ 1 + A cos^2(theta), 0 or more: 0 of fluorescence.
        extinction, scattering: Of the waters at the lines [1/m], `[water, line]`; of an elastic one the scattering by
            the medium's law.
        passed: Part of the line that the receiver's filter passes.
        media: The medium, or the waters of the layers, at the laser's wavelength; the scattering is above 0.
        elastic: The lines are of the laser, and light of a line is there from the start.
        delay: Group index at the line over that of the medium, by default 1.

    Raises:
        ArgumentError: A number out of range, or lists of several lengths.
    """
    device, lines, waters = check.device("device", device), Lines(), len(check.items("media", media))
    count = check.integer("number of lines", len(check.items("passed", passed)), 1, MOST_LINES)
    for one in media:
        check.kind("media", one, Medium)
    b = [check.number("scattering of the medium", one.extinction * one.albedo, "(0, inf)") for one in media]
    law = check.numbers("anisotropy", anisotropy, (count,), "[0, inf)")
    passed = check.numbers("passed", passed, (count,), "[0, inf)")
    late = delay if len(check.items("delay", delay)) else [1.0] * count
    late = check.numbers("delay", late, (count,), "(0, inf)")
    for k in range(count):
        lines.elastic[k], lines.passed[k], lines.delay[k] = float(elastic), passed[k], late[k]
        lines.even[k] = 1.0 / (4.0 * math.pi * (1.0 + law[k] / 3.0))
        lines.squared[k] = law[k] * lines.even[k]
    rows = {"source": source, "extinction": extinction, "scattering": scattering}
    columns = dict[str, Any]()
    for name, row in rows.items():
        within = "(-inf, inf)" if elastic and name == "source" else "[0, inf)"
        columns[name] = check.numbers(name, np.atleast_2d(check.numbers(name, row)), (waters, count), within)
    columns["more"] = columns.pop("extinction") - np.array([[one.extinction] for one in media])
    columns["again"] = columns.pop("scattering") / np.array(b)[:, None]
    filled = {name: np.pad(column, ((0, 0), (0, MOST_LINES - count))) for name, column in columns.items()}
    return fill(lines, device, **filled)


# ---- Layers.


_RANGES = {"start": "(-inf, inf)", "extinction": "(0, inf)", "albedo": "[0, 1]", "anisotropy": "(-1, 1)"}


@wp.struct
class Grid:
    """Cells of water in a box, made by `make_grid`."""

    turn: wp.mat33  # a point x [m] lies at turn x + shift in cells; the box has 0 ... size there.
    shift: wp.vec3  # likewise
    size: wp.vec3i  # number of cells along the three edges
    extinction: wp.array[float]  # c [1/m] by cell, the last edge fastest
    albedo: wp.array[float]  # single-scattering albedo in [0, 1]
    anisotropy: wp.array[float]
    """g in (-1, 1), for phase functions that use the medium's; empty: the medium's everywhere."""
    block_edge: int  # cells along the edges of a block
    block_size: wp.vec3i  # number of blocks along the three edges of the box; the last may be incomplete
    block_majorant: wp.array[float]  # largest c in each block [1/m]
    block_control: wp.array[wp.vec2]  # mean c of each block, and the largest difference from it in the block [1/m]
    residual: wp.array[float]  # c less the block's, see `block_statistics` [1/m], by cell
    shares: wp.array[wp.vec4]  # `Medium.shares` by cell, for mixtures; else empty


@wp.struct
class Layers:
    """Layers across an axis, in the order in which the axis meets them.

    In the frame of the photons: where a photon at x is at R x + o of the water's frame, with the axis a there, the axis
    here is R^T a, and each start is less by a·o. A layer reaches to the start of the next, the first back without end.
    """

    axis: wp.vec3  # unit vector
    start: wp.array[float]
    """Position along the axis, x·axis, at which each layer begins [m], ascending; the first is not read."""
    extinction: wp.array[float]  # c [1/m], > 0
    albedo: wp.array[float]  # single-scattering albedo in [0, 1]
    anisotropy: wp.array[float]  # g in (-1, 1), for phase functions that use the medium's
    shares: wp.array[wp.vec4]  # `Medium.shares` by layer, for mixtures; else empty
    grid: Grid  # of a spec with a grid, which has no layers: cells in a box; the medium is outside it


@wp.func
def layer_index(layers: Layers, along: float) -> int:
    """The layer at a position along the axis [m]."""
    k = int(0)
    for i in range(1, layers.start.shape[0]):
        if along >= layers.start[i]:
            k = i
    return k


@wp.func
def boundary_ahead(layers: Layers, layer: int, step: int, along: float, slope: float) -> float:
    """Distance [m] from `along`, at `slope` per metre, to the end of a layer; 1e30 where there is none."""
    ahead = layer + step
    if slope == 0.0 or ahead < 0 or ahead >= layers.start.shape[0]:
        return 1.0e30
    return (layers.start[wp.max(layer, ahead)] - along) / slope


@wp.func
def layered_free_path(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, xi: float, seed: wp.uint64) -> float:
    """Free flight [m] from x along u for uniform xi in (0, 1]: where the optical depth reaches -ln(xi)."""
    along = wp.dot(layers.axis, x)
    slope = wp.dot(layers.axis, u)
    step = wp.where(slope > 0.0, 1, -1)
    layer = layer_index(layers, along)
    extinction = float(layers.extinction[layer])
    depth = -wp.log(xi)
    begin = float(0.0)  # of the stretch of this extinction
    boundary = boundary_ahead(layers, layer, step, along, slope)
    while boundary < 1.0e30 and extinction * (boundary - begin) < depth:
        layer += step
        if layers.extinction[layer] != extinction:
            depth -= extinction * (boundary - begin)
            begin = boundary
            extinction = layers.extinction[layer]
        boundary = boundary_ahead(layers, layer, step, along, slope)
    return begin + depth / extinction


@wp.func
def layered_extinction(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, length: float, seed: wp.uint64) -> float:
    """Mean extinction [1/m] between x and x + length u, so that exp(-mean length) is what passes."""
    along = wp.dot(layers.axis, x)
    slope = wp.dot(layers.axis, u)
    step = wp.where(slope > 0.0, 1, -1)
    layer = layer_index(layers, along)
    extinction = float(layers.extinction[layer])
    depth = float(0.0)
    begin = float(0.0)
    boundary = boundary_ahead(layers, layer, step, along, slope)
    while boundary < length:
        layer += step
        if layers.extinction[layer] != extinction:
            depth += extinction * (boundary - begin)
            begin = boundary
            extinction = layers.extinction[layer]
        boundary = boundary_ahead(layers, layer, step, along, slope)
    if begin == 0.0:
        return extinction
    return (depth + extinction * (length - begin)) / length


@wp.func
def layered_water(medium: Medium, layers: Layers, x: wp.vec3) -> Medium:
    """The medium with the coefficients of the layer at x."""
    layer = layer_index(layers, wp.dot(layers.axis, x))
    water = medium
    water.extinction = layers.extinction[layer]
    water.albedo = layers.albedo[layer]
    water.anisotropy = layers.anisotropy[layer]
    if layers.shares.shape[0] > 0:
        water.shares = layers.shares[layer]
    return water


@wp.func
def _free_path(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, xi: float, seed: wp.uint64) -> float:
    return free_path(xi, medium.extinction)


@wp.func
def _extinction(medium: Medium, layers: Layers, x: wp.vec3, u: wp.vec3, length: float, seed: wp.uint64) -> float:
    return medium.extinction


@wp.func
def _water(medium: Medium, layers: Layers, x: wp.vec3) -> Medium:
    return medium


@wp.struct
class ProfileSample:
    """A point of a line: its distance s [m], the density over s of the draw [1/m], the optical depth up to it, and the
    extinction there [1/m], which a rounded point that lies by a face would not tell."""

    s: float
    density: float
    depth: float
    extinction: float


class Profile(NamedTuple):
    """Extinction along a line, by which `guided` takes a point of a flight, as Warp functions."""

    depth: wp.Function  # ``(medium, layers, x, u, length) -> float``, the optical depth
    # ``(medium, layers, x, u, width, given, xi) -> ProfileSample``, a point of [0, width] from c(s) exp(-depth(s)); or,
    # where that is not negative, the point `given` with the density that it would have. None: the point is where the
    # photon collides, and `depth` is a guess without chance
    draw: wp.Function | None = None


class Water(NamedTuple):
    """What transport asks of water, as Warp functions; `seed` has 64 random bits for those that answer by chance."""

    free_path: wp.Function  # ``(medium, layers, x, u, xi, seed) -> float``, free flight [m]
    # ``(medium, layers, x, u, length, seed) -> float``, mean extinction of a flight [1/m]; by chance, one whose
    # exp(-extinction length) has the expectation of what passes
    extinction: wp.Function
    at: wp.Function  # ``(medium, layers, x) -> Medium``, the water at a point
    profile: Profile | None = None  # how `guided` draws a point of a flight in a grid; None: with the mean extinction
    layered: bool = False
    phase: Any = None  # the phase function, of the water of a spec


HOMOGENEOUS = Water(_free_path, _extinction, _water)
LAYERED = Water(layered_free_path, layered_extinction, layered_water, layered=True)


def mixture_shares(shares: ArrayLike, shape: tuple[int, ...]) -> NDArray[np.float32]:
    """Shares `[n, 4]` of the scattering, which add up to 1, from those of up to 4 constituents, `[*shape, count]`;
    none from none. Raises `ArgumentError`."""
    values = check.numbers("shares", shares)
    if not values.size:
        return np.zeros((0, MOST_CONSTITUENTS), np.float32)
    check.numbers("shares", values, (*shape, None), "[0, 1]")
    check.integer("number of constituents", values.shape[-1], 1, MOST_CONSTITUENTS)
    check.numbers("sum of shares", values.sum(axis=-1), None, "[0.99999, 1.00001]")
    filled = np.zeros((values[..., 0].size, MOST_CONSTITUENTS), np.float32)
    filled[:, : values.shape[-1]] = values.reshape(-1, values.shape[-1])
    return filled


def make_layers(
    start: Sequence[float],
    extinction: Sequence[float],
    albedo: Sequence[float],
    anisotropy: Sequence[float],
    *,
    axis: Sequence[float] = (0.0, 0.0, 1.0),
    shares: Sequence[Sequence[float]] = (),
    device: wp.DeviceLike = None,
) -> Layers:
    """The layers of a layered spec, one entry of each list for a layer; see `Layers` for their meaning and ranges.

    `shares`: of mixtures, see `mixture_shares`. Raises `ArgumentError`.
    """
    device, count = check.device("device", device), len(check.items("start", start))
    check.integer("number of layers", count, 1)
    columns = {"start": start, "extinction": extinction, "albedo": albedo, "anisotropy": anisotropy}
    for name, column in columns.items():
        check.numbers(name, column, (count,), _RANGES[name])
    for k in range(2, count):
        check.number(f"start[{k}]", start[k], f"[{float(start[k - 1])}, inf)")
    check.vector("axis", axis, unit=True)
    return fill(Layers(), device, axis=axis, shares=mixture_shares(shares, (len(start),)), **columns)
