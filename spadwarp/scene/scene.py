"""A scene of all its sections, its file, what follows from several sections; and scenes that move."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import Floats
from spadwarp.io.paths import MESH_ENDINGS, example_or_path, used
from spadwarp.io.text import csv_lines, read_text, read_toml
from spadwarp.scene import settings
from spadwarp.scene.camera import Camera, pixel_directions, to_camera, to_world
from spadwarp.scene.laser import Laser, spectral_lines
from spadwarp.scene.medium import Medium, phase_function
from spadwarp.scene.port import Port, PortGeometry
from spadwarp.scene.pose import rotation_angles, rotation_matrix, turned, unit_vector, vector_of
from spadwarp.scene.sea import Surface
from spadwarp.scene.sections import Document, Overrides
from spadwarp.values import ArgumentError, ConfigError, FileError, Shown, check_integer, check_real, read_real, shown

__all__ = ["Scene", "SceneLike", "Shots", "Trajectory", "as_scene", "load_scene", "load_trajectory"]
__all__ += ["shot_at", "shot_scene", "shots_of", "template", "water_lines"]

# What the light has met.
Component = Literal["ballistic", "forward_scattered", "backscatter", "surface"]

_DOWNWARDS = 0.999  # Cosine with the vertical, of the normal of a surface.


class Scene(Shown, Document):
    """Everything a run depends on, checked and frozen."""

    medium: Medium
    laser: Laser = Laser()
    camera: Camera
    scan: settings.Scan = settings.Scan()
    detector: settings.Detector = settings.Detector()
    gate: settings.Gate
    surface: Surface | None = None
    daylight: settings.Daylight | None = None
    targets: tuple[settings.Target, ...] = ()
    domain: settings.Domain = settings.Domain()
    sun: settings.Sun | None = None
    flux: tuple[settings.Flux, ...] = ()
    transport: settings.Transport = settings.Transport()
    output: settings.Output = settings.Output()
    analytic: settings.Analytic = settings.Analytic()

    def _problems(self) -> Iterator[str]:
        try:  # the water that the laser's light meets
            self.__dict__["medium"] = self.medium.at_wavelength(self.laser.wavelength_nm)
        except ValueError as error:
            yield f"laser.{error}, for which medium.chlorophyll, temperature and salinity hold"
        if self.polarised or self.surface is not None:
            self._take_exact_directions()
        yield from self._exclusions()
        yield from self._scan_problems()
        yield from self._blocked_ports()
        yield from self._flux_exclusions()
        if self.surface is not None:
            yield from self._at_the_surface(self.surface)

    def _take_exact_directions(self) -> None:
        """Sets what polarised light, or the surface of a sea, needs where the defaults are without it."""
        medium, transport = self.medium, self.transport
        if transport.axis_threshold == settings.Transport().axis_threshold:
            self.__dict__["transport"] = transport.model_copy(update={"axis_threshold": 1.0})
        if self.polarised and medium.scattering_matrix == "none" and medium.range.scattering > 0.0:
            matrix = "rayleigh" if medium.phase_function == "rayleigh" else "voss_fry"
            self.__dict__["medium"] = medium.model_copy(update={"scattering_matrix": matrix})

    def _exclusions(self) -> Iterator[str]:
        """Why sections exclude each other."""
        medium, transport, goes = self.medium, self.transport, "does not go with"
        if self.camera.pinhole and transport.estimator == "analog":
            yield (
                f"camera.pinhole = true {goes} transport.estimator = 'analog', whose photons cannot hit a point: take "
                "a small aperture_diameter, or next_event or guided"
            )
        if self.domain.reflecting and math.isfinite(limit := transport.lateral_limit):
            yield f"transport.lateral_limit = {limit} {goes} domain.outside_index: faces reflect light from beyond it"
        if self.daylight is not None and medium.layers:
            yield f"medium.layers: {len(medium.layers)} given; daylight takes one water"
        if self.daylight is not None and medium.grid is not None:
            yield f"medium.grid {goes} daylight, which takes one water: leave one of them out"
        exact = {"polarised light": self.polarised, "flux": bool(self.flux), "surface": self.surface is not None}
        for name in (name for name, needs in exact.items() if needs and transport.axis_threshold < 1.0):
            yield f"transport.axis_threshold = {transport.axis_threshold} {goes} {name}: set 1, for exact directions"
        if medium.inelastic and self.polarised:
            yield f"medium.inelastic {goes} polarised light: leave one of them out"
        parts = [one.in_waters(medium.waters, self.laser.wavelength_nm) for one in medium.inelastic]
        for water, *taken in zip(medium.waters, *parts, strict=True) if parts else ():
            if (lost := math.fsum(row[0] for row in taken)) > water.absorption or water.scattering <= 0.0:
                yield (
                    f"medium.inelastic takes {lost:g} 1/m from absorption = {water.absorption:g}, beside scattering = "
                    f"{water.scattering:g}: it can take no more than that, in water that scatters"
                )
        for k, target in enumerate(self.targets if self.polarised else ()):
            if target.specular > 0.0 and abs(target.specular_index / medium.phase_index - 1.0) < 1e-3:
                yield (
                    f"targets[{k}].specular_index = {target.specular_index} is that of the water, "
                    f"{medium.phase_index:.4g}: such facets reflect nothing"
                )

    def _flux_exclusions(self) -> Iterator[str]:
        """Why flux is not tallied, or not what it seems."""
        transport, names, sun, medium = self.transport, [section.name for section in self.flux], self.sun, self.medium
        estimator = f"transport.estimator = {transport.estimator!r}"
        if len(set(names)) < len(names):
            yield f"flux: the names {', '.join(names)} are not all different"
        if self.flux and transport.estimator in ("analog", "guided"):
            yield (
                f"{estimator} does not go with flux, whose balance with absorption holds for light that nothing guides:"
                " take 'next_event', or 'none' for flux alone"
            )
        if self.flux and (self.polarised or isinstance(medium.albedo, str)):
            yield "flux goes neither with polarised light nor with a random albedo"
        if transport.estimator == "none" and not self.flux:
            yield f"{estimator} tallies nothing without [[flux]]"
        if sun is None:
            return
        if transport.estimator != "none" or self.scan.mode != "none":
            yield f"{estimator}: [sun] is for [[flux]] alone, with 'none', and without a scan"
        if self.surface is None:
            yield "sun needs [surface], through which its light comes"
            return
        up = np.abs(self.surface.normal)
        bounds = [side[j] for side in self.domain.bounds for j in range(3) if up[j] < _DOWNWARDS]
        if any(map(math.isfinite, [*bounds, transport.lateral_limit])):
            yield "sun: the domain and transport.lateral_limit bound the water along the surface; take inf there"
        if medium.layers and float(up @ np.abs(unit_vector(medium.layer_axis))) < _DOWNWARDS:
            yield "sun: water that varies along the surface; layers across it are allowed"

    def _scan_problems(self) -> Iterator[str]:
        """Why a scan along a trajectory excludes settings of other sections."""
        if self.scan.mode != "trajectory":
            return
        camera, laser, needs = self.camera, self.laser, "does not go with scan.mode = 'trajectory'"
        found = {
            f"scan.distance = {self.scan.distance}": math.isfinite(self.scan.distance),
            "camera.port or laser.port": camera.port is not None or laser.port is not None,
            f"camera.distortion = {list(camera.distortion)}": any(camera.distortion),
            "camera.cx or cy": (camera.cx, camera.cy) != (None, None),
            "polarised light": self.polarised,
            "daylight": self.daylight is not None,
            "domain.outside_index": bool(self.domain.reflecting),
            f"transport.lateral_limit = {self.transport.lateral_limit}": math.isfinite(self.transport.lateral_limit),
        }
        yield from (f"{name} {needs}" for name, holds in found.items() if holds)
        if laser.frame == "world":
            yield f"laser.frame = 'world' {needs}: the laser moves with the camera, in whose frame it stands"

    def _blocked_ports(self) -> Iterator[str]:
        """Why light cannot pass the ports, or cannot be computed through them."""
        camera, laser = self.camera.port, self.laser.port
        if laser == "camera" and camera is None:
            yield "laser.port = 'camera' needs a camera.port, such as camera.port.preset = 'flat-glass'"
        if camera is not None and camera.shape == "flat" and camera.axis[2] <= 0.0:
            yield f"camera.port.normal = {list(camera.normal)} points away from the view, which is along +z"
        for section, port in (("camera", camera), ("laser", laser)):
            try:
                _ = isinstance(port, Port) and port.indices(self.laser.wavelength_nm)
            except ValueError as error:
                yield f"{section}.port.{error}"
        is_surface = camera is not None and camera.shape == "flat" and not camera.thickness
        if self.daylight is not None and camera is not None and is_surface:
            normal = rotation_matrix(self.camera.rotation_deg) @ camera.axis
            if self.daylight.down @ normal > _DOWNWARDS:
                yield (
                    "daylight does not go with a camera.port that is the surface, seen from above: the sky that it "
                    "reflects is not modelled"
                )
        if self.scan.mode == "confocal" and (camera is not None or laser is not None):
            if laser != "camera":
                yield "scan.mode = 'confocal' behind a port needs laser.port = 'camera': one port for both"
            if math.isfinite(self.scan.distance):
                yield (
                    f"scan.distance = {self.scan.distance} does not go with a port, behind which beam and line of "
                    "sight can be parallel alone: inf"
                )
        through, position = camera_port(self), list(self.beam.position)
        if through is not None and (why := through.outside((0.0, 0.0, 0.0))):
            yield f"camera.port: the lens is outside: {why}; change offset or radius"
        if (through := laser_port(self)) is not None and (why := through.outside(position)):
            is_shared = laser == "camera"
            hint = "move the laser, or give it a port of its own: [laser.port]" if is_shared else "change it"
            yield f"laser.position = {position} is outside laser.port: {why}; {hint}"

    def _at_the_surface(self, surface: Surface) -> Iterator[str]:
        """Why light cannot be followed through the surface of the sea."""
        for field, found in {
            "camera.port, a table": self.camera.port is not None,
            "laser.port, a table": self.laser.port is not None,
            "domain.outside_index, a table": bool(self.domain.reflecting),
            "daylight, a table": self.daylight is not None,
            "medium.grid, a table": self.medium.grid is not None,
            f"scan.mode = {self.scan.mode!r}": self.scan.mode == "confocal",
        }.items():
            if found:
                yield f"{field}: cannot be combined with surface"
        if surface.is_flat and surface.height_of(self.camera.position) < 0.0 and self.sun is None:
            yield (
                "surface.mean_square_slope = 0 does not go with a camera in the water: a flat surface seen from below "
                "is a face of the domain with an outside_index"
            )
        if surface.air(self.laser.wavelength_nm)[0] >= self.medium.phase_index:
            yield f"medium.phase_index = {self.medium.phase_index} is not above that of the air"

    @property
    def scan_positions(self) -> int:
        """Positions of the beam: photon i is emitted at position i modulo this number."""
        width = 1 if self.scan.mode == "trajectory" and self.scan.pattern == "push_broom" else self.camera.width
        return 1 if self.scan.mode == "none" else width * self.camera.height

    @property
    def receiver(self) -> Camera:
        """The camera as one shot has it: of a scan along a trajectory one pixel or, of an array, a row of them."""
        if self.scan.mode != "trajectory":
            return self.camera
        width = self.camera.width if self.scan.pattern == "push_broom" else 1
        return self.camera.model_copy(update={"width": width, "height": 1})

    def unseen_peak(self, photons: float, ranges: ArrayLike = ()) -> tuple[float, float]:
        """The forward peak that so many photons hardly see: `PhaseFunction.unseen_share` of the directions in which
        the estimator looks for the lens. Those of `next_event` are anywhere; `guided` with a table aims at points of
        the lens, each drawn apart from the light that flies into it, here from the nearest of `ranges` [m] that is
        finite, else the middle of the gate. 0 for all others. Of layers and cells with an own g the largest share.

        Raises what `phase_function` raises.
        """
        directions, estimator = photons / self.scan_positions, self.transport.estimator
        if estimator in ("analog", "none") or (estimator == "guided" and not self.medium.has_phase_table):
            return 0.0, 0.0
        if estimator == "guided":
            middle = 0.25 * self.medium.pulse_speed * (self.gate.start + self.gate.stop)
            distance = min(np.extract(np.isfinite(ranges), ranges), default=middle)
            directions /= math.sin(0.5 * math.atan2(self.camera.aperture_radius, distance)) ** 2
        try:
            laws = self.medium.phase_functions
        except FileError:  # the file of the cells is gone
            laws = [phase_function(self.medium)]
        return max((law.unseen_share(directions) for law in laws), key=lambda found: found[1])

    def unseen_warning(self, photons: float, angle: float, unseen: float) -> str:
        """The sentence on what `unseen_peak` found."""
        estimator = self.transport.estimator
        return (
            f"{estimator}: up to {100.0 * unseen:.2g} % of the scattered light is of a forward peak, below "
            f"{math.degrees(angle):.2g}°, that {photons:.3g} photons hardly see: it is missing as a rule, and not in "
            f"standard errors; what helps: more photons{', guided' if estimator == 'next_event' else ''}"
        )

    @property
    def beam(self) -> Laser:
        """The laser with position and direction in the camera frame."""
        laser, camera = self.laser, self.camera
        if laser.frame == "camera" or not camera.is_posed:
            return laser
        position, axis = to_camera(camera, laser.position), laser.axis @ rotation_matrix(camera.rotation_deg)
        moved = {"position": vector_of(position), "direction": vector_of(axis), "frame": "camera"}
        return laser.model_copy(update=moved)

    @property
    def components(self) -> tuple[Component, ...]:
        """Parts of the light in the order of a result's tallies: `"surface"` is there with a surface of the sea."""
        return get_args(Component)[: 3 if self.surface is None else 4]

    @property
    def has_straight_sight(self) -> bool:
        """Whether unscattered light has one known way, to a lens at rest: `spadwarp.reconstruct` needs it."""
        return self.surface is None and self.scan.mode != "trajectory"

    @property
    def tallied_channels(self) -> tuple[str, ...]:
        """Channels with tallies of their own: of polarised light, but for its intensity, which is the histogram, or of
        light at other wavelengths."""
        own = (name for name in self.camera.channels if name != "I")
        others = (one.process for one in self.medium.inelastic)
        return (*own, *others, *(f"line {k + 1}" for k in range(len(self.medium.beside))))

    @property
    def polarised(self) -> bool:
        """Whether light is polarised: the laser's, what water scatters, or as far as the camera can tell."""
        chosen = (self.laser.polarisation, self.medium.scattering_matrix, self.camera.polarisation)
        return any(one != "none" for one in chosen)

    @property
    def detections_per_photon(self) -> float:
        """Detections for each photon of a pulse that reaches a pixel: PDE, times what the filter passes.

        Photons are counted as if the pulse had the one wavelength `laser.wavelength_nm`. Raises `FileError` or
        `ConfigError` if the table of a spectrum or a filter cannot be read.
        """
        return self.detector.pde * math.fsum(line.share for line in spectral_lines(self.laser, self.detector))

    @property
    def detectable_photons_per_pulse(self) -> float:
        """Expected detections of a pulse if all of its photons reached pixels [1]; a fraction that arrives, as in a
        histogram, times this is the expected detections per pulse. Raises as `detections_per_photon` does."""
        return self.laser.photons_per_pulse * self.detections_per_photon

    @property
    def pulses_per_depth_frame(self) -> int:
        """Pulses of one depth frame of the analytic model: `analytic.pulses_per_depth_frame`, else those of the
        detector's frame."""
        return self.analytic.pulses_per_depth_frame or self.detector.pulses_per_frame

    def optical_depth(self, begin: ArrayLike, end: ArrayLike) -> Any:
        """∫c ds along straight lines between points of the camera frame `[..., 3]` [m]."""
        if self.medium.varies and self.camera.is_posed:
            begin, end = (to_world(self.camera, point) for point in (begin, end))
        return self.medium.optical_depth(begin, end)

    @property
    def path_limit(self) -> float:
        """Longest geometric path that counts [m]: `transport.max_path` or the gate's end, whichever is shorter."""
        gate_end = self.gate.stop * self.medium.pulse_speed
        return min(self.transport.max_path or gate_end, gate_end)

    def __repr__(self) -> str:
        name = self.source.stem if self.source else "Python"
        targets = ", ".join(target.builtin or Path(target.mesh or "").name for target in self.targets[:3])
        targets += f" and {len(self.targets) - 3} more" if len(self.targets) > 3 else ""
        camera, gate = self.camera, self.gate
        return (
            f"Scene({name}: {targets or 'no target'}, extinction {self.medium.extinction:.4g} 1/m, "
            f"{camera.width} x {camera.height} pixels x {gate.bins} bins)"
        )

    __str__ = __repr__


