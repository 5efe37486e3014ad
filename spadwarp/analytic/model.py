"""The analytic model per pixel: signal, backscatter, information on the delay, Cramér–Rao bound.

From the truth of the scene: signal detections per pulse (eq 3–7), arrival time, detections per pulse α (eq 8), Fisher
information (eq 9) and Cramér–Rao bound. Equation numbers are those of *A Simulation Method for Underwater SPAD Depth
Imaging Datasets*, Sensors 24, 3886 (2024).

Over the surface of a sea the beam and what a pixel sees are spread by slopes, on the way down and on the way up, as
normal distributions; slopes of resolved waves count with the others, and no light is masked.

What the model leaves out: multiple scattering, shadows of a laser beside the lens, range aliasing, pile-up (the
information is that of α ≪ 1 per acquisition) and instrument responses that are not Gaussian.
"""

from __future__ import annotations

import math
import warnings
from typing import Any, NamedTuple

import numpy as np
import warp as wp
from numpy.typing import ArrayLike, NDArray

import spadwarp_kernels as sk
from spadwarp.arrays import Floats
from spadwarp.device import pick_device
from spadwarp.frames.response import FWHM_PER_SIGMA
from spadwarp.scene import Scene, daylight_rate, phase_function, water_lines
from spadwarp.scene.camera import to_world
from spadwarp.scene.medium import grid_cells
from spadwarp.scene.scene import camera_port, laser_port
from spadwarp.scene.sight import LinesOfSight, depth_per_time, lines_of_sight
from spadwarp.transport.model import port_kind, port_parameters
from spadwarp.values import ArgumentError, ConfigError, SpadwarpWarning

__all__ = ["model_notes", "pixel_maps"]


class BackscatterTable(NamedTuple):
    """When backscatter arrives: edges in path [m] and cumulative distribution, float32 `[1 or P, n]`."""

    paths: NDArray[np.float32]
    cumulative: NDArray[np.float32]


def model_notes(scene: Scene) -> list[str]:
    """What the model leaves out of a scene without refusing it; nothing for most scenes."""
    if not scene.polarised:
        return []
    behind = "" if scene.camera.polarisation == "none" else ", without the camera's analyser"
    return [
        f"the analytic model has no polarisation: its numbers are those of unpolarised light{behind}; `simulate` and "
        "`plan` compute polarised light"
    ]


def warn_of_model(scene: Scene, stacklevel: int = 3) -> None:
    """Warns of what `model_notes` has."""
    for text in model_notes(scene):
        warnings.warn(text, SpadwarpWarning, stacklevel=stacklevel)


def pixel_maps(
    scene: Scene,
    *,
    view: ArrayLike,
    distance: ArrayLike,
    normal: ArrayLike,
    reflectance: ArrayLike,
    device: Any = None,
    backscatter_profile: NDArray[np.float32] | None = None,
    gate: tuple[float, float] | None = None,
    outliers: bool = True,
) -> tuple[dict[str, Floats], BackscatterTable]:
    """The model's maps for any lines of sight, by name as in `AnalyticResult`, and the table of backscatter over path.

    Args:
        scene: The scene.
        view: Unit vectors `[P, 3]` in which the lens sees the pixels.
        distance: From the lens along the line of sight, which a port bends, `[P]` [m]; NaN where nothing is hit.
        normal: Unit vectors towards the camera `[P, 3]`.
        reflectance: `[P]`.
        device: Warp device.
        backscatter_profile: float32 `[1 or P, T]`, detections per pulse and bin.
        gate: (start, stop) [s] instead of the scene's.
        outliers: Whether `outlier_probability` is wanted, which takes most of the time; else it is NaN.

    Returns float64 maps `[P]`, `daylight` [1/s] among them, and the table. Raises `ConfigError`: a scene that the model
    does not cover; `ArgumentError`: the scene's backscatter needs a profile.
    """
    start, stop = gate or (scene.gate.start, scene.gate.stop)
    views = np.ascontiguousarray(view, np.float64)
    distances = np.nan_to_num(np.asarray(distance, np.float64), nan=0.0)
    model, chosen = _Model(scene, views, distances, pick_device(device), start, stop), scene.analytic
    signal, arrival = model.signal(normal, reflectance)
    if scene.medium.grid is not None:
        signal = signal * passed_by_grid(scene, views, distances)
    total, table, profile = model.backscatter(backscatter_profile)
    backscatter = model.on_device(np.broadcast_to(total, distances.shape))
    ambient = daylight_rate(
        scene, view=views, distance=distances, normal=np.asarray(normal), reflectance=np.asarray(reflectance)
    )
    statistics = sk.statistics_maps(
        model.lidar,
        model.phase,
        model.on_device(profile, np.float32),
        model.sights[0],
        model.on_device(signal),
        model.on_device(arrival, nan=np.nan),
        backscatter,
        count_law=chosen.count_law,
        acquisitions=scene.pulses_per_depth_frame if chosen.count_law == "per_pulse" else chosen.frames,
        pulses_per_frame=chosen.exposure * scene.laser.repetition_rate,
        outliers=outliers,
        lines=model.line_rows([water.scattering for _, water in model.lines]),
        ambient=None if scene.daylight is None else model.on_device(ambient),
        optics=model.optics,
    )
    names = ("alpha", "fisher", "sigma_time", "background_level", "outlier_probability")
    maps = {"signal": signal, "arrival": arrival, "backscatter": backscatter.numpy(), "daylight": ambient}
    maps |= {name: values.numpy() for name, values in zip(names, statistics, strict=True)}
    largest = maps["alpha"].max(initial=0.0)
    if chosen.count_law == "per_frame_lu2024" and largest > 1.0:
        raise ConfigError(
            f"analytic.count_law = 'per_frame_lu2024' needs alpha < 1; it reaches {largest:.4g} detections per pulse "
            "here, use 'per_frame'",
            source=scene.source,
        )
    with np.errstate(divide="ignore", invalid="ignore"):
        ratio = maps["signal"] / maps["backscatter"]
    maps["signal_to_backscatter"] = np.where(maps["fisher"] > 0, ratio, np.nan)
    maps["sigma_depth"] = maps["sigma_time"] * depth_per_time(scene, distances, views)
    return maps, table


