"""The result of a simulation as plain data, its files, the sum of results, and truth maps from other programs."""

from typing import TYPE_CHECKING

from spadwarp.result import conversion, file, merging, rendered_truth, result, tallies
from spadwarp.result.conversion import *  # noqa: F403
from spadwarp.result.file import *  # noqa: F403
from spadwarp.result.merging import *  # noqa: F403
from spadwarp.result.rendered_truth import *  # noqa: F403
from spadwarp.result.result import *  # noqa: F403
from spadwarp.result.tallies import *  # noqa: F403

if not TYPE_CHECKING:  # type checkers follow the stars
    _modules = (conversion, file, merging, rendered_truth, result, tallies)
    __all__ = [name for module in _modules for name in module.__all__]