SceneLike = Scene | str | os.PathLike[str]


def as_scene(scene: SceneLike) -> Scene:
    """A scene as it is, or that of a file. Raises `ArgumentError` for anything else, and what `load_scene` raises."""
    if isinstance(scene, str | os.PathLike):
        return load_scene(scene)
    if not isinstance(scene, Scene):
        raise ArgumentError(f"scene = {shown(scene)} is neither a Scene nor the path of a scene file")
    return scene


def load_scene(path: str | os.PathLike[str], overrides: Overrides | None = None) -> Scene:
    """Read a scene file, or by a bare name a scene that comes with the package: `load_scene("staircase_5m")`.

    `overrides` lie over the file: `["medium.extinction=0.9"]`, `{"medium.extinction": 0.9}` or nested mappings, None
    for a field's default; `"targets[0].translation[2]=9"` sets one item of a list. A medium is given by two
    coefficients; overriding one keeps another: extinction keeps the albedo, albedo the extinction, absorption the
    scattering, scattering the absorption; overriding two replaces both. Relative paths start at the file's folder,
    those in overrides at the working directory.
    Raises `FileError` if the file cannot be read, `ConfigError` with a line for each problem in it.
    """
    path = example_or_path(path, "scenes")
    if path.is_dir():
        run = path / "scene.toml"
        raise FileError(f"{path}: a directory, not a scene" + (f"; that of its run is {run}" if run.is_file() else ""))
    if path.suffix.lower() in (*MESH_ENDINGS, ".h5", ".hdf5") and path.is_file():
        raise FileError(f"{path}: not a scene{used(path)}")
    return Scene.from_dict(read_toml(path), overrides=overrides, source=path)


