"""Tallies of flux inside the water: fluence in voxels and gates of time, and light through planes, in fixed point.

Any kernel may call the Warp functions with sections and an array of its own; the transport kernel calls those of the
kinds in `TransportSpec.flux`. `halves`: the low bits of a tally where they are apart, see `tally.add_to_halves`, or an
array of length 0. A tally over its section's scale and the photons is, for a volume, the weight times
length [m] of an emitted photon in a voxel (its fluence over the voxel's volume), for planes the weight that crosses.
"""

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.native import fill

from .tally import add_to_halves, atomic_add_int64

__all__ = ["FLUX_KINDS", "Flux", "FluxPlanes", "FluxVolume", "Leg", "add_flux_collision", "add_flux_crossings"]
__all__ += ["add_flux_track", "make_flux", "make_flux_planes", "make_flux_volume"]

FLUX_KINDS = ("track", "collision", "planes")
"""How light is tallied: by the lengths of its ways in voxels, by its collisions there, by its crossings of planes."""

# Crossings with |mu| below this count in scalar irradiance and radiance 2 / _GRAZING, their mean: else no variance.
_GRAZING = wp.constant(0.01)


@wp.struct
class FluxVolume:
    """A box of voxels and gates, made by `make_flux_volume`."""

    turn: wp.mat33  # a point x [m] lies at turn x + shift in voxels; the box has 0 ... size there, 0 where unbounded
    shift: wp.vec3  # likewise
    size: wp.vec3i  # number of voxels along the three edges
    gate_start: float  # path at which the first gate begins [m]
    gates_per_metre: float  # of path; 0: one gate of all times
    gates: int
    by_collision: int  # 1: of kind "collision", else "track"
    first: int  # its first entry in the tally, of [gate, x, y, z]; filled by `make_flux`
    scale: float  # tally units per metre


@wp.struct
class FluxPlanes:
    """Planes across one axis, made by `make_flux_planes`; in the tally [plane, (irradiance downward, upward, scalar
    downward, scalar upward, radiance (polar, azimuth))]."""

    axis: wp.vec3  # unit vector, along which light is "downward"
    right: wp.vec3  # unit vector across it, of azimuth 0
    centre: wp.vec3  # of the discs, on the axis [m]
    radius2: float  # squared radius of the discs [m^2]; 1e30: planes without bounds
    begin: int  # of its `Flux.positions`
    count: int
    polar: int  # bins of radiance in the angle to the axis, 0 ... pi
    azimuth: int  # and about it, 0 ... 2 pi
    first: int  # its first entry in the tally; filled by `make_flux`
    scale: float  # tally units


@wp.struct
class Flux:
    """The sections of a tally of flux by kind, made by `make_flux`."""

    tracks: wp.array[FluxVolume]
    collision: FluxVolume  # the first of the next, which CUDA reads here at no cost
    collisions: wp.array[FluxVolume]
    planes: wp.array[FluxPlanes]
    positions: wp.array[float]  # of planes, x·axis [m]
    size: int  # entries of the tally


@wp.struct
class Leg:
    """A straight way of light."""

    x: wp.vec3  # where it begins [m]
    u: wp.vec3  # unit direction
    length: float  # [m]
    path: float  # by which the light has come there [m]
    weight: float
    rounding_sample: float  # uniform in [0, 1)


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return __float_as_int(__fadd_rd(x, 12582912.0f)) - 0x4b400000;
#else
    return x < 0.0f ? -1 : x < 4194304.0f ? static_cast<int>(x) : 4194304;
#endif
""")
def _floor(x: float) -> int:
    """The whole number below x; below 0 any that is negative, from 2^22 on any from there. CUDA converts numbers no
    faster than it computes logarithms; in the sum here it has them for nothing."""
    ...


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    unsigned part = __float_as_uint(__fadd_rz(units, 8388608.0f)) - 0x4b000000u;
    const bool small = units < 8388608.0f;
#if __CUDA_ARCH__ >= 800
    // Warps add up 32 bits: what might not fit keeps to itself.
    const int lane = threadIdx.x & 31;
    const unsigned peers = __match_any_sync(__activemask(), small ? index : ~lane);
    if (peers & (peers - 1)) part = __reduce_add_sync(peers, part);
    if (lane + 1 != __ffs(peers)) part = 0;
#endif
    return small ? part : static_cast<long long>(units);
#else
    return static_cast<long long>(units);
#endif
""")
def _sum_of_warp(index: int, units: float) -> wp.int64:
    """The whole part of units >= 0; of all threads of a warp that add to one entry the first has their sum, the others
    0: 1.1 to 1.3 times as fast."""
    ...


@wp.func
def _add(tally: wp.array[wp.int64], halves: wp.array[wp.uint32], index: int, units: float):
    added = _sum_of_warp(index, units)
    if added != wp.int64(0):
        if halves.shape[0] > 0:
            add_to_halves(tally, halves, index, added)
        else:
            atomic_add_int64(tally, index, added)


