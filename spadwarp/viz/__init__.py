"""Pictures, pages and videos: arrays in, images out."""

from typing import TYPE_CHECKING

from spadwarp.values import guarded
from spadwarp.viz.curves import *
from spadwarp.viz.notebook import *
from spadwarp.viz.result import *
from spadwarp.viz.scenes import *
from spadwarp.viz.viewer import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = guarded(__name__, [*result.__all__, *scenes.__all__, *curves.__all__, *viewer.__all__, *notebook.__all__])
