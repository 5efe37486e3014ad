"""The camera, how it images, what it sees for certain, and the time gate."""

from .camera import Camera, clip_to_planes, field, lens_point, pixel_direction, project, project_calibrated
from .gate import AFTER, BEFORE, C0, Gate, clip_to_gate, gate_bin
from .projection import CALIBRATED, PINHOLE, Lens
from .visibility import near_depth_map

__all__ = [
    "AFTER",
    "BEFORE",
    "C0",
    "CALIBRATED",
    "PINHOLE",
    "Camera",
    "Gate",
    "Lens",
    "clip_to_gate",
    "clip_to_planes",
    "field",
    "gate_bin",
    "lens_point",
    "near_depth_map",
    "pixel_direction",
    "project",
    "project_calibrated",
]
