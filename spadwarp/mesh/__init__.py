"""Targets: built-in shapes and mesh files, with their colours, placed in the world."""

from typing import TYPE_CHECKING

from spadwarp.mesh.targets import *
from spadwarp.values import guarded

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = guarded(__name__, targets.__all__)
