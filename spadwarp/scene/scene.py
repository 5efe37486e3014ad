"""A scene of all its sections, the file that it comes from, and what follows from several sections."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, NamedTuple, Self

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, PrivateAttr, ValidationError, model_validator

from spadwarp.errors import ArgumentError, ConfigError, FileError
from spadwarp.io.paths import MESH_ENDINGS, example_or_path, used
from spadwarp.io.text import parse_toml, read_toml
from spadwarp.limits import shown
from spadwarp.scene.camera import Camera, to_camera, to_world
from spadwarp.scene.detector import Detector
from spadwarp.scene.laser import Laser
from spadwarp.scene.medium import Medium
from spadwarp.scene.messages import describe
from spadwarp.scene.port import Port, PortGeometry
from spadwarp.scene.pose import rotation_matrix, vector_of
from spadwarp.scene.scattering import check_polarisation
from spadwarp.scene.sections import listed, plain, with_paths, with_units
from spadwarp.scene.settings import Analytic, Gate, Output, Scan, Transport
from spadwarp.scene.spectrum import detection_efficiency, spectral_lines
from spadwarp.scene.surroundings import Daylight, Domain, Target
from spadwarp.scene.tables import Key, merge_scene, override_layer, set_item, toml_text
from spadwarp.units import path_from_time

__all__ = ["Scene", "SceneLike", "WaterLine", "as_scene", "load_scene", "template", "water_lines"]

Overrides = Mapping[str, Any] | Sequence[str]

_DOWNWARDS = 0.999  # Cosine with the vertical, of the normal of a surface.


class Scene(BaseModel):
    """Everything a run depends on, checked and frozen."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    medium: Medium
    laser: Laser = Laser()
    camera: Camera
    scan: Scan = Scan()
    detector: Detector = Detector()
    gate: Gate
    daylight: Daylight | None = None
    targets: Annotated[tuple[Target, ...], BeforeValidator(listed)] = ()
    domain: Domain = Domain()
    transport: Transport = Transport()
    output: Output = Output()
    analytic: Analytic = Analytic()
    _source: Path | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _water_at_the_lasers_wavelength(self) -> Self:
        try:
            self.__dict__["medium"] = self.medium.at_wavelength(self.laser.wavelength_nm)
        except ValueError as error:
            raise ValueError(f"laser.{error}, for which medium.chlorophyll, temperature and salinity hold") from None
        return self

    @model_validator(mode="after")
    def _sections_that_agree(self) -> Self:
        camera, daylight, layers = self.camera, self.daylight, self.medium.layers
        if camera.pinhole and self.transport.estimator == "analog":
            raise ValueError(
                "camera.pinhole = true does not go with transport.estimator = 'analog', whose photons cannot hit a "
                "point: take a small aperture_diameter, or next_event or guided"
            )
        if self.domain.reflecting and math.isfinite(limit := self.transport.lateral_limit):
            raise ValueError(
                f"transport.lateral_limit = {limit} does not go with domain.outside_index: the faces reflect light "
                "from beyond it"
            )
        if daylight is not None and layers:
            raise ValueError(f"medium.layers: {len(layers)} given; daylight takes one water")
        if daylight is not None and self.medium.grid is not None:
            raise ValueError("medium.grid does not go with daylight, which takes one water: leave one of them out")
        if self.polarised:
            check_polarisation(self.medium, self.transport, self.targets)
        return self

    @model_validator(mode="after")
    def _ports_that_light_can_pass(self) -> Self:
        camera, laser = self.camera.port, self.laser.port
        if laser == "camera" and camera is None:
            raise ValueError("laser.port = 'camera' needs a camera.port")
        for section, port in (("camera", camera), ("laser", laser)):
            if isinstance(port, Port):
                try:
                    port.indices(self.laser.wavelength_nm)
                except ValueError as error:
                    raise ValueError(f"{section}.port.{error}") from None
        if self.daylight is not None and camera is not None and camera.shape == "flat" and not camera.thickness:
            normal = rotation_matrix(self.camera.rotation_deg) @ camera.axis
            if self.daylight.down @ normal > _DOWNWARDS:
                raise ValueError(
                    "daylight does not go with a camera.port that is the surface, seen from above: the sky that it "
                    "reflects is not modelled"
                )
        if self.scan.mode != "none" and (camera is not None or laser is not None):
            if laser != "camera":
                raise ValueError("scan.mode = 'confocal' behind a port needs laser.port = 'camera': one port for both")
            if math.isfinite(self.scan.distance):
                raise ValueError(
                    f"scan.distance = {self.scan.distance} does not go with a port, behind which beam and line of "
                    "sight can be parallel alone: inf"
                )
        through, position = camera_port(self), list(self.beam.position)
        if through is not None and (why := through.outside((0.0, 0.0, 0.0))):
            raise ValueError(f"camera.port: the lens is outside: {why}; change offset or radius")
        if (through := laser_port(self)) is not None and (why := through.outside(position)):
            is_shared = self.laser.port == "camera"
            hint = "move the laser, or give it a port of its own: [laser.port]" if is_shared else "change it"
            raise ValueError(f"laser.position = {position} is outside laser.port: {why}; {hint}")
        return self

    @classmethod
    def from_dict(cls, tables: Mapping[str, Any], *, source: str | os.PathLike[str] | None = None) -> Scene:
        """A scene from tables as TOML gives them; relative paths in them start at `source`'s folder.

        Raises `ConfigError` with a line for each problem.
        """
        return _build(dict(tables), source=source)

    @classmethod
    def from_toml(cls, text: str, *, source: str | os.PathLike[str] | None = None) -> Scene:
        """A scene from the text that `to_toml` made, in a file of results or frames. Raises `ConfigError`."""
        return _build(parse_toml(text), source=source)

    @property
    def source(self) -> Path | None:
        """The file that the scene came from."""
        return self._source

    @property
    def files(self) -> list[Path]:
        """Files that the scene refers to: meshes, tables and images, all that `to_dict` names."""
        found: list[Path] = []

        def noted(path: str) -> str:
            found.append(Path(path))
            return path

        with_paths(Scene, self.to_dict(), noted)
        return [path for path in found if path.suffix]

    @property
    def scan_positions(self) -> int:
        """Positions of the beam: photon i is emitted at position i modulo this number."""
        return 1 if self.scan.mode == "none" else self.camera.width * self.camera.height

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
    def polarised(self) -> bool:
        """Whether light is polarised: the laser's, what water scatters, or as far as the camera can tell."""
        chosen = (self.laser.polarisation, self.medium.scattering_matrix, self.camera.polarisation)
        return any(one != "none" for one in chosen)

    @property
    def detections_per_photon(self) -> float:
        """Detections for each photon of a pulse that reaches a pixel: PDE, times what the filter passes.

        Raises `FileError` or `ConfigError` if the table of a spectrum or a filter cannot be read.
        """
        return detection_efficiency(self.laser, self.detector)

    @property
    def pulses_per_depth_frame(self) -> int:
        """Pulses of one depth frame of the analytic model: `analytic.pulses_per_depth_frame`, else those of the
        detector's frame."""
        return self.analytic.pulses_per_depth_frame or self.detector.pulses_per_frame

    def optical_depth(self, begin: Sequence[float], end: Sequence[float]) -> float:
        """∫c ds along the straight line between two points of the camera frame [m]."""
        if self.medium.varies and self.camera.is_posed:
            begin, end = to_world(self.camera, [begin, end]).tolist()
        return self.medium.optical_depth(begin, end)

    @property
    def path_limit(self) -> float:
        """Longest geometric path that counts [m]: `transport.max_path` or the gate's end, whichever is shorter."""
        gate_end = path_from_time(self.gate.stop, self.medium.group_index)
        return min(self.transport.max_path or gate_end, gate_end)

    def to_dict(self) -> dict[str, Any]:
        """Tables from which `from_dict` makes an equal scene."""
        return {name: plain(value) for name, value in self if value not in (None, ())}

    def to_toml(self, *, folder: str | os.PathLike[str] | None = None) -> str:
        """The full text that `load_scene` reads back to an equal scene.

        `folder`: of the file that the text is for. Paths of files in it or in the folder above it, with the folders in
        these, are then relative to it: they still hold where all were moved together. Others stay absolute.
        """
        tables = self.to_dict()
        return toml_text(tables if folder is None else _paths_from(tables, folder))

    def with_overrides(self, overrides: Overrides | None = None, /, **sections: Mapping[str, Any]) -> Scene:
        """A changed scene: `with_overrides({"medium.extinction": 0.9})`, `with_overrides(medium={"extinction": 0.9})`.

        Overrides act as in `load_scene`. Raises `ConfigError`.
        """
        changed = self
        for layer in (overrides, sections):
            if layer:
                changed = _build(changed.to_dict(), overrides=layer, source=self.source, resolve=False)
        return changed

    def plot(self, **options: Any) -> Any:
        """A figure of what the camera sees through clear water; see `spadwarp.viz.plot`."""
        import spadwarp

        return spadwarp.viz.plot(self, **options)

    def _repr_html_(self) -> str:
        import spadwarp

        return spadwarp.viz.html(self)

    def __repr__(self) -> str:
        name = self.source.stem if self.source else "Python"
        targets = ", ".join(target.builtin or Path(target.mesh or "").name for target in self.targets[:3])
        targets += f" and {len(self.targets) - 3} more" if len(self.targets) > 3 else ""
        camera, gate = self.camera, self.gate
        return (
            f"Scene({name}: {targets or 'no target'}, extinction {self.medium.extinction:.4g} 1/m, "
            f"{camera.width} x {camera.height} pixels x {gate.bins} bins)"
        )

    def __str__(self) -> str:
        return repr(self)

    def __eq__(self, other: object) -> bool:
        """Equal in every field; where it came from does not matter."""
        return isinstance(other, Scene) and self.__dict__ == other.__dict__

    def __hash__(self) -> int:
        return hash(tuple(self.__dict__.values()))


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
    tables = read_toml(path)
    if "scene" in tables and "laser" not in tables:
        raise ConfigError("a recipe of a dataset, for `spadwarp dataset`, not a scene", source=str(path))
    return _build(tables, overrides=overrides, source=path)