def response_sigma(scene: Scene) -> float:
    """Standard deviation of the Gaussian response, pulse ⊗ jitter [s]; raises `ConfigError` for other responses."""
    if scene.detector.irf != "gaussian":
        raise ConfigError(
            f"detector.irf = {scene.detector.irf!r}: the analytic model needs 'gaussian'", source=scene.source
        )
    fwhm = math.hypot(scene.laser.pulse_fwhm_ps, scene.detector.jitter_fwhm_ps) * 1e-12
    if not fwhm > 0:
        raise ConfigError(
            "laser.pulse_fwhm_ps and detector.jitter_fwhm_ps are both 0: the analytic model needs some width",
            source=scene.source,
        )
    return fwhm / FWHM_PER_SIGMA


def scene_optics(scene: Scene) -> tuple[Any, Any]:
    """Optics of the kernels, and the parameters of the ports of a scene.

    Raises `ConfigError` for a lens or a laser that reaches through its port.
    """
    camera, laser = camera_port(scene), laser_port(scene)
    ports: Any = sk.Ports()
    if camera is not None:
        radius = 0.0 if scene.camera.pinhole else scene.camera.aperture_radius
        ports.camera = port_parameters(scene, camera, (0.0, 0.0, 0.0), radius, 0.0)
    if laser is not None:
        ports.laser = port_parameters(scene, laser, scene.beam.position, 0.0, 0.0)
    slope = 0.0 if scene.surface is None else math.sqrt(0.5 * sum(scene.surface.slope_variances))
    ports.slope = slope
    return sk.make_optics(port_kind(camera), port_kind(laser), rough=slope > 0.0), ports


def false_peaks(signal: ArrayLike, level: ArrayLike, lengths: ArrayLike, device: Any = None) -> Floats:
    """Probability that a maximum-likelihood fit takes background for the return: from recorded photons of the return,
    and of background per standard deviation of the response, and the gate's length in these."""
    target, columns = pick_device(device), (signal, level, lengths)
    arrays: list[Any] = [wp.array(np.nan_to_num(column), dtype=wp.float64, device=target) for column in columns]
    return sk.outlier_probabilities(*arrays).numpy()


