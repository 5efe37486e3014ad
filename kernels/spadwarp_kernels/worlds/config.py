"""What a single-photon camera in water is made of: laser, detector, water, and the frame of its pose.

Everything that stands in a camera here (laser, normals, points) is in the optical frame; poses are given in the frame
that the caller's simulator uses.
"""

import math
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.analytic.optics import BACKSCATTER_SOURCES, IN_WATER, Lidar
from spadwarp_kernels.analytic.rates import Scattering, make_scattering, single_scatter_rate
from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_choice,
    check_fields,
    check_integer,
    check_kind,
    check_number,
    check_vector,
)
from spadwarp_kernels.base.kernels import launch_pixels
from spadwarp_kernels.detection.arrival_time import PHASES
from spadwarp_kernels.optics.camera import C0
from spadwarp_kernels.optics.laser import LASER_PROFILES
from spadwarp_kernels.water.phase_functions import henyey_greenstein_density

__all__ = ["CAMERA_FRAMES", "SpadConfig"]

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
}


@dataclass(frozen=True, kw_only=True)
class SpadConfig:
    """A pulsed laser beside a SPAD array in water: what `SpadCamera` and `SpadTracer` take.

    Attributes:
        width, height: Of the image [pixels].
        horizontal_fov: Full angle [rad]; pixels are square. See `vertical_fov` for that of Newton and MuJoCo.
        bins: Time bins of a histogram.
        gate: What is recorded, as distance in this water along the optical axis [m].
        pulses: Of a frame.
        pulse_energy: [J].
        wavelength: [m].
        pde: Photon detection efficiency, PDP times fill factor.
        dark_rate: Dark counts and ambient light of a pixel [1/s].
        timing_sigma: Standard deviation of pulse and timing jitter together [s].
        aperture_radius: [m].
        laser_position: In the optical frame [m]: +x right, +y down, +z forward. The beam goes along +z.
        laser_half_angle: Of its uniform cone [rad]; None covers the corners of the image.
        absorption, scattering: Of the water [1/m]; both 0 in air.
        anisotropy: g of its Henyey–Greenstein phase function.
        group_index: c0 over the group velocity.
        nearest: Distance below which the water's backscatter is left out [m].
        method: Of the depth: "centroid", "peak", "matched" or "likelihood", see `arrival_bins`. The expected counts of
            an image without targets are taken as known background.
        seed: 64-bit.

    Raises:
        ArgumentError: A number out of range.
    """

    width: int = 160
    height: int = 120
    horizontal_fov: float = 1.2
    bins: int = 256
    gate: tuple[float, float] = (0.5, 10.0)
    pulses: int = 20_000
    pulse_energy: float = 2e-9
    wavelength: float = 532e-9
    pde: float = 0.25
    dark_rate: float = 1000.0
    timing_sigma: float = 200e-12
    aperture_radius: float = 0.01
    laser_position: tuple[float, float, float] = (0.05, 0.0, 0.0)
    laser_half_angle: float | None = None
    absorption: float = 0.1
    scattering: float = 0.2
    anisotropy: float = 0.924
    group_index: float = 1.3638
    nearest: float = 0.05
    method: str = "centroid"
    seed: int = 1

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
        if (bins := self.timing_sigma * self.speed / self.bin_path) > 1e4:
            width = self.bin_path / self.speed
            raise ArgumentError(
                f"config.timing_sigma = {self.timing_sigma} s is {bins:.3g} bins of {width:.3g} s; 10000 are possible"
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
        sigma = self.timing_sigma * self.speed / self.bin_path
        reach = math.ceil(5.0 * sigma) + 1
        edges = np.arange(-reach, reach + 2)[None, :] - np.arange(int(PHASES))[:, None] / int(PHASES)
        cumulative = 0.5 * (1.0 + np.vectorize(math.erf)(edges / (math.sqrt(2.0) * sigma)))
        return np.diff(cumulative, axis=1), -reach

    def bin_response(self, parts: int = 1) -> tuple[np.ndarray, int]:
        """Shares in a bin of the light that is spread evenly over each of the parts of the bins about it.

        Returns float64 `[taps]` and the first tap's part, counted from the first part of the bin.
        """
        sigma = self.timing_sigma * self.speed / self.bin_path
        reach = math.ceil(5.0 * sigma)
        edges = np.arange(-reach * parts, (reach + 1) * parts + 1) / parts
        after, before = (np.array([_normal_integral((end - s) / sigma) for s in edges]) for end in (1.0, 0.0))
        return -parts * sigma * np.diff(after - before), -reach * parts


def _normal_integral(z: float) -> float:
    """Integral of the normal distribution function up to z."""
    return z * 0.5 * math.erfc(-z / math.sqrt(2.0)) + math.exp(-0.5 * z * z) / math.sqrt(2.0 * math.pi)


def check_config(config: Any) -> SpadConfig:
    """A `SpadConfig`, or the default for None."""
    config = SpadConfig() if config is None else config
    check_kind("config", config, SpadConfig)
    return config


@wp.kernel(enable_backward=False)
def _backscatter_kernel(
    first: int,
    lidar: Lidar,
    water: Scattering,
    view: wp.array[wp.vec3d],
    # Out:
    rates: wp.array2d[float],
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
    """Detections of light that the water scattered back once, per pulse and bin, float32 `[pixels, bins]`: without a
    target, blurred by the response. Waits for the device."""
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
