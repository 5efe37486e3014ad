"""Depth frames of the analytic simulator: the true depth with Cramér–Rao noise, or a background photon instead."""

from collections.abc import Mapping, Sequence
from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_array,
    check_integer,
    check_number,
    check_seed,
    check_vector,
)
from spadwarp_kernels.base.kernels import launch_pixels, made_once
from spadwarp_kernels.base.philox import STREAM_ANALYTIC, random_block, u01, u01_open

from .lidar import Ports
from .optics import IN_WATER, Optics, check_ports

__all__ = ["sample_frames"]

wp.set_module_options({"enable_backward": False})


@wp.struct
class Sampler:
    """What is drawn.

    Attributes:
        laser: Position of the laser [m].
        nearest, farthest: Paths at which the gate opens and closes [m].
        pixels: Number of pixels of a frame.
        first_frame, frames: The range of frames.
        seed: Of the random numbers.
    """

    laser: wp.vec3
    nearest: float
    farthest: float
    pixels: int
    first_frame: int
    frames: int
    seed: wp.uint64


@wp.func
def path_at_share(paths: wp.array2d(dtype=float), cumulative: wp.array2d(dtype=float), pixel: int, u: float) -> float:
    """The path [m] at which a pixel's cumulative distribution of backscatter reaches u."""
    row = pixel % cumulative.shape[0]
    edges = pixel % paths.shape[0]
    low = wp.int32(0)
    high = wp.int32(cumulative.shape[1] - 1)
    while high - low > 1:
        middle = (low + high) / 2
        if cumulative[row, middle] <= u:
            low = middle
        else:
            high = middle
    below = cumulative[row, low]
    width = cumulative[row, high] - below
    w = wp.float32(0.5)
    if width > 0.0:
        w = wp.clamp((u - below) / width, 0.0, 1.0)
    return paths[edges, low] + w * (paths[edges, high] - paths[edges, low])


@wp.func
def depth_of_path(laser: wp.vec3, view: wp.vec3, path: float) -> float:
    """Planar depth at which light has gone `path` from laser to target to lens [m]; 0 if there is none."""
    baseline2 = wp.length_sq(laser)
    if path * path <= baseline2:
        return 0.0
    return view[2] * (path * path - baseline2) / (2.0 * (path - wp.dot(view, laser)))


@made_once
def make_depth_of_path(optics: Optics) -> wp.Function:
    """The Warp function ``(laser, ports, view, path)`` -> planar depth at which light has gone a path; 0 if there is
    none."""
    see, point, range_of_path = optics.see, optics.point, optics.range_of_path
    in_water = optics is IN_WATER

    @wp.func
    def depth_at(laser: wp.vec3, ports: Ports, view: wp.vec3, path: float) -> float:
        if wp.static(in_water):
            return depth_of_path(laser, view, path)
        sight = see(ports, wp.vec3d(view))
        r = range_of_path(wp.vec3d(laser), ports, sight, wp.float64(path))
        depth = wp.float64(0.0)
        if r > depth:
            depth = point(sight, r)[2]
        return float(depth)

    return depth_at