def template() -> str:
    """The text of a commented scene to start from."""
    return read_text(Path(__file__).with_name("template.toml"))


def water_lines(scene: Scene) -> list[tuple[float, Medium]]:
    """Lines of a pulse that pass the filter: their photons, over those of a pulse of one line at `laser.wavelength_nm`,
    and the medium as they meet it; one line where nothing of the water follows the wavelength.

    Raises `FileError` or `ConfigError` for a table, and `ConfigError` for a spectrum beyond where the water is known.
    """
    medium, lines = scene.medium, spectral_lines(scene.laser, scene.detector)
    if len(lines) == 1 or not medium.follows_wavelength:
        return [(math.fsum(line.share for line in lines), medium)]
    try:
        return [(line.share, medium.at_wavelength(line.wavelength_nm)) for line in lines]
    except ArgumentError as error:
        text = "laser: the spectrum reaches beyond where medium.chlorophyll, temperature and salinity hold"
        raise ConfigError(f"{text}: {error}", source=scene.source) from None


def camera_port(scene: Scene) -> PortGeometry | None:
    """The port that a scene's camera looks through, or the mean plane of the sea below it; None: it is in the water."""
    port = scene.camera.port
    if scene.surface is not None:
        above = scene.sun is None and scene.surface.height_of(scene.camera.position) > 0.0
        return mean_plane(scene) if above else None
    return None if port is None else _placed(scene, port, np.zeros(3), np.array(port.axis))


