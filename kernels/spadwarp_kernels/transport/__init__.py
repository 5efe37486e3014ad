"""The transport kernel, what it takes and writes, and its launch."""

from typing import TYPE_CHECKING

from .launch import *
from .loops import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = loops.__all__ + launch.__all__
