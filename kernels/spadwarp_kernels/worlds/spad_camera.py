"""Single-photon cameras in water, in many worlds: what both kinds share, and the fast one, in closed form: one surface
and single scattering a pixel, for all worlds in one launch.

Everything that stands in a camera here (laser, normals, points) is in the optical frame; poses are given in the frame
that the caller's simulator uses.
"""

import math
import os
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.analytic.depth_frames import depth_of_path
from spadwarp_kernels.analytic.optics import IN_WATER, Lidar, beam_path
from spadwarp_kernels.analytic.rates import radiometric_signal
from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.kernels import launch_pixels, memoised
from spadwarp_kernels.detection.arrival_time import ArrivalEstimator
from spadwarp_kernels.detection.counts import FirstPhotons, draw_bin
from spadwarp_kernels.detection.significance import Windows, begin_search, offer_bin, significance_of

from .shapes import CAMERA_FRAMES, Shapes, ShapeTable, check_poses, intersect_shapes, move_shapes
from .spad_config import SpadConfig, WorldValues, scattering_table, world_value, world_values

__all__ = ["CAMERA_OUTPUTS", "CAMERA_STATUS", "SpadCamera"]

# Unrolled loops would make the compilation for a GPU take a minute.
wp.set_module_options({"enable_backward": False, "max_unroll": 1})

CAMERA_OUTPUTS = ("rates", "histogram", "depth")
"""Outputs that a caller chooses: those with bins need memory, and a depth needs an estimate."""

CAMERA_STATUS = ("target", "no_return", "saturated", "outside_gate")
"""Words for the numbers of a camera's `status`."""
TARGET, NO_RETURN, SATURATED, OUTSIDE_GATE = (wp.constant(i) for i in range(len(CAMERA_STATUS)))

# Part of the pulses that count at which a pixel is saturated: three mean photons a pulse.
_SATURATION = wp.constant(0.95)

_ROWS = 1 << 19  # pixels that are drawn side by side: enough for a GPU, and 540 MB of counts of 256 bins

_see = IN_WATER.see


def optical_to(frame: Any) -> wp.transform:
    """The pose of the optical frame in a camera frame of `CAMERA_FRAMES`; raises `ArgumentError`."""
    check.choice("frame", frame, CAMERA_FRAMES)
    return wp.transform(wp.vec3(0.0), wp.quat(*CAMERA_FRAMES[frame]))


@wp.struct
class Images:
    """Images of all cameras, by row: a pixel of a camera; see the attributes of `SpadCamera`."""

    true_distance: wp.array[float]
    true_depth: wp.array[float]
    normal: wp.array[wp.vec3]
    reflectance: wp.array[float]
    counts: wp.array[int]
    significance: wp.array[float]
    depth: wp.array[float]
    distance: wp.array[float]
    status: wp.array[int]


@wp.struct
class Sensor:
    """What the frames of all cameras have in common."""

    lidar: Lidar
    images: Images
    values: WorldValues
    world: wp.array[int]
    due: wp.array[int]  # whether a camera sees at this step
    step: wp.array[wp.int64]
    view: wp.array[wp.vec3]  # unit vectors of the pixels in the optical frame
    scans: bool  # each ray has the laser and the axis of a scanner, which turns with it
    table: wp.array2d[float]  # see `scattering_table`; one row of a scanner's rays
    gate_start: float  # [m of path]
    bin_path: float  # [m of path]
    sigma_path: float  # [m of path]
    dark: float  # dark counts per pulse and bin
    bins: int
    pulse_energy: float  # [J]
    pulses: int
    read: wp.vec2i  # bins, from the best window's first on, in which the estimator reads the background
    seed: wp.uint64


@wp.struct
class PixelLight:
    """What a pixel gets."""

    signal: float  # of the surface, detections per pulse
    path: float  # of its light [m], infinite where there is none
    start: float  # at which the gate opens [m of path]
    delay: float  # of the gate [bins]
    water: float  # by which the table is multiplied in the first bin
    decay: float  # and from bin to bin
    dark: float  # per pulse and bin
    row: int  # of the table


# ---- Rays.


@wp.kernel(enable_backward=False)
def _schedule_kernel(
    world: wp.array[int], active: wp.array[wp.bool], dt: float, period: float, age: wp.array[float], due: wp.array[int]
):
    """Which cameras see at this step. Launch: cameras."""
    v = wp.tid()
    age[v] = age[v] + dt
    w = world[v]
    is_due = age[v] >= period
    if active.shape[0] > 0:
        is_due = is_due and w >= 0 and w < active.shape[0] and active[w]
    due[v] = wp.where(is_due, 1, 0)
    if is_due:
        age[v] = 0.0


