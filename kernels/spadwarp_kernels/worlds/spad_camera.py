"""Single-photon cameras in water, in many worlds: their configuration, what both kinds share, and the fast one, in
closed form: one surface and single scattering a pixel, for all worlds in one launch.

Everything that stands in a camera here (laser, normals, points) is in the optical frame; poses are given in the frame
that the caller's simulator uses.
"""

import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.analytic.depth_frames import depth_of_path
from spadwarp_kernels.analytic.optics import BACKSCATTER_SOURCES, IN_WATER, Lidar, beam_path
from spadwarp_kernels.analytic.rates import Scattering, make_scattering, radiometric_signal, single_scatter_rate
from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_array,
    check_choice,
    check_device,
    check_fields,
    check_integer,
    check_items,
    check_kind,
    check_number,
    check_vector,
)
from spadwarp_kernels.base.kernels import launch_pixels
from spadwarp_kernels.detection.arrival_time import PHASES, ArrivalEstimator
from spadwarp_kernels.detection.counts import first_photon_counts
from spadwarp_kernels.detection.significance import MIN_SIGNIFICANCE
from spadwarp_kernels.optics.camera import C0
from spadwarp_kernels.optics.laser import LASER_PROFILES
from spadwarp_kernels.water.phase_functions import henyey_greenstein_density

from .shapes import Shapes, ShapeTable, check_poses, intersect_shapes, move_shapes

