"""Frames of a SPAD camera: counts, arrival times, depth, the Cramér–Rao bound, files."""

from typing import TYPE_CHECKING

from spadwarp.frames import cramer_rao, depth, file, measured, response, spad
from spadwarp.frames.cramer_rao import *
from spadwarp.frames.depth import *
from spadwarp.frames.file import *
from spadwarp.frames.measured import *
from spadwarp.frames.response import *
from spadwarp.frames.spad import *
from spadwarp.values import guarded

_MODULES = (cramer_rao, depth, file, measured, response, spad)
if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = guarded(__name__, [name for module in _MODULES for name in module.__all__])
