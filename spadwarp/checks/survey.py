"""A scene with its mesh, the numbers that follow from both, and the findings about it."""

from __future__ import annotations

import dataclasses
import math
from dataclasses import dataclass
from typing import Literal

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic import axis_fluence
from spadwarp.mesh import TriangleMesh, build_mesh, focus_distance
from spadwarp.scene import Scene
from spadwarp.scene.laser import profile_extent
from spadwarp.scene.port import PortGeometry
from spadwarp.scene.scene import camera_port, laser_port
from spadwarp.scene.sight import beam_planes, points_inside, port_advance, view_planes
from spadwarp.values import range_from_time, time_from_path

__all__ = ["CheckMessage"]

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

    distance: float  # that range [m]
    optical_depth: float  # to it, one way
    irradiance: float  # mean over time [W/m²]
    samples_per_pixel: float  # traced photons that reach one pixel's part of the target
    photons_per_pixel: float  # from the target, of a pulse
    signal_per_pulse: float  # detected of these


class Survey:
    """A scene's targets as the camera sees them and the beam illuminates them, without occlusion; and the findings.

    Attributes:
        messages: The findings so far.
        targets: The faces of each target in the camera frame `[F, 3, 3]` [m].
        view, beam: Planes around the view and the beam, as in `spadwarp.scene.sight`.
        focus_distance: Depth that the lens images sharply [m]; None for a pinhole.
        target_range: Nearest and farthest point from the lens that is in both [m]; None if there are none.
        target_arrival_ns: First and last unscattered return from them [ns], likewise.
        optical_depth: From the lens to the nearest of them, likewise.
        on_axis: Light of the nearest; None if there is none, or it lies at the lens centre.
        bin_range: Range that a bin covers [m].
        irf_fwhm_ps: Width of the instrument response [ps], if pulse and jitter are Gaussian.
        histogram_bytes: Memory of one set of tallies.
    """

    def __init__(self, scene: Scene, mesh: TriangleMesh | None) -> None:
        if mesh is None and scene.targets:
            mesh = build_mesh(scene)
        self.scene, self.messages, laser = scene, list[CheckMessage](), scene.beam
        triangles = np.zeros((0, 3, 3)) if mesh is None else mesh.vertices[mesh.faces].astype(np.float64)
        self.targets = [] if mesh is None else [triangles[mesh.target == i] for i in range(len(scene.targets))]
        self.reflectance = 0.0 if mesh is None else float(mesh.reflectance.max(initial=0.0))
        self.focus_distance = focus_distance(scene, mesh)
        self.camera_port, self.laser_port = camera_port(scene), laser_port(scene)
        self.view = view_planes(scene.camera)
        # A scan brings its beam to all that is in view.
        self.beam = beam_planes(laser) if scene.scan_positions == 1 else np.zeros((0, 4))
        # Planes in air, the port that they are bent at, its axis, and where they begin; of view and beam.
        self._sides = (
            (self.view, self.camera_port, (0.0, 0.0, 1.0), np.zeros(3)),
            (self.beam, self.laser_port, laser.axis, np.array(laser.position)),
        )
        self.bin_range = range_from_time(scene.gate.bin_width, scene.medium.group_index)
        self.irf_fwhm_ps = math.hypot(scene.laser.pulse_fwhm_ps, scene.detector.jitter_fwhm_ps)
        self.histogram_bytes = 3 * 8 * scene.camera.width * scene.camera.height * scene.gate.bins
        self.target_range = self.target_arrival_ns = self.optical_depth = self.on_axis = None
        illuminated = self.illuminated_part(triangles)
        if len(illuminated):
            ranges, paths = self._ways(illuminated, self._sides[:1], 2), self.paths(illuminated)
            self.target_range = float(ranges.min()), float(ranges.max())
            self.target_arrival_ns = self.arrival_ns(float(paths.min())), self.arrival_ns(float(paths.max()))
            self.optical_depth = scene.optical_depth((0.0, 0.0, 0.0), illuminated[ranges.argmin()].tolist())
            if self.target_range[0]:
                self.on_axis = self._on_axis(self.target_range[0], self.optical_depth)

    def warn(self, field: str, text: str, **values: float) -> None:
        """Adds a warning."""
        self.messages.append(CheckMessage("warning", field, text, values))

    def note(self, field: str, text: str, **values: float) -> None:
        """Adds a note."""
        self.messages.append(CheckMessage("note", field, text, values))

    def illuminated_part(self, triangles: Points) -> Points:
        """Points of triangles in the view and the beam, `[N, 3]`; behind ports, of those that planes in air hold."""
        has_port = self.camera_port is not None or self.laser_port is not None
        whole = [np.array([[0.0, 0.0, 1.0, 0.0]])] if has_port else []
        for planes, port, axis, _ in self._sides:
            # Bent towards its normal, light stays within the planes in air, but about a tilted port.
            if port is None or port.shape == "dome" or np.dot(port.normal, axis) > 0.999:
                whole.append(planes)
        points = points_inside(triangles, np.concatenate(whole))
        for planes, port, _, origin in self._sides:
            if port is not None and len(points):
                ahead = origin + port.connect(points, origin)[0]
                points = points[(ahead @ planes[:, :3].T + planes[:, 3] >= 0.0).all(axis=1)]
        return points

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
        ballistic = self._pixel_share(distance) * passed
        # Lambertian, towards the lens
        collected = self.reflectance / math.pi * scene.camera.aperture_area / distance**2
        share = ballistic * passed * _transmission(port)
        if port is not None and port.shape == "dome":
            share *= (port.index[0] / port.index[2]) ** 2
        photons = share * collected * scene.laser.photons_per_pulse
        return OnAxis(
            distance=distance,
            optical_depth=optical_depth,
            irradiance=axis_fluence(scene, distance) * passed * scene.laser.average_power,
            samples_per_pixel=scene.transport.photons / scene.scan_positions * ballistic,
            photons_per_pixel=photons,
            signal_per_pulse=photons * scene.detections_per_photon,
        )

    def _pixel_share(self, distance: float) -> float:
        """Part of the beam within one pixel's footprint at `distance` [m], on the beam's axis, without water."""
        laser, footprint = self.scene.laser, (self.scene.camera.pixel_tangent * distance) ** 2
        footprint *= _narrowed(self.camera_port) / _narrowed(self.laser_port) * _transmission(self.laser_port)
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


def _narrowed(port: PortGeometry | None) -> float:
    """By which a flat port makes a small solid angle about its normal smaller."""
    return 1.0 if port is None or port.shape != "flat" else (port.index[0] / port.index[2]) ** 2


def _transmission(port: PortGeometry | None) -> float:
    """Of light that falls on a port at right angles."""
    first, second, third = (1.0, 1.0, 1.0) if port is None else port.index
    return (4.0 * first * second / (first + second) ** 2) * (4.0 * second * third / (second + third) ** 2)
