"""The transport kernel, what it takes and writes, and its launch."""

from typing import TYPE_CHECKING

from .kernel import *
from .launch import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = kernel.__all__ + launch.__all__
