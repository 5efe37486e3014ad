"""What a photon adds to the histogram."""

from .estimator import *
from .registry import *