@wp.kernel(enable_backward=False)
def _mount_kernel(
    body: wp.array[int], offset: wp.array[wp.transform], body_q: wp.array[wp.transform], poses: wp.array[wp.transform]
):
    """Launch: cameras."""
    v = wp.tid()
    poses[v] = wp.transform_multiply(body_q[body[v]], offset[v])


@wp.kernel(enable_backward=False)
def _trace_kernel(shapes: ShapeTable, camera_q: wp.array[wp.transform], optical: wp.transform, sensor: Sensor):
    """Launch: rows, each a pixel of a camera."""
    row = wp.tid()
    v = row / sensor.view.shape[0]
    if sensor.due[v] == 0:
        return
    pose = wp.transform_multiply(camera_q[v], optical)
    u = sensor.view[row % sensor.view.shape[0]]
    x = wp.transform_get_translation(pose)
    hit, reflectance = intersect_shapes(shapes, sensor.world[v], x, wp.transform_vector(pose, u))
    images = sensor.images
    images.true_distance[row] = wp.NAN
    images.true_depth[row] = wp.NAN
    images.normal[row] = wp.vec3(wp.NAN)
    images.reflectance[row] = wp.NAN
    if hit.distance >= 0.0:
        images.true_distance[row] = hit.distance
        images.true_depth[row] = hit.distance * u[2]
        images.normal[row] = wp.quat_rotate_inv(wp.transform_get_rotation(pose), hit.normal)
        images.reflectance[row] = reflectance


# ---- Frames.


@wp.func
def _light(sensor: Sensor, row: int, world: int) -> PixelLight:
    light = PixelLight()
    lidar = sensor.lidar
    pixel = row % sensor.view.shape[0]
    distance = sensor.images.true_distance[row]
    values = sensor.values
    scattering = world_value(values.scattering, world, float(lidar.scattering))
    absorption = world_value(values.absorption, world, float(lidar.extinction - lidar.scattering))
    excess = float(0.0)  # extinction beyond the table's [1/m]
    if values.scattering.shape[0] + values.absorption.shape[0] > 0:
        excess = scattering + absorption - float(lidar.extinction)
    brightness = float(1.0)
    if values.pulse_energy.shape[0] > 0:
        brightness = world_value(values.pulse_energy, world, sensor.pulse_energy) / sensor.pulse_energy
    light.dark = sensor.dark
    if values.dark_rate.shape[0] > 0:
        light.dark = world_value(values.dark_rate, world, 0.0) * sensor.bin_path / float(lidar.speed)
    later = 2.0 * wp.max(world_value(values.gate_delay, world, 0.0), 0.0)
    light.delay = later / sensor.bin_path
    light.start = sensor.gate_start + later
    light.water = brightness * scattering * wp.exp(-excess * (light.start + 0.5 * sensor.bin_path))
    light.decay = wp.exp(-excess * sensor.bin_path)
    light.row = pixel % sensor.table.shape[0]
    light.path = wp.inf
    if distance > 0.0:
        u = wp.vec3d(sensor.view[pixel])
        n = sensor.images.normal[row]
        if sensor.scans:
            u = wp.vec3d(wp.float64(0.0), wp.float64(0.0), wp.float64(1.0))
            n = wp.quat_rotate(wp.quat_between_vectors(sensor.view[pixel], wp.vec3(0.0, 0.0, 1.0)), n)
        r = wp.float64(distance)
        reflectance = wp.float64(sensor.images.reflectance[row])
        value = radiometric_signal(lidar, _see(lidar.ports, u), r, wp.vec3d(n), reflectance)
        light.path = float(beam_path(lidar, r * u) + r)
        if value > wp.float64(0.0) and wp.isfinite(value):
            light.signal = float(value) * brightness * wp.exp(-excess * light.path)
    return light


@wp.func
def _below(z: float) -> float:
    """Probability below z standard deviations."""
    return 0.5 * wp.erfc(-0.70710678118654752 * z)


