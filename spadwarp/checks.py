"""Warnings and notes on a scene that is valid, in numbers, before a photon is traced.

A survey holds a scene's numbers and the findings so far; the checks run in the order of `_CHECKS`.
"""

from __future__ import annotations

import dataclasses
import math
import tomllib
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic import PILE_UP, axis_fluence
from spadwarp.device import pick_devices
from spadwarp.frames import detector_response
from spadwarp.mesh import TriangleMesh, build_mesh, focus_distance, guess_unit
from spadwarp.mesh.targets import target_balls
from spadwarp.scene import Scene, SceneLike, as_scene, daylight_rate, phase_function, shot_at, shots_of
from spadwarp.scene.camera import image_points, to_camera, to_world
from spadwarp.scene.laser import Laser, profile_extent, spectral_lines
from spadwarp.scene.medium import NOTABLE_UNSEEN, WATER_INDICES, Water, grid_cells, natural_laws, scattering_matrix
from spadwarp.scene.port import Port
from spadwarp.scene.scene import camera_port, laser_port, water_lines
from spadwarp.scene.sections import interval_of
from spadwarp.scene.sight import beam_planes, lines_of_sight, points_inside, port_advance, view_planes, within_port
from spadwarp.transport import points_per_flight
from spadwarp.transport.model import first_hits
from spadwarp.transport.spectrum import scenes_of_lines
from spadwarp.values import ConfigError, guarded, path_from_time, quantity, range_from_time, time_from_path, with_prefix
from spadwarp.water import group_index, molecular_density, pure_water_absorption

__all__ = ["CheckMessage", "check", "implausible", "summary"]

Points = NDArray[np.float64]


@dataclass(frozen=True)
class CheckMessage:
    """One finding: `warning` if the run will not show what the scene asks for, `note` if one should know it.

    `field` names the place in the scene, `values` the numbers in `text` (units as in the text).
    """

    level: Literal["warning", "note"]
    field: str
    text: str
    values: dict[str, float] = dataclasses.field(default_factory=dict)

    def __str__(self) -> str:
        return f"{self.level}: {self.field}: {self.text}"


@dataclass(frozen=True)
class OnAxis:
    """Unscattered light on the beam's axis at the range of the nearest illuminated point."""

    optical_depth: float  # to it, one way
    irradiance: float  # mean over time [W/m²]
    samples_per_pixel: float  # traced photons that reach one pixel's part of the target
    photons_per_pixel: float  # from the target, of a pulse
    signal_per_pulse: float  # detected of these


class Survey:
    """A scene's targets as the camera sees them and the beam illuminates them, shadows aside; and the findings."""

    def __init__(self, scene: Scene, mesh: TriangleMesh | None, device: str | None = "cpu") -> None:
        mesh = build_mesh(scene) if mesh is None and scene.targets else mesh
        self.histogram_bytes = 3 * 8 * scene.camera.width * scene.camera.height * scene.gate.bins
        self.mesh = mesh
        self.moving = None if scene.scan.mode != "trajectory" else scene
        if self.moving is not None:  # all else is of one of its shots
            self.balls = target_balls(scene, mesh)
            scene = shot_at(scene, [middle for middle, _ in self.balls])
            mesh = build_mesh(scene) if scene.targets else None
        self.device, self.scene, self.messages, laser = pick_devices(device)[0], scene, list[CheckMessage](), scene.beam
        triangles = np.zeros((0, 3, 3)) if mesh is None else mesh.vertices[mesh.faces].astype(np.float64)
        # Faces by target, in the camera frame `[F, 3, 3]` [m].
        self.targets = [] if mesh is None else [triangles[mesh.target == i] for i in range(len(scene.targets))]
        self.reflectance = 0.0 if mesh is None else float(mesh.reflectance.max(initial=0.0))
        self.focus_distance = focus_distance(scene, mesh)  # [m]; None for a pinhole
        self.camera_port, self.laser_port = camera_port(scene), laser_port(scene)
        port, axis = self.laser_port, (np.array(laser.position), np.array(laser.axis))
        self.beam_axis = axis if port is None else port.enter(*axis)[:2]  # from where it enters the water, and its way
        self.view = view_planes(scene.camera)
        # A scan brings its beam to all that is in view.
        self.beam = beam_planes(laser) if scene.scan_positions == 1 else np.zeros((0, 4))
        # Planes in air, the port that they are bent at, its axis, and where they begin; of view and beam.
        self._sides = (
            (self.view, self.camera_port, (0.0, 0.0, 1.0), np.zeros(3)),
            (self.beam, self.laser_port, laser.axis, np.array(laser.position)),
        )
        # Range that a bin covers [m]; width of the response, if pulse and jitter are Gaussian; one set of tallies.
        self.bin_range = range_from_time(scene.gate.bin_width, scene.medium.group_index)
        self.irf_fwhm_ps = math.hypot(scene.laser.pulse_fwhm_ps, scene.detector.jitter_fwhm_ps)
        # Nearest and farthest point from the lens that is in view and beam [m], first and last unscattered return from
        # them [ns], light of the nearest; None if there are none, or it lies at the lens centre.
        self.target_range = self.target_arrival_ns = self.on_axis = None
        self.distance = self.range_of(scene.gate.stop)  # of the nearest; where there is none, of the gate's end [m]
        if found := within_port(scene, triangles):
            self.warn(*found)
        if len(illuminated := self.illuminated_part(triangles)):
            illuminated = self.visible(illuminated)
            ranges, paths = self._ways(illuminated, self._sides[:1], 2), self.paths(illuminated)
            self.distance, _ = self.target_range = float(ranges.min()), float(ranges.max())
            self.target_arrival_ns = self.arrival_ns(float(paths.min())), self.arrival_ns(float(paths.max()))
            nearest, begin = illuminated[ranges.argmin()], np.zeros(3)
            if scene.surface is not None and self.camera_port is not None:  # from the air: of the way in the water
                begin = self.camera_port.enter(begin, self.camera_port.connect(nearest, begin)[0])[0]
            if self.distance > 1e-5:
                self.on_axis = self._on_axis(self.distance, scene.optical_depth(begin, nearest))

    def warn(self, field: str, text: str, **values: float) -> None:
        """Adds a warning."""
        self.messages.append(CheckMessage("warning", field, text, values))

    def note(self, field: str, text: str, **values: float) -> None:
        """Adds a note."""
        self.messages.append(CheckMessage("note", field, text, values))

    def illuminated_part(self, triangles: Points, sides: int = 2) -> Points:
        """Points of triangles in the view and the beam, or in the first of these `sides`, `[N, 3]`; behind ports, of
        those that planes in air hold."""
        has_port = self.camera_port is not None or self.laser_port is not None
        whole = [np.array([[0.0, 0.0, 1.0, 0.0]])] if has_port else []
        for planes, port, axis, _ in self._sides[:sides]:
            # Bent towards its normal, light stays within the planes in air, but about a tilted port.
            if port is None or port.shape == "dome" or np.dot(port.normal, axis) > 0.999:
                whole.append(planes)
        points = points_inside(triangles, np.concatenate(whole))
        if has_port and len(triangles):
            start, direction = self._rays()
            hits = start + first_hits(triangles, start, direction, self.device)[:, None] * direction
            points = np.concatenate([points, hits[np.isfinite(hits).all(axis=1)]])
        for planes, port, _, origin in self._sides[:sides]:
            if port is not None and len(points):
                ahead = origin + port.connect(points, origin)[0]
                points = points[(ahead @ planes[:, :3].T + planes[:, 3] >= 0.0).all(axis=1)]
        return points

    def visible(self, points: Points) -> Points:
        """Those of the points of targets that nothing hides from the lens; all of them where there is none."""
        distance, targets = np.linalg.norm(points, axis=1), np.concatenate(self.targets)
        hit = first_hits(targets, np.zeros(3), points / np.maximum(distance, 1e-30)[:, None], self.device)
        return points[seen] if (seen := hit >= 0.999 * distance).any() else points

    def _rays(self) -> tuple[Points, Points]:
        """Rays in the water over what the camera sees, and the beam's axis: a triangle's corners may lie beside."""
        scene, steps = self.scene, np.linspace(0.001, 0.999, 25)
        left, top, right, bottom = scene.camera.view_box
        x, y = np.meshgrid(left + (right - left) * steps, top + (bottom - top) * steps)
        view = np.stack([x, y, np.ones_like(x)], axis=-1).reshape(-1, 3)
        seen = lines_of_sight(scene, view / np.linalg.norm(view, axis=1, keepdims=True))
        return np.vstack([seen.start, self.beam_axis[0]]), np.vstack([seen.direction, self.beam_axis[1]])

    def paths(self, points: Points) -> Points:
        """Paths [m] from the laser by points `[N, 3]` to the lens, as lengths in water."""
        return self._ways(points, self._sides[::-1], 3)

    def _ways(self, points: Points, sides: tuple, item: int) -> Points:
        """Lengths of the ways of light [m] from points to the origins of sides, an item of what `connect` returns."""
        ways = (
            np.linalg.norm(points - origin, axis=1) if port is None else port.connect(points, origin)[item]
            for _, port, _, origin in sides
        )
        return sum(ways)

    def arrival_ns(self, path: float) -> float:
        """Time of flight [ns] along a path [m]."""
        return 1e9 * time_from_path(path, self.scene.medium.group_index)

    def range_of(self, time: float) -> float:
        """Range [m] of a round trip of `time` [s], laser at the lens."""
        return range_from_time(time, self.scene.medium.group_index) + (port_advance(self.scene) if time > 0.0 else 0.0)

    def _on_axis(self, distance: float, optical_depth: float) -> OnAxis:
        scene, passed, port = self.scene, math.exp(-optical_depth), self.camera_port
        through, footprint = 1.0, (scene.camera.pixel_tangent * distance) ** 2
        if port is not None:
            through = float(port.transmission(np.zeros(3), (0.0, 0.0, 1.0)))
            if port.shape == "flat":  # makes solid angles smaller
                footprint *= (port.index[0] / port.index[2]) ** 2
            else:
                through *= (port.index[0] / port.index[2]) ** 2
        # Of the beam within one pixel's footprint on its axis, without water; of a measured one where it is brightest.
        ballistic = min(1.0, footprint * axis_fluence(scene, distance)) * passed
        # Lambertian, towards the lens
        collected = self.reflectance / math.pi * scene.camera.aperture_area / distance**2
        photons = ballistic * passed * through * collected * scene.laser.photons_per_pulse
        return OnAxis(
            optical_depth=optical_depth,
            irradiance=axis_fluence(scene, distance) * passed * scene.laser.average_power,
            samples_per_pixel=_photons(scene) / scene.scan_positions * ballistic,
            photons_per_pixel=photons,
            signal_per_pulse=photons * scene.detections_per_photon,
        )


