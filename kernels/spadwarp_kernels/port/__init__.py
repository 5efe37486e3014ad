"""What is between a camera or a laser in its housing and the water."""

from .kinds import DOME_PORT, FLAT_PORT, PortKind, make_dome_port, make_flat_port
from .port import Connection, Passage, Port, transmission

__all__ = [
    "DOME_PORT",
    "FLAT_PORT",
    "Connection",
    "Passage",
    "Port",
    "PortKind",
    "make_dome_port",
    "make_flat_port",
    "transmission",
]
