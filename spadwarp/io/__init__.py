"""Files that appear whole or not at all, and files read with care: HDF5, EXR, NumPy, PLY, TOML, JSON, CSV."""

from typing import TYPE_CHECKING

from spadwarp.io import arrays, paths, text
from spadwarp.io.arrays import *
from spadwarp.io.paths import *
from spadwarp.io.text import *
from spadwarp.values import guarded

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = guarded(__name__, arrays.__all__ + paths.__all__ + text.__all__)
