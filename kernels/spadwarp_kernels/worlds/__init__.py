"""SPAD cameras in simulations: many worlds in one launch, moving shapes, nothing read back."""

from .shapes import *
from .simulators import *
from .spad_camera import *
from .spad_config import *
from .spad_tracer import *