def template() -> str:
    """The text of a commented scene to start from."""
    return (files("spadwarp.scene") / "template.toml").read_text(encoding="utf-8")


class WaterLine(NamedTuple):
    """A line of the light that passes the filter, in the water.

    Attributes:
        share: Photons, over those of a pulse of one line at `laser.wavelength_nm`.
        extinction, scattering: [1/m].
        speed: Of a pulse [m/s].
    """

    share: float
    extinction: float
    scattering: float
    speed: float


def water_lines(scene: Scene) -> list[WaterLine]:
    """Lines of a pulse that pass the filter; one line where nothing of the water follows the wavelength.

    Raises `FileError` or `ConfigError` for a table, and `ConfigError` for a spectrum beyond where the water is known.
    """
    medium, lines = scene.medium, spectral_lines(scene.laser, scene.detector)
    if len(lines) == 1 or not medium.follows_wavelength:
        whole = math.fsum(line.share for line in lines)
        return [WaterLine(whole, medium.extinction, medium.scattering, medium.pulse_speed)]
    try:
        waters = [(line.share, medium.at_wavelength(line.wavelength_nm)) for line in lines]
    except ArgumentError as error:
        raise ConfigError(
            f"laser: the spectrum reaches beyond where medium.chlorophyll, temperature and salinity hold: {error}",
            source=None if scene.source is None else str(scene.source),
        ) from None
    return [WaterLine(share, water.extinction, water.scattering, water.pulse_speed) for share, water in waters]