def check(scene: SceneLike, mesh: TriangleMesh | None = None, *, device: str | None = "cpu") -> list[CheckMessage]:
    """Everything worth knowing about a scene, warnings first; shadows of the beam are not considered.

    `mesh` is the scene's mesh if the caller has it; else it is built. `device`, for rays, is best that of the run that
    follows. Raises `MeshError`, `DeviceError`; `FileError` or `ConfigError` for the tables of a phase function and a
    scattering matrix and the detector's response; `ConfigError` for points per flight that do not go with the rest.
    """
    survey = Survey(as_scene(scene), mesh, device)
    points_per_flight(survey.scene)
    try:  # read here, since only depth and counts need it: at the end of a run it would be too late
        detector_response(survey.scene.detector, survey.scene.laser)
    except ValueError as error:
        raise ConfigError(f"detector.irf: {error}", source=survey.scene.source) from None
    for find in _CHECKS:
        find(survey)
    if survey.scene.laser.wavelengths_nm:
        _check_lines(survey)
    return sorted(survey.messages, key=lambda message: message.level != "warning")


def _check_lines(survey: Survey) -> None:
    """What lines of `laser.wavelengths_nm` are warned of, and the wavelength of everything else is not."""
    known, lines = {one.field for one in survey.messages if one.level == "warning"}, scenes_of_lines(survey.scene)
    found = dict[str, dict[float, CheckMessage]]()
    for line in lines:
        of_line = Survey(line, survey.mesh, survey.device.alias)
        for find in _CHECKS:
            find(of_line)
        for one in of_line.messages:
            if one.level == "warning" and one.field not in known:
                found.setdefault(one.field, {})[line.laser.wavelength_nm] = one
    for field, by_line in found.items():
        first = next(iter(by_line.values()))
        survey.warn(field, f"at {', '.join(f'{one:g}' for one in by_line)} nm: {first.text}", **first.values)
    if len(lines) > 1 and len({line.medium.extinction for line in lines}) == 1 and survey.scene.medium.preset is None:
        survey.warn("laser.wavelengths_nm", "all lines have the same water; that of medium.chlorophyll follows them")