def laser_port(scene: Scene) -> PortGeometry | None:
    """The port that a scene's laser shines through, or the mean plane of the sea below it; None: it is in the water."""
    port = scene.laser.port
    if scene.surface is not None:
        place = vector_of(to_world(scene.camera, scene.beam.position))
        return mean_plane(scene) if scene.surface.height_of(place) > 0.0 else None
    if not isinstance(port, Port):
        return None if port is None else camera_port(scene)
    normal = np.array(port.axis)
    if scene.laser.frame == "world" and scene.camera.is_posed:
        normal = normal @ rotation_matrix(scene.camera.rotation_deg)
    return _placed(scene, port, np.array(scene.beam.position), normal)


def mean_plane(scene: Scene, *, from_below: bool = False) -> PortGeometry:
    """The mean plane of the scene's surface as a port without a window, from the air into the water or back."""
    surface, camera, medium = scene.surface, scene.camera, scene.medium
    assert surface is not None
    down = -np.array(surface.normal) @ rotation_matrix(camera.rotation_deg)
    height = surface.height_of(camera.position)
    air, water = surface.air(scene.laser.wavelength_nm), (medium.phase_index, medium.group_index)
    before, behind, sign = (water, air, -1.0) if from_below else (air, water, 1.0)
    index, group_index = zip(before, before, behind, strict=True)
    return PortGeometry("flat", sign * height, vector_of(sign * down), 0.0, (0.0,) * 3, 0.0, index, group_index)


