"""Photon transport: a scene in, a `Result`, truth maps or photon records out."""

from typing import TYPE_CHECKING

from spadwarp.transport import derivatives, light, model, plan, records, simulation, tally_unit, workers
from spadwarp.transport.derivatives import *  # noqa: F403
from spadwarp.transport.light import *  # noqa: F403
from spadwarp.transport.model import *  # noqa: F403
from spadwarp.transport.plan import *  # noqa: F403
from spadwarp.transport.records import *  # noqa: F403
from spadwarp.transport.simulation import *  # noqa: F403
from spadwarp.transport.tally_unit import *  # noqa: F403
from spadwarp.transport.workers import *  # noqa: F403

if not TYPE_CHECKING:  # type checkers follow the stars
    _modules = (derivatives, light, model, plan, records, simulation, tally_unit, workers)
    __all__ = [name for module in _modules for name in module.__all__]
