"""From counts to the scene: derivatives, Fisher information, Cramér–Rao bounds of all unknowns, fits."""

from spadwarp.inverse.exposure import *
from spadwarp.inverse.fitting import *
from spadwarp.inverse.goodness import *
from spadwarp.inverse.tensors import *
from spadwarp.inverse.unknowns import *
from spadwarp.values import guarded

guarded(__name__)