def _placed(scene: Scene, port: Port, origin: Any, normal: Any) -> PortGeometry:
    """A port with its lengths from an origin, and its normal, in the frame of the camera."""
    water = scene.medium.phase_index, scene.medium.group_index
    index, group_index = zip(*port.indices(scene.laser.wavelength_nm), water, strict=True)
    distance, radius = (port.distance or 0.0) + float(origin @ normal), port.radius or 0.0
    ends = vector_of(normal), vector_of(origin + port.offset)
    return PortGeometry(port.shape, distance, ends[0], radius, ends[1], port.thickness, index, group_index)


# Scenes that move

_MOST_ROWS = 1_000_000


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory:
    """Values of fields of a scene at ascending times."""

    times: NDArray[np.float64]  # [s], `[N]`
    fields: tuple[str, ...]  # as overrides name them, such as `camera.position[0]` or `targets[1].translation[2]`
    values: NDArray[np.float64]  # `[N, fields]`, in the units of the fields
    source: str | None = None  # the file that they came from

    def __len__(self) -> int:
        return len(self.times)

    def scene(self, base: Scene, row: int) -> Scene:
        """The scene at a row. Raises `ConfigError` for a field that it does not have, or a value out of range."""
        try:
            return base.with_overrides(dict(zip(self.fields, map(float, self.values[row]), strict=True)))
        except ConfigError as error:
            place = f"row {row + 1}, time {self.times[row]:g} s"
            raise ConfigError([f"{place}: {text}" for text in error.problems], source=self.source) from None

    def scenes(self, base: Scene) -> Iterator[Scene]:
        """The scene at each row."""
        return (self.scene(base, row) for row in range(len(self)))

    def sampled(self, frame_rate: float) -> Trajectory:
        """The trajectory at even times from its first to its last, `frame_rate` a second.

        Values in between are linear; the three angles of a `rotation_deg` together are those of the shortest turn.
        """
        check_real("frame_rate", frame_rate, "[1e-6, 1e12] Hz")
        span = float(self.times[-1] - self.times[0])
        count = int(span * frame_rate * (1 + 1e-12)) + 1
        check_integer("frames of the trajectory", count, f"[1, {_MOST_ROWS}]")
        times = np.minimum(self.times[0] + np.arange(count) / frame_rate, self.times[-1])
        values = np.stack([np.interp(times, self.times, column) for column in self.values.T], axis=1)
        for name in self.fields if len(self) > 1 else ():
            angles = [f"{name[:-3]}[{axis}]" for axis in range(3)]
            if name.endswith("rotation_deg[0]") and set(angles) <= set(self.fields):
                columns = [self.fields.index(angle) for angle in angles]
                turns = turned(times, self.times, self.values[:, columns])
                values[:, columns] = [rotation_angles(turn) for turn in turns]
        return Trajectory(times=times, fields=self.fields, values=values, source=self.source)


