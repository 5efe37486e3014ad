"""Depth frames of the analytic simulator: the true depth with Cramér–Rao noise, or a background photon instead.

`sample_frames` gives depth [m] and labels; `draw_frames` the integers and bits that a dataset stores, for frames that
differ in the part of their pixels that reports background, with the number of recorded photons beside them.
"""

from collections.abc import Sequence
from typing import Any

import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.binomial import count_quantile
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import launch_pixels, memoised
from spadwarp_kernels.base.philox import STREAM_ANALYTIC, STREAM_FRAMES, random_block, u01, u01_open
from spadwarp_kernels.optics.laser import first_above

from .optics import IN_WATER, Optics, Ports, check_ports, point_at

__all__ = ["FrameCoding", "draw_frames", "sample_frames"]

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class PixelMaps:
    """What frames are drawn from, float32 `[pixel]`: see `sample_frames`."""

    laser: wp.vec3
    nearest: float  # path at which the gate opens [m]
    farthest: float  # path at which it closes [m]
    view: wp.array[wp.vec3]
    depth: wp.array[float]
    sigma_depth: wp.array[float]
    probability: wp.array[float]
    flat_share: wp.array[float]
    paths: wp.array2d[float]
    cumulative: wp.array2d[float]
    ports: Ports


@wp.func
def depth_of_path(laser: wp.vec3, view: wp.vec3, path: float) -> float:
    """Planar depth at which light has gone `path` from laser to target to lens [m]; 0 if there is none."""
    baseline2 = wp.length_sq(laser)
    if path * path <= baseline2:
        return 0.0
    return view[2] * (path * path - baseline2) / (2.0 * (path - wp.dot(view, laser)))


@memoised
def _make_depths(optics: Optics) -> tuple[wp.Function, wp.Function]:
    """Two Warp functions: ``(maps, pixel, path)`` -> planar depth at which light has gone a path, 0 if there is none;
    and ``(maps, pixel, flat, draw)`` -> that of a background photon, which comes at any time of the gate alike (flat)
    or by its distribution."""
    see, range_of_path = optics.see, optics.range_of_path
    in_water = optics is IN_WATER

    @wp.func
    def depth_at(maps: PixelMaps, pixel: int, path: float) -> float:
        if wp.static(in_water):
            return depth_of_path(maps.laser, maps.view[pixel], path)
        sight = see(maps.ports, wp.vec3d(maps.view[pixel]))
        r = range_of_path(wp.vec3d(maps.laser), maps.ports, sight, wp.float64(path))
        depth = wp.float64(0.0)
        if r > depth:
            depth = point_at(sight, r)[2]
        return float(depth)

    @wp.func
    def background_depth(maps: PixelMaps, pixel: int, flat: bool, draw: float) -> float:
        path = maps.nearest + draw * (maps.farthest - maps.nearest)
        if not flat:  # the path at which the pixel's cumulative distribution of backscatter reaches the draw
            row = pixel % maps.cumulative.shape[0]
            edges = pixel % maps.paths.shape[0]
            k = wp.max(first_above(maps.cumulative[row], draw), 1)
            below = maps.cumulative[row, k - 1]
            width = maps.cumulative[row, k] - below
            w = wp.float32(0.5)
            if width > 0.0:
                w = wp.clamp((draw - below) / width, 0.0, 1.0)
            path = maps.paths[edges, k - 1] + w * (maps.paths[edges, k] - maps.paths[edges, k - 1])
        return depth_at(maps, pixel, path)

    return depth_at, background_depth