@wp.func
def _background(sensor: Sensor, light: PixelLight, k: int) -> float:
    """The water's detections per pulse in a bin, where nothing is in the way, but for the decay from the first on."""
    value = float(0.0)
    if light.delay == 0.0:
        value = sensor.table[light.row, k]
    else:
        place = float(k) + light.delay
        j = wp.min(int(place), sensor.table.shape[1] - 2)
        after = wp.min(place - float(j), 1.0)
        value = (1.0 - after) * sensor.table[light.row, j] + after * sensor.table[light.row, j + 1]
    return value * light.water


@wp.func
def _expected(sensor: Sensor, light: PixelLight, k: int, water: float) -> float:
    """Detections per pulse in a bin: surface, backscatter up to it, dark counts."""
    scale = 1.0 / sensor.sigma_path
    low = (light.start + float(k) * sensor.bin_path - light.path) * scale
    high = low + sensor.bin_path * scale
    if high < -9.0:
        return light.dark + water
    if low > 9.0:
        return light.dark
    # From the side on which both are small, where a difference keeps its digits.
    side = wp.where(low > 0.0, -1.0, 1.0)
    surface = side * (_below(side * high) - _below(side * low)) * light.signal
    return light.dark + water * _below(-0.5 * (low + high)) + wp.max(surface, 0.0)


_FRAME_BLOCK = 128


@memoised
def _frame_kernel(traced: bool) -> wp.Kernel:
    # Four blocks on a multiprocessor: without the bound the surface's light takes the registers of all bins.
    @wp.kernel(
        enable_backward=False, module="unique", module_options={"max_unroll": 1}, launch_bounds=(_FRAME_BLOCK, 4)
    )
    def frame(
        first: int,
        first_row: int,
        sensor: Sensor,
        windows: Windows,
        # [rows of this launch], but for arrays without entries; rates are read if they are traced:
        water: wp.array2d[float],
        rates: wp.array2d[float],
        histogram: wp.array2d[int],
        known: wp.array2d[float],
        window: wp.array[int],
    ):
        """Counts of a pixel, the background that it knows, and the significance of its best window. Launch: rows, each
        a pixel of a camera."""
        i = first + wp.tid()
        row = first_row + i
        v = row / sensor.view.shape[0]
        if sensor.due[v] == 0:
            return
        world = sensor.world[v]
        pulses = world_value(sensor.values.pulses, world, sensor.pulses)
        light = PixelLight()
        if wp.static(traced):
            light.dark = sensor.dark
        else:
            light = _light(sensor, row, world)
        id = wp.uint64(sensor.step[0]) * wp.uint64(sensor.images.counts.shape[0]) + wp.uint64(row)
        draws = FirstPhotons()
        draws.left = pulses
        search = begin_search(windows, row, wp.float64(pulses))
        decay = float(1.0)
        for k in range(histogram.shape[1]):
            level = float(0.0)
            rate = float(0.0)
            if wp.static(traced):
                level = water[i, k]
                rate = rates[i, k]
            else:
                level = _background(sensor, light, k) * decay
                decay *= light.decay
                rate = _expected(sensor, light, k, level)
                if rates.shape[0] > 0:
                    rates[i, k] = rate
            draws = draw_bin(draws, rate, sensor.seed, id)
            histogram[i, k] = draws.count
            search = offer_bin(windows, search, k, wp.int64(draws.count), float(pulses) * (level + light.dark))
        sensor.images.counts[row] = pulses - draws.left
        sensor.images.significance[row] = significance_of(windows, search)
        window[i] = search.window
        if known.shape[0] > 0:
            low = wp.max(search.window + sensor.read[0], 0)
            decay = wp.pow(light.decay, float(low))
            for k in range(low, wp.min(search.window + sensor.read[1], histogram.shape[1])):
                level = water[i, k] if wp.static(traced) else _background(sensor, light, k) * decay
                decay *= light.decay
                known[i, k] = float(pulses) * (level + light.dark)

    return frame


