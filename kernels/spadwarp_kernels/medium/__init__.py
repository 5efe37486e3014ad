"""The water: one, plane layers of several, or a grid of cells; its box and the limits that end a history."""

from .boundary import Boundary, fresnel_reflectance, make_boundary, reflection_images
from .grid import Grid, make_grid
from .grid_tracking import DELTA_TRACKING, REGULAR_TRACKING
from .layers import (
    HOMOGENEOUS,
    LAYERED,
    Layers,
    Profile,
    Water,
    layer_index,
    layered_extinction,
    layered_free_path,
    layered_water,
    make_layers,
)
from .limits import EXIT_FACES, Limits, exit_distance
from .voxels import voxel_values_kernel
from .water import Medium, free_path

__all__ = [
    "DELTA_TRACKING",
    "EXIT_FACES",
    "HOMOGENEOUS",
    "LAYERED",
    "REGULAR_TRACKING",
    "Boundary",
    "Grid",
    "Layers",
    "Limits",
    "Medium",
    "Profile",
    "Water",
    "exit_distance",
    "free_path",
    "fresnel_reflectance",
    "layer_index",
    "layered_extinction",
    "layered_free_path",
    "layered_water",
    "make_boundary",
    "make_grid",
    "make_layers",
    "reflection_images",
    "voxel_values_kernel",
]
