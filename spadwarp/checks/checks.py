"""What may be wrong with a scene that is valid, in numbers, before a photon is traced."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene import Laser, Layer, Medium, Scene, phase_function
from spadwarp.scene.beam_profile import profile_extent
from spadwarp.scene.frustum import beam_planes, points_inside, view_planes
from spadwarp.scene.intrinsics import image_points
from spadwarp.scene.pose import to_world
from spadwarp.scene.preset import WATER_INDICES
from spadwarp.units import path_from_time, range_from_time, time_from_path
from spadwarp.water import group_index, molecular_density, pure_water_absorption, water_optics

if TYPE_CHECKING:
    from spadwarp.mesh import TriangleMesh

__all__ = ["CheckMessage", "check", "summary"]

Points = NDArray[np.float64]

_INDICES_AT_532_NM = [group for _, group in WATER_INDICES.values()]

_MEMORY_LIMIT = 2 * 2**30  # [bytes] of one set of tallies that is worth a word


@dataclasses.dataclass(frozen=True)
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


def check(scene: Scene, mesh: TriangleMesh | None = None) -> list[CheckMessage]:
    """Everything worth knowing about a scene, warnings first.

    `mesh` is the scene's mesh if the caller has it; else it is built. Occlusion is not looked at. Raises `MeshError`;
    `FileError` or `ConfigError` for the table of a phase function.
    """
    shape = _Shape(scene, mesh)
    messages = [*_targets(shape), *_focus(shape), *_scan(shape), *_timing(shape), *_water(shape), *_statistics(shape)]
    return sorted(messages, key=lambda message: message.level != "warning")


def summary(scene: Scene, mesh: TriangleMesh | None = None) -> dict[str, Any]:
    """Numbers that follow from a scene; lengths in m, None where there is no target in the view and the beam.

    `attenuation_length` and `albedo` are those of the water before the first layer; `layers` has those of each layer,
    with its start. `optical_depth` is one-way to the nearest visible point. `signal_per_pulse` is the expected number
    of unscattered target photons that one pixel on the beam's axis detects from a pulse; `samples_per_pixel` how many
    of the traced photons reach a pixel's part of the target unscattered. `histogram_bytes` is one set of tallies.
    Raises `MeshError`.
    """
    shape = _Shape(scene, mesh)
    camera, gate, laser = scene.camera, scene.gate, scene.laser
    return {
        "attenuation_length": scene.medium.attenuation_length,
        "albedo": scene.medium.scattering / scene.medium.extinction,
        "layers": [
            {
                "start": layer.start,
                "attenuation_length": layer.attenuation_length,
                "albedo": layer.scattering / layer.extinction,
            }
            for layer in scene.medium.layers
        ],
        "target_range": shape.target_range,
        "target_arrival_ns": shape.arrival_ns,
        "optical_depth": shape.optical_depth,
        "gate_range": (shape.range_of(gate.start), shape.range_of(gate.stop)),
        "bin_range": shape.range_of(gate.bin_width),
        "path_limit": scene.path_limit,
        "unambiguous_range": shape.range_of(1.0 / laser.repetition_rate),
        "irf_fwhm_ps": shape.irf_fwhm_ps,
        "horizontal_fov_deg": math.degrees(camera.horizontal_fov),
        "vertical_fov_deg": math.degrees(camera.vertical_fov),
        "aperture_area": camera.aperture_area,
        "photons_per_pulse": laser.photons_per_pulse,
        "pde": scene.detector.pde,
        "signal_per_pulse": shape.signal_per_pulse,
        "samples_per_pixel": shape.samples_per_pixel,
        "histogram_bytes": shape.histogram_bytes,
    }


class _Shape:
    """A scene with its mesh, and what both imply."""

    def __init__(self, scene: Scene, mesh: TriangleMesh | None) -> None:
        if mesh is None and scene.targets:
            from spadwarp.mesh import build_mesh

            mesh = build_mesh(scene)
        self.scene = scene
        self.target = np.zeros(0, dtype=np.int32) if mesh is None else mesh.target
        self.reflectance = np.zeros(0) if mesh is None else mesh.reflectance
        self.triangles = np.zeros((0, 3, 3)) if mesh is None else mesh.vertices[mesh.faces].astype(np.float64)
        self.view = view_planes(scene.camera)
        # A scan brings its beam to all that is in view.
        self.beam = beam_planes(scene.beam) if scene.scan_positions == 1 else np.zeros((0, 4))
        self.lit = points_inside(self.triangles, np.concatenate([self.view, self.beam]))
        paths = np.linalg.norm(self.lit - np.array(scene.beam.position), axis=1) + np.linalg.norm(self.lit, axis=1)
        ranges = np.linalg.norm(self.lit, axis=1)
        self.target_range = (float(ranges.min()), float(ranges.max())) if len(ranges) else None
        nearest = self.lit[ranges.argmin()].tolist() if len(ranges) else None
        self.optical_depth = None if nearest is None else scene.optical_depth((0.0, 0.0, 0.0), nearest)
        self.target_path = (float(paths.min()), float(paths.max())) if len(paths) else None

    @property
    def arrival_ns(self) -> tuple[float, float] | None:
        """First and last unscattered return of the target."""
        if self.target_path is None:
            return None
        first, last = (1e9 * time_from_path(path, self.scene.medium.group_index) for path in self.target_path)
        return first, last

    def range_of(self, time: float) -> float:
        """Range [m] of a round trip of `time` [s], laser at the lens."""
        return range_from_time(time, self.scene.medium.group_index)

    @property
    def irf_fwhm_ps(self) -> float:
        return math.hypot(self.scene.laser.pulse_fwhm_ps, self.scene.detector.jitter_fwhm_ps)

    @property
    def histogram_bytes(self) -> int:
        camera = self.scene.camera
        return 3 * 8 * camera.width * camera.height * self.scene.gate.bins

    def _pixel_share(self, distance: float) -> float:
        """Part of the beam within one pixel's footprint at `distance` [m], on the beam's axis, without water."""
        laser, footprint = self.scene.laser, (self.scene.camera.pixel_tangent * distance) ** 2
        if laser.profile == "uniform_cone":
            area = 2.0 * math.pi * (1.0 - math.cos(laser.half_angle)) * distance**2
        elif laser.profile == "gaussian":
            area = 0.5 * math.pi * (math.tan(laser.half_angle) * distance) ** 2
        elif laser.profile == "measured":
            wide, tall = profile_extent(laser)
            area = 4.0 * wide * tall * distance**2  # if it were even
        else:
            area = math.pi * laser.beam_radius**2
        return min(1.0, footprint / area) if area > 0.0 else 1.0

    @property
    def samples_per_pixel(self) -> float | None:
        if self.target_range is None or self.optical_depth is None or self.target_range[0] == 0.0:
            return None
        distance = self.target_range[0]
        arriving = math.exp(-self.optical_depth)
        return self.scene.transport.photons / self.scene.scan_positions * arriving * self._pixel_share(distance)

    @property
    def signal_per_pulse(self) -> float | None:
        if self.target_range is None or self.optical_depth is None or self.target_range[0] == 0.0:
            return None
        scene, distance = self.scene, self.target_range[0]
        reflectance = float(self.reflectance.max())
        collected = reflectance / math.pi * scene.camera.aperture_area / distance**2  # Lambertian, towards the lens
        fraction = self._pixel_share(distance) * math.exp(-2.0 * self.optical_depth) * collected
        return fraction * scene.laser.photons_per_pulse * scene.detector.pde


def _targets(shape: _Shape) -> Iterator[CheckMessage]:
    scene = shape.scene
    if not scene.targets:
        yield CheckMessage("note", "targets", "the scene has none: only the water scatters light back")
    for index in range(len(scene.targets)):
        triangles = shape.triangles[shape.target == index]
        if len(triangles):
            yield from _placement(shape, f"targets[{index}]", triangles)
    for index, target in enumerate(scene.targets):
        if target.specular > 0.0:
            text = (
                f"specular = {target.specular:g} acts in `simulate` alone: the analytic simulator, budgets and the"
                " signal named here take the target as Lambertian"
            )
            yield CheckMessage("note", f"targets[{index}].specular", text, {"specular": target.specular})
    (low, high), laser = scene.domain.bounds, to_world(scene.camera, scene.beam.position)
    for place, point in (("the lens", scene.camera.position), ("the laser", laser)):
        if any(not (a <= x <= b) for a, x, b in zip(low, point, high, strict=True)):
            yield CheckMessage(
                "warning",
                "domain",
                f"{place} at {_vector(point)} m is outside the water, {_vector(low)} to {_vector(high)} m",
            )


def _placement(shape: _Shape, name: str, triangles: Points) -> Iterator[CheckMessage]:
    """Findings about one target; a later one would only repeat an earlier one, so the first ends the search."""
    scene = shape.scene
    corners = triangles.reshape(-1, 3)
    low, high = corners.min(axis=0), corners.max(axis=0)
    where = f"spans x {_span(low[0], high[0])}, y {_span(low[1], high[1])}, z {_span(low[2], high[2])} m"
    if _is_posed(scene):
        where += " in the camera frame"
    seen = points_inside(triangles, shape.view)
    if not len(seen):
        depth = float(high[2])
        if depth <= 0:
            yield CheckMessage("warning", name, f"behind the camera: {where}", {"depth": depth})
            return
        left, top, right, bottom = (depth * tangent for tangent in scene.camera.view_box)
        wide, tall = max(-left, right), max(-top, bottom)
        text = f"outside the view: {where}, the view at its far end is |x| < {wide:.3g}, |y| < {tall:.3g} m"
        yield CheckMessage("warning", name, text, {"half_width": wide, "half_height": tall, "depth": depth})
        return
    nearest = float(np.linalg.norm(seen, axis=1).min())
    if nearest <= scene.camera.aperture_radius:
        text = f"reaches the lens ({where}): translation moves it away"
        yield CheckMessage("warning", name, text, {"nearest": nearest})
        return
    lit = points_inside(triangles, np.concatenate([shape.view, shape.beam]))
    if not len(lit):
        angles = _angles(seen, scene.beam)
        text = (
            f"the beam misses what the camera sees of it: {where}, that is {math.degrees(angles.min()):.3g} to "
            f"{math.degrees(angles.max()):.3g}° off the axis, {_beam_text(scene.laser)}"
        )
        yield CheckMessage("warning", name, text, {"nearest_angle_deg": math.degrees(angles.min())})
        return
    paths = np.linalg.norm(lit - np.array(scene.beam.position), axis=1) + np.linalg.norm(lit, axis=1)
    first, last = (1e9 * time_from_path(float(path), scene.medium.group_index) for path in (paths.min(), paths.max()))
    start, stop = scene.gate.start * 1e9, scene.gate.stop * 1e9
    values = {"first_ns": first, "last_ns": last, "start_ns": start, "stop_ns": stop}
    times = (
        f"its light comes back from {first:.5g} to {last:.5g} ns, the gate is open from {start:.5g} to {stop:.5g} ns"
    )
    if first >= stop or last < start:
        yield CheckMessage("warning", name, f"outside the gate: {times}", values)
    elif first < start or last > stop:
        yield CheckMessage("warning", name, f"partly outside the gate: {times}", values)
    limit = scene.path_limit
    if paths.max() > limit < path_from_time(scene.gate.stop, scene.medium.group_index):
        text = f"max_path = {limit:.4g} m ends photons before they return from {name}, up to {paths.max():.4g} m"
        yield CheckMessage("warning", "transport.max_path", text, {"max_path": limit, "path": float(paths.max())})
    side = float(np.abs(lit[:, :2]).max())
    if side > scene.transport.lateral_limit:
        text = f"lateral_limit = {scene.transport.lateral_limit:.4g} m cuts {name}, which is seen out to {side:.4g} m"
        yield CheckMessage("warning", "transport.lateral_limit", text, {"side": side})
    bounds = np.array(scene.domain.bounds)
    if _is_posed(scene):
        there = to_world(scene.camera, corners)
        low, high = there.min(axis=0), there.max(axis=0)
        where = f"spans {_vector(low)} to {_vector(high)} m"
    if (low < bounds[0]).any() or (high > bounds[1]).any():
        text = f"{where}; the water reaches from {_vector(bounds[0])} to {_vector(bounds[1])} m: nothing outside is hit"
        yield CheckMessage("warning", name, text)

    extent = np.ptp(image_points(scene.camera, seen[:, :2] / seen[:, 2:]), axis=0)
    if extent.max() < 1.0:
        text = (
            f"smaller than a pixel, {extent[0]:.2g} x {extent[1]:.2g} of one: the truth maps may miss it, and what is "
            "beside it shares its pixel"
        )
        yield CheckMessage("warning", name, text, {"columns": float(extent[0]), "rows": float(extent[1])})


def _focus(shape: _Shape) -> Iterator[CheckMessage]:
    """How far a thin lens is out of focus on what it sees."""
    camera = shape.scene.camera
    if camera.focus_distance is None or shape.target_range is None or shape.target_range[0] == 0.0:
        return
    blur = {
        distance: 2.0 * camera.aperture_radius * abs(1.0 / distance - camera.inverse_focus) / camera.pixel_tangent
        for distance in shape.target_range
    }
    worst = max(blur, key=blur.__getitem__)
    if blur[worst] > 1.0:
        text = (
            f"a point at {worst:.4g} m is blurred over {blur[worst]:.3g} pixels; truth maps and the analytic simulator "
            "are sharp"
        )
        yield CheckMessage("note", "camera.focus_distance", text, {"distance": worst, "pixels": blur[worst]})


def _scan(shape: _Shape) -> Iterator[CheckMessage]:
    """Whether the beam of a confocal scan is where its pixel looks, and what of the detector is then one pixel's."""
    scene = shape.scene
    if scene.scan_positions == 1:
        return
    detector, laser = scene.detector, scene.beam
    if scene.laser.direction != type(scene.laser)().direction:
        text = f"direction = {list(scene.laser.direction)} is not looked at: a scan aims the laser"
        yield CheckMessage("note", "laser.direction", text)
    snapped = math.degrees(math.acos(scene.transport.axis_threshold))
    pixel_deg = math.degrees(math.atan(scene.camera.pixel_tangent))
    if snapped > pixel_deg:
        text = (
            f"axis_threshold = {scene.transport.axis_threshold:g} scatters light within {snapped:.3g}° of the optical "
            f"axis as if it went along it, and a pixel sees {pixel_deg:.3g}°: 1 is exact"
        )
        yield CheckMessage("warning", "transport.axis_threshold", text, {"degrees": snapped, "pixel_deg": pixel_deg})
    for name in ("crosstalk_probability", "dark_count_spread", "hot_pixel_fraction"):
        if value := getattr(detector, name):
            text = f"{name} = {value:g} is drawn between positions of the scan, where one pixel looks at all of them"
            yield CheckMessage("note", f"detector.{name}", text, {name: value})
    if shape.target_range is None or shape.target_range[0] == 0.0:
        return
    distance = shape.target_range[0]
    axis = np.array([0.0, 0.0, 1.0])
    aside = float(np.linalg.norm(np.cross(np.array(laser.position), axis))) * abs(1.0 - distance / scene.scan.distance)
    spot = laser.beam_radius if laser.profile == "collimated" else math.tan(min(laser.half_angle, 1.5)) * distance
    pixel = scene.camera.pixel_tangent * distance
    if aside > spot + pixel:
        text = (
            f"at {distance:.4g} m the beam is {aside:.3g} m beside what its pixel sees ({pixel:.3g} m wide, the spot's "
            f"radius is {spot:.3g} m): scan.distance makes them cross"
        )
        values = {"aside": aside, "spot": spot, "pixel": pixel}
        yield CheckMessage("warning", "scan.distance", text, values)