class _Model:
    """A scene and lines of sight as the kernels take them. Raises `ConfigError` for what the model does not cover."""

    def __init__(self, scene: Scene, views: Floats, distances: Floats, device: Any, start: float, stop: float) -> None:
        if problems := [text for text, is_met in _not_covered(scene).items() if is_met]:
            raise ConfigError(problems, source=scene.source)
        self.scene, self.device, self.lines = scene, device, water_lines(scene)
        self.lidar, self.optics = _lidar(scene, start, stop)
        # At 0, where the density may be infinite, that of 2e-5 rad.
        angles = np.maximum(np.linspace(0.0, np.pi, 4097), 2e-5)
        self.phase = self.on_device(phase_function(scene.medium).density(angles))
        in_water = distances
        if camera_port(scene) is not None:
            beyond = np.nan_to_num(distances - lines_of_sight(scene, views).lead, nan=0.0)
            if scene.surface is not None and ((distances > 0.0) & (beyond < 0.0)).any():
                raise ConfigError("analytic: a target is seen before the [surface], in the air", source=scene.source)
            in_water = np.maximum(beyond, 0.0)
        self.sights = [self.on_device(views), self.on_device(in_water)]

    def on_device(self, values: ArrayLike, kind: Any = np.float64, *, nan: float = 0.0) -> Any:
        """An array of numbers `[P]` or vectors `[P, 3]` in the device's memory."""
        rows = np.nan_to_num(np.ascontiguousarray(values, kind), nan=nan)
        dtype: Any = wp.float32 if kind is np.float32 else wp.vec3d if rows.shape[1:] == (3,) else wp.float64
        return wp.array(rows, dtype=dtype, device=self.device)

    def line_rows(self, scattering: list[float]) -> Any:
        """Photons per pulse, extinction and scattering of each line of the spectrum."""
        lines = zip(self.lines, scattering, strict=True)
        return self.on_device([(self.lidar.photons * share, water.extinction, b) for (share, water), b in lines])

    def signal(self, normal: ArrayLike, reflectance: ArrayLike) -> tuple[Floats, Floats]:
        """S, summed over the lines, and the mean arrival time of their photons, `[P]`."""
        lidar, surfaces = self.lidar, [*self.sights, self.on_device(normal), self.on_device(reflectance)]
        whole = (lidar.photons, lidar.extinction, lidar.speed)
        parts: list[tuple[Floats, Floats]] = []
        for share, water in self.lines:
            lidar.photons, lidar.extinction, lidar.speed = whole[0] * share, water.extinction, water.pulse_speed
            signal, arrival = sk.signal_map(lidar, *surfaces, optics=self.optics)
            parts.append((signal.numpy(), arrival.numpy()))
        lidar.photons, lidar.extinction, lidar.speed = whole
        if len(parts) == 1:
            return parts[0]
        total = np.sum([signal for signal, _ in parts], axis=0)
        even = np.full_like(total, 1.0 / len(parts))
        shares = [np.divide(signal, total, out=even.copy(), where=total > 0) for signal, _ in parts]
        return total, np.sum([share * time for share, (_, time) in zip(shares, parts, strict=True)], axis=0)

    def backscatter(self, profile: NDArray[np.float32] | None) -> tuple[Floats, BackscatterTable, NDArray[np.float32]]:
        """Detections per pulse in the gate, their table, and their profile if the model takes one."""
        lidar, chosen, speed = self.lidar, self.scene.analytic, self.scene.medium.pulse_speed
        gate, empty = (lidar.start, lidar.stop), np.zeros((1, 1), np.float32)
        if chosen.backscatter == "constant":
            ends = np.array([[gate[0] * speed, gate[1] * speed]], np.float32)
            total = np.array([chosen.backscatter_rate * (gate[1] - gate[0])])
            return total, BackscatterTable(ends, np.array([[0.0, 1.0]], np.float32)), empty
        if chosen.backscatter == "single_scatter":
            # Through cells, the table of water that scatters 1/m, times what the cells do.
            by_cells = self.scene.medium.grid is not None
            rows = self.line_rows([1.0 if by_cells else water.scattering for _, water in self.lines])
            table = sk.single_scatter_table(lidar, self.phase, *self.sights, lines=rows, optics=self.optics)
            paths, cumulative, total = (part.numpy() for part in table)
            found = BackscatterTable(paths, cumulative)
            if not by_cells:
                return total, found, empty
            profile = grid_backscatter(self.scene, self.sights[0].numpy(), found, total, gate)
            lidar.source = sk.BACKSCATTER_SOURCES.index("monte_carlo")
        elif profile is None:
            raise ArgumentError("backscatter_profile is missing; analytic.backscatter = 'monte_carlo' needs it")
        sums = np.concatenate([np.zeros((len(profile), 1)), np.cumsum(profile, axis=1, dtype=np.float64)], axis=1)
        paths = (np.linspace(*gate, profile.shape[1] + 1) * speed).astype(np.float32)[None]
        total = sums[:, -1:]
        cumulative = (sums / np.maximum(total, 1e-300)).astype(np.float32)
        return total[:, 0], BackscatterTable(paths, cumulative), profile


