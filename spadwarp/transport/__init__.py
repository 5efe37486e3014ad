"""Photon transport: a scene in, a `Result`, truth maps or photon records out."""

from typing import TYPE_CHECKING

from spadwarp.transport import derivatives, model, plan, reconstruction, records, simulation, spectrum, workers
from spadwarp.transport.derivatives import *
from spadwarp.transport.model import *
from spadwarp.transport.plan import *
from spadwarp.transport.reconstruction import *
from spadwarp.transport.records import *
from spadwarp.transport.simulation import *
from spadwarp.transport.spectrum import *
from spadwarp.transport.workers import *
from spadwarp.values import guarded

if not TYPE_CHECKING:  # type checkers follow the stars
    _modules = (derivatives, model, plan, reconstruction, records, simulation, spectrum, workers)
    __all__ = guarded(__name__, [name for module in _modules for name in module.__all__])
