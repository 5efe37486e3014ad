"""The camera, how it images, what it sees for certain, and the time gate."""

from .camera import (
    Camera,
    clip_to_planes,
    clip_to_view,
    field,
    in_view,
    lens_point,
    pixel_direction,
    project,
    project_calibrated,
)
from .gate import AFTER, BEFORE, C0, Gate, clip_to_gate, gate_bin
from .projection import CALIBRATED, PLAIN, Lens
from .visibility import near_depth_map

__all__ = [
    "AFTER",
    "BEFORE",
    "C0",
    "CALIBRATED",
    "PLAIN",
    "Camera",
    "Gate",
    "Lens",
    "clip_to_gate",
    "clip_to_planes",
    "clip_to_view",
    "field",
    "gate_bin",
    "in_view",
    "lens_point",
    "near_depth_map",
    "pixel_direction",
    "project",
    "project_calibrated",
]
