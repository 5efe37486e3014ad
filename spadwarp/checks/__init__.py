"""Warnings and notes on a scene that is valid, in numbers, before a photon is traced."""

from typing import TYPE_CHECKING

from spadwarp.checks.checks import *
from spadwarp.checks.survey import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = sorted(checks.__all__ + survey.__all__)