def camera_port(scene: Scene) -> PortGeometry | None:
    """The port that a scene's camera looks through; None: it is in the water."""
    port = scene.camera.port
    return None if port is None else _placed(scene, port, np.zeros(3), np.array(port.axis))


def laser_port(scene: Scene) -> PortGeometry | None:
    """The port that a scene's laser shines through; None: it is in the water."""
    port = scene.laser.port
    if not isinstance(port, Port):
        return None if port is None else camera_port(scene)
    normal = np.array(port.axis)
    if scene.laser.frame == "world" and scene.camera.is_posed:
        normal = normal @ rotation_matrix(scene.camera.rotation_deg)
    return _placed(scene, port, np.array(scene.beam.position), normal)


def _placed(scene: Scene, port: Port, origin: Any, normal: Any) -> PortGeometry:
    water = scene.medium.phase_index, scene.medium.group_index
    return port.placed(origin, normal, wavelength_nm=scene.laser.wavelength_nm, water=water)


def _build(
    tables: dict[str, Any],
    *,
    overrides: Overrides | None = None,
    source: str | os.PathLike[str] | None = None,
    resolve: bool = True,
) -> Scene:
    name = None if source is None else str(source)
    layer: dict[str, Any] = {}
    items: dict[Key, Any] = {}
    try:
        if source is not None and resolve:
            tables = _absolute_paths(tables, Path(source).absolute().parent)
        if overrides:
            layer, items = override_layer(overrides)
            tables = merge_scene(_with_units(tables), _absolute_paths(_with_units(layer), Path.cwd()))
        scene = Scene.model_validate(tables)
        for key, value in items.items():  # of lists that may be defaults
            scene = Scene.model_validate(set_item(scene.to_dict(), key, value))
    except ConfigError as error:
        raise ConfigError(error.problems, source=name) from None
    except ValidationError as error:
        raise ConfigError(describe(error, Scene, layer), source=name) from None
    scene._source = None if source is None else Path(source)
    return scene