def _is_posed(scene: Scene) -> bool:
    return any((*scene.camera.position, *scene.camera.rotation_deg))


def _timing(shape: _Shape) -> Iterator[CheckMessage]:
    scene = shape.scene
    laser, gate, index = scene.laser, scene.gate, scene.medium.group_index
    unambiguous, period_ns = shape.range_of(1.0 / laser.repetition_rate), 1e9 / laser.repetition_rate
    if shape.arrival_ns is not None and shape.arrival_ns[1] > period_ns:
        last = shape.arrival_ns[1]
        text = (
            f"the target returns after up to {last:.5g} ns, later than the next pulse ({period_ns:.5g} ns): the "
            f"unambiguous range is {unambiguous:.4g} m, "
            + ("time wraps" if scene.detector.wrap else "ignored, since detector.wrap is false")
        )
        values = {"unambiguous_range": unambiguous, "last_ns": last, "period_ns": period_ns}
        yield CheckMessage("warning" if scene.detector.wrap else "note", "laser.repetition_rate", text, values)
    if (length := (gate.stop - gate.start) * 1e9) > period_ns * (1 + 1e-9):
        text = f"the gate of {length:.5g} ns is longer than the pulse period, {period_ns:.5g} ns: time wraps within it"
        yield CheckMessage("note", "gate.bins", text, {"gate_ns": length, "period_ns": period_ns})
    if gate.bin_width_ps > shape.irf_fwhm_ps:
        text = (
            f"bin_width_ps = {gate.bin_width_ps:.4g} is coarser than the instrument response, "
            f"{shape.irf_fwhm_ps:.4g} ps: depth is resolved to {shape.range_of(gate.bin_width):.3g} m"
        )
        yield CheckMessage("note", "gate.bin_width_ps", text, {"irf_fwhm_ps": shape.irf_fwhm_ps})
    if index in _INDICES_AT_532_NM and abs(laser.wavelength_nm - 532.0) > 10.0 and _visible(laser):
        salinity = 35.0 * (index == WATER_INDICES["seawater"][1])
        there = group_index(laser.wavelength_nm, salinity=salinity)
        far = shape.target_range[0] if shape.target_range else shape.range_of(gate.stop)
        error = far * (there / index - 1.0)
        text = (
            f"{index} is for 532 nm; at the laser's {laser.wavelength_nm:g} nm it is {there:.4f}: {error:.3f} m at "
            f"{far:.3g} m; medium.temperature takes it from the laser"
        )
        yield CheckMessage("warning", "medium.group_index", text, {"group_index": there, "error": error})
    elif "group_index" not in scene.medium.model_fields_set and not scene.medium.follows_wavelength:
        yield CheckMessage(
            "note", "medium.group_index", f"not given: {index}, seawater at 532 nm, is used for the time of flight"
        )
    elif 1.32 < index < 1.35:
        sea, distance = (
            WATER_INDICES["seawater"][1],
            shape.target_range[0] if shape.target_range else shape.range_of(gate.stop),
        )
        error = distance * (sea / index - 1.0)
        text = (
            f"{index} is a phase index; light pulses travel with the group index, {sea} in seawater and "
            f"{WATER_INDICES['fresh'][1]} in fresh water at 532 nm: {error:.2f} m at {distance:.3g} m in seawater"
        )
        yield CheckMessage("warning", "medium.group_index", text, {"error": error, "distance": distance})


