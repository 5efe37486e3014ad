"""The result of a simulation as plain data, its files, the sum of results, and truth maps from other programs."""

from typing import TYPE_CHECKING

from spadwarp.result import conversion, file, flux, noise, rendered_truth, result, tallies
from spadwarp.result.conversion import *
from spadwarp.result.file import *
from spadwarp.result.flux import *
from spadwarp.result.noise import *
from spadwarp.result.rendered_truth import *
from spadwarp.result.result import *
from spadwarp.result.tallies import *
from spadwarp.values import guarded

if not TYPE_CHECKING:  # type checkers follow the stars
    _modules = (conversion, file, flux, noise, rendered_truth, result, tallies)
    __all__ = guarded(__name__, [name for module in _modules for name in module.__all__])
