"""The water: one, or plane layers of several; its box and the limits that end a history."""

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
    "Layers",
    "Limits",
    "Medium",
    "Water",
    "exit_distance",
    "free_path",
    "layer_index",
    "layered_extinction",
    "layered_free_path",
    "layered_water",
    "make_layers",
]
