"""The water: its coefficients, layers, cells and phase functions; its walls and the limits that end a history."""

from .grid import *
from .limits import *
from .medium import *
from .phase_functions import *
