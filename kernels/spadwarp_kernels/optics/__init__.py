"""Camera, lens, gate, ports and laser."""

from typing import TYPE_CHECKING

from .camera import *
from .laser import *
from .polarisation import *
from .port import *
from .sea import *
from .visibility import *

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = camera.__all__ + laser.__all__ + polarisation.__all__ + port.__all__ + sea.__all__ + visibility.__all__