def _water(shape: _Shape) -> Iterator[CheckMessage]:
    medium, transport, laser = shape.scene.medium, shape.scene.transport, shape.scene.laser
    if _visible(laser):
        pure = pure_water_absorption(laser.wavelength_nm)
        for name, water in _named_waters(medium):
            if water.absorption < 0.95 * pure:
                text = f"absorption = {water.absorption:.3g} 1/m is below pure water's {pure:.3g} 1/m"
                values = {"absorption": water.absorption, "pure_water": pure}
                yield CheckMessage("note", f"{name}.absorption", text, values)
    if abs(laser.wavelength_nm - 532.0) > 10.0:
        for name, water in _named_waters(medium):
            if water.preset is not None:
                yield _preset_at_another_wavelength(name, water.preset, laser)
    if medium.layers:
        yield from _molecular_scattering(shape.scene)
    if medium.has_phase_table:
        yield from _phase_function(shape.scene)
    thickest = max(water.extinction for water in medium.waters)
    mean = thickest * shape.scene.path_limit  # collisions along the longest path that counts
    most = mean + 3.0 * math.sqrt(mean)
    cutoff = _cutoff_collisions(shape.scene)
    values = {"path_collisions": mean, "cutoff_collisions": cutoff}
    if transport.max_collisions < min(most, cutoff):
        text = (
            f"max_collisions = {transport.max_collisions} ends histories that the longest path would let collide "
            f"{mean:.3g} times on average, {most:.3g} at most"
        )
        yield CheckMessage("warning", "transport.max_collisions", text, values)
    elif cutoff < min(most, transport.max_collisions):
        text = (
            f"weight_cutoff = {transport.weight_cutoff:g} ends histories after about {cutoff:.0f} collisions, before "
            f"max_collisions = {transport.max_collisions} matters; the longest path allows {mean:.3g} on average "
            f'(termination = "roulette" is without this bias)'
        )
        yield CheckMessage("note", "transport.weight_cutoff", text, values)


