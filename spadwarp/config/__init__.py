"""Scenes: TOML in, frozen and validated models out.

`load_scene` reads a file, `Scene.from_dict` takes tables, `Scene.with_overrides` changes a scene. A section may name a
`preset`; the file's own fields lie over it and overrides over both. SI units, except where a name carries its unit.
"""

from spadwarp._layers import parse_override

from .detection import Detector, Gate
from .medium import Layer, Medium
from .methods import Analytic, Output, Transport
from .optics import Camera, Laser, Scan
from .scene import Scene, load_scene
from .sections import SPEED_OF_LIGHT
from .surroundings import Domain, Target

__all__ = [
    "SPEED_OF_LIGHT",
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
