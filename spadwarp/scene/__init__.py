"""Scenes: TOML in, frozen and validated models out.

`load_scene` reads a file, `Scene.from_dict` takes tables, `Scene.with_overrides` changes a scene. A section may name a
`preset`; the file's own fields lie over it and overrides over both. SI units, except where a name carries its unit.
"""

from spadwarp.scene.detection import Detector, Gate
from spadwarp.scene.load import parse_override
from spadwarp.scene.medium import Layer, Medium
from spadwarp.scene.methods import Analytic, Output, Transport
from spadwarp.scene.optics import Camera, Laser, Scan
from spadwarp.scene.scene import Scene, load_scene
from spadwarp.scene.surroundings import Domain, Target

__all__ = [
    "Analytic",
    "Camera",
    "Detector",
    "Domain",
    "Gate",
    "Laser",
    "Layer",
    "Medium",
    "Output",
    "Scan",
    "Scene",
    "Target",
    "Transport",
    "load_scene",
    "parse_override",
]