def load_trajectory(path: str | os.PathLike[str]) -> Trajectory:
    """Reads a .csv file: a line of names, `time` [s] first and then fields of the scene, and a row for each pose.

    Fields are named as `--set` names them, with one number each: `camera.position[0]`, `camera.rotation_deg[1]`,
    `laser.position[2]`, `targets[0].translation[2]`. Lines that begin with # are passed over. Raises `FileError` if the
    file cannot be read, `ConfigError` for no such table, a number that is not finite, or times that do not ascend.
    """
    rows: list[list[float]] = []
    with csv_lines(path) as lines:
        names = tuple(cell.strip() for cell in next(lines, [""]))
        if names[0] != "time" or len(names) < 2:
            needed = "time and names of fields, such as time,camera.position[0]"
            raise ValueError(f"{shown(','.join(names))} is not {needed}")
        if twice := next((name for name in names if names.count(name) > 1), None):
            raise ValueError(f"{shown(twice)} is there twice")
        for cells in lines:
            if len(cells) != len(names):
                raise ValueError(f"{len(cells)} values for {len(names)} names")
            row = [read_real(name, cell, "[-1e19, 1e19]") for name, cell in zip(names, cells, strict=True)]
            if rows and not row[0] > rows[-1][0]:
                raise ValueError(f"time = {row[0]:g} is not after {rows[-1][0]:g}")
            rows.append(row)
            if len(rows) > _MOST_ROWS:
                raise ValueError(f"more than {_MOST_ROWS} rows")
        if not rows:
            raise ValueError("no row of numbers")
    table = np.array(rows, np.float64)
    return Trajectory(times=table[:, 0], fields=names[1:], values=table[:, 1:], source=str(Path(path)))