def summary(scene: SceneLike, mesh: TriangleMesh | None = None) -> dict[str, Any]:
    """Numbers that follow from a scene; lengths in m, None where there is no target in the view and the beam.

    `attenuation_length` and `albedo` are those of the water before the first layer; `layers` has those of each layer,
    with its start; `grid` counts, edges, least and largest extinction and memory of the cells, and the optical depth
    along the axis through their box, None without a grid. `focus_distance` is the depth that the lens images sharply,
    None for a pinhole. `optical_depth` is one-way to the nearest visible point. `signal_per_pulse` is the expected
    number of unscattered target photons that one pixel on the beam's axis detects from a pulse, `photons_per_pixel` how
    many it receives; `samples_per_pixel` how many of the traced photons reach a pixel's part of the target unscattered,
    None where their number is "auto". `irradiance` is that of unscattered light at the nearest visible point's range on
    the beam's axis, mean over time [W/m²]. `histogram_bytes` is one set of tallies. Raises `MeshError`.
    """
    scene = as_scene(scene)
    survey = Survey(scene, mesh)
    camera, gate, laser, medium = scene.camera, scene.gate, scene.laser, scene.medium
    axis = {field.name: getattr(survey.on_axis, field.name, None) for field in dataclasses.fields(OnAxis)}
    if axis["samples_per_pixel"] == math.inf:  # of as many photons as it takes
        axis["samples_per_pixel"] = None
    waters = [{"attenuation_length": 1.0 / w.extinction, "albedo": w.scattering / w.extinction} for w in medium.waters]
    return {
        **waters[0],
        "layers": [{"start": layer.start, **water} for layer, water in zip(medium.layers, waters[1:], strict=True)],
        "grid": _grid_summary(scene),
        "target_range": survey.target_range,
        "target_arrival_ns": survey.target_arrival_ns,
        **axis,
        "gate_range": (survey.range_of(gate.start), survey.range_of(gate.stop)),
        "bin_range": survey.bin_range,
        "path_limit": scene.path_limit,
        "unambiguous_range": survey.range_of(1.0 / laser.repetition_rate),
        "irf_fwhm_ps": survey.irf_fwhm_ps,
        "horizontal_fov_deg": math.degrees(camera.horizontal_fov),
        "vertical_fov_deg": math.degrees(camera.vertical_fov),
        "aperture_area": camera.aperture_area,
        "focus_distance": survey.focus_distance,
        **{name: getattr(laser, name) for name in ("photons_per_pulse", "average_power", "peak_power")},
        "pde": scene.detections_per_photon,
        "histogram_bytes": survey.histogram_bytes,
    }


# Values that are valid but far from what a SPAD camera, its laser, water and targets have: mostly a wrong unit

_PLAUSIBLE = tomllib.loads((files("spadwarp") / "plausible.toml").read_text(encoding="utf-8"))
_FRESH, _SEA = WATER_INDICES["fresh"][1], WATER_INDICES["seawater"][1]
_MOST_POWER = 100.0  # [W]
_FARTHEST = 1000.0  # [m] of a laser, a camera or a target
_MESH_SIDES = (0.01, 100.0)  # longest side of a mesh file's target [m]


def implausible(scene: SceneLike) -> list[CheckMessage]:
    """Warnings that need no ray: values that are not plausible, with the unit that was probably meant, or not used."""
    scene, found = as_scene(scene), list[CheckMessage]()
    laser, detector, medium = scene.laser, scene.detector, scene.medium
    moves = scene.scan.mode == "trajectory"
    aloft = ("horizontal_fov_deg", "half_angle_deg", "start_ns")[: 3 if scene.surface else int(moves)]
    ports = {"camera.port": scene.camera.port, "laser.port": laser.port}
    ports = {name: port for name, port in ports.items() if isinstance(port, Port) and port.thickness > 0.0}
    for section, fields in _PLAUSIBLE.items():
        for place, model in (ports if section == "port" else {section: getattr(scene, section)}).items():
            for name in (field for field in fields if field not in aloft):
                found += _doubts(f"{place}.{name}", model, *fields[name])
    if laser.average_power > _MOST_POWER and not any(item.field.startswith("laser.") for item in found):
        energy, rate = with_prefix(laser.pulse_energy, "J"), with_prefix(laser.repetition_rate, "Hz")
        text = f"{energy} at {rate} are {with_prefix(laser.average_power, 'W')} on average"
        found.append(CheckMessage("warning", "laser.pulse_energy", text, {"average_power": laser.average_power}))
    places = {"laser.position": laser.position, "camera.position": scene.camera.position}
    places |= {f"targets[{i}].translation": target.translation for i, target in enumerate(scene.targets)}
    for name, point in places.items() if scene.surface is None else ():
        if (farthest := max(map(abs, point))) > _FARTHEST:
            text = f"{list(point)} m is {farthest:.4g} m away; in mm it would be {[1e-3 * x for x in point]} m"
            found.append(CheckMessage("warning", name, text, {"farthest": farthest}))
    if medium.group_index < min(medium.phase_index, 1.32):
        text = f"group_index = {medium.group_index:g} is below phase_index = {medium.phase_index:g}; {_SEA} in the sea"
        found.append(CheckMessage("warning", "medium.group_index", text))
    for name in ("dead_time_ns", "afterpulsing_probability") if detector.mode == "first_photon" else ():
        if value := getattr(detector, name):
            text = f"{value:g} is not used: it goes with detector.mode = 'free_running'"
            found.append(CheckMessage("warning", f"detector.{name}", text))
    return found


def _doubts(field: str, model: Any, low: float, high: float, *units: str) -> list[CheckMessage]:
    name = field.rpartition(".")[2]
    value = getattr(model, name)
    if not isinstance(value, float) or value == 0.0 or low <= value <= high:
        return []
    unit = f" {interval_of(type(model).model_fields[name]).unit}".rstrip()
    text = f"{value:g}{unit} is not plausible ({low:g} to {high:g}{unit} is)"
    meant = {other: quantity(f"{value!r} {other}", unit.strip() or "1") for other in units}
    meant = {other: number for other, number in meant.items() if low <= number <= high}
    words = [f'"{value:g} {other}" ({number:g}{unit})' for other, number in meant.items()]
    text += f"; did you mean {' or '.join(words)}?" if words else ""
    return [CheckMessage("warning", field, text, {"value": value} | {f"in_{one}": meant[one] for one in meant})]


def _check_plausible(survey: Survey) -> None:
    """What is implausible, and the size of meshes."""
    survey.messages += implausible(survey.moving or survey.scene)
    for index, (target, triangles) in enumerate(zip(survey.scene.targets, survey.targets, strict=True)):
        if len(triangles) and (target.mesh is not None or set(target.scale) != {1.0}):
            _check_mesh(survey, f"targets[{index}].scale", target.scale, np.ptp(triangles.reshape(-1, 3), axis=0))


def _check_mesh(survey: Survey, field: str, scales: tuple[float, ...], extent: Points) -> None:
    """The size of a target from a file, whose unit most formats do not state."""
    if _MESH_SIDES[0] <= (longest := float(extent.max())) <= _MESH_SIDES[1]:
        return
    text = f"the mesh is {' x '.join(f'{side:.4g}' for side in extent)} m"
    if (guess := guess_unit(longest)) is not None and guess[0] != "m":
        scale = [guess[1] * factor for factor in scales]
        shown = f"{scale[0]:g}" if len(set(scale)) == 1 else f"{[float(f'{factor:g}') for factor in scale]}"
        smaller = " x ".join(f"{side * guess[1]:.4g}" for side in extent)
        text += f"; if its unit is {guess[0]}, scale = {shown} makes it {smaller} m"
    survey.warn(field, text, longest=longest)