@wp.kernel(enable_backward=False)
def _depth_kernel(first: int, first_row: int, sensor: Sensor, arrival: wp.array[float]):
    """Depths, their status, and with the last of all rows the next step. `arrival`: of the rows of this launch. Launch:
    rows, each a pixel of a camera."""
    i = first + wp.tid()
    row = first_row + i
    images = sensor.images
    if row + 1 == images.counts.shape[0]:
        sensor.step[0] = sensor.step[0] + wp.int64(1)
    v = row / sensor.view.shape[0]
    if sensor.due[v] == 0:
        return
    u = sensor.view[row % sensor.view.shape[0]]
    ray = u
    if sensor.scans:
        ray = wp.vec3(0.0, 0.0, 1.0)
    laser = wp.vec3(sensor.lidar.laser)
    world = sensor.world[v]
    start = sensor.gate_start + 2.0 * world_value(sensor.values.gate_delay, world, 0.0)
    images.depth[row] = wp.NAN
    images.distance[row] = wp.NAN
    status = int(NO_RETURN)
    if arrival.shape[0] > 0 and wp.isfinite(arrival[i]):
        z = depth_of_path(laser, ray, start + arrival[i] * sensor.bin_path)
        if z > 0.0:
            images.distance[row] = z / ray[2]
            images.depth[row] = wp.where(sensor.scans, z * u[2], z)
            status = TARGET
    pulses = float(world_value(sensor.values.pulses, world, sensor.pulses))
    true_distance = images.true_distance[row]
    if pulses > 0.0 and float(images.counts[row]) >= _SATURATION * pulses:
        status = SATURATED
    elif status == NO_RETURN and true_distance > 0.0:
        path = true_distance + wp.length(true_distance * ray - laser)
        if path < start or path > start + float(sensor.bins) * sensor.bin_path:
            status = OUTSIDE_GATE
    images.status[row] = status


@wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 1})
def _points_kernel(sensor: Sensor, pose: wp.transform, points: wp.array3d[wp.vec3]):
    """Launch: (cameras, height, width)."""
    v, i, j = wp.tid()
    pixel = i * points.shape[2] + j
    distance = sensor.images.distance[v * sensor.view.shape[0] + pixel]
    points[v, i, j] = wp.transform_point(pose, distance * sensor.view[pixel])


