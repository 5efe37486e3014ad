"""Phase functions of the water, and what `guided` draws from instead."""

from .densities import (
    fournier_forand_density,
    henyey_greenstein_density,
    interpolated_density,
    rayleigh_density,
    sphere_integral,
    two_term_henyey_greenstein_density,
)
from .henyey_greenstein import (
    HENYEY_GREENSTEIN,
    HENYEY_GREENSTEIN_GUIDE,
    henyey_greenstein_pdf,
    henyey_greenstein_score,
    sample_henyey_greenstein,
)
from .phase_function import Guiding, PhaseFunction, PhaseGuide
from .registry import PHASE_FUNCTIONS
from .tabulated import TABULATED, make_phase_tables

__all__ = [
    "HENYEY_GREENSTEIN",
    "HENYEY_GREENSTEIN_GUIDE",
    "PHASE_FUNCTIONS",
    "TABULATED",
    "Guiding",
    "PhaseFunction",
    "PhaseGuide",
    "fournier_forand_density",
    "henyey_greenstein_density",
    "henyey_greenstein_pdf",
    "henyey_greenstein_score",
    "interpolated_density",
    "make_phase_tables",
    "rayleigh_density",
    "sample_henyey_greenstein",
    "sphere_integral",
    "two_term_henyey_greenstein_density",
]
