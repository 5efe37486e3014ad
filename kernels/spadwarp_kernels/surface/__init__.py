"""Meshes: reflectance, and rays against a tree of their faces, on a GPU and on a core."""

from .mesh import *
from .patches import *
from .ray_cast import *
