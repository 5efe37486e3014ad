"""The laser, the SPAD array and the water of the cameras for simulators, and their formulas."""

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.analytic.optics import BACKSCATTER_SOURCES, IN_WATER, Lidar
from spadwarp_kernels.analytic.rates import Scattering, make_scattering, single_scatter_rate
from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import launch_pixels
from spadwarp_kernels.detection.arrival_time import PHASES
from spadwarp_kernels.detection.significance import MIN_SIGNIFICANCE
from spadwarp_kernels.optics.camera import C0
from spadwarp_kernels.optics.laser import LASER_PROFILES
from spadwarp_kernels.water.phase_functions import henyey_greenstein_density

__all__ = ["SpadConfig"]

wp.set_module_options({"enable_backward": False, "max_unroll": 1})

PLANCK = 6.62607015e-34  # [J s]

_see = IN_WATER.see

_FIELDS_OF_VIEW = ("horizontal_fov", "vertical_fov", "pixel_fov", "camera_matrix")

_RANGES = {
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
    horizontal_fov: float | None = None  # full angle [rad] of the image; 1.2 if no field of view is given
    vertical_fov: float | None = None  # full angle [rad] in its place, as Newton's `camera_fov` and MuJoCo's `fovy`
    pixel_fov: float | None = None  # full angle [rad] of a pixel on the axis in its place, as of scanners
    camera_matrix: Any = None
    """3 x 3 in its place, as of OpenCV, ROS and Isaac Lab: (f_x, 0, c_x), (0, f_y, c_y), (0, 0, 1) [pixels], where the
    first pixel's centre is (0, 0). To read: `SpadCamera.camera_matrix`."""
    bins: int = 256  # time bins of a histogram
    gate_distance: tuple[float, float] = (0.5, 10.0)  # one way in this water: least and largest recorded [m]
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
            check.integer(f"config.{name}", getattr(self, name), 1)
        check.integer("config.pulses", self.pulses, 0)
        check.fields("config", self, _RANGES)
        self._check_field_of_view()
        check.vector("config.gate_distance", self.gate_distance, size=2)
        check.number("config.gate_distance[0]", self.gate_distance[0], "[0, inf)")
        check.number("config.gate_distance[1]", self.gate_distance[1], f"({float(self.gate_distance[0])}, inf)")
        check.vector("config.laser_position", self.laser_position)
        if self.laser_half_angle is not None:
            check.number("config.laser_half_angle", self.laser_half_angle, "(0, 3.1416]")
        check.choice("config.method", self.method, ("centroid", "peak", "matched", "likelihood"))
        check.integer("config.seed", self.seed, 0, 2**64 - 1)
        if (bins := self._sigma_bins) > 1e4:
            found = f"{self.timing_sigma} s is {bins:.3g} bins of {self.bin_path / self.speed:.3g} s"
            raise ArgumentError(f"config.timing_sigma = {found}; 10000 are possible")

    def _check_field_of_view(self) -> None:
        found = [name for name in _FIELDS_OF_VIEW if getattr(self, name) is not None]
        if len(found) > 1:
            raise ArgumentError(f"config.{found[0]} and config.{found[1]}: only one says what the image shows")
        check.fields("config", self, dict.fromkeys(set(found) - {"camera_matrix"}, "(0, 3.1)"))
        if self.camera_matrix is not None:
            k = check.numbers("config.camera_matrix", self.camera_matrix, (3, 3))
            if not (k[0, 0] > 0.0 < k[1, 1] and (k * [[0, 1, 0], [1, 0, 0], [1, 1, 0]] == 0).all()):
                form = "(f_x, 0, c_x), (0, f_y, c_y), (0, 0, 1) of f > 0 [pixels]"
                raise ArgumentError(f"config.camera_matrix = {k.tolist()} is not {form}")

    @property
    def intrinsics(self) -> np.ndarray:
        """The camera matrix, see `camera_matrix`, float64 `[3, 3]`."""
        if self.camera_matrix is not None:
            return np.array(self.camera_matrix, np.float64)
        if self.pixel_fov is not None:
            f = 0.5 / math.tan(0.5 * self.pixel_fov)
        elif self.vertical_fov is not None:
            f = 0.5 * self.height / math.tan(0.5 * self.vertical_fov)
        else:
            f = 0.5 * self.width / math.tan(0.5 * (1.2 if self.horizontal_fov is None else self.horizontal_fov))
        return np.array([(f, 0.0, 0.5 * self.width - 0.5), (0.0, f, 0.5 * self.height - 0.5), (0.0, 0.0, 1.0)])

    @property
    def pixel_tangent(self) -> float:
        """Pixel pitch over focal length; the geometric mean of both axes."""
        k = self.intrinsics
        return float(1.0 / math.sqrt(k[0, 0] * k[1, 1]))

    @property
    def speed(self) -> float:
        """Group velocity [m/s]."""
        return C0 / self.group_index

    @property
    def gate_paths(self) -> tuple[float, float]:
        """Paths from the laser to the lens at which the gate opens and closes [m]."""
        return 2.0 * float(self.gate_distance[0]), 2.0 * float(self.gate_distance[1])

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
        k = self.intrinsics
        sizes = enumerate((self.width, self.height))
        corner = [max(k[i, 2] + 0.5, n - 0.5 - k[i, 2]) / k[i, i] for i, n in sizes]
        return min(1.1 * math.atan(math.hypot(*corner)), 0.5 * math.pi)

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
        lidar.sigma, lidar.bin_width = self.timing_sigma, self.bin_path / self.speed
        lidar.source, lidar.nearest = BACKSCATTER_SOURCES.index("single_scatter"), self.nearest
        return lidar

    def lines_of_sight(self) -> np.ndarray:
        """Unit vectors through the pixel centres in the optical frame, float64 `[height * width, 3]`."""
        k = self.intrinsics
        x, y = np.meshgrid((np.arange(self.width) - k[0, 2]) / k[0, 0], (np.arange(self.height) - k[1, 2]) / k[1, 1])
        view = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        return view / np.linalg.norm(view, axis=1, keepdims=True)

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


# ---- The water's light.


@wp.kernel(enable_backward=False)
def _table_kernel(first: int, lidar: Lidar, water: Scattering, view: wp.array[wp.vec3d], table: wp.array2d[float]):
    """Single scattering per pulse and bin, by its rate at four times of the bin. Launch: pixels."""
    i = first + wp.tid()
    sight = _see(lidar.ports, view[i])
    step = wp.float64(0.25) * lidar.bin_width
    for k in range(table.shape[1]):
        total = wp.float64(0.0)
        for n in range(4):
            time = lidar.start + (wp.float64(4 * k + n) + wp.float64(0.5)) * step
            total += single_scatter_rate(lidar, water, sight, time)
        table[i, k] = float(total * step)


def scattering_table(config: SpadConfig, view: np.ndarray, bins: int, device: wp.Device) -> np.ndarray:
    """Detections of single scattering without a target, blurred by the response, per pulse and bin, in the config's
    water but for a scattering coefficient of 1 / m, float32 `[pixels, bins]`; waits for the device."""
    lidar, table = config.lidar(), wp.zeros((len(view), bins), dtype=float, device=device)
    cosines = np.cos(np.linspace(0.0, np.pi, 3601))
    phase = wp.array(henyey_greenstein_density(1.0 - cosines, config.anisotropy), dtype=wp.float64, device=device)
    line = wp.array([wp.vec3d(lidar.photons, lidar.extinction, 1.0)], dtype=wp.vec3d, device=device)
    water = make_scattering(lidar, phase, device, lines=line)
    inputs = [lidar, water, wp.array(view, dtype=wp.vec3d, device=device), table]
    launch_pixels(_table_kernel, len(view), inputs, device=device)
    taps, lowest = config.bin_response()
    padded = np.pad(table.numpy(), ((0, 0), (-lowest, -lowest)))
    return np.lib.stride_tricks.sliding_window_view(padded, taps.size, axis=1) @ taps.astype(np.float32)


# ---- What differs from world to world.


@wp.struct
class WorldValues:
    """What may differ from world to world, `[worlds]`; without entries it is that of the `SpadConfig`."""

    absorption: wp.array[float]
    scattering: wp.array[float]
    pulse_energy: wp.array[float]
    dark_rate: wp.array[float]
    pulses: wp.array[int]
    gate_delay: wp.array[float]  # by which the gate opens and closes later [one-way m]


@wp.func
def world_value(values: wp.array[Any], world: int, otherwise: Any):
    if world >= 0 and world < values.shape[0]:
        return values[world]
    return otherwise


def world_values(by_world: Mapping[str, Any], config: SpadConfig, device: wp.Device) -> tuple[WorldValues, int]:
    """Arrays of checked values, and the number of worlds that they are for; 0 for none."""
    values, worlds = WorldValues(), 0
    check.kind("by_world", by_world, Mapping)
    for name, given in by_world.items():
        check.choice("by_world", name, WorldValues.vars)
        dtype = WorldValues.vars[name].type.dtype
        if not isinstance(given, wp.array):
            rows = check.numbers(f"by_world[{name!r}]", given, (None,))
            given = wp.array(rows.astype(wp.dtype_to_numpy(dtype)), dtype=dtype, device=device)
        check.array(f"by_world[{name!r}]", given, dtype, (worlds or None,), device)
        gate = config.gate_distance
        high = {"gate_delay": gate[1] - gate[0], "pulses": 2**31 - 1}.get(name, 1e6)
        check.numbers(f"by_world[{name!r}]", given, None, f"[0, {high}]")
        setattr(values, name, given)
        worlds = given.size
    return values, worlds