__all__ = ["CAMERA_FRAMES", "SpadCamera", "SpadConfig"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

_see = IN_WATER.see

PLANCK = 6.62607015e-34  # [J s]

CAMERA_FRAMES = {
    "optical": (0.0, 0.0, 0.0, 1.0),
    "opengl": (1.0, 0.0, 0.0, 0.0),
    "forward_left_up": (-0.5, 0.5, -0.5, 0.5),
}
"""Conventions of a camera's pose, and the rotation (x, y, z, w) that takes the optical frame there.

``optical``: +x right, +y down, +z forward (OpenCV; ROS, REP 103, `_optical` frames). ``opengl``: +x right, +y up, -z
forward (OpenGL, USD, Newton, MuJoCo). ``forward_left_up``: +x forward, +y left, +z up (ROS, REP 103, bodies).
"""


def optical_to(frame: Any) -> wp.transform:
    """The pose of the optical frame in a camera frame of `CAMERA_FRAMES`; raises `ArgumentError`."""
    check_choice("frame", frame, CAMERA_FRAMES)
    return wp.transform(wp.vec3(0.0), wp.quat(*CAMERA_FRAMES[frame]))


_RANGES = {
    "horizontal_fov": "(0, 3.1)",
    "pulse_energy": "[0, 1e6]",
    "wavelength": "(0, 1]",
    "pde": "[0, 1]",
    "dark_rate": "[0, inf)",
    "timing_sigma": "(0, inf)",
    "aperture_radius": "(0, inf)",
    "absorption": "[0, inf)",
    "scattering": "[0, inf)",
    "anisotropy": "(-1, 1)",
    "group_index": "[1, inf)",
    "nearest": "(0, inf)",
    "min_significance": "[0, 1e6]",
}


@dataclass(frozen=True, kw_only=True)
class SpadConfig:
    """A pulsed laser beside a SPAD array in water: what `SpadCamera` and `SpadTracer` take.

    Raises:
        ArgumentError: A number out of range.
    """

    width: int = 160  # of the image [pixels]
    height: int = 120  # of the image [pixels]
    horizontal_fov: float = 1.2
    """Full angle [rad]; pixels are square. See `vertical_fov` for that of Newton and MuJoCo."""
    bins: int = 256  # time bins of a histogram
    gate: tuple[float, float] = (0.5, 10.0)  # what is recorded, as distance in this water along the optical axis [m]
    pulses: int = 20_000  # of a frame
    pulse_energy: float = 2e-9  # [J]
    wavelength: float = 532e-9  # [m]
    pde: float = 0.25  # photon detection efficiency, PDP times fill factor
    dark_rate: float = 1000.0  # dark counts and ambient light of a pixel [1/s]
    timing_sigma: float = 200e-12  # standard deviation of pulse and timing jitter together [s]
    aperture_radius: float = 0.01  # [m]
    laser_position: tuple[float, float, float] = (0.05, 0.0, 0.0)
    """In the optical frame [m]: +x right, +y down, +z forward. The beam goes along +z."""
    laser_half_angle: float | None = None  # of its uniform cone [rad]; None covers the corners of the image
    absorption: float = 0.1  # of the water [1/m]; 0 in air
    scattering: float = 0.2  # of the water [1/m]; 0 in air
    anisotropy: float = 0.924  # g of its Henyey–Greenstein phase function
    group_index: float = 1.3638  # c0 over the group velocity
    nearest: float = 0.05  # distance below which the water's backscatter is left out [m]
    method: str = "centroid"
    """Of the depth: "centroid", "peak", "matched" or "likelihood", see `arrival_bins`. The expected counts of an image
    without targets are taken as known background."""
    min_significance: float = MIN_SIGNIFICANCE
    """Of a pixel that has a depth, −log10 of the probability that background alone looks like it, see `DetectionTest`.
    0: every pixel reports."""
    seed: int = 1  # 64-bit

    def __post_init__(self) -> None:
        for name in ("width", "height", "bins"):
            check_integer(f"config.{name}", getattr(self, name), 1)
        check_integer("config.pulses", self.pulses, 0)
        check_fields("config", self, _RANGES)
        check_vector("config.gate", self.gate, size=2)
        check_number("config.gate[0]", self.gate[0], "[0, inf)")
        check_number("config.gate[1]", self.gate[1], f"({float(self.gate[0])}, inf)")
        check_vector("config.laser_position", self.laser_position)
        if self.laser_half_angle is not None:
            check_number("config.laser_half_angle", self.laser_half_angle, "(0, 3.1416]")
        check_choice("config.method", self.method, ("centroid", "peak", "matched", "likelihood"))
        check_integer("config.seed", self.seed, 0, 2**64 - 1)
        if (bins := self._sigma_bins) > 1e4:
            width = f"bins of {self.bin_path / self.speed:.3g} s"
            raise ArgumentError(
                f"config.timing_sigma = {self.timing_sigma} s is {bins:.3g} {width}; 10000 are possible"
            )

    @property
    def pixel_tangent(self) -> float:
        """Pixel pitch over focal length."""
        return 2.0 * math.tan(0.5 * self.horizontal_fov) / self.width

    @property
    def vertical_fov(self) -> float:
        """Full angle [rad]."""
        return 2.0 * math.atan(0.5 * self.height * self.pixel_tangent)

    @property
    def speed(self) -> float:
        """Group velocity [m/s]."""
        return C0 / self.group_index

    @property
    def gate_paths(self) -> tuple[float, float]:
        """Paths from the laser to the lens at which the gate opens and closes [m]."""
        return 2.0 * float(self.gate[0]), 2.0 * float(self.gate[1])

    @property
    def bin_path(self) -> float:
        """Width of a bin [m of path]."""
        start, stop = self.gate_paths
        return (stop - start) / self.bins

    @property
    def _sigma_bins(self) -> float:
        return self.timing_sigma * self.speed / self.bin_path

    @property
    def half_angle(self) -> float:
        """Of the laser's cone [rad]."""
        if self.laser_half_angle is not None:
            return float(self.laser_half_angle)
        corner = 0.5 * self.pixel_tangent * math.hypot(self.width, self.height)
        return min(1.1 * math.atan(corner), 0.5 * math.pi)

    @property
    def photons(self) -> float:
        """Of a pulse."""
        return self.pulse_energy * self.wavelength / (PLANCK * C0)

    def lidar(self) -> Lidar:
        """The struct of the analytic functions."""
        lidar = Lidar()
        lidar.photons, lidar.pde, lidar.dark = self.photons, self.pde, self.dark_rate
        lidar.scattering, lidar.extinction = self.scattering, self.absorption + self.scattering
        lidar.speed = self.speed
        lidar.laser, lidar.axis = wp.vec3d(*self.laser_position), wp.vec3d(0.0, 0.0, 1.0)
        lidar.profile, lidar.spread = LASER_PROFILES.index("uniform_cone"), 1.0 - math.cos(self.half_angle)
        lidar.tan2 = math.tan(min(self.half_angle, 1.57)) ** 2
        lidar.pixel_tangent, lidar.aperture_area = self.pixel_tangent, math.pi * self.aperture_radius**2
        lidar.start, lidar.stop = (path / self.speed for path in self.gate_paths)
        lidar.sigma = self.timing_sigma
        lidar.source, lidar.nearest = BACKSCATTER_SOURCES.index("single_scatter"), self.nearest
        return lidar

    def lines_of_sight(self) -> np.ndarray:
        """Unit vectors through the pixel centres in the optical frame, float64 `[height * width, 3]`."""
        column = (np.arange(self.width) + 0.5 - 0.5 * self.width) * self.pixel_tangent
        row = (np.arange(self.height) + 0.5 - 0.5 * self.height) * self.pixel_tangent
        x, y = np.meshgrid(column, row)
        view = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        return view / np.linalg.norm(view, axis=1, keepdims=True)

    def phase_table(self) -> np.ndarray:
        """The phase function at 4097 angles uniform on [0, π] [1/sr]."""
        return henyey_greenstein_density(1.0 - np.cos(np.linspace(0.0, np.pi, 4097)), self.anisotropy)

    def response(self) -> tuple[np.ndarray, int]:
        """The Gaussian response in bins for `arrival_bins`, `[PHASES, taps]`, and its lowest tap."""
        sigma = self._sigma_bins
        reach = math.ceil(5.0 * sigma) + 1
        edges = np.arange(-reach, reach + 2)[None, :] - np.arange(int(PHASES))[:, None] / int(PHASES)
        cumulative = 0.5 * (1.0 + np.vectorize(math.erf)(edges / (math.sqrt(2.0) * sigma)))
        return np.diff(cumulative, axis=1), -reach

    def bin_response(self, parts: int = 1) -> tuple[np.ndarray, int]:
        """Shares in a bin of the light that is spread evenly over each of the parts of the bins about it.

        Returns float64 `[taps]` and the first tap's part, counted from the first part of the bin.
        """
        sigma = self._sigma_bins
        reach = math.ceil(5.0 * sigma)
        edges = np.arange(-reach * parts, (reach + 1) * parts + 1) / parts
        after, before = (np.array([_normal_integral((end - s) / sigma) for s in edges]) for end in (1.0, 0.0))
        return -parts * sigma * np.diff(after - before), -reach * parts


def _normal_integral(z: float) -> float:
    """Integral of the normal distribution function up to z."""
    return z * 0.5 * math.erfc(-z / math.sqrt(2.0)) + math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)