# Where things are: targets in the view, the beam, the gate and the water; focus, ports and the confocal scan

_AROUND = 2.0  # [ns] of a gate before and after a target


def _check_targets(survey: Survey) -> None:
    """The targets, and whether camera and laser stand in the water."""
    scene = survey.scene
    if not scene.targets:
        survey.note("targets", "the scene has none: only the water scatters light back")
    for index, triangles in enumerate(survey.targets):
        if len(triangles):
            _check_target(survey, f"targets[{index}]", triangles)
    for index, target in enumerate(scene.targets):
        if target.specular > 0.0:
            text = f"specular = {target.specular:g} acts in `simulate` alone; all else takes the target as Lambertian"
            survey.note(f"targets[{index}].specular", text, specular=target.specular)
    low, high = np.array(scene.domain.bounds)
    for name, field, place, port in (
        ("the lens", "camera.port", np.array(scene.camera.position), scene.camera.port),
        ("the laser", "laser.port", to_world(scene.camera, scene.beam.position), scene.laser.port),
    ):
        if not ((low <= place) & (place <= high)).all():
            text = f"{name} at {_vector(place)} m is outside the water, {_vector(low)} to {_vector(high)} m"
            survey.warn("domain", text)
        elif isinstance(port, Port) and port.shape == "flat" and port.thickness == 0.0:
            text = "without a window it is a calm surface, but no face of the domain ends the water there: domain"
            survey.warn(field, text)


def _vector(values: Any) -> str:
    """`(0, 1, 2.5)`"""
    return "(" + ", ".join(f"{value:.4g}" for value in np.asarray(values)) + ")"


def _check_target(survey: Survey, name: str, triangles: Points) -> None:
    """One target; where light cannot come back from it, the first reason alone."""
    scene, laser, in_view = survey.scene, survey.scene.beam, points_inside(triangles, survey.view)
    illuminated = survey.illuminated_part(triangles) if len(in_view) else in_view
    corners, depth = triangles.reshape(-1, 3), float(triangles[..., 2].max())
    ends = zip("xyz", corners.min(0), corners.max(0), strict=True)
    where = f"spans {', '.join(f'{axis} {low:.4g} to {high:.4g}' for axis, low, high in ends)} m"
    where += " in the camera frame" if scene.camera.is_posed else ""
    if not len(in_view) and depth <= 0:
        return survey.warn(name, f"behind the camera: {where}", depth=depth)
    if not len(in_view):
        left, top, right, bottom = (depth * tangent for tangent in scene.camera.view_box)
        wide, tall = max(-left, right), max(-top, bottom)
        text = f"outside the view: {where}, the view at its far end is |x| < {wide:.3g}, |y| < {tall:.3g} m"
        return survey.warn(name, text, half_width=wide, half_height=tall, depth=depth)
    if (nearest := float(np.linalg.norm(in_view, axis=1).min())) <= scene.camera.aperture_radius:
        return survey.warn(name, f"reaches the lens ({where}): translation moves it away", nearest=nearest)
    seen = survey.illuminated_part(triangles, sides=1)  # through the port
    angles = _angles(survey, survey.visible(seen if len(seen) else in_view))
    if not len(illuminated):
        text = f"the beam misses what the camera sees of it: {where}, that is {angles.min():.3g} to "
        text += f"{angles.max():.3g}° off the axis, {_beam_text(scene.laser)}"
        return survey.warn(name, text, nearest_angle_deg=float(angles.min()))
    widest = float(angles.max())
    cone = laser.profile in ("uniform_cone", "gaussian") and scene.scan_positions == 1 and laser.half_angle_deg < 90.0
    if cone and math.tan(math.radians(min(widest, 89.9))) > 2.0 * math.tan(laser.half_angle):
        text = f"the beam misses most of what the camera sees of it: that reaches {widest:.3g}° off the axis, "
        survey.note("laser.half_angle_deg", text + _beam_text(scene.laser), widest_angle_deg=widest)
    illuminated = survey.visible(illuminated)
    _check_gate(survey, name, survey.paths(illuminated))
    side = float(np.abs(illuminated[:, :2]).max())
    if side > scene.transport.lateral_limit:
        text = f"lateral_limit = {scene.transport.lateral_limit:.4g} m cuts {name}, which is seen out to {side:.4g} m"
        survey.warn("transport.lateral_limit", text, side=side)
    corners, bounds = to_world(scene.camera, corners), scene.domain.bounds
    low, high = corners.min(axis=0), corners.max(axis=0)
    if (low < bounds[0]).any() or (high > bounds[1]).any():
        text = f"spans {_vector(low)} to {_vector(high)} m in the world; the water reaches from "
        text += f"{_vector(bounds[0])} to {_vector(bounds[1])} m: nothing outside is hit"
        survey.warn(name, text)
    extent = np.ptp(image_points(scene.camera, in_view[:, :2] / in_view[:, 2:]), axis=0)
    if extent.max() < 1.0:
        text = f"smaller than a pixel, {extent[0]:.2g} x {extent[1]:.2g} of one: the truth maps may miss it, and "
        text += "what is beside it shares its pixel"
        survey.warn(name, text, columns=float(extent[0]), rows=float(extent[1]))


def _check_gate(survey: Survey, name: str, paths: Points) -> None:
    scene, nearest, farthest = survey.scene, float(paths.min()), float(paths.max())
    first, last = survey.arrival_ns(nearest), survey.arrival_ns(farthest)
    start, stop, limit = scene.gate.start * 1e9, scene.gate.stop * 1e9, scene.path_limit
    if first < start or last > stop or first >= stop:
        partly = "" if first >= stop or last < start else "partly "
        begin = max(0.0, math.floor(first - _AROUND))
        bins = math.ceil(1e3 * (last + _AROUND - begin) / scene.gate.bin_width_ps)
        advice = f"start_ns = {begin:g} and bins = {bins} hold it, and `spadwarp plan` proposes a gate"
        text = (
            f"{partly}outside the gate: its light comes back from {first:.5g} to {last:.5g} ns, the gate is open from "
            f"{start:.5g} to {stop:.5g} ns; {advice if bins <= 1_000_000 else '`spadwarp plan` proposes one'}"
        )
        survey.warn(name, text, first_ns=first, last_ns=last, start_ns=start, stop_ns=stop)
    if farthest > limit < path_from_time(scene.gate.stop, scene.medium.group_index):
        text = f"max_path = {limit:.4g} m ends photons before they return from {name}, up to {farthest:.4g} m"
        survey.warn("transport.max_path", text, max_path=limit, path=farthest)


