"""The analytic simulator, photon budgets and plans: numbers without photon transport, or with little of it."""

from typing import TYPE_CHECKING

from spadwarp.analytic.budgets import *
from spadwarp.analytic.eye_safety import *
from spadwarp.analytic.model import *
from spadwarp.analytic.pilot import *
from spadwarp.analytic.planning import *
from spadwarp.analytic.result import *
from spadwarp.analytic.sweeps import *
from spadwarp.values import guarded

if not TYPE_CHECKING:  # type checkers follow the stars
    _modules = (budgets, eye_safety, model, pilot, planning, result, sweeps)
    __all__ = guarded(__name__, sorted(name for module in _modules for name in module.__all__))
