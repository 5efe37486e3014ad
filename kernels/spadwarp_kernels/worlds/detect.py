"""The last stage of both cameras: counts from expected detections, and depth from counts, by step."""

import warp as wp

from spadwarp_kernels.analytic.depth_frames import depth_of_path
from spadwarp_kernels.detection.arrival_time import ArrivalEstimator
from spadwarp_kernels.detection.counts import first_photon_step

from .config import SpadConfig, backscatter_rates

wp.set_module_options({"enable_backward": False})


@wp.kernel(enable_backward=False)
def _depth_kernel(
    arrival: wp.array(dtype=float),
    view: wp.array(dtype=wp.vec3),
    laser: wp.vec3,
    gate_start: float,
    bin_path: float,
    histogram: wp.array2d(dtype=int),
    # Out:
    depth: wp.array(dtype=float),
    counts: wp.array(dtype=int),
):
    """Planar depth and the counts of all bins. Launch: cameras x pixels."""
    row = wp.tid()
    pixel = row % view.shape[0]
    total = int(0)
    for k in range(histogram.shape[1]):
        total += histogram[row, k]
    counts[row] = total
    depth[row] = wp.NAN
    if wp.isfinite(arrival[row]):
        z = depth_of_path(laser, view[pixel], gate_start + arrival[row] * bin_path)
        if z > 0.0:
            depth[row] = z


@wp.kernel(enable_backward=False)
def _advance_kernel(step: wp.array(dtype=wp.int64)):
    step[0] = step[0] + wp.int64(1)


@wp.kernel(enable_backward=False)
def _points_kernel(
    depth: wp.array3d(dtype=float), view: wp.array(dtype=wp.vec3), pose: wp.transform, points: wp.array3d(dtype=wp.vec3)
):
    """Launch: (cameras, height, width)."""
    v, i, j = wp.tid()
    u = view[i * depth.shape[2] + j]
    points[v, i, j] = wp.transform_point(pose, depth[v, i, j] / u[2] * u)


class Detection:
    """Arrays of what a camera gives, and the kernels that fill them from `rates`.

    Attributes:
        rates: Expected detections per pulse, float32 `[cameras, height, width, bins]`.
        histogram: Counts of the step's frame, int32 of the same shape.
        counts: Sum of the histogram, int32 `[cameras, height, width]`.
        depth: Planar depth from the histogram [m], float32 `[cameras, height, width]`; NaN for none.
        step: Number of the next step, int64 `[1]`.
        background: Expected detections per pulse and bin of an image without targets, `[pixels, bins]`.
        view: Unit lines of sight in the optical frame, `[pixels]`.
    """

    def __init__(self, config: SpadConfig, cameras: int, device: wp.Device) -> None:
        self.config = config
        image = (cameras, config.height, config.width)
        self.rates = wp.zeros((*image, config.bins), dtype=float, device=device)
        self.histogram = wp.zeros((*image, config.bins), dtype=int, device=device)
        self.counts = wp.zeros(image, dtype=int, device=device)
        self.depth = wp.full(image, wp.nan, dtype=float, device=device)
        self.step = wp.zeros(1, dtype=wp.int64, device=device)
        self.view = wp.array(config.lines_of_sight(), dtype=wp.vec3, device=device)
        background = backscatter_rates(config, device)
        self.background = wp.array(background, dtype=float, device=device)
        self.rows = (cameras * config.height * config.width, config.bins)
        self._arrival = wp.empty(self.rows[0], dtype=float, device=device)
        dark = config.dark_rate * config.bin_path / config.speed
        known = wp.array(config.pulses * (background + dark), dtype=float, device=device)
        response, lowest_tap = config.response()
        self._estimate = ArrivalEstimator(
            config.bins,
            device=device,
            method=config.method,
            background=known,
            response=response,
            lowest_tap=lowest_tap,
            half_width=-lowest_tap - 1,
        )

    def launch(self) -> None:
        """Counts and depth of all cameras from their rates, and the next step; nothing is allocated or read."""
        config = self.config
        rates, counts = self.rates.reshape(self.rows), self.histogram.reshape(self.rows)
        first_photon_step(rates, pulses=config.pulses, frame=self.step, seed=config.seed, counts=counts)
        self._estimate(counts, self._arrival)
        inputs = [self._arrival, self.view, wp.vec3(*config.laser_position), config.gate_paths[0], config.bin_path]
        outputs = [self.depth.flatten(), self.counts.flatten()]
        wp.launch(_depth_kernel, self.rows[0], [*inputs, counts], outputs, device=self.depth.device)
        wp.launch(_advance_kernel, 1, [self.step], device=self.step.device)

    def points(self, pose: wp.transform, out: wp.array) -> None:
        """Points of the depth image in another frame than the optical one."""
        wp.launch(_points_kernel, self.depth.shape, [self.depth, self.view, pose], [out], device=self.depth.device)
