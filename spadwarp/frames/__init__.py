"""Frames of a SPAD camera: counts, arrival times, depth, the Cramér–Rao bound, files."""

from typing import TYPE_CHECKING

from spadwarp.frames import cramer_rao, depth, file, frames, measured, receiver, record, response, spad
from spadwarp.frames.cramer_rao import *  # noqa: F403
from spadwarp.frames.depth import *  # noqa: F403
from spadwarp.frames.file import *  # noqa: F403
from spadwarp.frames.frames import *  # noqa: F403
from spadwarp.frames.measured import *  # noqa: F403
from spadwarp.frames.receiver import *  # noqa: F403
from spadwarp.frames.record import *  # noqa: F403
from spadwarp.frames.response import *  # noqa: F403
from spadwarp.frames.spad import *  # noqa: F403

_MODULES = (cramer_rao, depth, file, frames, measured, receiver, record, response, spad)
if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = [name for module in _MODULES for name in module.__all__]
