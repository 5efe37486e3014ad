"""The analytic simulator, photon budgets and plans: numbers without photon transport, or with little of it."""

from spadwarp.analytic.budgets import *
from spadwarp.analytic.eye_safety import *
from spadwarp.analytic.model import *
from spadwarp.analytic.pilot import *
from spadwarp.analytic.planning import *
from spadwarp.analytic.result import *
from spadwarp.analytic.sweeps import *
from spadwarp.values import guarded

guarded(__name__)