def _visible(laser: Laser) -> bool:
    return 400.0 <= laser.wavelength_nm <= 700.0


def _named_waters(medium: Medium) -> Iterator[tuple[str, Medium | Layer]]:
    yield "medium", medium
    for i, layer in enumerate(medium.layers):
        yield f"medium.layers[{i}]", layer


def _preset_at_another_wavelength(name: str, preset: str, laser: Laser) -> CheckMessage:
    text = f"the coefficients of {preset} are for about 532 nm, the laser has {laser.wavelength_nm:g} nm"
    values = {"wavelength_nm": laser.wavelength_nm}
    if _visible(laser):
        values |= {
            "pure_water": pure_water_absorption(laser.wavelength_nm),
            "pure_water_532": pure_water_absorption(532.0),
        }
        text += f", where pure water absorbs {values['pure_water']:.3g} 1/m and not {values['pure_water_532']:.3g}"
    return CheckMessage("warning", f"{name}.preset", text, values)


def _phase_function(scene: Scene) -> Iterator[CheckMessage]:
    """A forward peak narrower than the near-axis rule; a table that leaves most of the light to its power law."""
    law = phase_function(scene.medium)
    snapped = math.acos(scene.transport.axis_threshold)
    within = law.fraction_below(snapped) if snapped > 0.0 else 0.0
    if within > 0.1:
        text = (
            f"axis_threshold = {scene.transport.axis_threshold:g} takes light within {math.degrees(snapped):.3g}° of "
            f"the optical axis for axial, and {100.0 * within:.2g} % of the scattered light turns by less than that; "
            "guided follows the forward peak with axis_threshold = 1 only, else single photons stand out"
        )
        yield CheckMessage("warning", "transport.axis_threshold", text, {"within": within})
    continued = law.fraction_below(law.first_angle) if law.first_angle > 0.0 else 0.0
    if continued > 0.1:
        text = (
            f"begins at {math.degrees(law.first_angle):.3g}°: {100.0 * continued:.2g} % of the scattered light is "
            "below that, where the law between the first two points is continued"
        )
        yield CheckMessage("note", "medium.phase_table", text, {"continued": continued})