@wp.kernel(enable_backward=False)
def _backscatter_kernel(
    first: int, lidar: Lidar, water: Scattering, view: wp.array[wp.vec3d], rates: wp.array2d[float]
):
    """Mean over each bin of the single-scatter rate times its width. Launch: pixels."""
    i = first + wp.tid()
    bins = rates.shape[1]
    width = (lidar.stop - lidar.start) / wp.float64(bins)
    sight = _see(lidar.ports, view[i])
    for k in range(bins):
        total = wp.float64(0.0)
        for n in range(4):
            time = lidar.start + (wp.float64(k) + (wp.float64(n) + wp.float64(0.5)) / wp.float64(4.0)) * width
            total += single_scatter_rate(lidar, water, sight, time)
        rates[i, k] = float(total * width / wp.float64(4.0))


def backscatter_rates(config: SpadConfig, device: wp.Device) -> np.ndarray:
    """Detections of single scattering without a target, blurred by the response, per pulse and bin, float32 `[pixels,
    bins]`; waits for the device."""
    rates = wp.zeros((config.width * config.height, config.bins), dtype=float, device=device)
    if config.scattering > 0.0:
        phase = wp.array(config.phase_table(), dtype=wp.float64, device=device)
        view = wp.array(config.lines_of_sight(), dtype=wp.vec3d, device=device)
        lidar = config.lidar()
        inputs = [lidar, make_scattering(lidar, phase, device), view, rates]
        launch_pixels(_backscatter_kernel, rates.shape[0], inputs, device=device)
    taps, lowest = config.bin_response()
    padded = np.pad(rates.numpy(), ((0, 0), (-lowest, -lowest)))
    return np.lib.stride_tricks.sliding_window_view(padded, taps.size, axis=1) @ taps.astype(np.float32)