def _angles(survey: Survey, points: Points) -> Points:
    """Angles [°] against the beam's axis at which light leaves the laser for the points, through its port."""
    laser, port = survey.scene.beam, survey.laser_port
    away = points - laser.position if port is None else port.connect(points, laser.position)[0]
    return np.degrees(np.arctan2(np.linalg.norm(np.cross(away, laser.axis), axis=1), away @ np.array(laser.axis)))


def _beam_text(laser: Laser) -> str:
    if laser.profile == "collimated":
        return f"the beam is parallel with a radius of {laser.beam_radius:.3g} m"
    if laser.profile == "measured":
        wide, tall = (math.degrees(math.atan(tangent)) for tangent in profile_extent(laser))
        return f"the beam's image spans ±{wide:.3g}° and ±{tall:.3g}°"
    return f"the beam's half angle is {laser.half_angle_deg:.3g}°"


def _check_focus(survey: Survey) -> None:
    """How far the lens is out of focus on what it sees."""
    camera, focus, port = survey.scene.camera, survey.focus_distance, survey.camera_port
    if focus is None or survey.target_range is None or survey.on_axis is None:
        return

    def blur(distance: float) -> float:
        """Of a point at a range on the axis [pixels]."""
        apparent = distance
        if port is not None:
            start, axis, lead, _ = port.enter((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
            apparent = port.apparent_distance(start + (distance - float(lead)) * axis)
        return 2.0 * camera.aperture_radius * abs(1.0 / apparent - 1.0 / focus) / camera.pixel_tangent

    worst = max(survey.target_range, key=blur)
    if (pixels := blur(worst)) > 1.0:
        text = f"a point at {worst:.4g} m is blurred over {pixels:.3g} pixels by a lens focused at "
        text += f"{focus:.4g} m; truth maps and the analytic simulator are sharp"
        survey.note("camera.focus_distance", text, distance=worst, pixels=pixels)


def _check_ports(survey: Survey) -> None:
    """The view through a port, and where it bends the beam."""
    scene, port = survey.scene, survey.camera_port
    if port is not None:
        left, top, right, bottom = scene.camera.view_box
        edges = np.array([[left, 0.0, 1.0], [right, 0.0, 1.0], [0.0, top, 1.0], [0.0, bottom, 1.0]])
        _, water, _, _ = port.enter((0.0, 0.0, 0.0), edges / np.linalg.norm(edges, axis=1, keepdims=True))
        angles = np.degrees(np.arctan2(water[[0, 1, 2, 3], [0, 0, 1, 1]], water[:, 2]))
        wide, tall = float(angles[1] - angles[0]), float(angles[3] - angles[2])
        if not math.isfinite(wide + tall):
            survey.warn("camera.port", "some of the view does not get through the port: it shows nothing there")
        else:
            text = f"through it the camera sees {wide:.3g} x {tall:.3g}° of the water; intrinsics are those in air"
            survey.note("camera.port", text, wide_deg=wide, tall_deg=tall)
    if survey.laser_port is not None and scene.scan_positions == 1:
        (start, along), distance, origin = survey.beam_axis, survey.distance, np.array(scene.beam.position)
        point, bend = start + distance * along, math.degrees(math.acos(min(float(along @ scene.beam.axis), 1.0)))
        ahead = point / np.linalg.norm(point) if port is None else port.connect(point, np.zeros(3))[0]
        inside = (survey.view[:, :3] / np.linalg.norm(survey.view[:, :3], axis=1, keepdims=True)) @ ahead
        # Not of a beam that is turned out of the view, nor of one that still lights the middle of the view.
        turned = (survey.view[:, :3] @ (origin + distance * np.array(scene.beam.axis)) < 0.0).any()
        middle = origin + survey.laser_port.connect([0.0, 0.0, distance], origin)[0]
        lit = (survey.beam[:, :3] @ middle + survey.beam[:, 3] >= 0.0).all()
        if (beside := -math.degrees(math.asin(inside.min()))) > 0.0 and not (turned or lit):
            text = f"bends the beam by {bend:.3g}°: at {distance:.4g} m its axis is {beside:.3g}° beside the view, "
            text += f"{_beam_text(scene.laser)}; none is bent in the centre of a dome"
            survey.warn("laser.port", text, bend_deg=bend, beside_deg=beside)


def _check_scan(survey: Survey) -> None:
    """Whether the beam of a confocal scan is where its pixel looks, and what of the detector is then one pixel's."""
    scene, laser, distance = survey.scene, survey.scene.beam, survey.distance
    if scene.scan_positions == 1:
        return
    if scene.laser.direction != Laser().direction:
        survey.note("laser.direction", f"direction = {list(scene.laser.direction)} is not used: a scan aims the laser")
    snapped = math.degrees(math.acos(scene.transport.axis_threshold))
    pixel_deg = math.degrees(math.atan(scene.camera.pixel_tangent))
    if snapped > pixel_deg:
        text = (
            f"axis_threshold = {scene.transport.axis_threshold:g} scatters light within {snapped:.3g}° of the optical "
            f"axis as if it went along it, and a pixel sees {pixel_deg:.3g}°: 1 is exact"
        )
        survey.warn("transport.axis_threshold", text, degrees=snapped, pixel_deg=pixel_deg)
    for name in ("crosstalk_probability", "dark_count_spread", "hot_pixel_fraction"):
        if value := getattr(scene.detector, name):
            text = f"{name} = {value:g} is drawn between positions of the scan, where one pixel looks at all of them"
            survey.note(f"detector.{name}", text, **{name: value})
    if survey.on_axis is None:
        return
    aside = math.hypot(*laser.position[:2]) * abs(1.0 - distance / scene.scan.distance)
    spot = laser.beam_radius if laser.profile == "collimated" else math.tan(min(laser.half_angle, 1.5)) * distance
    pixel = scene.camera.pixel_tangent * distance
    if aside > spot + pixel:
        text = f"at {distance:.4g} m the beam is {aside:.3g} m beside what its pixel sees ({pixel:.3g} m wide, "
        text += f"the spot's radius is {spot:.3g} m): scan.distance makes them cross"
        survey.warn("scan.distance", text, aside=aside, spot=spot, pixel=pixel)


def _check_shots(survey: Survey) -> None:
    """Whether a scan along a trajectory comes to its targets, and how dense its shots are."""
    if survey.moving is None:
        return
    survey.messages = [one for one in survey.messages if not one.field.startswith("targets")]  # of one shot
    scene, shots = survey.moving, shots_of(survey.moving)
    if (far := float(np.linalg.norm(shots.position - scene.camera.position, axis=1).max())) > 1e4:  # floats have mm
        survey.warn("scan.path", f"shots are up to {far:.4g} m from camera.position: single precision", distance=far)
    wide = 0.5 * scene.path_limit * scene.receiver.pixel_tangent * scene.receiver.width
    for number, (middle, radius) in enumerate(survey.balls):
        if (aside := float(shots.aside(middle).min())) > radius + wide:
            survey.warn(f"targets[{number}]", f"no shot looks at it: all pass {aside:.4g} m beside it", aside=aside)
    distance, (start, along) = survey.distance, shots.lines()
    gaps = [np.linalg.norm(np.diff(start + distance * along, axis=k), axis=2).ravel() for k in (1, 0)]
    in_row, rows = (float(np.median(gap)) if gap.size else 0.0 for gap in gaps)
    text = f"at {distance:.4g} m pixels of a row are {in_row:.3g} m apart, rows {rows:.3g} m"
    survey.note("scan.pattern", text, in_row=in_row, rows=rows)


# The light: time of flight, spectrum, daylight, polarisation, and whether enough photons come back

_MEMORY_LIMIT = 2 * 2**30  # [bytes] of one set of tallies, from which on it is mentioned


def _check_timing(survey: Survey) -> None:
    """Range aliasing, the length of the gate, the width of its bins, and the group index."""
    laser, gate, wraps = survey.scene.laser, survey.scene.gate, survey.scene.detector.wrap
    unambiguous, period = survey.range_of(1.0 / laser.repetition_rate), 1e9 / laser.repetition_rate
    if survey.target_arrival_ns is not None and (last := survey.target_arrival_ns[1]) > period:
        text = (
            f"the target returns after up to {last:.5g} ns, later than the next pulse ({period:.5g} ns): the "
            f"unambiguous range is {unambiguous:.4g} m, "
            f"{'time wraps' if wraps else 'ignored, since detector.wrap is false'}"
        )
        report = survey.warn if wraps and survey.scene.surface is None else survey.note  # in orbit, many are under way
        report("laser.repetition_rate", text, unambiguous_range=unambiguous, last_ns=last, period_ns=period)
    if (length := (gate.stop - gate.start) * 1e9) > period * (1 + 1e-9):
        text = f"the gate of {length:.5g} ns is longer than the pulse period, {period:.5g} ns: time wraps within it"
        survey.note("gate.bins", text, gate_ns=length, period_ns=period)
    if gate.bin_width_ps > survey.irf_fwhm_ps:
        text = f"bin_width_ps = {gate.bin_width_ps:.4g} is coarser than the instrument response, "
        text += f"{survey.irf_fwhm_ps:.4g} ps: depth is resolved to {survey.bin_range:.3g} m"
        survey.note("gate.bin_width_ps", text, irf_fwhm_ps=survey.irf_fwhm_ps)
    medium, index, distance = survey.scene.medium, survey.scene.medium.group_index, survey.distance
    if index in (_FRESH, _SEA) and abs(laser.wavelength_nm - 532.0) > 10.0 and laser.is_visible:
        true = group_index(laser.wavelength_nm, salinity=35.0 * (index == _SEA))
        error = distance * (true / index - 1.0)
        text = f"{index} is for 532 nm; at the laser's {laser.wavelength_nm:g} nm it is {true:.4f}: {error:.3f} m at "
        text += f"{distance:.3g} m; medium.temperature takes it from the laser"
        survey.warn("medium.group_index", text, group_index=true, error=error)
    elif "group_index" not in medium.model_fields_set and not medium.follows_wavelength:
        survey.note("medium.group_index", f"not given: {index}, seawater at 532 nm, is used for the time of flight")
    elif 1.32 < index < 1.35:
        error = distance * (_SEA / index - 1.0)
        text = (
            f"{index} is a phase index; light pulses travel with the group index, {_SEA} in seawater and {_FRESH} in "
            f"fresh water at 532 nm: {error:.2f} m at {distance:.3g} m in seawater"
        )
        survey.warn("medium.group_index", text, error=error, distance=distance)


def _check_spectrum(survey: Survey) -> None:
    """The part that the filter passes; what the Monte Carlo run, which traces one wavelength, leaves out."""
    scene, laser, detector = survey.scene, survey.scene.laser, survey.scene.detector
    lines = spectral_lines(laser, detector)
    passed = math.fsum(line.share for line in lines)
    middle = math.fsum(line.share * line.wavelength_nm for line in lines) / passed if passed else laser.wavelength_nm
    if laser.spectrum is not None and abs(middle - laser.wavelength_nm) > 20.0:
        text = f"{laser.wavelength_nm:g} nm is that of photons and water, and the spectrum lies about {middle:.4g} nm"
        survey.warn("laser.wavelength_nm", text, middle=middle)
    if detector.has_filter and passed < 0.2:
        field = "filter_fwhm_nm" if detector.filter_table is None else "filter_table"
        text = f"the filter passes {100.0 * passed:.3g} % of the laser's light, which is at {laser.wavelength_nm:g} nm"
        survey.warn(f"detector.{field}", text, passed=passed)
    if len(lines) == 1 or survey.on_axis is None or passed == 0.0:
        return
    field = "laser.linewidth_nm" if laser.spectrum is None else "laser.spectrum"
    try:
        waters, path = water_lines(scene), 2.0 * survey.distance
    except ConfigError as error:
        survey.note(field, f"the analytic simulator refuses it: {error.problems[0].removeprefix('laser: ')}")
        return
    if len(waters) == 1:
        return
    weights = [share * math.exp(-(water.extinction - scene.medium.extinction) * path) for share, water in waters]
    total = math.fsum(weights)
    if abs((ratio := total / passed) - 1.0) > 0.01:
        text = (
            f"over the spectrum the water leaves {ratio:.3g} times the target's unscattered light that it leaves at "
            f"{laser.wavelength_nm:g} nm, which is the wavelength that simulate traces; the analytic simulator takes "
            "the whole spectrum"
        )
        survey.note(field, text, ratio=ratio)
    slowness = [1.0 / water.pulse_speed for _, water in waters]
    mean = math.fsum(weight * t for weight, t in zip(weights, slowness, strict=True)) / total
    variance = math.fsum(w * (t - mean) ** 2 for w, t in zip(weights, slowness, strict=True)) / total
    spread_ps = 2.0 * math.sqrt(2.0 * math.log(2.0)) * math.sqrt(variance) * path * 1e12
    if spread_ps > 0.3 * survey.irf_fwhm_ps:
        text = f"dispersion spreads the target's light over {spread_ps:.3g} ps, and the response has "
        text += f"{survey.irf_fwhm_ps:.3g} ps: set pulse_fwhm_ps to both, the spread is left out"
        survey.note(field, text, spread_ps=spread_ps)


def _check_daylight(survey: Survey) -> None:
    """How much daylight a pixel that looks into open water along the optical axis detects, and what leaves it out."""
    scene, report = survey.scene, survey.note
    if scene.daylight is None:
        return
    rate = float(daylight_rate(scene, view=np.array([[0.0, 0.0, 1.0]]))[0])
    per_pulse = rate * min(scene.gate.stop - scene.gate.start, 1.0 / scene.laser.repetition_rate)
    text = f"a pixel on the optical axis detects {rate:.3g} photons of daylight per second in open water"
    if per_pulse > PILE_UP:
        text += f"; that is {per_pulse:.2g} a pulse, and more than {PILE_UP:g} distort the histogram (pile-up)"
        text += "" if scene.detector.has_filter else ": there is no filter (detector.filter_fwhm_nm)"
        report = survey.warn
    report("daylight", text, rate=rate, per_pulse=per_pulse)
    if scene.medium.phase_index < 1.3:
        text = f"phase_index = {scene.medium.phase_index:g} is not water's: light from above is not refracted to it"
        survey.note("medium.phase_index", text, phase_index=scene.medium.phase_index)


def _check_polarisation(survey: Survey) -> None:
    """Polarised light that no channel records, and fields without their choice; reads the matrix's table."""
    scene, medium, laser = survey.scene, survey.scene.medium, survey.scene.laser
    scattering_matrix(medium)
    if scene.polarised:
        text = f"light is polarised: scattering_matrix = {medium.scattering_matrix!r}, without the near-axis rule"
        survey.note("medium.scattering_matrix", text)
    measured, cameras = scene.camera.polarisation != "none", "polarisation = 'analyser' or 'stokes'"
    if scene.polarised and not measured:
        survey.note("camera.polarisation", f"light is polarised, but no channel records it; {cameras} does")
    if measured and laser.polarisation == "none":
        survey.note("laser.polarisation", "the camera measures polarisation, but the laser's light is not polarised")
    rayleigh = "rayleigh" in (medium.scattering_matrix, medium.phase_function)
    scaled = medium.scattering_matrix == "scaled_rayleigh"
    for section, field, used, needed in (
        ("laser", "polarisation_angle_deg", laser.polarisation == "linear", "polarisation = 'linear'"),
        ("medium", "depolarisation_ratio", rayleigh, "scattering_matrix or phase_function = 'rayleigh'"),
        ("medium", "largest_polarisation", scaled, "scattering_matrix = 'scaled_rayleigh'"),
        ("camera", "analyser_angle_deg", measured, cameras),
        ("camera", "analyser_extinction_ratio", measured, cameras),
    ):
        model = getattr(scene, section)
        value = getattr(model, field)
        if not used and value != type(model).model_fields[field].default:
            survey.note(f"{section}.{field}", f"{field} = {value:g} is not used: it goes with {section}.{needed}")


def _photons(scene: Scene) -> float:
    """That will be traced; infinite where their noise decides, and the run itself says whether they were enough."""
    return math.inf if isinstance(scene.transport.photons, str) else scene.transport.photons


def _check_peak(survey: Survey) -> None:
    """A forward peak that is too narrow for the photons to see it."""
    scene, photons = survey.scene, _photons(survey.scene)
    if scene.medium.range.scattering == 0.0 or photons == math.inf:
        return
    angle, unseen = scene.unseen_peak(photons, survey.target_range or ())
    if unseen > NOTABLE_UNSEEN:
        values = {"unseen": unseen, "angle_deg": math.degrees(angle)}
        survey.warn("transport.estimator", scene.unseen_warning(photons, angle, unseen), **values)


def _check_statistics(survey: Survey) -> None:
    """The size of the tallies, the expected signal, and the photons that a pixel gets."""
    scene, size, axis = survey.scene, survey.histogram_bytes, survey.on_axis
    if size > _MEMORY_LIMIT:
        text = f"the tallies take {size / 2**30:.3g} GiB, and a run on the CPU needs twice that"
        survey.warn("gate.bins", text, bytes=size)
    if axis is None:
        return
    signal, samples, traced = axis.signal_per_pulse, axis.samples_per_pixel, _photons(scene)
    text = f"optical depth to the nearest illuminated point {axis.optical_depth:.3g} one way ({survey.distance:.4g} m);"
    text += f" a pixel on the beam's axis detects {signal:.3g} unscattered photons a pulse"
    survey.note("medium.extinction", text, optical_depth=axis.optical_depth, signal_per_pulse=signal)
    if signal > 0.05:
        text = f"{signal:.3g} target detections per pulse and pixel: first-photon counting piles up"
        survey.note("laser.pulse_energy", text, signal_per_pulse=signal)
    emitted = scene.detectable_photons_per_pulse or math.inf
    where, field, name, reach = "what a pixel sees", "transport.photons", "samples_per_pixel", samples
    if scene.transport.estimator == "analog":
        reach = signal * traced / scene.scan_positions / emitted
        where, field, name = "a pixel", "transport.estimator", "photons_per_pixel"
    if reach < 10.0:
        enough = f"; about {10.0 * traced / reach:.1e} would be enough" if reach > 0.0 else ""
        text = f"only about {reach:.2g} of {traced:.3g} photons reach {where} unscattered{enough}"
        survey.warn(field, text, **{name: reach})


# The water: its coefficients, phase function and cells, and what ends a photon's history in it


def _check_medium(survey: Survey) -> None:
    """The medium and its layers."""
    medium, laser = survey.scene.medium, survey.scene.laser
    pure = pure_water_absorption(laser.wavelength_nm) if laser.is_visible else 0.0
    waters: dict[str, Water] = {"medium": medium}
    waters |= {f"medium.layers[{i}]": layer for i, layer in enumerate(medium.layers)}
    for name, water in waters.items():
        if water.absorption < 0.95 * pure:
            text = f"absorption = {water.absorption:.3g} 1/m is below pure water's {pure:.3g} 1/m"
            survey.note(f"{name}.absorption", text, absorption=water.absorption, pure_water=pure)
        if water.preset is not None and abs(laser.wavelength_nm - 532.0) > 10.0:
            text = f"the coefficients of {water.preset} are for about 532 nm, the laser has {laser.wavelength_nm:g} nm"
            if laser.is_visible:
                text += f", where pure water absorbs {pure:.3g} 1/m and not {pure_water_absorption(532.0):.3g}"
            survey.warn(f"{name}.preset", text, wavelength_nm=laser.wavelength_nm, pure_water=pure)
        if medium.phase_function == "henyey_greenstein" and laser.is_visible and water.is_natural:
            _check_backscatter(survey, name, water)


def _check_backscatter(survey: Survey, name: str, water: Water) -> None:
    """Natural water with Henyey–Greenstein's law, which falls towards 180°: molecules and real particles do not."""
    used, fits = natural_laws(survey.scene.medium, water, survey.scene.laser.wavelength_nm)
    back, (kept, natural) = float(fits.density(math.pi)), (used.backscatter_fraction, fits.backscatter_fraction)
    if 0.9 < (ratio := back / float(used.density(math.pi))) < 1.1:
        return
    law = "'fournier_forand' with " + ", ".join(f"{name} = {value:g}" for name, value in fits.parameters.items())
    advice, own = f"phase_function = {law} fits", fits.molecular_share
    if used.molecular_share == 0.0 and own * float(molecular_density(np.array(2.0))) > 0.1 * back:
        advice = f"constituents fit: 'rayleigh' with scattering = {own * water.scattering:.2g} and {law} for the rest"
    text = (
        f"b_b/b of Henyey–Greenstein with g = {used.parameters['anisotropy']:g} is {kept:.3f}, of such water "
        f"{natural:.3f}: straight back it is {max(ratio, 1.0 / ratio):.2g} times too "
        f"{'weak' if ratio > 1.0 else 'strong'}; {advice}"
    )
    survey.note(f"{name}.anisotropy", text, used=kept, natural=natural, ratio=ratio)


def _check_phase_table(survey: Survey) -> None:
    """A forward peak narrower than the near-axis rule; a table that leaves most of the light to its power law."""
    scene = survey.scene
    if not scene.medium.has_phase_table:
        return
    law, snapped = phase_function(scene.medium), math.acos(scene.transport.axis_threshold)
    within = law.fraction_below(snapped) if snapped > 0.0 else 0.0
    if within > 0.1:
        text = (
            f"axis_threshold = {scene.transport.axis_threshold:g} takes light within {math.degrees(snapped):.3g}° of "
            f"the optical axis for axial, and {100.0 * within:.2g} % of the scattered light turns by less than that; "
            "guided follows the forward peak with axis_threshold = 1 only, else single photons stand out"
        )
        survey.warn("transport.axis_threshold", text, within=within)
    continued = law.fraction_below(law.first_angle) if law.first_angle > 0.0 else 0.0
    if continued > 0.1:
        text = f"begins at {math.degrees(law.first_angle):.3g}°: {100.0 * continued:.2g} % of the scattered light is "
        text += "below that, where the law between the first two points is continued"
        survey.note("medium.phase_table", text, continued=continued)


def _check_collisions(survey: Survey) -> None:
    """Whether `max_collisions` or `weight_cutoff` ends histories that the longest path would let go on."""
    scene, transport, beam = survey.scene, survey.scene.transport, survey.scene.beam
    mean = scene.medium.range.extinction * scene.path_limit  # along the longest path
    if scene.medium.grid is not None:  # most of which is not in the densest cell
        far = [p + 0.5 * scene.path_limit * u for p, u in zip(beam.position, beam.axis, strict=True)]
        mean = 2.0 * scene.optical_depth(beam.position, far)
    most, cutoff = mean + 3.0 * math.sqrt(mean), _cutoff_collisions(scene)
    values = {"path_collisions": mean, "cutoff_collisions": cutoff}
    if transport.max_collisions < min(most, cutoff):
        text = (
            f"max_collisions = {transport.max_collisions} ends histories that the longest path would let collide "
            f"{mean:.3g} times on average, {most:.3g} at most"
        )
        survey.warn("transport.max_collisions", text, **values)
    elif cutoff < min(most, transport.max_collisions):
        text = (
            f"weight_cutoff = {transport.weight_cutoff:g} ends histories after about {cutoff:.0f} collisions, before "
            f"max_collisions = {transport.max_collisions} matters; the longest path allows {mean:.3g} on average "
            f'(termination = "roulette" is without this bias)'
        )
        survey.note("transport.weight_cutoff", text, **values)


def _cutoff_collisions(scene: Scene) -> float:
    """Collisions after which the analog weight is below the cut-off, on average; inf where it never is."""
    transport, albedo = scene.transport, scene.medium.range.albedo
    if transport.termination != "cutoff" or transport.weight_cutoff == 0.0:
        return math.inf
    step = math.log(0.97) - 1.0  # the mean of ln ω for ω uniform in (0, 0.97)
    if scene.medium.albedo != "lu2024":
        if albedo in (0.0, 1.0):
            return 1.0 if albedo == 0.0 else math.inf
        step = math.log(albedo)
    return max(1.0, math.ceil(math.log(transport.weight_cutoff) / step))


def _check_grid(survey: Survey) -> None:
    """The cells of `medium.grid`: where their box lies, and what light loses in it."""
    scene, axis = survey.scene, survey.on_axis
    if scene.medium.grid is None:
        return
    cells, view = grid_cells(scene.medium), view_planes(scene.camera)
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    corners = to_camera(scene.camera, (signs * 0.5 * np.array(cells.size)) @ cells.rotation.T + cells.centre)
    # Whether one plane of the view, and one of the beam, has the whole box behind it.
    both = (view, beam_planes(scene.beam) if scene.scan_positions == 1 else view)
    if all((((corners @ planes[:, :3].T + planes[:, 3]) < 0.0).all(axis=0).any()) for planes in both):
        survey.warn("medium.grid", "lies beside the view and the beam: single scattering does not show it")
    else:
        begin, end = (0.0, 0.0, 0.0), (0.0, 0.0, 0.5 * scene.path_limit if axis is None else survey.distance)
        depth, without = scene.optical_depth(begin, end), scene.medium.extinction * end[2]
        where = "to the end of the gate" if axis is None else "to the target's range"
        text = f"optical depth along the axis {where} ({end[2]:.4g} m): {depth:.3g} one way, {without:.3g} without it"
        survey.note("medium.grid", text, optical_depth=depth, without_grid=without)
    longest = max(edge / count for edge, count in zip(cells.size, cells.extinction.shape, strict=True))
    thickest = float(cells.extinction.max()) * longest
    if thickest > 1.0:
        text = f"a cell has an optical depth of up to {thickest:.3g} and does not resolve what varies in it; take more"
        survey.warn("medium.grid.cells", text, cell_optical_depth=thickest)


def _grid_summary(scene: Scene) -> dict[str, Any] | None:
    """Numbers of the cells, see `summary`."""
    if scene.medium.grid is None:
        return None
    cells = grid_cells(scene.medium)
    reach = float(to_camera(scene.camera, cells.centre)[2]) + math.hypot(*cells.size)
    return {
        "cells": list(cells.extinction.shape),
        "size": list(cells.size),
        "extinction": [float(cells.extinction.min()), float(cells.extinction.max())],
        "optical_depth": scene.optical_depth((0.0, 0.0, 0.0), (0.0, 0.0, max(reach, 0.0))),
        "bytes": cells.extinction.size * (8 if cells.anisotropy is None else 12),
    }


_CHECKS = (
    *(_check_plausible, _check_targets, _check_shots, _check_focus, _check_ports, _check_scan, _check_timing),
    *(_check_spectrum, _check_daylight, _check_medium, _check_phase_table, _check_collisions, _check_grid),
    *(_check_peak, _check_polarisation, _check_statistics),
)


guarded(__name__)
