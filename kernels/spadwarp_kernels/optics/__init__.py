"""Camera, lens, gate, ports and laser."""

from .camera import *
from .laser import *
from .polarisation import *
from .port import *
from .sea import *
from .visibility import *
