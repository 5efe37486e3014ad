"""What a photon carries and adds to, the choices that make a kernel, and the queue of a warp."""

from .derivatives import *
from .spec import *
from .state import *