@memoised
def _make_sample_kernel(optics: Optics) -> wp.Kernel:
    _, background_depth = _make_depths(optics)

    @wp.kernel(module="unique", enable_backward=False)
    def frames_kernel(
        first: int,
        maps: PixelMaps,
        pixels: int,
        first_frame: int,
        frame_count: int,
        seed: wp.uint64,
        # Out:
        frames: wp.array2d[float],
        labels: wp.array2d[wp.bool],
    ):
        """μ + N(0, σ*²), or with some probability a background photon; a draw depends on seed, pixel and frame number
        alone, one block of random numbers serves two frames. Launch grid: frame pairs x pixels."""
        tid = first + wp.tid()
        pair = tid / pixels
        pixel = tid - pair * pixels
        pair += first_frame / 2
        block = random_block(seed, wp.uint64(pixel), wp.uint32(2 * pair), STREAM_ANALYTIC)
        radius = maps.sigma_depth[pixel] * wp.sqrt(-2.0 * wp.log(u01_open(block[0])))
        angle = 6.283185307179586 * u01(block[1])
        p = maps.probability[pixel]
        for k in range(2):
            frame = 2 * pair + k - first_frame
            if frame >= 0 and frame < frame_count:
                value = maps.depth[pixel] + radius * wp.where(k == 0, wp.cos(angle), wp.sin(angle))
                reports_background = u01(block[2 + k]) < p
                if reports_background:
                    extra = random_block(seed, wp.uint64(pixel), wp.uint32(2 * pair + 1), STREAM_ANALYTIC)
                    flat = u01(extra[2 * k]) < maps.flat_share[pixel]
                    value = background_depth(maps, pixel, flat, u01(extra[2 * k + 1]))
                frames[frame, pixel] = value
                labels[frame, pixel] = reports_background

    return frames_kernel


def _pixel_maps(
    optics: Any, ports: Any, laser: Sequence[float], gate: Sequence[float], view: Any, **maps: Any
) -> tuple[Optics, PixelMaps]:
    """The maps of all pixels, if they fit each other; raises `ArgumentError`."""
    check.array("view", view, wp.vec3, (None,))
    rows = {name: maps[name] for name in ("paths", "cumulative")}
    check.arrays(wp.float32, (None, None), view.device, **rows)
    check.arrays(wp.float32, view.shape, view.device, **{name: maps[name] for name in maps if name not in rows})
    for name, array in rows.items():
        check.integer(f"rows of {name}", array.shape[0], 1)
        check.integer(f"columns of {name}", array.shape[1], 2)
    if rows["paths"].shape[1] != rows["cumulative"].shape[1]:
        raise ArgumentError(
            f"paths {rows['paths'].shape} and cumulative {rows['cumulative'].shape} have not as many columns"
        )
    check.vector("laser", laser)
    check.vector("gate_paths", gate, size=2)
    check.number("gate_paths[1]", gate[1], f"[{float(gate[0])}, inf)")
    made = PixelMaps()
    optics, made.ports = check_ports("ports", ports, optics)
    made.laser, (made.nearest, made.farthest), made.view = wp.vec3(*map(float, laser)), gate, view
    for name, array in maps.items():
        setattr(made, name, array)
    return optics, made


