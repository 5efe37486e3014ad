"""From counts to the scene: derivatives, Fisher information, Cramér–Rao bounds of all unknowns, fits."""

from typing import TYPE_CHECKING

from spadwarp.inverse.cramer_rao import *
from spadwarp.inverse.exposure import *
from spadwarp.inverse.fitting import *
from spadwarp.inverse.tensors import *
from spadwarp.inverse.unknowns import *
from spadwarp.values import guarded

if not TYPE_CHECKING:  # type checkers follow the stars
    _modules = (cramer_rao, exposure, fitting, tensors, unknowns)
    __all__ = guarded(__name__, sorted(name for module in _modules for name in module.__all__))