# ---- Both kinds of cameras.


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

    traced = False  # whether the light comes from transport, which fills `_light` and `_water`

    def __init__(
        self,
        config: SpadConfig | None = None,
        cameras: int = 1,
        *,
        world: wp.array | Sequence[int] | None = None,
        frame: str | None = None,
        outputs: Sequence[str] = CAMERA_OUTPUTS,
        by_world: Mapping[str, Any] | None = None,
        rays: Any = None,
        body: Any = None,
        offset: Any = None,
        update_period: float = 0.0,
        device: wp.DeviceLike = None,
    ) -> None:
        self.config = config = SpadConfig() if config is None else config
        check.kind("config", config, SpadConfig)
        self.device = device = check.device("device", device)
        self.cameras = check.integer("cameras", cameras, 1)
        self.outputs = tuple(check.items("outputs", outputs))
        for one in self.outputs:
            check.choice("outputs", one, CAMERA_OUTPUTS)
        sizes = {"cameras": self.cameras, "config.height": config.height, "config.width": config.width}
        image, self._rows = tuple(sizes.values()), self.cameras * config.height * config.width
        pixels, sizes["config.bins"] = dict(sizes), config.bins
        check_memory("images", pixels, 1, device, rows=3)
        needed = 4 * ("rates" in self.outputs) + 4 * ("histogram" in self.outputs)
        check_memory("rates and counts", sizes, needed + 16 // self.cameras, device, rows=0)
        check_memory("images", pixels, 56, device, rows=3)
        if frame is not None:
            check.choice("frame", frame, CAMERA_FRAMES)
        self.frame = frame
        self._set_worlds(world)
        self._set_mount(body, offset)
        self._period = check.number("update_period", update_period, "[0, inf)")
        self._masked = False  # whether a step has had a mask
        self._age = wp.full(self.cameras, math.inf, dtype=float, device=device)
        self._due = wp.ones(self.cameras, dtype=int, device=device)
        self._poses_checked = False

        def full(name: str) -> tuple[int, ...]:
            return (*image, config.bins) if name in self.outputs else (0, 0, 0, 0)

        self.rates = wp.zeros(full("rates"), dtype=float, device=device)
        self.histogram = wp.zeros(full("histogram"), dtype=int, device=device)
        for name, var in Images.vars.items():
            setattr(self, name, wp.zeros(image, dtype=var.type.dtype, device=device))
        for array in (self.depth, self.distance, self.true_depth, self.true_distance):
            array.fill_(wp.nan)
        self.step = wp.zeros(1, dtype=wp.int64, device=device)
        self._lines = config.lines_of_sight() if rays is None else self._checked_rays(rays)
        self._scans = rays is not None
        self._view = wp.array(self._lines, dtype=wp.vec3, device=device)
        self._values, worlds = world_values(by_world or {}, config, device)
        self._by_world = worlds > 0
        if worlds and self._most_worlds > worlds:
            raise ArgumentError(f"by_world has arrays of {worlds} worlds; the cameras are in {self._most_worlds}")
        if config.pulse_energy == 0.0 and self._values.pulse_energy is not None:
            raise ArgumentError("by_world['pulse_energy'] needs config.pulse_energy > 0, to which it is relative")
        self._tabulate()

    def _checked_rays(self, rays: Any) -> np.ndarray:
        shape = (self.config.height, self.config.width, 3)
        lines = check.numbers("rays", rays, shape)
        length = check.numbers("length of rays", np.linalg.norm(lines, axis=-1, keepdims=True), None, "(0, inf)")
        return (lines / length).reshape(-1, 3)

    def _set_worlds(self, world: wp.array | Sequence[int] | None) -> None:
        self._most_worlds = 0
        if isinstance(world, wp.array):
            self._world = check.array("world", world, wp.int32, (self.cameras,), self.device)
            return
        items = range(self.cameras) if world is None else world
        worlds = check.numbers("world", items, (self.cameras,), "[0, 2147483646]", whole=True).astype(np.int32)
        self._world, self._most_worlds = wp.array(worlds, dtype=int, device=self.device), int(worlds.max()) + 1

    def _set_mount(self, body: Any, offset: Any) -> None:
        self._bodies = 0
        if body is None:
            if offset is not None:
                raise ArgumentError("offset is a pose on a body; body is needed with it")
            return
        rows = np.full(self.cameras, body) if np.ndim(body) == 0 else body
        rows = check.numbers("body", rows, (self.cameras,), "[0, 2147483647]", whole=True).astype(np.int32)
        self._body, self._bodies = wp.array(rows, dtype=int, device=self.device), int(rows.max()) + 1
        offset = (0, 0, 0, 0, 0, 0, 1) if offset is None else offset
        poses = np.tile(offset, (self.cameras, 1)) if np.ndim(offset) == 1 else offset
        poses = check.numbers("offset", poses, (self.cameras, 7))
        self._offset = wp.array(poses, dtype=wp.transform, device=self.device)
        check_poses("offset", self._offset)
        self._camera_q = wp.zeros(self.cameras, dtype=wp.transform, device=self.device)

    @property
    def camera_matrix(self) -> np.ndarray:
        """Of OpenCV and ROS: (f_x, 0, c_x), (0, f_y, c_y), (0, 0, 1) [pixels], the first pixel's centre at (0, 0)."""
        if self._scans:
            raise ArgumentError("rays have no camera matrix")
        return self.config.intrinsics

    @property
    def output(self) -> dict[str, wp.array]:
        """The images by their names in Isaac Lab's cameras; planar depth and that along the ray are told apart."""
        return {
            "distance_to_image_plane": self.depth,
            "distance_to_camera": self.distance,
            "normals": self.normal,
            "counts": self.counts,
            "status": self.status,
        }

    def _matrix(self, rows: int, dtype: Any = float) -> wp.array:
        """[rows, bins], of which a GPU has rows side by side, so that its threads read together."""
        bins = self.config.bins
        if self.device.is_cuda:
            return wp.empty((bins, rows), dtype=dtype, device=self.device).transpose()
        return wp.empty((rows, bins), dtype=dtype, device=self.device)

    def _columns(self, values: np.ndarray) -> wp.array:
        """As `_matrix`, of values."""
        if self.device.is_cuda:
            return wp.array(np.ascontiguousarray(values.T), dtype=float, device=self.device).transpose()
        return wp.array(np.ascontiguousarray(values), dtype=float, device=self.device)

    def _tabulate(self) -> None:
        """Light and responses that no shape changes, after all arguments are checked."""
        config, device, bins = self.config, self.device, self.config.bins
        lines = np.array([[0.0, 0.0, 1.0]]) if self._scans else self._lines
        columns = bins * (1 if self._values.gate_delay is None else 2)
        table = np.zeros((1, columns), np.float32) if self.traced else scattering_table(config, lines, columns, device)
        sensor = self._sensor = Sensor()
        for name in Images.vars:
            setattr(sensor.images, name, getattr(self, name).flatten())
        sensor.lidar, sensor.values, sensor.table = config.lidar(), self._values, self._columns(table)
        sensor.world, sensor.due, sensor.step, sensor.view = self._world, self._due, self.step, self._view
        sensor.scans, sensor.bins, sensor.pulses, sensor.seed = self._scans, bins, config.pulses, config.seed
        sensor.gate_start, sensor.bin_path = config.gate_paths[0], config.bin_path
        sensor.sigma_path = config.timing_sigma * config.speed
        sensor.dark = config.dark_rate * config.bin_path / config.speed
        sensor.pulse_energy = config.pulse_energy
        known = self._columns(config.pulses * (config.scattering * table[:, :bins] + sensor.dark))
        response, lowest_tap = config.response()
        taps = {"response": response, "lowest_tap": lowest_tap, "half_width": -lowest_tap - 1}
        taps |= {"min_significance": config.min_significance, "width": 2.355 * config._sigma_bins}
        self._estimate = ArrivalEstimator(bins, device, config.method, known, **taps, pulses=config.pulses)
        read = self._estimate.background_bins
        sensor.read = wp.vec2i(*(read or (0, 0)))
        rates, counts = (
            each.reshape((self._rows, bins)) if each.size else None for each in (self.rates, self.histogram)
        )
        water = None
        if self.traced:
            shape = (self._rows, bins)
            rates = wp.empty(shape, dtype=float, device=device) if rates is None else rates
            water = wp.empty(shape, dtype=float, device=device)
        self._light, self._water = rates, water
        rows = max(_ROWS // len(self._lines), 1) * len(self._lines)
        most = min(rows, self._rows)
        scratch = self._matrix(most, int) if counts is None else None
        known = self._matrix(most) if read and (self._by_world or self.traced) else None
        window, arrival = wp.empty(most, dtype=int, device=device), wp.empty(most, dtype=float, device=device)
        self._launches = []
        for start in range(0, self._rows, rows):
            stop = min(start + rows, self._rows)
            own = [None if each is None else each[start:stop] for each in (water, rates, counts)]
            shared = [None if each is None else each[: stop - start] for each in (scratch, known, window, arrival)]
            self._launches.append((start, stop, [*own[:2], own[2] or shared[0], *shared[1:]]))

    def _pose(self, shapes: Shapes, camera_q: wp.array | None, body_q: wp.array | None) -> wp.array:
        """Poses of the cameras, which are checked at the first step."""
        if self._most_worlds > shapes.worlds:
            raise ArgumentError(f"world = {self._most_worlds - 1} is none of the {shapes.worlds} worlds of the shapes")
        if not (self._poses_checked or self.device.is_capturing):  # once: later steps wait for nothing
            if camera_q is not None:
                check.array("camera_q", camera_q, wp.transform, (self.cameras,), self.device)
                check_poses("camera_q", camera_q)
            if body_q is not None:
                check.array("body_q", body_q, wp.transform, (None,), self.device)
                check_poses("body_q", body_q, max(shapes.bodies, self._bodies))
            self._poses_checked = True
        if not self._bodies:
            return check.array("camera_q", camera_q, wp.transform, (self.cameras,), self.device)
        if camera_q is not None:
            raise ArgumentError("camera_q: cameras on a body have the pose of the body and offset")
        check.array("body_q", body_q, wp.transform, (None,), self.device)
        if body_q.size < self._bodies:
            raise ArgumentError(f"body_q has {body_q.size} poses; a camera is on body {self._bodies - 1}")
        inputs = [self._body, self._offset, body_q]
        wp.launch(_mount_kernel, self.cameras, inputs, [self._camera_q], device=self.device)
        return self._camera_q

    def _optical(self, frame: str | None) -> wp.transform:
        """The pose of the optical frame in that of the poses: the camera's, which agrees with the shapes'."""
        if frame and self.frame and frame != self.frame:
            raise ArgumentError(f"frame = {self.frame!r}; the poses of cameras of these shapes are {frame!r}")
        if not (frame or self.frame):
            raise ArgumentError(f"frame is not given: say which of {', '.join(CAMERA_FRAMES)} the poses are")
        return optical_to(frame or self.frame)

    def _schedule(self, active: wp.array | None, dt: float) -> None:
        """Which cameras are due."""
        if active is not None:
            check.array("active", active, wp.bool, (None,), self.device)
            self._masked = True
        elif self._period == 0.0 and not self._masked:
            return
        inputs = [self._world, active, check.number("dt", dt, "[0, inf)"), self._period * (1.0 - 1e-5)]
        wp.launch(_schedule_kernel, self.cameras, inputs, [self._age, self._due], device=self.device)

    def _cast_rays(self, shapes: Shapes, camera_q: wp.array | None, body_q: wp.array | None) -> wp.array:
        """Moves the shapes, casts a ray a pixel, and returns the poses of the cameras."""
        check.kind("shapes", shapes, Shapes)
        optical, poses = self._optical(shapes.frame), self._pose(shapes, camera_q, body_q)
        move_shapes(shapes, body_q)
        inputs = [shapes.table, poses, optical, self._sensor]
        wp.launch(_trace_kernel, self._rows, inputs, device=self.device)
        return poses

    def _detect(self) -> None:
        """Counts and depth of all cameras, and the next step; nothing is allocated or read."""
        estimate, sensor, kernel = self._estimate, self._sensor, _frame_kernel(self.traced)
        for start, stop, (water, rates, histogram, known, window, arrival) in self._launches:
            count, significance = stop - start, sensor.images.significance[start:stop]
            inputs = [start, sensor, estimate.test.windows, water, rates, histogram, known, window]
            launch_pixels(kernel, count, inputs, device=self.device, block_dim=_FRAME_BLOCK)
            if "depth" in self.outputs:
                estimate.locate(histogram, arrival, significance, window, known)
            inputs = [start, sensor, arrival if "depth" in self.outputs else None]
            launch_pixels(_depth_kernel, count, inputs, device=self.device)

    def point_cloud(self, out: wp.array, *, frame: str = "optical") -> None:
        """Points of the noisy depth, vec3 `[cameras, height, width]` [m], in a frame of CAMERA_FRAMES; NaN for none.

        A row of 12 bytes a point: the data of a `PointCloud2` with the fields x, y and z of FLOAT32."""
        check.array("out", out, wp.vec3, self.depth.shape, self.device)
        wp.launch(_points_kernel, self.depth.shape, [self._sensor, optical_to(frame)], [out], device=self.device)


# ---- The fast camera.


@wp.kernel(enable_backward=False, module="unique", module_options={"max_unroll": 1})
def _images_kernel(
    sensor: Sensor,
    # [cameras, height, width]; those that are None have no entries:
    depth: wp.array3d[float],
    along_ray: bool,
    normal: wp.array3d[wp.vec3],
    camera_q: wp.array[wp.transform],
    optical: wp.transform,
    reflectance: wp.array3d[float],
    one_reflectance: float,
):
    """Launch: (cameras, height, width)."""
    v, i, j = wp.tid()
    view = sensor.view
    images = sensor.images
    u = view[i * depth.shape[2] + j]
    row = v * view.shape[0] + i * depth.shape[2] + j
    s = depth[v, i, j]
    if not along_ray:
        s = s / u[2]
    s = wp.where(wp.isfinite(s) and s > 0.0, s, wp.NAN)
    images.true_distance[row] = s
    images.true_depth[row] = s * u[2]
    images.reflectance[row] = one_reflectance
    if reflectance.shape[0] > 0:
        images.reflectance[row] = reflectance[v, i, j]
    n = wp.vec3(0.0)
    if normal.shape[0] > 0:
        n = normal[v, i, j]
        if camera_q.shape[0] > 0:
            n = wp.quat_rotate_inv(wp.transform_get_rotation(camera_q[v]), n)
        n = wp.quat_rotate_inv(wp.transform_get_rotation(optical), n)
    else:
        n = wp.cross(_edge(view, depth, along_ray, v, i, j, 0, 1), _edge(view, depth, along_ray, v, i, j, 1, 0))
        n = wp.where(wp.length_sq(n) > 0.0, n, u)
    n = wp.normalize(n)
    images.normal[row] = wp.where(wp.dot(n, u) > 0.0, -n, n)


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


class SpadCamera(WorldCameras):
    """Single-photon cameras in many worlds: histograms, counts and noisy depth of all in a few launches.

    A pixel sees one surface, the water between by single scattering, and dark counts. The first
    step checks the poses. Every other one allocates nothing, reads nothing back and has its random numbers from a
    counter on the device: it can be captured in a CUDA graph.

    Args:
        config: Laser, detector and water.
        cameras: Their number.
        world: World of each camera, as in Newton; by default camera k is in world k. Kept if it is an array on the
            device, which may change.
        frame: Of the cameras' poses, one of CAMERA_FRAMES: "optical" (+z forward, y down), "opengl" (-z forward, y up),
            "forward_left_up". Shapes of Newton and MuJoCo carry theirs, "opengl"; with others it must be given.
        outputs: Which of CAMERA_OUTPUTS are made. Without "rates" and "histogram" no bins are stored.
        by_world: What differs from world to world, `[worlds]`, by name: "absorption", "scattering" [1/m],
            "pulse_energy" [J], "dark_rate" [1/s], "pulses", and "gate_delay", by which the gate opens and closes later
            [one-way m], at most its length. Warp arrays are kept, and may change in place. The blur of the response is
            that in the config's water.
        rays: Directions in the optical frame `[height, width, 3]` in place of an image: each is that of a scanner,
            whose laser and pixel (`config.pixel_fov`) turn with it.
        body, offset: Index of the body in `body_q` that carries each camera, and the camera's pose on it (x, y, z, qx,
            qy, qz, qw), `[cameras, 7]` or one for all.
        update_period: Time between two frames of a camera [s], of which `update` is told by `dt`; 0: every step.
        device: Of the arrays.

    Attributes:
        rates: Expected detections per pulse, float32 `[cameras, height, width, bins]`.
        histogram: Counts of the frame, int32 `[cameras, height, width, bins]`.
        counts: Sum of the histogram, int32 `[cameras, height, width]`.
        depth: Planar depth (z of the optical frame) from the histogram [m], float32 `[cameras, height, width]`; NaN
            where nothing was detected.
        distance: As `depth`, along the ray of the pixel.
        status: Index into CAMERA_STATUS, int32 `[cameras, height, width]`: a depth; none; saturated: 95 % of the pulses
            have counted; none, and the surface that is there lies outside the gate.
        significance: Of the detection, float32 `[cameras, height, width]`, see `SpadConfig.min_significance`.
        true_depth, true_distance, normal, reflectance: What is there, `[cameras, height, width]`: depths [m], unit
            normals to the camera in the optical frame, reflectance; NaN for none.
        step: Number of the next step, int64 `[1]`. A step's random numbers depend on `config.seed` and it alone.

    Raises:
        ArgumentError: A number out of range, or arrays that do not fit.
    """

    def update(
        self,
        shapes: Shapes,
        camera_q: wp.array | None = None,
        body_q: wp.array | None = None,
        *,
        active: wp.array | None = None,
        dt: float = 0.0,
    ) -> None:
        """A step: moves the shapes, casts a ray a pixel, and draws a frame.

        Args:
            shapes: From `make_shapes`, `newton_shapes` or `mujoco_shapes`.
            camera_q: Poses of the cameras in their worlds, `wp.transform` `[cameras]`; None of those on a body.
            body_q: Poses of the bodies, `wp.transform` `[bodies]`, as Newton's `state.body_q`.
            active: Worlds that are seen, bool `[worlds]`; the images of the others stay as they are. Default: all.
            dt: Time since the last step [s], for `update_period`.
        """
        self._schedule(active, dt)
        self._cast_rays(shapes, camera_q, body_q)
        self._detect()

    def update_from_images(
        self,
        depth: wp.array,
        normal: wp.array | None = None,
        reflectance: wp.array | float = 0.2,
        *,
        along_ray: bool = False,
        camera_q: wp.array | None = None,
        active: wp.array | None = None,
        dt: float = 0.0,
    ) -> None:
        """A step from what the simulator's own camera has rendered, `[cameras, height, width]`.

        Args:
            depth: float32 [m], planar; 0, negative, NaN or infinite where nothing is.
            normal: vec3, either side, in the camera's frame or, with `camera_q`, in the world's; None takes them from
                the slope of the depth.
            reflectance: float32 in [0, 1], or a number.
            along_ray: Depth is the distance from the lens, as Newton's `depth_image` is.
            camera_q, active, dt: As in `update`.
        """
        self._schedule(active, dt)
        shape = self.true_depth.shape
        check.array("depth", depth, wp.float32, shape, self.device)
        number = 0.0
        if isinstance(reflectance, wp.array):
            check.array("reflectance", reflectance, wp.float32, shape, self.device)
        else:
            number, reflectance = check.number("reflectance", reflectance, "[0, 1]"), None
        if normal is not None:
            check.array("normal", normal, wp.vec3, shape, self.device)
        if camera_q is not None:
            check.array("camera_q", camera_q, wp.transform, (self.cameras,), self.device)
        optical = wp.transform_identity() if normal is None else self._optical("optical" if not self.frame else None)
        inputs = [self._sensor, depth, bool(along_ray), normal, camera_q, optical, reflectance, number]
        wp.launch(_images_kernel, shape, inputs, device=self.device)
        self._detect()
