"""The analytic simulator: photon budget, Cramér–Rao bound, depth frames."""

from .cramer_rao import *
from .depth_frames import *
from .optics import *
from .rates import *