# ---- Both kinds of cameras.


@wp.kernel(enable_backward=False)
def _trace_kernel(
    shapes: ShapeTable,
    camera_q: wp.array[wp.transform],
    optical: wp.transform,
    world: wp.array[int],
    view: wp.array[wp.vec3],
    # Out, [cameras, height, width]:
    depth: wp.array3d[float],
    normal: wp.array3d[wp.vec3],
    reflectance: wp.array3d[float],
):
    """Launch: (cameras, height, width)."""
    v, i, j = wp.tid()
    pose = wp.transform_multiply(camera_q[v], optical)
    u = view[i * depth.shape[2] + j]
    x = wp.transform_get_translation(pose)
    hit, hit_reflectance = intersect_shapes(shapes, world[v], x, wp.transform_vector(pose, u))
    depth[v, i, j] = wp.NAN
    normal[v, i, j] = wp.vec3(wp.NAN)
    reflectance[v, i, j] = wp.NAN
    if hit.distance >= 0.0:
        depth[v, i, j] = hit.distance * u[2]
        normal[v, i, j] = wp.quat_rotate_inv(wp.transform_get_rotation(pose), hit.normal)
        reflectance[v, i, j] = hit_reflectance


@wp.kernel(enable_backward=False)
def _depth_kernel(
    arrival: wp.array[float],
    view: wp.array[wp.vec3],
    laser: wp.vec3,
    gate_start: float,
    bin_path: float,
    histogram: wp.array2d[int],
    # Out:
    depth: wp.array[float],
    counts: wp.array[int],
    step: wp.array[wp.int64],
):
    """Planar depth, the counts of all bins, and the next step. Launch: cameras x pixels."""
    row = wp.tid()
    if row == 0:
        step[0] = step[0] + wp.int64(1)
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
def _points_kernel(depth: wp.array3d[float], view: wp.array[wp.vec3], pose: wp.transform, points: wp.array3d[wp.vec3]):
    """Launch: (cameras, height, width)."""
    v, i, j = wp.tid()
    u = view[i * depth.shape[2] + j]
    points[v, i, j] = wp.transform_point(pose, depth[v, i, j] / u[2] * u)


def check_memory(what: str, sizes: Mapping[str, int], item_bytes: int, device: wp.Device, *, rows: int = 1) -> None:
    """Arrays of so many items of so many bytes that the device can have; `rows`: how many of the sizes, from the first
    on, make an index of kernels."""
    values = list(sizes.values())
    if (count := int(np.prod(values[:rows], dtype=object))) > 2**31 - 1:
        names = " x ".join(list(sizes)[:rows])
        raise ArgumentError(f"{names} = {count} is outside [1, 2147483647]")
    needed = item_bytes * int(np.prod(values, dtype=object))
    memory = device.total_memory if device.is_cuda else 2**63
    if device.is_cpu and hasattr(os, "sysconf"):
        memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES")
    if needed > memory:
        found = f"{needed / 1e9:.3g} GB, and {device} has {memory / 1e9:.3g} GB"
        raise ArgumentError(f"{' x '.join(sizes)} = {' x '.join(map(str, values))}: {what} need {found}")