def _not_covered(scene: Scene) -> dict[str, bool]:
    """Sentences on what the model cannot do, and whether the scene asks for it."""
    laser, chosen, medium = scene.beam, scene.analytic, scene.medium
    ported = camera_port(scene) is not None or laser_port(scene) is not None
    port, parallel, lu2024 = laser_port(scene), laser.profile == "collimated", chosen.form == "lu2024"
    return {
        "analytic: over [surface] the model needs camera and laser in the air, and a diverging laser.profile": (
            scene.surface is not None and (parallel or camera_port(scene) is None or port is None)
        ),
        "analytic: laser.profile = 'measured' has no closed form; simulate takes any": laser.profile == "measured",
        f"analytic: scan.mode = {scene.scan.mode!r} is not one beam for all pixels; simulate takes it": (
            scene.scan.mode != "none"
        ),
        f"analytic.form = 'lu2024' needs a uniform_cone laser of half_angle_deg < 90, not {laser.profile!r} "
        f"of {laser.half_angle_deg}": lu2024 and (laser.profile != "uniform_cone" or laser.half_angle_deg >= 90),
        "analytic.form = 'lu2024' knows no port and no surface; 'radiometric' does": lu2024 and ported,
        "analytic: laser.profile = 'collimated' does not stay parallel behind a dome, and has no closed form; "
        "simulate takes it": parallel and port is not None and port.shape == "dome",
        f"medium.layers: {len(medium.layers)} given; the analytic simulator takes one water": bool(medium.layers),
        "medium.grid.constituent: the analytic simulator takes cells of the medium's phase function": (
            medium.grid is not None and medium.grid.constituent is not None
        ),
        "analytic.form = 'lu2024' takes one water, and not medium.grid; 'radiometric' takes both": (
            lu2024 and medium.grid is not None
        ),
        "analytic.backscatter = 'single_scatter' needs a diverging laser.profile, not 'collimated'; 'monte_carlo' "
        "takes any": parallel and chosen.backscatter == "single_scatter",
    }


def _lidar(scene: Scene, start: float, stop: float) -> tuple[Any, Any]:
    """The scene and its optics as the kernels take it."""
    laser, camera, chosen = scene.beam, scene.camera, scene.analytic
    lidar: Any = sk.Lidar()
    lidar.lu2024 = int(chosen.form == "lu2024")
    lidar.photons = laser.photons_per_pulse
    lidar.pde = scene.detector.pde
    lidar.extinction = scene.medium.extinction
    lidar.scattering = scene.medium.scattering
    lidar.speed = scene.medium.pulse_speed
    lidar.laser = wp.vec3d(*laser.position)
    lidar.axis = wp.vec3d(*laser.axis)
    lidar.profile = sk.LASER_PROFILES.index(laser.profile)
    lidar.spread = 2.0 * math.sin(0.5 * laser.half_angle) ** 2
    lidar.tan2 = math.tan(min(laser.half_angle, math.radians(89.9))) ** 2
    lidar.radius = laser.beam_radius
    lidar.pixel_tangent = camera.pixel_tangent
    lidar.aperture_area = camera.aperture_area
    lidar.start = start
    lidar.stop = stop
    lidar.sigma = response_sigma(scene)
    lidar.dark = scene.detector.noise_rate
    lidar.source = sk.BACKSCATTER_SOURCES.index(chosen.backscatter)
    lidar.constant = chosen.backscatter_rate
    # Nearer than its own diameter the aperture's solid angle is not area over distance squared.
    lidar.nearest = 2.0 * camera.aperture_radius
    lidar.bin_width = scene.gate.bin_width
    optics, lidar.ports = scene_optics(scene)
    return lidar, optics


# Water cell by cell: what lines of sight and the beam lose in it, and what it scatters back

# Pieces of a line of sight, and lines of sight at a time.
_PIECES, _LINES = 400, 256


def passed_by_grid(scene: Scene, views: Floats, distances: Floats) -> Floats:
    """Part of the light that passes the cells on its way from the laser to points and on to the lens, over what passes
    the medium without cells; exact for the cells. Views `[P, 3]` and distances `[P]` [m] as in `pixel_maps`."""
    cells, c = grid_cells(scene.medium), scene.medium.extinction
    sights = lines_of_sight(scene, views)
    points = sights.points(distances)
    depth = np.zeros(len(points))
    for begin in (sights.start, _begin_of_light(scene, sights, points)):
        way = np.isfinite(begin + points).all(axis=-1, keepdims=True)
        ends = (np.where(way, end, 0.0) for end in (begin, points))
        first, last = (to_world(scene.camera, end) for end in ends)
        depth += cells.optical_depths(first, last, c) - c * np.linalg.norm(last - first, axis=-1)
    return np.exp(-depth)


