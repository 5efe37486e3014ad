"""SPAD cameras in simulations: many worlds in one launch, moving shapes, nothing read back."""

from .closed_forms import SHAPE_KINDS, intersect_shape
from .config import SpadConfig
from .frames import CAMERA_FRAMES
from .shapes import Shapes, ShapeTable, intersect_shapes, make_shapes, move_shapes
from .simulators import mujoco_shapes, newton_shapes, write_poses
from .spad_camera import SpadCamera
from .spad_tracer import SpadTracer

__all__ = [
    "CAMERA_FRAMES",
    "SHAPE_KINDS",
    "ShapeTable",
    "Shapes",
    "SpadCamera",
    "SpadConfig",
    "SpadTracer",
    "intersect_shape",
    "intersect_shapes",
    "make_shapes",
    "move_shapes",
    "mujoco_shapes",
    "newton_shapes",
    "write_poses",
]
