"""Frames of a SPAD camera: counts, arrival times, depth, the Cramér–Rao bound, files."""

from spadwarp.frames.backgrounds import *
from spadwarp.frames.cramer_rao import *
from spadwarp.frames.depth import *
from spadwarp.frames.file import *
from spadwarp.frames.measured import *
from spadwarp.frames.response import *
from spadwarp.frames.spad import *
from spadwarp.values import guarded

guarded(__name__)
