"""Photon transport: a scene in, a `Result`, truth maps or photon records out."""

from spadwarp.transport.derivatives import *
from spadwarp.transport.model import *
from spadwarp.transport.plan import *
from spadwarp.transport.reconstruction import *
from spadwarp.transport.records import *
from spadwarp.transport.simulation import *
from spadwarp.transport.spectrum import *
from spadwarp.transport.workers import *
from spadwarp.values import guarded

guarded(__name__)