def _molecular_scattering(scene: Scene) -> Iterator[CheckMessage]:
    """Water molecules scatter little, but nearly evenly: the phase function of particles misses it straight back."""
    medium = scene.medium
    for name, water in _named_waters(medium):
        if water.chlorophyll is None or medium.phase_function != "henyey_greenstein":
            continue
        optics = water_optics(
            scene.laser.wavelength_nm,
            chlorophyll=water.chlorophyll,
            temperature=20.0 if medium.temperature is None else medium.temperature,
            salinity=35.0 if medium.salinity is None else medium.salinity,
        )
        molecules = optics.water_scattering * float(molecular_density(np.array(2.0)))
        g = medium.anisotropy if water.anisotropy is None else water.anisotropy
        particles = (optics.scattering - optics.water_scattering) * (1.0 - g) / (4.0 * math.pi * (1.0 + g) ** 2)
        missing = molecules / (molecules + particles)
        if missing > 0.1:
            text = (
                f"layers have the phase function of particles alone: {100.0 * missing:.2g} % of what would be "
                "scattered straight back is the water's own and is missing"
            )
            yield CheckMessage("note", f"{name}.chlorophyll", text, {"missing": missing})


def _cutoff_collisions(scene: Scene) -> float:
    """Collisions after which the analog weight is below the cut-off, on average; inf where it never is."""
    transport, albedo = scene.transport, scene.medium.albedo
    if albedo != "lu2024":
        albedo = max(water.scattering / water.extinction for water in scene.medium.waters)
    if transport.termination != "cutoff" or transport.weight_cutoff == 0.0 or albedo == 1.0:
        return math.inf
    if albedo == 0.0:
        return 1.0
    # The mean of ln ω for ω uniform in (0, 0.97) is ln 0.97 − 1.
    step = math.log(0.97) - 1.0 if albedo == "lu2024" else math.log(albedo)
    return max(1.0, math.ceil(math.log(transport.weight_cutoff) / step))