@made_once
def _make_kernel(optics: Optics) -> wp.Kernel:
    depth_at = make_depth_of_path(optics)

    @wp.kernel(module="unique", enable_backward=False)
    def frames_kernel(
        first: int,
        sampler: Sampler,
        view: wp.array(dtype=wp.vec3),
        depth: wp.array(dtype=float),
        sigma_depth: wp.array(dtype=float),
        probability: wp.array(dtype=float),
        flat_share: wp.array(dtype=float),
        paths: wp.array2d(dtype=float),
        cumulative: wp.array2d(dtype=float),
        ports: Ports,
        # Out:
        frames: wp.array2d(dtype=float),
        labels: wp.array2d(dtype=wp.bool),
    ):
        """μ + N(0, σ*²), or with some probability a background photon. Launch grid: frame pairs x pixels.

        One block of random numbers serves two frames; a draw depends on seed, pixel and frame number alone.
        """
        tid = first + wp.tid()
        pair = tid / sampler.pixels
        pixel = tid - pair * sampler.pixels
        pair += sampler.first_frame / 2
        block = random_block(sampler.seed, wp.uint64(pixel), wp.uint32(2 * pair), STREAM_ANALYTIC)
        radius = sigma_depth[pixel] * wp.sqrt(-2.0 * wp.log(u01_open(block[0])))
        angle = 6.283185307179586 * u01(block[1])
        p = probability[pixel]
        for k in range(2):
            frame = 2 * pair + k - sampler.first_frame
            if frame >= 0 and frame < sampler.frames:
                shift = radius * wp.cos(angle)
                word = block[2]
                if k == 1:
                    shift = radius * wp.sin(angle)
                    word = block[3]
                value = depth[pixel] + shift
                reports_background = u01(word) < p
                if reports_background:
                    extra = random_block(sampler.seed, wp.uint64(pixel), wp.uint32(2 * pair + 1), STREAM_ANALYTIC)
                    kind = u01(extra[0])
                    draw = u01(extra[1])
                    if k == 1:
                        kind = u01(extra[2])
                        draw = u01(extra[3])
                    path = sampler.nearest + draw * (sampler.farthest - sampler.nearest)
                    if kind >= flat_share[pixel]:
                        path = path_at_share(paths, cumulative, pixel, draw)
                    value = depth_at(sampler.laser, ports, view[pixel], path)
                frames[frame, pixel] = value
                labels[frame, pixel] = reports_background

    return frames_kernel


def check_pixel_maps(maps: Mapping[str, Any], paths: Any, cumulative: Any, pixels: int, device: wp.Device) -> None:
    """float32 maps `[pixel]`, and the two tables of backscatter over path."""
    for name, array in maps.items():
        check_array(name, array, wp.float32, (pixels,), device)
    for name, array in {"paths": paths, "cumulative": cumulative}.items():
        check_array(name, array, wp.float32, (None, None), device)
        check_integer(f"rows of {name}", array.shape[0], 1)
        check_integer(f"columns of {name}", array.shape[1], 2)
    if paths.shape[1] != cumulative.shape[1]:
        raise ArgumentError(f"paths {paths.shape} and cumulative {cumulative.shape} have not as many columns")


def check_gate_paths(gate_paths: Sequence[float]) -> None:
    """Two rising path lengths [m]."""
    check_vector("gate_paths", gate_paths, size=2)
    check_number("gate_paths[1]", gate_paths[1], f"[{float(gate_paths[0])}, inf)")


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
    check_array("view", view, wp.vec3, (None,))
    pixels, device = view.shape[0], view.device
    maps = {"depth": depth, "sigma_depth": sigma_depth, "probability": probability, "flat_share": flat_share}
    check_pixel_maps(maps, paths, cumulative, pixels, device)
    check_vector("laser", laser)
    optics, ports = check_ports("ports", ports, optics)
    check_gate_paths(gate_paths)
    frames = check_integer("frames", frames, 0)
    first_frame, seed = check_integer("first_frame", first_frame, 0, 2**31 - 1 - frames), check_seed(seed)
    if out is None:
        out = (
            wp.empty((frames, pixels), dtype=float, device=device),
            wp.empty((frames, pixels), dtype=wp.bool, device=device),
        )
    if not (isinstance(out, tuple) and len(out) == 2):
        raise ArgumentError("out is not a pair of arrays, of depth and of labels")
    check_array("out[0]", out[0], wp.float32, (frames, pixels), device)
    check_array("out[1]", out[1], wp.bool, (frames, pixels), device)
    kernel = _make_kernel(optics)
    # wp.tid() is a 32-bit integer, and a thread draws two frames.
    step = 2 * max((1 << 30) // max(pixels, 1), 1)
    for start in range(0, frames, step):
        stop = min(start + step, frames)
        sampler = Sampler()
        sampler.laser = wp.vec3(*map(float, laser))
        sampler.nearest, sampler.farthest = gate_paths
        sampler.pixels = pixels
        sampler.first_frame = first_frame + start
        sampler.frames = stop - start
        sampler.seed = wp.uint64(seed)
        pairs = (first_frame + stop + 1) // 2 - (first_frame + start) // 2
        inputs = [sampler, view, depth, sigma_depth, probability, flat_share, paths, cumulative, ports]
        launch_pixels(kernel, pairs * pixels, [*inputs, out[0][start:stop], out[1][start:stop]], device=device)
    return out