# Scans along a trajectory: when and where each shot is, and what it sees

_POSE = tuple(f"camera.{name}[{axis}]" for name in ("position", "rotation_deg") for axis in range(3))


@dataclass(frozen=True, eq=False, kw_only=True)
class Shots:
    """The shots of a scan along a trajectory, in the order of its image's rows; R points of a receiver each."""

    time: Floats  # of each shot from the first one on [s], `[N]`
    position: Floats  # of the lens in the world [m], `[N, 3]`
    rotation: Floats  # axes of camera and laser in the world, as columns, `[N, 3, 3]`
    view: Floats  # unit vectors of the receiver's pixels in the camera's frame, `[R, 3]`
    shape: tuple[int, int]  # of the image: N·R pixels

    def __len__(self) -> int:
        return len(self.time)

    @property
    def number(self) -> NDArray[np.int64]:
        """The shot of each pixel, `[H, W]`."""
        return np.repeat(np.arange(len(self)), len(self.view)).reshape(self.shape)

    def lines(self) -> tuple[Floats, Floats]:
        """Where each pixel's line of sight begins in the world [m], and its unit vector, both `[H, W, 3]`."""
        start = np.repeat(self.position, len(self.view), axis=0)
        along = np.einsum("nij,rj->nri", self.rotation, self.view)
        return start.reshape(*self.shape, 3), along.reshape(*self.shape, 3)

    def aside(self, point: Floats) -> Floats:
        """By how far the axis of each shot passes a point of the world [m], `[N]`."""
        to_point, axis = point - self.position, self.rotation[:, :, 2]
        along = np.maximum((to_point * axis).sum(axis=1), 0.0)
        return np.linalg.norm(to_point - along[:, None] * axis, axis=1)


def shots_of(scene: Scene) -> Shots:
    """When and where each shot of a scan along a trajectory is.

    A shot takes `detector.pulses_per_frame` pulses. The platform flies by `scan.velocity`, or as the file `scan.path`
    says: linear in between, attitudes by the shortest turn. The pattern turns the camera's axis in the plane of both
    directions, without a turn of the image about it.

    Raises `ArgumentError`: the scene has no such scan; `FileError` or `ConfigError`: the file of the trajectory cannot
    be read, holds another field than the camera's pose, or ends before the last shot.
    """
    if scene.scan.mode != "trajectory":
        raise ArgumentError(f"scan.mode = {scene.scan.mode!r}; 'trajectory' is needed")
    count, camera = scene.scan_positions, scene.camera
    time: Floats = np.arange(count, dtype=np.float64) * (scene.detector.pulses_per_frame / scene.laser.repetition_rate)
    if scene.scan.path is None:
        position = np.asarray(camera.position) + time[:, None] * np.asarray(scene.scan.velocity)
        platform = np.broadcast_to(rotation_matrix(camera.rotation_deg), (count, 3, 3))
    else:
        position, platform = _platform(scene, time)
    return Shots(
        time=time,
        position=position,
        rotation=platform @ _deflections(scene, count),
        view=pixel_directions(scene.receiver)[0],
        shape=(camera.height, camera.width),
    )


