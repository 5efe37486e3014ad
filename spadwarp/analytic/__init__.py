"""The analytic simulator, photon budgets and plans: numbers without photon transport, or with little of it."""

from typing import TYPE_CHECKING

from spadwarp.analytic.eye_safety import *  # noqa: F403
from spadwarp.analytic.file import *  # noqa: F403
from spadwarp.analytic.model import *  # noqa: F403
from spadwarp.analytic.planning import *  # noqa: F403
from spadwarp.analytic.result import *  # noqa: F403
from spadwarp.analytic.sweeps import *  # noqa: F403

if not TYPE_CHECKING:  # type checkers follow the stars
    _modules = (eye_safety, file, model, planning, result, sweeps)  # noqa: F405
    __all__ = sorted(name for module in _modules for name in module.__all__)
