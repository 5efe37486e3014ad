"""Scenes: TOML in, frozen and validated models out.

`load_scene` reads a file, `Scene.from_dict` takes tables, `Scene.with_overrides` changes a scene. A section may name a
`preset`; the file's own fields lie over it and overrides over both. SI units, except where a name carries its unit.
"""

from spadwarp.scene.ambient_light import daylight_radiance, daylight_rate, downwelling_irradiance, noise_rate
from spadwarp.scene.analytic import Analytic
from spadwarp.scene.calibration import load_calibration, save_calibration
from spadwarp.scene.camera import Camera
from spadwarp.scene.daylight import Daylight
from spadwarp.scene.detector import Detector
from spadwarp.scene.domain import Domain
from spadwarp.scene.gate import Gate
from spadwarp.scene.laser import Laser
from spadwarp.scene.layers import Layer
from spadwarp.scene.load import parse_override
from spadwarp.scene.matrix import Matrix, scattering_matrix
from spadwarp.scene.medium import Medium
from spadwarp.scene.output import Output
from spadwarp.scene.phase import PhaseFunction, phase_function
from spadwarp.scene.pose import look_at, opencv_pose
from spadwarp.scene.preset import Preset, presets
from spadwarp.scene.scan import Scan
from spadwarp.scene.scene import Scene, SceneLike, as_scene, load_scene, template
from spadwarp.scene.spectrum import (
    SpectralLine,
    WaterLine,
    detection_efficiency,
    filter_transmission,
    spectral_lines,
    water_lines,
)
from spadwarp.scene.targets import Target
from spadwarp.scene.trajectory import Trajectory, load_trajectory
from spadwarp.scene.transport import Transport

__all__ = [
    "Analytic",
    "Camera",
    "Daylight",
    "Detector",
    "Domain",
    "Gate",
    "Laser",
    "Layer",
    "Matrix",
    "Medium",
    "Output",
    "PhaseFunction",
    "Preset",
    "Scan",
    "Scene",
    "SceneLike",
    "SpectralLine",
    "Target",
    "Trajectory",
    "Transport",
    "WaterLine",
    "as_scene",
    "daylight_radiance",
    "daylight_rate",
    "detection_efficiency",
    "downwelling_irradiance",
    "filter_transmission",
    "load_calibration",
    "load_scene",
    "load_trajectory",
    "look_at",
    "noise_rate",
    "opencv_pose",
    "parse_override",
    "phase_function",
    "presets",
    "save_calibration",
    "scattering_matrix",
    "spectral_lines",
    "template",
    "water_lines",
]
