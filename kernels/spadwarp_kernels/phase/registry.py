"""The phase functions by name."""

from .henyey_greenstein import HENYEY_GREENSTEIN
from .phase_function import PhaseFunction
from .tabulated import TABULATED

PHASE_FUNCTIONS: dict[str, PhaseFunction] = {one.name: one for one in (HENYEY_GREENSTEIN, TABULATED)}
"""What `TransportSpec.phase` may be; add one of your own here, and the tests compare its samples with its density."""
