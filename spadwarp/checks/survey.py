"""A scene with its mesh, and the numbers that follow from both."""

from __future__ import annotations

import math
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from spadwarp.analytic import beam_axis_fluence
from spadwarp.mesh import TriangleMesh, build_mesh, focus_distance
from spadwarp.scene import Scene
from spadwarp.scene.laser import profile_extent
from spadwarp.scene.port import PortGeometry
from spadwarp.scene.scene import camera_port, laser_port
from spadwarp.scene.sight import beam_planes, points_inside, port_advance, view_planes
from spadwarp.units import range_from_time, time_from_path

__all__ = ["Survey"]

Points = NDArray[np.float64]


class Survey:
    """What the camera sees of a scene's targets, and what of that the beam illuminates; occlusion is not considered.

    Attributes:
        triangles, target, reflectance: The faces `[F, 3, 3]` [m] in the camera frame, their targets and reflectances.
        view, beam: Planes around the view and the beam, as in `spadwarp.scene.sight`.
        focus_distance: Depth that the lens images sharply [m]; None for a pinhole.
        illuminated: Points of the targets in both, `[N, 3]` [m].
        target_range: Nearest and farthest of them from the lens [m]; None if there are none.
        target_path: Shortest and longest path from the laser by them to the lens [m], likewise.
        optical_depth: From the lens to the nearest of them, likewise.
    """

    def __init__(self, scene: Scene, mesh: TriangleMesh | None) -> None:
        if mesh is None and scene.targets:
            mesh = build_mesh(scene)
        self.scene = scene
        self.target = np.zeros(0, dtype=np.int32) if mesh is None else mesh.target
        self.reflectance = np.zeros(0) if mesh is None else mesh.reflectance
        self.triangles = np.zeros((0, 3, 3)) if mesh is None else mesh.vertices[mesh.faces].astype(np.float64)
        self.focus_distance = focus_distance(scene, mesh)
        self.camera_port, self.laser_port = camera_port(scene), laser_port(scene)
        self.view = view_planes(scene.camera)
        # A scan brings its beam to all that is in view.
        self.beam = beam_planes(scene.beam) if scene.scan_positions == 1 else np.zeros((0, 4))
        self.illuminated = self.illuminated_part(self.triangles)
        self.target_range = self.target_path = self.optical_depth = None
        if len(self.illuminated):
            ranges, paths = self.ranges(self.illuminated), self.paths(self.illuminated)
            self.target_range = float(ranges.min()), float(ranges.max())
            self.target_path = float(paths.min()), float(paths.max())
            self.optical_depth = scene.optical_depth((0.0, 0.0, 0.0), self.illuminated[ranges.argmin()].tolist())

    def illuminated_part(self, triangles: Points) -> Points:
        """Points of triangles in the view and the beam, `[N, 3]`; behind ports, of those that planes in air hold."""
        if self.camera_port is None and self.laser_port is None:
            return points_inside(triangles, np.concatenate([self.view, self.beam]))
        # Bent towards its normal, light stays within the planes in air, but about a tilted port.
        whole = [np.array([[0.0, 0.0, 1.0, 0.0]])]
        for planes, port, axis in (
            (self.view, self.camera_port, (0.0, 0.0, 1.0)),
            (self.beam, self.laser_port, self.scene.beam.axis),
        ):
            if port is None or port.shape == "dome" or np.dot(port.normal, axis) > 0.999:
                whole.append(planes)
        points = points_inside(triangles, np.concatenate(whole))
        laser = np.array(self.scene.beam.position)
        for port, planes, origin in (
            (self.camera_port, self.view, np.zeros(3)),
            (self.laser_port, self.beam, laser),
        ):
            if port is not None and len(points):
                ahead = origin + port.connect(points, origin)[0]
                points = points[(ahead @ planes[:, :3].T + planes[:, 3] >= 0.0).all(axis=1)]
        return points

    def ranges(self, points: Points) -> Points:
        """Lengths of the ways of light [m] from points `[N, 3]` to the lens."""
        if self.camera_port is not None:
            return self.camera_port.connect(points, np.zeros(3))[2]
        return np.linalg.norm(points, axis=1)

    def paths(self, points: Points) -> Points:
        """Paths [m] from the laser by points `[N, 3]` to the lens, as lengths in water."""
        laser = np.array(self.scene.beam.position)
        to_lens, to_laser = np.linalg.norm(points, axis=1), np.linalg.norm(points - laser, axis=1)
        if self.camera_port is not None:
            to_lens = self.camera_port.connect(points, np.zeros(3))[3]
        if self.laser_port is not None:
            to_laser = self.laser_port.connect(points, laser)[3]
        return to_laser + to_lens

    def arrival_ns(self, path: float) -> float:
        """Time of flight [ns] along a path [m]."""
        return 1e9 * time_from_path(path, self.scene.medium.group_index)

    def range_of(self, time: float) -> float:
        """Range [m] of a round trip of `time` [s], laser at the lens."""
        return range_from_time(time, self.scene.medium.group_index) + (port_advance(self.scene) if time > 0.0 else 0.0)

    @property
    def bin_range(self) -> float:
        """Range that a bin covers [m]."""
        return range_from_time(self.scene.gate.bin_width, self.scene.medium.group_index)

    @property
    def target_arrival_ns(self) -> tuple[float, float] | None:
        """First and last unscattered return of the targets [ns]."""
        return (
            None
            if self.target_path is None
            else (self.arrival_ns(self.target_path[0]), self.arrival_ns(self.target_path[1]))
        )

    @property
    def irf_fwhm_ps(self) -> float:
        """Width of the instrument response [ps], if pulse and jitter are Gaussian."""
        return math.hypot(self.scene.laser.pulse_fwhm_ps, self.scene.detector.jitter_fwhm_ps)

    @property
    def histogram_bytes(self) -> int:
        """Memory of one set of tallies."""
        camera = self.scene.camera
        return 3 * 8 * camera.width * camera.height * self.scene.gate.bins

    @property
    def distance(self) -> float | None:
        """Range of the nearest illuminated point [m]; None if there is none, or it lies at the lens centre."""
        return self.target_range[0] or None if self.target_range is not None else None

    @cached_property
    def ballistic_share(self) -> float | None:
        """Part of the beam that reaches, unscattered, one pixel's footprint on the axis at the nearest point."""
        if self.distance is None or self.optical_depth is None:
            return None
        return self._pixel_share(self.distance) * math.exp(-self.optical_depth)

    def _pixel_share(self, distance: float) -> float:
        """Part of the beam within one pixel's footprint at `distance` [m], on the beam's axis, without water."""
        laser, footprint = self.scene.laser, (self.scene.camera.pixel_tangent * distance) ** 2
        footprint *= self._narrowed(self.camera_port) / self._narrowed(self.laser_port)
        footprint *= self._transmission(self.laser_port)
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

    @staticmethod
    def _narrowed(port: PortGeometry | None) -> float:
        """By which a flat port makes a small solid angle about its normal smaller."""
        return 1.0 if port is None or port.shape != "flat" else (port.index[0] / port.index[2]) ** 2

    @staticmethod
    def _transmission(port: PortGeometry | None) -> float:
        """Of light that falls on a port at right angles."""
        if port is None:
            return 1.0
        first, second, third = port.index
        return (4.0 * first * second / (first + second) ** 2) * (4.0 * second * third / (second + third) ** 2)

    @property
    def samples_per_pixel(self) -> float | None:
        """Traced photons that reach one pixel's part of the target unscattered."""
        if self.ballistic_share is None:
            return None
        return self.scene.transport.photons / self.scene.scan_positions * self.ballistic_share

    @property
    def irradiance(self) -> float | None:
        """Unscattered light on the beam's axis at the range of the nearest point, mean over time [W/m²]."""
        if self.distance is None or self.optical_depth is None:
            return None
        return (
            beam_axis_fluence(self.scene, self.distance)
            * math.exp(-self.optical_depth)
            * self.scene.laser.average_power
        )

    @property
    def photons_per_pixel(self) -> float | None:
        """Unscattered photons from the target that a pixel on the beam's axis receives from a pulse."""
        if self.ballistic_share is None or self.distance is None or self.optical_depth is None:
            return None
        # Lambertian, towards the lens
        collected = float(self.reflectance.max()) / math.pi * self.scene.camera.aperture_area / self.distance**2
        share = self.ballistic_share * math.exp(-self.optical_depth) * self._transmission(self.camera_port)
        if self.camera_port is not None and self.camera_port.shape == "dome":
            share *= (self.camera_port.index[0] / self.camera_port.index[2]) ** 2
        return share * collected * self.scene.laser.photons_per_pulse

    @property
    def signal_per_pulse(self) -> float | None:
        """Unscattered photons from the target that a pixel on the beam's axis detects from a pulse."""
        return None if self.photons_per_pixel is None else self.photons_per_pixel * self.scene.detections_per_photon
