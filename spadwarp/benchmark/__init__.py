"""How fast this machine is, in numbers that can be kept and compared: `run` measures named cases."""

from typing import TYPE_CHECKING

from spadwarp.benchmark.cases import *
from spadwarp.benchmark.runs import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = sorted(cases.__all__ + runs.__all__)