@wp.func
def _voxel(volume: FluxVolume, p: wp.vec4) -> int:
    """The entry of a point in the box, or by a rounding error beside it."""
    entry = wp.clamp(_floor(p[3]), 0, volume.gates - 1)
    for i in range(3):
        entry = entry * volume.size[i] + wp.clamp(_floor(p[i]), 0, volume.size[i] - 1)
    return volume.first + entry


@wp.func
def _in_voxels(volume: FluxVolume, x: wp.vec3, path: float) -> wp.vec4:
    q = volume.turn * x + volume.shift
    return wp.vec4(q[0], q[1], q[2], volume.gates_per_metre * (path - volume.gate_start))


@wp.func
def add_flux_track(volume: FluxVolume, tally: wp.array[wp.int64], halves: wp.array[wp.uint32], leg: Leg):
    """Adds weight times length at a point in each of equal steps of a voxel or gate at most: unbiased, exact in sum."""
    q = _in_voxels(volume, leg.x, leg.path)
    along = volume.turn * leg.u
    v = wp.vec4(along[0], along[1], along[2], volume.gates_per_metre)
    size = wp.vec4(float(volume.size[0]), float(volume.size[1]), float(volume.size[2]), float(volume.gates))
    begin = float(0.0)
    end = float(leg.length)
    fastest = float(0.0)
    for i in range(4):
        if wp.abs(v[i]) > 1.0e-20:
            near = -q[i] / v[i]
            far = (size[i] - q[i]) / v[i]
            begin = wp.max(begin, wp.min(near, far))
            end = wp.min(end, wp.max(near, far))
            fastest = wp.max(fastest, wp.abs(v[i]))
        elif q[i] < 0.0 or q[i] >= size[i]:
            end = -1.0
    steps = int(wp.ceil(wp.max((end - begin) * fastest, 0.5)))
    step = (end - begin) / float(steps)
    # The low bits, which the rounding of what is added hardly depends on.
    part = leg.rounding_sample * 4096.0
    p = q + (begin + (part - wp.floor(part)) * step) * v
    units = leg.weight * step * volume.scale + leg.rounding_sample
    if end > begin:
        for _step in range(steps):
            _add(tally, halves, _voxel(volume, p), units)
            p += step * v


@wp.func
def add_flux_collision(
    volume: FluxVolume, tally: wp.array[wp.int64], halves: wp.array[wp.uint32], leg: Leg, extinction: float
):
    """Adds weight over extinction [1/m] at the collision that ends a leg: the expectation of `add_flux_track`."""
    p = _in_voxels(volume, leg.x + leg.length * leg.u, leg.path + leg.length)
    entry = _floor(p[3])
    inside = wp.uint32(entry) < wp.uint32(volume.gates)
    for i in range(3):
        k = _floor(p[i])
        inside = inside and wp.uint32(k) < wp.uint32(volume.size[i])
        entry = entry * volume.size[i] + k
    if inside:
        _add(tally, halves, volume.first + entry, leg.weight / extinction * volume.scale + leg.rounding_sample)


@wp.func
def add_flux_crossings(
    planes: FluxPlanes, positions: wp.array[float], tally: wp.array[wp.int64], halves: wp.array[wp.uint32], leg: Leg
):
    """Adds the weight to all planes that a leg crosses."""
    begin = wp.dot(planes.axis, leg.x)
    # As of the point where the next leg begins, so that none crosses a plane twice.
    end = wp.dot(planes.axis, leg.x + leg.length * leg.u)
    mu = wp.dot(planes.axis, leg.u)
    units = leg.weight * planes.scale
    exact = units + leg.rounding_sample
    scalar = units / wp.where(wp.abs(mu) < _GRAZING, 0.5 * _GRAZING, wp.abs(mu)) + leg.rounding_sample
    side = wp.where(end > begin, 0, 1)
    width = 4 + planes.polar * planes.azimuth
    for k in range(planes.count):
        p = positions[planes.begin + k]
        if wp.min(begin, end) < p and p <= wp.max(begin, end):
            away = leg.x + ((p - begin) / (end - begin) * leg.length) * leg.u - planes.centre
            across = away - wp.dot(planes.axis, away) * planes.axis
            if planes.radius2 >= 1.0e30 or wp.dot(across, across) <= planes.radius2:
                entry = planes.first + k * width
                _add(tally, halves, entry + side, exact)
                _add(tally, halves, entry + 2 + side, scalar)
                if planes.polar > 0:
                    angle = wp.acos(wp.clamp(mu, -1.0, 1.0)) / wp.pi
                    i = wp.min(int(angle * float(planes.polar)), planes.polar - 1)
                    turn = wp.atan2(wp.dot(wp.cross(planes.axis, planes.right), leg.u), wp.dot(planes.right, leg.u))
                    turn = turn / (2.0 * wp.pi) + wp.where(turn < 0.0, 1.0, 0.0)
                    j = wp.min(int(turn * float(planes.azimuth)), planes.azimuth - 1)
                    _add(tally, halves, entry + 4 + i * planes.azimuth + j, scalar)


