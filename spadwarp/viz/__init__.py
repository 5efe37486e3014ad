"""Pictures, pages and videos: arrays in, images out."""

from typing import TYPE_CHECKING

from spadwarp.viz.curves import *  # noqa: F403
from spadwarp.viz.notebook import *  # noqa: F403
from spadwarp.viz.result import *  # noqa: F403
from spadwarp.viz.scenes import *  # noqa: F403
from spadwarp.viz.viewer import *  # noqa: F403

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = [*result.__all__, *scenes.__all__, *curves.__all__, *viewer.__all__, *notebook.__all__]  # noqa: F405
