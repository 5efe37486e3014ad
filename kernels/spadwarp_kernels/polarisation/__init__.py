"""Polarised light: Stokes vectors that photons carry, what turns them, and what a receiver takes of them."""

from .crossing import make_crossing_stokes
from .emission import make_first_stokes
from .events import make_event_stokes, make_reflected_stokes
from .fresnel import facet_elements, fresnel_elements
from .receiver import make_add_channels, make_leave_water, make_receive
from .request import MATRIX_POINTS, MOST_CHANNELS, Polarisation, make_polarisation, matrix_cosines
from .stokes import Elements, table_elements, transport_stokes, turn_stokes

__all__ = [
    "MATRIX_POINTS",
    "MOST_CHANNELS",
    "Elements",
    "Polarisation",
    "facet_elements",
    "fresnel_elements",
    "make_add_channels",
    "make_crossing_stokes",
    "make_event_stokes",
    "make_first_stokes",
    "make_leave_water",
    "make_polarisation",
    "make_receive",
    "make_reflected_stokes",
    "matrix_cosines",
    "table_elements",
    "transport_stokes",
    "turn_stokes",
]
