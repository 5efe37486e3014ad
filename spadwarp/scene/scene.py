"""A scene of all its sections, and the file that it comes from."""

from __future__ import annotations

import math
import os
from collections.abc import Mapping, Sequence
from importlib.resources import files
from pathlib import Path
from typing import Annotated, Any, Self

from pydantic import BaseModel, BeforeValidator, ConfigDict, PrivateAttr, ValidationError, model_validator

from spadwarp.errors import ArgumentError, ConfigError, FileError
from spadwarp.io.examples import example_or_path
from spadwarp.io.parsing import parse_toml, read_toml
from spadwarp.io.paths import MESH_ENDINGS, used
from spadwarp.limits import shown
from spadwarp.scene import load
from spadwarp.scene.analytic import Analytic
from spadwarp.scene.camera import Camera
from spadwarp.scene.daylight import Daylight
from spadwarp.scene.detector import Detector
from spadwarp.scene.domain import Domain
from spadwarp.scene.file_paths import FILE_FIELDS, with_absolute_paths, with_paths_from
from spadwarp.scene.gate import Gate
from spadwarp.scene.laser import Laser
from spadwarp.scene.matrix import check_polarisation
from spadwarp.scene.medium import Medium
from spadwarp.scene.messages import describe
from spadwarp.scene.output import Output
from spadwarp.scene.port import Port
from spadwarp.scene.port_rays import camera_port, laser_port
from spadwarp.scene.pose import rotation_matrix, to_camera, to_world
from spadwarp.scene.quantities import with_units
from spadwarp.scene.scan import Scan
from spadwarp.scene.sections import listed
from spadwarp.scene.spectrum import detection_efficiency
from spadwarp.scene.targets import Target
from spadwarp.scene.transport import Transport
from spadwarp.units import path_from_time

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
    def _lens_that_photons_can_hit(self) -> Self:
        if self.camera.pinhole and self.transport.estimator == "analog":
            raise ValueError(
                "camera.pinhole = true does not go with transport.estimator = 'analog', whose photons cannot hit a "
                "point: take a small aperture_diameter, or next_event or guided"
            )
        return self

    @model_validator(mode="after")
    def _faces_within_reach(self) -> Self:
        if self.domain.reflecting and math.isfinite(self.transport.lateral_limit):
            raise ValueError(
                f"transport.lateral_limit = {self.transport.lateral_limit} does not go with domain.outside_index: the "
                "faces reflect light from beyond it"
            )
        return self

    @model_validator(mode="after")
    def _daylight_in_one_water(self) -> Self:
        if self.daylight is not None and self.medium.layers:
            raise ValueError(f"medium.layers: {len(self.medium.layers)} given; daylight takes one water")
        if self.daylight is not None and self.medium.grid is not None:
            raise ValueError("medium.grid does not go with daylight, which takes one water: leave one of them out")
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
        return self

    @model_validator(mode="after")
    def _light_that_can_be_polarised(self) -> Self:
        if self.polarised:
            check_polarisation(self.medium, self.transport, self.targets)
        return self

    @model_validator(mode="after")
    def _inside_their_ports(self) -> Self:
        through = camera_port(self)
        if through is not None and (why := through.outside((0.0, 0.0, 0.0))):
            raise ValueError(f"camera.port: the lens is outside: {why}; change offset or radius")
        through, position = laser_port(self), list(self.beam.position)
        if through is not None and (why := through.outside(position)):
            way_out = (
                "move the laser, or give it a port of its own: [laser.port]"
                if self.laser.port == "camera"
                else "change it"
            )
            raise ValueError(f"laser.position = {position} is outside laser.port: {why}; {way_out}")
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
        tables = self.to_dict()
        named = [tables[section].get(name, "") for section, name, _ in FILE_FIELDS]
        named += [target.get("mesh", "") for target in tables.get("targets", ())]
        named.append(tables["medium"].get("grid", {}).get("file", ""))
        return [Path(path) for path in named if Path(path).suffix]

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
        moved = {"position": tuple(map(float, position)), "direction": tuple(map(float, axis)), "frame": "camera"}
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
        tables: dict[str, Any] = {}
        for name, section in self:
            if section is not None:
                tables[name] = [target.to_dict() for target in section] if name == "targets" else section.to_dict()
        if not tables["targets"]:
            del tables["targets"]
        return tables

    def to_toml(self, *, folder: str | os.PathLike[str] | None = None) -> str:
        """The full text that `load_scene` reads back to an equal scene.

        `folder`: of the file that the text is for. Paths of files in it or in the folder above it, with the folders in
        these, are then relative to it: they still hold where all were moved together. Others stay absolute.
        """
        tables = self.to_dict()
        return load.toml_text(tables if folder is None else with_paths_from(tables, folder))

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


def _build(
    tables: dict[str, Any],
    *,
    overrides: Overrides | None = None,
    source: str | os.PathLike[str] | None = None,
    resolve: bool = True,
) -> Scene:
    name = None if source is None else str(source)
    layer: dict[str, Any] = {}
    items: dict[load.Key, Any] = {}
    try:
        if source is not None and resolve:
            tables = with_absolute_paths(tables, Path(source).absolute().parent)
        if overrides:
            layer, items = load.override_layer(overrides)
            tables = load.merge_scene(_with_units(tables), with_absolute_paths(_with_units(layer), Path.cwd()))
        scene = Scene.model_validate(tables)
        for key, value in items.items():  # of lists that may be defaults
            scene = Scene.model_validate(load.set_item(scene.to_dict(), key, value))
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
