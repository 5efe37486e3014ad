"""What all packages use: checks of arguments, kernels made once, random numbers, tables, rotations."""

from .check import *
from .kernels import *
from .philox import *
from .rotations import *
