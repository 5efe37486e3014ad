"""Pictures, pages and videos: arrays in, images out."""

from typing import TYPE_CHECKING

from spadwarp.viz.curves import *  # noqa: F403
from spadwarp.viz.frames import *  # noqa: F403
from spadwarp.viz.notebook import *  # noqa: F403
from spadwarp.viz.result import *  # noqa: F403
from spadwarp.viz.sheets import *  # noqa: F403
from spadwarp.viz.transient_video import *  # noqa: F403
from spadwarp.viz.viewer import *  # noqa: F403
from spadwarp.viz.water import *  # noqa: F403

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = [*curves.__all__, *frames.__all__, *notebook.__all__, *result.__all__]  # noqa: F405
    __all__ += [*sheets.__all__, *transient_video.__all__, *viewer.__all__, *water.__all__]  # noqa: F405
