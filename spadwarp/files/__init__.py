"""Files opened and written: runs, frames, datasets, formats of other programs, JSON Schema of our TOML files."""

from typing import TYPE_CHECKING

from spadwarp.files import formats, lidar, loader, run, schema
from spadwarp.files.formats import *
from spadwarp.files.lidar import *
from spadwarp.files.loader import *
from spadwarp.files.run import *
from spadwarp.files.schema import *
from spadwarp.values import guarded

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = guarded(__name__, formats.__all__ + lidar.__all__ + loader.__all__ + run.__all__ + schema.__all__)
