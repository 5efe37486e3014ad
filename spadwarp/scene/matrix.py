"""Polarised light in a scene: the scattering matrix of its water, and what goes with it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from functools import partial

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ConfigError
from spadwarp.scene.medium import Medium
from spadwarp.scene.targets import Target
from spadwarp.scene.transport import Transport
from spadwarp.water import rayleigh_matrix, read_matrix_table, scaled_rayleigh_matrix, voss_fry_matrix

__all__ = ["Matrix", "check_polarisation", "scattering_matrix"]

Matrix = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Cosines of the scattering angle `[n]` → m12, m22, m33, m34 and m44, each over m11, `[n, 5]`: I′ = I + m12 Q,
Q′ = m12 I + m22 Q, U′ = m33 U + m34 V, V′ = −m34 U + m44 V with respect to the plane of scattering (Bohren & Huffman
1983, eq 4.77)."""


def scattering_matrix(medium: Medium) -> Matrix | None:
    """The scattering matrix of a scene's medium, over its phase function, `scattering_matrix(scene.medium)`; None for
    "none".

    Raises `FileError` or `ConfigError` if its table cannot be read.
    """
    if medium.scattering_matrix == "tabulated":
        try:
            return read_matrix_table(str(medium.matrix_table))
        except ConfigError as error:
            raise ConfigError(f"medium.matrix_table: {error}") from None
    return {
        "none": None,
        "rayleigh": partial(rayleigh_matrix, depolarisation_ratio=medium.depolarisation_ratio),
        "scaled_rayleigh": partial(scaled_rayleigh_matrix, largest=medium.largest_polarisation),
        "voss_fry": voss_fry_matrix,
    }[medium.scattering_matrix]


def check_polarisation(medium: Medium, transport: Transport, targets: Sequence[Target]) -> None:
    """Raises `ValueError` for sections of a scene that do not go with polarised light."""
    if transport.axis_threshold < 1.0:
        raise ValueError(
            f"transport.axis_threshold = {transport.axis_threshold} does not go with polarised light: set it to 1, "
            "for directions without the near-axis rule"
        )
    if medium.scattering_matrix == "none" and medium.range.scattering > 0.0:
        raise ValueError(
            "medium.scattering_matrix = 'none' does not go with polarised light in water that scatters: choose "
            "'rayleigh', 'scaled_rayleigh', 'voss_fry' or 'tabulated'"
        )
    for k, target in enumerate(targets):
        if target.specular > 0.0 and abs(target.specular_index / medium.phase_index - 1.0) < 1e-3:
            raise ValueError(
                f"targets[{k}].specular_index = {target.specular_index} is that of the water, "
                f"{medium.phase_index:.4g}: such facets reflect nothing"
            )
