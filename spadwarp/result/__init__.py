"""The result of a simulation as plain data, its files, the sum of results, and truth maps from other programs."""

from spadwarp.result.analysis import *
from spadwarp.result.conversion import *
from spadwarp.result.file import *
from spadwarp.result.result import *
from spadwarp.result.tallies import *
from spadwarp.values import guarded

guarded(__name__)