class WorldCameras:
    """The part that `SpadCamera` and `SpadTracer` share; see there."""

    def __init__(
        self,
        config: SpadConfig | None,
        cameras: int,
        *,
        world: wp.array | Sequence[int] | None,
        frame: str,
        device: wp.DeviceLike,
    ) -> None:
        self.config = config = SpadConfig() if config is None else config
        check_kind("config", config, SpadConfig)
        self.device = device = check_device("device", device)
        self.cameras = check_integer("cameras", cameras, 1)
        sizes = {"cameras": self.cameras, "config.height": config.height, "config.width": config.width}
        image = tuple(sizes.values())
        sizes["config.bins"] = config.bins
        check_memory("rates, counts and background", sizes, 8 + 24 // self.cameras, device, rows=3)
        self._optical = optical_to(frame)
        self._most_worlds = 0
        if isinstance(world, wp.array):
            self._world = check_array("world", world, wp.int32, (self.cameras,), device)
        else:
            items = range(self.cameras) if world is None else check_items("world", world)
            worlds = [check_integer("world", one, 0) for one in items]
            if len(worlds) != self.cameras:
                text = f"world has {len(worlds)} entries; one for each of {self.cameras} cameras is needed"
                raise ArgumentError(text)
            self._world, self._most_worlds = wp.array(worlds, dtype=int, device=device), max(worlds) + 1
        self._poses_checked = False
        self.rates = wp.zeros((*image, config.bins), dtype=float, device=device)
        self.histogram = wp.zeros((*image, config.bins), dtype=int, device=device)
        self.counts = wp.zeros(image, dtype=int, device=device)
        self.depth, self.true_depth = (wp.full(image, wp.nan, dtype=float, device=device) for _ in range(2))
        self.normal = wp.zeros(image, dtype=wp.vec3, device=device)
        self.reflectance, self.significance = (wp.zeros(image, dtype=float, device=device) for _ in range(2))
        self.step = wp.zeros(1, dtype=wp.int64, device=device)
        self._view = wp.array(config.lines_of_sight(), dtype=wp.vec3, device=device)

    def _tabulate(self) -> None:
        """Light and responses that no shape changes: seconds of work, after all arguments are checked."""
        config, device = self.config, self.device
        background = backscatter_rates(config, device)
        self._background = wp.array(background, dtype=float, device=device)
        self._rows = (self.cameras * config.height * config.width, config.bins)
        self._arrival = wp.empty(self._rows[0], dtype=float, device=device)
        self._dark = config.dark_rate * config.bin_path / config.speed
        known = wp.array(config.pulses * (background + self._dark), dtype=float, device=device)
        response, lowest_tap = config.response()
        taps = {"response": response, "lowest_tap": lowest_tap, "half_width": -lowest_tap - 1}
        taps |= {"min_significance": config.min_significance, "width": 2.355 * config._sigma_bins}
        self._estimate = ArrivalEstimator(config.bins, device, config.method, known, **taps, pulses=config.pulses)

    def _cast_rays(self, shapes: Shapes, camera_q: wp.array, body_q: wp.array | None) -> None:
        """Moves the shapes and casts a ray a pixel."""
        check_kind("shapes", shapes, Shapes)
        check_array("camera_q", camera_q, wp.transform, (self.cameras,), self.device)
        if self._most_worlds > shapes.worlds:
            raise ArgumentError(f"world = {self._most_worlds - 1} is none of the {shapes.worlds} worlds of the shapes")
        if not (self._poses_checked or self.device.is_capturing):  # once: later steps wait for nothing
            check_poses("camera_q", camera_q)
            if body_q is not None:
                check_array("body_q", body_q, wp.transform, (None,), self.device)
                check_poses("body_q", body_q, shapes.bodies)
            self._poses_checked = True
        move_shapes(shapes, body_q)
        inputs = [shapes.table, camera_q, self._optical, self._world, self._view]
        outputs = [self.true_depth, self.normal, self.reflectance]
        wp.launch(_trace_kernel, self.true_depth.shape, inputs, outputs, device=self.device)

    def _detect(self) -> None:
        """Counts and depth of all cameras from their rates, and the next step; nothing is allocated or read."""
        config = self.config
        rates, counts = self.rates.reshape(self._rows), self.histogram.reshape(self._rows)
        first_photon_counts(rates, pulses=config.pulses, first_frame=self.step, seed=config.seed, counts=counts)
        self._estimate(counts, self._arrival, self.significance.flatten())
        inputs = [self._arrival, self._view, wp.vec3(*config.laser_position), config.gate_paths[0], config.bin_path]
        outputs = [self.depth.flatten(), self.counts.flatten(), self.step]
        wp.launch(_depth_kernel, self._rows[0], [*inputs, counts], outputs, device=self.device)

    def point_cloud(self, out: wp.array, *, frame: str = "optical") -> None:
        """Points of the noisy depth, vec3 `[cameras, height, width]` [m], in a frame of CAMERA_FRAMES; NaN for none."""
        check_array("out", out, wp.vec3, self.depth.shape, self.device)
        inputs = [self.depth, self._view, optical_to(frame)]
        wp.launch(_points_kernel, self.depth.shape, inputs, [out], device=self.device)


# ---- The fast camera.


@wp.kernel(enable_backward=False)
def _images_kernel(
    view: wp.array[wp.vec3],
    # In, [cameras, height, width]; those that are None have no entries:
    depth_in: wp.array3d[float],
    along_ray: bool,
    normal_in: wp.array3d[wp.vec3],
    camera_q: wp.array[wp.transform],
    optical: wp.transform,
    reflectance_in: wp.array3d[float],
    one_reflectance: float,
    # Out:
    depth: wp.array3d[float],
    normal: wp.array3d[wp.vec3],
    reflectance: wp.array3d[float],
):
    """Launch: (cameras, height, width)."""
    v, i, j = wp.tid()
    width = depth.shape[2]
    u = view[i * width + j]
    z = depth_in[v, i, j]
    if along_ray:
        z = z * u[2]
    depth[v, i, j] = wp.where(wp.isfinite(z) and z > 0.0, z, wp.NAN)
    value = one_reflectance
    if reflectance_in.shape[0] > 0:
        value = reflectance_in[v, i, j]
    reflectance[v, i, j] = value
    n = wp.vec3(0.0)
    if normal_in.shape[0] > 0:
        n = normal_in[v, i, j]
        if camera_q.shape[0] > 0:
            n = wp.quat_rotate_inv(wp.transform_get_rotation(camera_q[v]), n)
        n = wp.quat_rotate_inv(wp.transform_get_rotation(optical), n)
    else:
        n = wp.cross(_edge(view, depth_in, along_ray, v, i, j, 0, 1), _edge(view, depth_in, along_ray, v, i, j, 1, 0))
        n = wp.where(wp.length_sq(n) > 0.0, n, u)
    n = wp.normalize(n)
    normal[v, i, j] = wp.where(wp.dot(n, u) > 0.0, -n, n)


@wp.func
def _point(view: wp.array[wp.vec3], depth: wp.array3d[float], along_ray: bool, v: int, i: int, j: int):
    u = view[i * depth.shape[2] + j]
    return wp.where(along_ray, depth[v, i, j], depth[v, i, j] / u[2]) * u


@wp.func
def _edge(view: wp.array[wp.vec3], depth: wp.array3d[float], along_ray: bool, v: int, i: int, j: int, di: int, dj: int):
    """From a pixel's surface to the neighbour's along an axis which is nearer in depth, not across an edge of a thing;
    0 for none."""
    here = _point(view, depth, along_ray, v, i, j)
    best = wp.vec3(0.0)
    least = float(1.0e30)
    for side in range(2):
        sign = 2 * side - 1
        ii = i + sign * di
        jj = j + sign * dj
        if ii >= 0 and jj >= 0 and ii < depth.shape[1] and jj < depth.shape[2]:
            there = _point(view, depth, along_ray, v, ii, jj)
            gap = wp.abs(there[2] - here[2])
            if wp.isfinite(gap) and gap < least:
                least = gap
                best = float(sign) * (there - here)
    return best


@wp.kernel(enable_backward=False)
def _signal_kernel(
    lidar: Lidar,
    view: wp.array[wp.vec3],
    depth: wp.array[float],
    normal: wp.array[wp.vec3],
    reflectance: wp.array[float],
    # Out:
    signal: wp.array[float],
    path: wp.array[float],
):
    """Detections per pulse of the surface, and its path, infinite where there is none. Launch: cameras x pixels."""
    row = wp.tid()
    u = wp.vec3d(view[row % view.shape[0]])
    signal[row] = 0.0
    path[row] = wp.inf
    if depth[row] > 0.0:
        r = wp.float64(depth[row]) / u[2]
        value = radiometric_signal(lidar, _see(lidar.ports, u), r, wp.vec3d(normal[row]), wp.float64(reflectance[row]))
        path[row] = float(beam_path(lidar, r * u) + r)
        if value > wp.float64(0.0) and wp.isfinite(value):
            signal[row] = float(value)


@wp.func
def _below(z: float) -> float:
    """Probability below z standard deviations."""
    return 0.5 * wp.erfc(-0.70710678118654752 * z)


@wp.kernel(enable_backward=False)
def _rates_kernel(
    signal: wp.array[float],
    path: wp.array[float],
    background: wp.array2d[float],
    gate_start: float,
    bin_path: float,
    sigma_path: float,
    dark: float,
    # Out:
    rates: wp.array2d[float],
):
    """Expected detections per pulse: surface, backscatter up to it, dark counts. Launch: (cameras x pixels, bins)."""
    row, k = wp.tid()
    scale = 1.0 / sigma_path
    low = (gate_start + float(k) * bin_path - path[row]) * scale
    high = low + bin_path * scale
    surface = float(0.0)
    if low < 9.0 and high > -9.0:
        # From the side on which both are small, where a difference keeps its digits.
        surface = wp.where(low > 0.0, _below(-low) - _below(-high), _below(high) - _below(low)) * signal[row]
    water = background[row % background.shape[0], k] * _below(-0.5 * (low + high))
    rates[row, k] = dark + water + wp.max(surface, 0.0)


class SpadCamera(WorldCameras):
    """Single-photon cameras in many worlds: histograms, counts and noisy depth of all in a few launches.

    A pixel sees one surface, the water between by single scattering, and dark counts. The first
    step checks the poses. Every other one allocates nothing, reads nothing back and has its random numbers from a
    counter on the device: it can be captured in a CUDA graph.

    Args:
        config: Laser, detector and water; the same for all cameras.
        cameras: Their number.
        world: World of each camera, as in Newton; by default camera k is in world k. Kept if it is an array on the
            device, which may change.
        frame: Of the cameras' poses, one of CAMERA_FRAMES: "optical" (+z forward, y down), "opengl" (-z forward, y up:
            Newton, MuJoCo, USD), "forward_left_up" (bodies in ROS).
        device: Of the arrays.

    Attributes:
        rates: Expected detections per pulse, float32 `[cameras, height, width, bins]`.
        histogram: Counts of the frame, int32 `[cameras, height, width, bins]`.
        counts: Sum of the histogram, int32 `[cameras, height, width]`.
        depth: Planar depth (z of the optical frame) from the histogram [m], float32 `[cameras, height, width]`; NaN
            where nothing was detected.
        significance: Of the detection, float32 `[cameras, height, width]`, see `SpadConfig.min_significance`.
        true_depth, normal, reflectance: What is there, `[cameras, height, width]`: planar depth [m], unit normals to
            the camera in the optical frame, reflectance; NaN for none.
        step: Number of the next step, int64 `[1]`. A step's random numbers depend on `config.seed` and it alone.

    Raises:
        ArgumentError: A number out of range, or arrays that do not fit.
    """

    def __init__(
        self,
        config: SpadConfig | None = None,
        cameras: int = 1,
        *,
        world: wp.array | Sequence[int] | None = None,
        frame: str = "optical",
        device: wp.DeviceLike = None,
    ) -> None:
        super().__init__(config, cameras, world=world, frame=frame, device=device)
        self._tabulate()
        self._lidar = self.config.lidar()
        self._signal, self._path = (wp.zeros(self._rows[0], dtype=float, device=self.device) for _ in range(2))

    def update(self, shapes: Shapes, camera_q: wp.array, body_q: wp.array | None = None) -> None:
        """A step: moves the shapes, casts a ray a pixel, and draws a frame.

        Args:
            shapes: From `make_shapes`, `newton_shapes` or `mujoco_shapes`.
            camera_q: Poses of the cameras in their worlds, `wp.transform` `[cameras]`.
            body_q: Poses of the bodies, `wp.transform` `[bodies]`, as Newton's `state.body_q`.
        """
        self._cast_rays(shapes, camera_q, body_q)
        self._draw()

    def update_from_images(
        self,
        depth: wp.array,
        normal: wp.array | None = None,
        reflectance: wp.array | float = 0.2,
        *,
        along_ray: bool = False,
        camera_q: wp.array | None = None,
    ) -> None:
        """A step from what the simulator's own camera has rendered, `[cameras, height, width]`.

        Args:
            depth: float32 [m], planar; 0, negative, NaN or infinite where nothing is.
            normal: vec3, either side, in the camera's frame or, with `camera_q`, in the world's; None takes them from
                the slope of the depth.
            reflectance: float32 in [0, 1], or a number.
            along_ray: Depth is the distance from the lens, as Newton's `depth_image` is.
            camera_q: As in `update`.
        """
        shape = self.true_depth.shape
        check_array("depth", depth, wp.float32, shape, self.device)
        number = 0.0
        if isinstance(reflectance, wp.array):
            check_array("reflectance", reflectance, wp.float32, shape, self.device)
        else:
            number, reflectance = check_number("reflectance", reflectance, "[0, 1]"), None
        if normal is not None:
            check_array("normal", normal, wp.vec3, shape, self.device)
        if camera_q is not None:
            check_array("camera_q", camera_q, wp.transform, (self.cameras,), self.device)
        inputs = [self._view, depth, bool(along_ray), normal, camera_q, self._optical, reflectance, number]
        outputs = [self.true_depth, self.normal, self.reflectance]
        wp.launch(_images_kernel, shape, inputs, outputs, device=self.device)
        self._draw()

    def _draw(self) -> None:
        """Signal, rates, counts and depth from the images of what is there."""
        config = self.config
        inputs = [self._lidar, self._view, self.true_depth.flatten(), self.normal.flatten(), self.reflectance.flatten()]
        outputs = [self._signal, self._path]
        wp.launch(_signal_kernel, self._rows[0], inputs, outputs, device=self.device)
        inputs = [self._signal, self._path, self._background, config.gate_paths[0], config.bin_path]
        inputs += [config.timing_sigma * config.speed, self._dark]
        wp.launch(_rates_kernel, self._rows, inputs, [self.rates.reshape(self._rows)], device=self.device)
        self._detect()
