"""Meshes: reflectance, and rays against a tree of their faces, on a GPU and on a core."""

from typing import TYPE_CHECKING

from .mesh import *
from .patches import *
from .ray_cast import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = mesh.__all__ + patches.__all__ + ray_cast.__all__
