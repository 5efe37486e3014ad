"""Files that appear whole or not at all, and files read with care: HDF5, EXR, NumPy, PLY, TOML, JSON, CSV."""

from spadwarp.io.arrays import *
from spadwarp.io.paths import *
from spadwarp.io.text import *
from spadwarp.values import guarded

guarded(__name__)
