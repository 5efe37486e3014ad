"""From counts to the scene: derivatives, Fisher information, Cramér–Rao bounds of all unknowns, fits."""

from typing import TYPE_CHECKING

from spadwarp.inverse.cramer_rao import *  # noqa: F403
from spadwarp.inverse.estimates import *  # noqa: F403
from spadwarp.inverse.exposure import *  # noqa: F403
from spadwarp.inverse.fitting import *  # noqa: F403
from spadwarp.inverse.tensors import *  # noqa: F403
from spadwarp.inverse.unknowns import *  # noqa: F403

if not TYPE_CHECKING:  # type checkers follow the stars
    _modules = (cramer_rao, estimates, exposure, fitting, tensors, unknowns)  # noqa: F405
    __all__ = sorted(name for module in _modules for name in module.__all__)