def _platform(scene: Scene, time: Floats) -> tuple[Floats, Floats]:
    """Positions and attitudes by the file of a trajectory; what it lacks is the camera's own."""
    flown = load_trajectory(str(scene.scan.path))
    if other := [name for name in flown.fields if name not in _POSE]:
        raise ConfigError(f"{other[0]} is no part of the camera's pose: {', '.join(_POSE)}", source=flown.source)
    at, last = flown.times[0] + time, float(flown.times[0] + time[-1])
    if last > flown.times[-1]:
        text = f"time = {flown.times[-1]:g} is the last, and the last shot is at {last:g} s"
        raise ConfigError(text, source=flown.source)
    columns = dict(zip(flown.fields, flown.values.T, strict=True))
    own = dict(zip(_POSE, (*scene.camera.position, *scene.camera.rotation_deg), strict=True))
    pose = np.stack([columns.get(name, np.full(len(flown), own[name])) for name in _POSE], axis=1)
    position = np.stack([np.interp(at, flown.times, values) for values in pose[:, :3].T], axis=1)
    return position, turned(at, flown.times, pose[:, 3:])


def _deflections(scene: Scene, count: int) -> Floats:
    """Rotations from the frame of each shot to that of the platform, `[N, 3, 3]`."""
    scan, width = scene.scan, scene.camera.width
    turn = np.arange(count) / width  # rows that have gone by
    azimuth, edge = 2.0 * math.pi * turn, math.tan(math.radians(scan.half_angle_deg))
    x, y = np.zeros(count), np.zeros(count)
    if scan.pattern == "raster":
        part = 2.0 * (np.arange(count) % width + 0.5) / width - 1.0
        x = np.tan(math.radians(scan.half_angle_deg) * part)
    elif scan.pattern in ("conical", "elliptic"):
        along = scan.half_angle_deg if scan.pattern == "conical" else scan.half_angle_y_deg
        x, y = edge * np.cos(azimuth), math.tan(math.radians(along)) * np.sin(azimuth)
    elif scan.pattern == "rosette":
        other = -scan.rosette_ratio * azimuth
        x, y = (0.5 * edge * (of(azimuth) + of(other)) for of in (np.cos, np.sin))
    axis = np.stack([x, y, np.ones(count)], axis=1)
    axis /= np.linalg.norm(axis, axis=1, keepdims=True)
    # By Rodrigues' formula about z × axis, of sine |z × axis| and cosine axis_z.
    cross = np.zeros((count, 3, 3))
    cross[:, 0, 2], cross[:, 1, 2] = axis[:, 0], axis[:, 1]
    cross -= cross.transpose(0, 2, 1)
    return np.eye(3) + cross + cross @ cross / (1.0 + axis[:, 2, None, None])


def shot_scene(scene: Scene, shot: int) -> Scene:
    """The scene of one shot alone: laser and camera stand where they are then.

    Raises `ArgumentError` for a shot that there is not, and what `shots_of` raises.
    """
    shots = shots_of(scene)
    at = check_integer("shot", shot, f"[0, {len(shots) - 1}]")
    receiver = scene.receiver
    pose = {"position": vector_of(shots.position[at]), "rotation_deg": rotation_angles(shots.rotation[at])}
    size = {"width": receiver.width, "height": 1}
    return scene.with_overrides({"camera": {**size, **pose}, "scan": dict.fromkeys(type(scene.scan).model_fields)})


def shot_at(scene: Scene, points: Sequence[Floats]) -> Scene:
    """The scene of the shot, alone and with its part of the photons, whose axis passes nearest to one of some points of
    the world; without points the first."""
    shots, photons = shots_of(scene), scene.transport.photons
    passes = [shots.aside(point) for point in points] or [np.zeros(len(shots))]
    best = min((aside.min(), int(aside.argmin())) for aside in passes)[1]
    share = photons if isinstance(photons, str) else max(photons // scene.scan_positions, 1)
    return shot_scene(scene, best).with_overrides({"transport.photons": share})