def _statistics(shape: _Shape) -> Iterator[CheckMessage]:
    scene = shape.scene
    size = shape.histogram_bytes
    if size > _MEMORY_LIMIT:
        text = f"the tallies take {size / 2**30:.3g} GiB, and a run on the CPU needs twice that"
        yield CheckMessage("warning", "gate.bins", text, {"bytes": size})
    samples, signal = shape.samples_per_pixel, shape.signal_per_pulse
    if shape.target_range is None or samples is None or signal is None:
        return
    depth = shape.optical_depth or 0.0
    text = (
        f"optical depth to the nearest lit point {depth:.3g} one way ({shape.target_range[0]:.4g} m); a pixel on the "
        f"beam's axis detects {signal:.3g} unscattered photons a pulse"
    )
    yield CheckMessage("note", "medium.extinction", text, {"optical_depth": depth, "signal_per_pulse": signal})
    if signal > 0.05:
        text = f"{signal:.3g} target detections per pulse and pixel: first-photon counting piles up"
        yield CheckMessage("note", "laser.pulse_energy", text, {"signal_per_pulse": signal})
    if scene.transport.estimator == "analog":
        emitted = scene.transport.photons / scene.scan_positions
        photons = signal * emitted / (scene.laser.photons_per_pulse * scene.detector.pde or math.inf)
        if photons < 10.0:
            text = (
                f"analog: only about {photons:.2g} of {scene.transport.photons:.3g} photons reach a pixel unscattered"
            )
            yield CheckMessage("warning", "transport.estimator", text, {"photons_per_pixel": photons})
    elif samples < 10.0:
        text = f"only about {samples:.2g} of {scene.transport.photons:.3g} photons reach what a pixel sees unscattered"
        yield CheckMessage("warning", "transport.photons", text, {"samples_per_pixel": samples})


def _angles(points: Points, laser: Laser) -> Points:
    """Angles [rad] of the points against the beam's axis, seen from the laser."""
    away = points - np.array(laser.position)
    along = away @ np.array(laser.axis)
    return np.arctan2(np.linalg.norm(away - along[:, None] * np.array(laser.axis), axis=1), along)


def _beam_text(laser: Laser) -> str:
    if laser.profile == "collimated":
        return f"the beam is parallel with a radius of {laser.beam_radius:.3g} m"
    if laser.profile == "measured":
        wide, tall = (math.degrees(math.atan(tangent)) for tangent in profile_extent(laser))
        return f"the beam's image spans ±{wide:.3g}° and ±{tall:.3g}°"
    return f"the beam's half angle is {laser.half_angle_deg:.3g}°"


def _span(low: float, high: float) -> str:
    return f"{low:.4g} to {high:.4g}"


def _vector(values: Any) -> str:
    return "(" + ", ".join(f"{value:.4g}" for value in values) + ")"
