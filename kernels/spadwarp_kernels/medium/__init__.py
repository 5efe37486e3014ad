"""The water: one, or plane layers of several; its box and the limits that end a history."""

from .boundary import Boundary, fresnel_reflectance, make_boundary, reflection_images
from .layers import (
    HOMOGENEOUS,
    LAYERED,
    Layers,
    Water,
    layer_index,
    layered_extinction,
    layered_free_path,
    layered_water,
    make_layers,
)
from .limits import EXIT_FACES, Limits, exit_distance
from .water import Medium, free_path

__all__ = [
    "EXIT_FACES",
    "HOMOGENEOUS",
    "LAYERED",
    "Boundary",
    "Layers",
    "Limits",
    "Medium",
    "Water",
    "exit_distance",
    "free_path",
    "fresnel_reflectance",
    "layer_index",
    "layered_extinction",
    "layered_free_path",
    "layered_water",
    "make_boundary",
    "make_layers",
    "reflection_images",
]
