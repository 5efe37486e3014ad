"""Targets: built-in shapes and mesh files, with their colours, placed in the world."""

from spadwarp.mesh.targets import *
from spadwarp.values import guarded

guarded(__name__)