def sample_frames(
    view: wp.array,
    depth: wp.array,
    sigma_depth: wp.array,
    probability: wp.array,
    flat_share: wp.array,
    paths: wp.array,
    cumulative: wp.array,
    *,
    laser: Sequence[float],
    gate_paths: tuple[float, float],
    first_frame: int,
    frames: int,
    seed: int,
    out: tuple[wp.array, wp.array] | None = None,
    optics: Optics | None = None,
    ports: Any = None,
) -> tuple[wp.array, wp.array]:
    """Depth frames and which of their pixels report background: float32 and bool `[frames, pixel]`.

    Frame n is the same whatever range of frames it is drawn in.

    Args:
        view: vec3 `[pixel]`, unit lines of sight.
        depth, sigma_depth: float32 `[pixel]` [m]; NaN for no estimate.
        probability: float32 `[pixel]`, that a pixel reports a background photon instead.
        flat_share: float32 `[pixel]`, part of these that arrive at any time of the gate alike.
        paths, cumulative: For the others edges in path [m] and distribution, float32 `[1 or pixel, n]`.
        laser: Position of the laser [m].
        gate_paths: Paths at which the gate opens and closes [m].
        first_frame, frames: The range of frames.
        seed: 64-bit.
        out: Arrays to write into.
        optics: Of `make_optics`: what camera and laser are behind; default: both are in the water.
        ports: `Ports`, their parameters; needed where the optics have any.

    Raises:
        ArgumentError: A number out of range, or arrays that do not fit each other.
    """
    maps = {"depth": depth, "sigma_depth": sigma_depth, "probability": probability, "flat_share": flat_share}
    maps |= {"paths": paths, "cumulative": cumulative}
    optics, drawn = _pixel_maps(optics, ports, laser, gate_paths, view, **maps)
    pixels, device = view.shape[0], view.device
    frames = check.integer("frames", frames, 0)
    first_frame = check.integer("first_frame", first_frame, 0, 2**31 - 1 - frames)
    seed = check.integer("seed", seed, 0, 2**64 - 1)
    kinds = (wp.float32, wp.bool)
    made: Any = tuple(wp.empty((frames, pixels), dtype=kind, device=device) for kind in kinds) if out is None else out
    if not (isinstance(made, tuple) and len(made) == 2):
        raise ArgumentError("out is not a pair of arrays, of depth and of labels")
    for k, kind in enumerate(kinds):
        check.array(f"out[{k}]", made[k], kind, (frames, pixels), device)
    # wp.tid() is a 32-bit integer, and a thread draws two frames.
    step = 2 * max((1 << 30) // max(pixels, 1), 1)
    for start in range(0, frames, step):
        stop = min(start + step, frames)
        pairs = (first_frame + stop + 1) // 2 - (first_frame + start) // 2
        inputs = [drawn, pixels, first_frame + start, stop - start, seed, *(array[start:stop] for array in made)]
        launch_pixels(_make_sample_kernel(optics), pairs * pixels, inputs, device=device)
    return made


# ---- Frames as a dataset stores them.


@wp.struct
class FrameCoding:
    """What is drawn, and how it is written."""

    laser: wp.vec3  # position of the laser [m]
    nearest: float  # path at which the gate opens [m]
    farthest: float  # path at which it closes [m]
    width: int  # pixels of a row
    pixels: int  # of a frame
    seed: wp.uint64  # of the random numbers
    first_sample: wp.int64  # id of the first frame; the others follow
    depth_offset: float  # [m]: depth = offset + step · code; code 0 is no return
    depth_step: float  # [m]
    pulses: float  # pulses of a frame
    intensity_step: float  # recorded photons per unit of the intensity code
    counted: int  # 1: only a pixel that recorded a photon reports


@memoised
def _make_coding_kernel(optics: Optics) -> wp.Kernel:
    depth_at, background_depth = _make_depths(optics)

    @wp.kernel(module="unique", module_options={"max_unroll": 1}, enable_backward=False)
    def frames_kernel(
        first: int,
        coding: FrameCoding,
        maps: PixelMaps,
        alpha: wp.array[float],
        fraction: wp.array[float],
        # Out:
        depth_codes: wp.array2d[wp.uint16],
        intensity_codes: wp.array2d[wp.uint8],
        label_bytes: wp.array2d[wp.uint8],
    ):
        """Launch grid: frames x bytes of labels. A thread draws the eight pixels of one byte."""
        tid = first + wp.tid()
        frame = tid / label_bytes.shape[1]
        byte = tid - frame * label_bytes.shape[1]
        row_bytes = (coding.width + 7) / 8
        row = byte / row_bytes
        column = 8 * (byte - row * row_bytes)
        bits = int(0)
        for k in range(8):
            if column + k < coding.width:
                pixel = row * coding.width + column + k
                sample = wp.uint64(coding.first_sample + wp.int64(frame))
                block = random_block(coding.seed, sample, wp.uint32(pixel), STREAM_FRAMES)
                radius = wp.sqrt(-2.0 * wp.log(u01_open(block[0])))
                angle = 6.283185307179586 * u01(block[1])
                low = depth_at(maps, pixel, maps.nearest)
                high = depth_at(maps, pixel, maps.farthest)
                # NaN, no estimate, stays NaN.
                value = maps.depth[pixel] + maps.sigma_depth[pixel] * radius * wp.cos(angle)
                chance = maps.probability[pixel] * fraction[frame]
                kind = u01(block[2])
                if kind < chance:
                    bits |= 128 >> k
                    draw = u01(block[3])
                    # Of the pixels that report background, kind / chance is uniform again.
                    value = background_depth(maps, pixel, kind < maps.flat_share[pixel] * chance, draw)
                code = int(0)
                if value == value:
                    # A fit does not leave the gate.
                    value = wp.clamp(value, low, high)
                    code = wp.clamp(int((value - coding.depth_offset) / coding.depth_step + 0.5), 1, 65535)
                count = count_quantile(radius * wp.sin(angle), coding.pulses, alpha[pixel])
                if coding.counted == 1 and count < 0.5:
                    code = 0
                    bits &= ~(128 >> k)
                depth_codes[frame, pixel] = wp.uint16(code)
                level = wp.min(int(count / coding.intensity_step + 0.5), 255)
                intensity_codes[frame, pixel] = wp.uint8(level)
        label_bytes[frame, byte] = wp.uint8(bits)

    return frames_kernel


def draw_frames(
    coding: FrameCoding,
    view: wp.array,
    depth: wp.array,
    sigma_depth: wp.array,
    alpha: wp.array,
    probability: wp.array,
    flat_share: wp.array,
    paths: wp.array,
    cumulative: wp.array,
    fraction: wp.array,
    *,
    optics: Optics | None = None,
    ports: Any = None,
) -> Sequence[wp.array]:
    """Frames `coding.first_sample` and on, one for each entry of `fraction`.

    A frame depends on seed, sample id and the pixels' own values alone, whatever it is drawn with.

    Args:
        coding: A `FrameCoding`.
        view, depth, sigma_depth, flat_share, paths, cumulative, optics, ports: As for `sample_frames`.
        alpha: float32 `[pixel]`, expected detections per pulse.
        probability: float32 `[pixel]`; times `fraction` the probability that a pixel reports background.
        fraction: float32 `[frame]`, in [0, 1].

    Returns:
        Depth codes uint16 `[frame, pixel]`, intensity codes uint8 `[frame, pixel]`, labels uint8 `[frame, byte]`: rows
        of (width + 7)/8 bytes, the first pixel in the highest bit, as `np.packbits` has them.

    Raises:
        ArgumentError: A number out of range, or arrays that do not fit each other.
    """
    check.kind("coding", coding, FrameCoding)
    width = check.integer("coding.width", coding.width, 1)
    if check.integer("coding.pixels", coding.pixels, 1) % width:
        raise ArgumentError(f"coding.width = {width} does not divide coding.pixels = {coding.pixels}")
    check.integer("coding.counted", coding.counted, 0, 1)
    check.fields("coding", coding, {"depth_offset": "(-inf, inf)", "depth_step": "(0, inf)"})
    check.fields("coding", coding, {"intensity_step": "(0, inf)", "pulses": "[0, inf)"})
    check.array("view", view, wp.vec3, (coding.pixels,))
    maps = {"depth": depth, "sigma_depth": sigma_depth, "probability": probability, "flat_share": flat_share}
    maps |= {"paths": paths, "cumulative": cumulative}
    optics, drawn = _pixel_maps(optics, ports, coding.laser, (coding.nearest, coding.farthest), view, **maps)
    check.array("alpha", alpha, wp.float32, (coding.pixels,), view.device)
    check.array("fraction", fraction, wp.float32, (None,), view.device)
    device, frames = view.device, fraction.size
    label_count = coding.pixels // width * ((width + 7) // 8)
    depth_codes = wp.empty((frames, coding.pixels), dtype=wp.uint16, device=device)
    intensity_codes = wp.empty((frames, coding.pixels), dtype=wp.uint8, device=device)
    labels = wp.empty((frames, label_count), dtype=wp.uint8, device=device)
    inputs = [coding, drawn, alpha, fraction, depth_codes, intensity_codes, labels]
    launch_pixels(_make_coding_kernel(optics), frames * label_count, inputs, device=device)
    return depth_codes, intensity_codes, labels