def _with_units(tables: Mapping[str, Any]) -> dict[str, Any]:
    """Numbers with a unit in the water and the laser as numbers: merging completes what they define."""
    changed = dict(tables)
    for name, model in (("medium", Medium), ("laser", Laser)):
        if isinstance(fields := tables.get(name), Mapping):
            changed[name] = with_units(model, fields)
    return changed


def _absolute_paths(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The tables with paths that are relative to a folder made absolute."""
    return with_paths(Scene, tables, lambda path: _without_dots(folder / os.path.expanduser(path)))


def _paths_from(tables: Mapping[str, Any], folder: str | os.PathLike[str]) -> dict[str, Any]:
    """The tables of a scene in memory with the paths that a scene file in a folder has.

    Relative for files in the folder or in the one above it, with the folders in these: what is moved together stays
    together. Absolute for others.
    """
    here = os.path.abspath(folder)
    above = os.path.dirname(here)
    root = above if os.path.dirname(above) != above else here  # that of a disk holds all files

    def shortened(value: str) -> str:
        place = os.path.abspath(value)
        if not Path(place).is_relative_to(root):
            return place
        relative = os.path.relpath(place, here)
        return Path(relative).as_posix() if _is_same(os.path.join(here, relative), place) else place

    return with_paths(Scene, tables, shortened)


def _without_dots(path: Path) -> str:
    short = os.path.normpath(path)
    return short if ".." in path.parts and _is_same(short, path) else str(path)


def _is_same(one: str | Path, other: str | Path) -> bool:
    """Whether two paths lead to one place; links may make a difference of `..`."""
    try:
        return os.path.realpath(one) == os.path.realpath(other)
    except (OSError, ValueError):  # no path at all
        return False
