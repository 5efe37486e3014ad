"""Labelled frames of a dataset, as they are stored: depth and intensity as integers, labels as bits.

The same draw as in `analytic`, μ + N(0, σ*²) or a background photon instead, for frames that differ in the part of
their pixels that reports background, with the number of recorded photons beside the depth.
"""

from collections.abc import Sequence
from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_array,
    check_integer,
    check_number,
    check_struct,
    check_vector,
)
from spadwarp_kernels.base.binomial import count_quantile
from spadwarp_kernels.base.kernels import launch_pixels, made_once
from spadwarp_kernels.base.philox import STREAM_FRAMES, random_block, u01, u01_open

from .depth_frames import check_gate_paths, check_pixel_maps, make_depth_of_path, path_at_share
from .lidar import Ports
from .optics import Optics, check_ports

__all__ = ["FrameCoding", "draw_frames"]

wp.set_module_options({"enable_backward": False, "max_unroll": 1})


@wp.struct
class FrameCoding:
    """What is drawn, and how it is written.

    Attributes:
        laser: Position of the laser [m].
        nearest, farthest: Paths at which the gate opens and closes [m].
        width, pixels: Of a row, of a frame.
        seed: Of the random numbers.
        first_sample: Id of the first frame; the others follow.
        depth_offset, depth_step: depth = offset + step · code [m]; code 0 is no return.
        pulses: Pulses of a frame.
        intensity_step: Recorded photons per unit of the intensity code.
    """

    laser: wp.vec3
    nearest: float
    farthest: float
    width: int
    pixels: int
    seed: wp.uint64
    first_sample: wp.int64
    depth_offset: float
    depth_step: float
    pulses: float
    intensity_step: float


@made_once
def _make_kernel(optics: Optics) -> wp.Kernel:
    depth_at = make_depth_of_path(optics)

    @wp.kernel(module="unique", module_options={"max_unroll": 1}, enable_backward=False)
    def frames_kernel(
        first: int,
        coding: FrameCoding,
        view: wp.array(dtype=wp.vec3),
        depth: wp.array(dtype=float),
        sigma_depth: wp.array(dtype=float),
        alpha: wp.array(dtype=float),
        probability: wp.array(dtype=float),
        flat_share: wp.array(dtype=float),
        paths: wp.array2d(dtype=float),
        cumulative: wp.array2d(dtype=float),
        fraction: wp.array(dtype=float),
        ports: Ports,
        # Out:
        depth_codes: wp.array2d(dtype=wp.uint16),
        intensity_codes: wp.array2d(dtype=wp.uint8),
        label_bytes: wp.array2d(dtype=wp.uint8),
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
                low = depth_at(coding.laser, ports, view[pixel], coding.nearest)
                high = depth_at(coding.laser, ports, view[pixel], coding.farthest)
                # NaN, no estimate, stays NaN.
                value = depth[pixel] + sigma_depth[pixel] * radius * wp.cos(angle)
                chance = probability[pixel] * fraction[frame]
                kind = u01(block[2])
                if kind < chance:
                    bits |= 128 >> k
                    draw = u01(block[3])
                    path = coding.nearest + draw * (coding.farthest - coding.nearest)
                    # Of the pixels that report background, kind / chance is uniform again.
                    if kind >= flat_share[pixel] * chance:
                        path = path_at_share(paths, cumulative, pixel, draw)
                    value = depth_at(coding.laser, ports, view[pixel], path)
                code = int(0)
                if value == value:
                    # A fit does not leave the gate.
                    value = wp.clamp(value, low, high)
                    code = wp.clamp(int((value - coding.depth_offset) / coding.depth_step + 0.5), 1, 65535)
                depth_codes[frame, pixel] = wp.uint16(code)
                count = count_quantile(radius * wp.sin(angle), coding.pulses, alpha[pixel])
                level = wp.min(int(count / coding.intensity_step + 0.5), 255)
                intensity_codes[frame, pixel] = wp.uint8(level)
        label_bytes[frame, byte] = wp.uint8(bits)

    return frames_kernel


def _check_coding(coding: Any) -> None:
    check_struct("coding", coding, FrameCoding)
    check_vector("coding.laser", coding.laser)
    check_gate_paths((coding.nearest, coding.farthest))
    width = check_integer("coding.width", coding.width, 1)
    if check_integer("coding.pixels", coding.pixels, 1) % width:
        raise ArgumentError(f"coding.width = {width} does not divide coding.pixels = {coding.pixels}")
    check_number("coding.depth_offset", coding.depth_offset)
    for name in ("depth_step", "intensity_step"):
        check_number(f"coding.{name}", getattr(coding, name), "(0, inf)")
    check_number("coding.pulses", coding.pulses, "[0, inf)")


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
        view: vec3 `[pixel]`, unit lines of sight.
        depth, sigma_depth: float32 `[pixel]` [m]; NaN for no estimate.
        alpha: float32 `[pixel]`, expected detections per pulse.
        probability: float32 `[pixel]`; times `fraction` the probability that a pixel reports background.
        flat_share: float32 `[pixel]`, part of these that arrive at any time of the gate alike.
        paths, cumulative: For the others edges in path [m] and distribution, float32 `[1 or pixel, n]`.
        fraction: float32 `[frame]`, in [0, 1].
        optics, ports: As for `sample_frames`.

    Returns:
        Depth codes uint16 `[frame, pixel]`, intensity codes uint8 `[frame, pixel]`, labels uint8 `[frame, byte]`: rows
        of (width + 7)/8 bytes, the first pixel in the highest bit, as `np.packbits` has them.

    Raises:
        ArgumentError: A number out of range, or arrays that do not fit each other.
    """
    _check_coding(coding)
    optics, ports = check_ports("ports", ports, optics)
    check_array("view", view, wp.vec3, (coding.pixels,))
    maps = {"depth": depth, "sigma_depth": sigma_depth, "alpha": alpha, "probability": probability}
    check_pixel_maps(maps | {"flat_share": flat_share}, paths, cumulative, coding.pixels, view.device)
    check_array("fraction", fraction, wp.float32, (None,), view.device)
    device, frames = view.device, fraction.size
    row_bytes = (coding.width + 7) // 8
    label_count = coding.pixels // coding.width * row_bytes
    depth_codes = wp.empty((frames, coding.pixels), dtype=wp.uint16, device=device)
    intensity_codes = wp.empty((frames, coding.pixels), dtype=wp.uint8, device=device)
    labels = wp.empty((frames, label_count), dtype=wp.uint8, device=device)
    inputs = [coding, view, depth, sigma_depth, alpha, probability, flat_share, paths, cumulative, fraction, ports]
    launch_pixels(
        _make_kernel(optics), frames * label_count, [*inputs, depth_codes, intensity_codes, labels], device=device
    )
    return depth_codes, intensity_codes, labels
