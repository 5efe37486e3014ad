"""The fields of `medium` that belong to each phase function."""

from __future__ import annotations

from typing import NamedTuple


class PhaseFields(NamedTuple):
    """Fields of a phase function.

    Attributes:
        needed: None by default: the phase function needs them, and no other takes them.
        optional: With a default; phase functions may share them.
    """

    needed: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()


PHASE_FIELDS = {
    "henyey_greenstein": PhaseFields(optional=("anisotropy",)),
    "two_term_henyey_greenstein": PhaseFields(needed=("g1", "g2", "alpha")),
    "fournier_forand": PhaseFields(optional=("particle_index", "junge_slope")),
    "rayleigh": PhaseFields(optional=("depolarisation_ratio",)),
    "tabulated": PhaseFields(needed=("phase_table",)),
}