def make_flux_volume(
    shape: Sequence[int],
    *,
    lower: Sequence[float],
    edge: Sequence[float],
    rotation: Sequence[Sequence[float]] = ((1.0, 0.0, 0.0), (0.0, 1.0, 0.0), (0.0, 0.0, 1.0)),
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    gates: int = 1,
    gate_start: float = 0.0,
    gate_path: float = math.inf,
    estimator: str = "track",
    scale: float = 2.0**22,
) -> FluxVolume:
    """A box of voxels and gates; `estimator`: "track" or "collision", see FLUX_KINDS; `scale`: units per metre.

    The box of `shape` voxels begins at `lower`, in a frame in which a point x of the photons lies at rotation x +
    origin; where the `edge` of a voxel is infinite it has no bounds, and one voxel. Gates of `gate_path` follow each
    other from `gate_start` on. Lengths and paths in metres. Raises `ArgumentError`.
    """
    for name, vector in (("shape", shape), ("lower", lower), ("origin", origin)):
        check.vector(name, vector)
    check.choice("estimator", estimator, FLUX_KINDS[:2])
    rows, shift = [], []
    edge, turn = check.numbers("edge", edge, (3,)), check.numbers("rotation", rotation, (3, 3))
    for k, width in enumerate(edge.tolist()):
        check.number(f"edge[{k}]", min(width, 1e30), "(0, inf)")
        check.integer(f"shape[{k}]", shape[k], 1, 1 if width == math.inf else 1 << 20)
        rows += [x / width for x in turn[k].tolist()]
        shift.append((origin[k] - lower[k]) / width)
    gate_path = float(check.numbers("gate_path", gate_path, ()))
    check.number("gate_path", min(gate_path, 1e30), "(0, inf)")
    gates = check.integer("gates", gates, 1, 1 if gate_path == math.inf else 1 << 20)
    box = fill(FluxVolume(), turn=np.reshape(rows, (3, 3)), shift=shift, size=[*shape], gates=gates)
    fill(box, gate_start=check.number("gate_start", gate_start), gates_per_metre=1.0 / gate_path)
    return fill(box, by_collision=int(estimator == "collision"), scale=check.number("scale", scale, "(0, inf)"))


def make_flux_planes(
    count: int,
    *,
    axis: Sequence[float],
    right: Sequence[float],
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    radius: float = math.inf,
    polar: int = 0,
    azimuth: int = 0,
    scale: float = 2.0**20,
) -> FluxPlanes:
    """So many planes, see `FluxPlanes`; `make_flux` takes their positions, in order. Raises `ArgumentError`."""
    for name, vector in (("axis", axis), ("right", right), ("centre", centre)):
        check.vector(name, vector, unit=name != "centre")
    whole = {"count": count, "polar": polar, "azimuth": azimuth}
    whole = {name: check.integer(name, n, int(name == "count"), 1 << 16) for name, n in whole.items()}
    radius2 = min(check.number("radius", min(radius, 1e15), "(0, inf)") ** 2, 1e30)
    planes = fill(FluxPlanes(), axis=axis, right=right, centre=centre, **whole, radius2=radius2)
    return fill(planes, scale=check.number("scale", scale, "(0, inf)"))


def make_flux(sections: Sequence[Any], positions: Sequence[float] = (), *, device: wp.DeviceLike = None) -> Flux:
    """The sections, FluxVolume or FluxPlanes, one after the other in the tally, and the positions of all their planes.

    Raises `ArgumentError`: a tally of 2^31 entries or more, or positions that are not those of the planes.
    """
    device, flux, size, begin = check.device("device", device), Flux(), 0, 0
    kinds: dict[str, list[Any]] = {"tracks": [], "collisions": [], "planes": []}
    for section in sections:
        section.first = size
        if hasattr(section, "polar"):
            section.begin = begin
            begin += section.count
            size += section.count * (4 + section.polar * section.azimuth)
            kinds["planes"].append(section)
        else:
            size += math.prod(section.size) * section.gates
            kinds["collisions" if section.by_collision else "tracks"].append(section)
        check.integer("entries of the tally of flux", size, 0, 2**31 - 1)
    if len(positions) != begin:
        raise ArgumentError(f"positions: {len(positions)} of {begin} planes")
    flux.size = size
    flux.collision = next(iter(kinds["collisions"]), FluxVolume())
    return fill(flux, device, **kinds, positions=list(positions))