def _begin_of_light(scene: Scene, sights: LinesOfSight, points: Floats) -> Floats:
    """Where the laser's light to points `[P, 3]` enters the water, or is emitted in it [m]; NaN without a way."""
    beam, port = scene.beam, laser_port(scene)
    laser, axis = np.array(beam.position), np.array(beam.axis)
    if beam.profile != "collimated":
        light, water, _ = sights.light_at(points)
        return points - water[:, None] * light
    if port is None:
        return points - ((points - laser) @ axis)[:, None] * axis
    # Behind a flat port, see `_not_covered`, a parallel beam stays one.
    direction, normal = port.enter(laser, axis)[1], np.array(port.normal)
    outside = points @ normal - (port.distance + port.thickness)
    return points - (outside / (direction @ normal))[:, None] * direction


def grid_backscatter(
    scene: Scene, views: Floats, table: BackscatterTable, total: Floats, gate: tuple[float, float]
) -> NDArray[np.float32]:
    """Detections per pulse and bin of light scattered once, `[P, T]`.

    From the table of `single_scatter_table` with a scattering coefficient of 1 / m everywhere. The beam's way to a
    point is taken to lose what the line of sight to it loses, by their lengths in the water, as it does for a laser
    beside the camera.
    """
    medium, cells, every = scene.medium, grid_cells(scene.medium), lines_of_sight(scene, views)
    bins = max(1, round((gate[1] - gate[0]) / scene.gate.bin_width))
    edges, result = np.linspace(*gate, bins + 1) * medium.pulse_speed, np.zeros((len(views), bins))
    for some in (slice(first, first + _LINES) for first in range(0, len(views), _LINES)):
        sights = every[some]
        # Length in the water up to where the way by the laser has the longest path.
        reach = np.nan_to_num(sights.range_from_path(table.paths[some, -1].astype(np.float64)) - sights.lead)
        ends = reach[:, None] * np.linspace(0.0, 1.0, _PIECES + 1)
        middle = 0.5 * (ends[:, 1:] + ends[:, :-1])
        # The laser's light at the middles: directions and lengths in the water, NaN where none comes; paths by the
        # ends.
        start, along = sights.start[:, None, :], sights.direction[:, None, :]
        light, water, path = sights.light_at(start + ends[..., None] * along)
        light, water = light[:, 1:] + light[:, :-1], 0.5 * (water[:, 1:] + water[:, :-1])
        light = light / np.maximum(np.linalg.norm(light, axis=-1, keepdims=True), 1e-9)
        lengths = np.nan_to_num(path + ends + sights.delay[:, None])
        points = to_world(scene.camera, start + middle[..., None] * along)
        place, inside = cells.index_of(np.nan_to_num(cells.in_cells(points), nan=-1.0))
        extinction = np.where(inside, cells.extinction[place], medium.extinction)
        scattering = np.where(inside, cells.scattering[place], medium.scattering)
        excess = (extinction - medium.extinction) * np.diff(ends, axis=1)
        excess = np.cumsum(excess, axis=1) - 0.5 * excess
        weight = scattering * np.exp(-excess * (1.0 + water / np.maximum(middle, 1e-9)))
        if cells.anisotropy is not None:
            cosine = -(light * along).sum(axis=-1)
            anisotropy = np.where(inside, cells.anisotropy[place], medium.anisotropy)
            weight *= _henyey_greenstein(cosine, anisotropy) / _henyey_greenstein(cosine, medium.anisotropy)
        weight = np.nan_to_num(weight)  # where no light comes
        rows = zip(lengths, weight, table.paths[some], table.cumulative[some], strict=True)
        for row, (length, part, paths, cumulative) in enumerate(rows, some.start):
            share = np.diff(np.interp(length, paths, cumulative))
            result[row] = np.histogram(0.5 * (length[1:] + length[:-1]), edges, weights=share * part)[0]
    return (result * total[:, None]).astype(np.float32)


def _henyey_greenstein(cosine: Floats, g: Floats | float) -> Floats:
    """The phase function without its factor 1/4π."""
    return (1.0 - np.square(g)) / (1.0 + np.square(g) - 2.0 * g * cosine) ** 1.5
