"""Scattering by a scene's water, in float64: the phase function and the scattering matrix of polarised light."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ConfigError
from spadwarp.scene.medium import Medium
from spadwarp.scene.sections import read_table
from spadwarp.scene.settings import Transport
from spadwarp.scene.surroundings import Target
from spadwarp.scene.tables import PHASE_TABLES
from spadwarp.water import (
    molecular_density,
    rayleigh_matrix,
    read_matrix_table,
    scaled_rayleigh_matrix,
    voss_fry_matrix,
)

__all__ = ["Matrix", "PhaseFunction", "phase_function", "scattering_matrix"]

Floats = NDArray[np.float64]

PHASE_COLUMNS = {"angle_deg": "[0, 180]", "value": "[0, 1e30]"}
"""Columns of a phase table: scattering angle [°] and value of any scale."""


@dataclass(frozen=True, eq=False)
class PhaseFunction:
    """Probability density of the direction of scattered light, of unit integral over the sphere.

    Attributes:
        name: `medium.phase_function`.
        parameters: The medium's fields that it takes.
        molecular_share: Part of the scattering that is the water's own and not of that name.
        over_t: The density [1/sr] over t = 1 - cosθ in (0, 2].
        first_angle: Of a table [rad]; below it the table is continued.
    """

    name: str
    parameters: dict[str, float | str]
    molecular_share: float
    over_t: Callable[[Floats], Floats]
    first_angle: float = 0.0

    def density(self, angle: ArrayLike) -> Floats:
        """p(θ) [1/sr] at scattering angles θ [rad] in (0, π]; at 0 Fournier–Forand and steep tables are infinite."""
        return self.over_t(2.0 * np.sin(0.5 * np.asarray(angle, np.float64)) ** 2)

    @cached_property
    def mean_cosine(self) -> float:
        """⟨cosθ⟩, the asymmetry parameter g."""
        if self.name == "henyey_greenstein":
            return (1.0 - self.molecular_share) * float(self.parameters["anisotropy"])
        return _sphere_integral(lambda t: self.over_t(t) * (1.0 - t))

    @cached_property
    def backscatter_fraction(self) -> float:
        """Part of the light that is scattered by more than 90°."""
        return _sphere_integral(lambda t: self.over_t(t) * (t > 1.0))

    def fraction_below(self, angle: float) -> float:
        """Part of the light that is scattered by less than an angle [rad] in (0, π]."""
        share = math.sin(0.5 * angle) ** 2
        return share * _sphere_integral(lambda t: self.over_t(share * t))


def _sphere_integral(density: Callable[[Floats], Floats]) -> float:
    from spadwarp_kernels import sphere_integral

    return sphere_integral(density)


def phase_function(medium: Medium) -> PhaseFunction:
    """The phase function of a scene's medium, `phase_function(scene.medium)`.

    Raises `FileError` if its table cannot be read, `ConfigError` if the table is not a phase function.
    """
    import spadwarp_kernels as sk

    density: Callable[[Floats], Floats]
    first_angle = 0.0
    name, parameters = medium.phase_function, medium.phase_parameters
    if name == "tabulated":
        path = Path(str(medium.phase_table))
        if str(path) in PHASE_TABLES:
            path = Path(__file__).parents[1] / "water" / "tables" / PHASE_TABLES[str(path)][0]
        angles, values = read_table("medium.phase_table", path, PHASE_COLUMNS)
        try:
            density = sk.interpolated_density(np.radians(angles), values)
            first_angle = math.radians(float(angles[0]))
        except ValueError as error:
            raise ConfigError(f"medium.phase_table: {path}: {error}") from None
    else:
        numbers: dict[str, Any] = {"g": medium.anisotropy} if name == "henyey_greenstein" else dict(parameters)
        density = partial(getattr(sk, f"{name}_density"), **numbers)
    share = medium.molecular_share
    if share > 0.0:
        of_particles = density

        def density(t: Floats) -> Floats:
            return (1.0 - share) * of_particles(t) + share * molecular_density(t)

    return PhaseFunction(name, parameters, share, density, first_angle)


Matrix = Callable[[NDArray[np.float64]], NDArray[np.float64]]
"""Cosines of the scattering angle `[n]` → m12, m22, m33, m34 and m44, each over m11, `[n, 5]`: I′ = I + m12 Q,
Q′ = m12 I + m22 Q, U′ = m33 U + m34 V, V′ = −m34 U + m44 V with respect to the plane of scattering (Bohren & Huffman
1983, eq 4.77)."""


def scattering_matrix(medium: Medium) -> Matrix | None:
    """The scattering matrix of a scene's medium, over its phase function, `scattering_matrix(scene.medium)`; None for
    "none".

    Raises `FileError` or `ConfigError` if its table cannot be read.
    """
    if medium.scattering_matrix == "rayleigh":
        return partial(rayleigh_matrix, depolarisation_ratio=medium.depolarisation_ratio)
    if medium.scattering_matrix == "scaled_rayleigh":
        return partial(scaled_rayleigh_matrix, largest=medium.largest_polarisation)
    if medium.scattering_matrix == "tabulated":
        try:
            return read_matrix_table(str(medium.matrix_table))
        except ConfigError as error:
            raise ConfigError(f"medium.matrix_table: {error}") from None
    return voss_fry_matrix if medium.scattering_matrix == "voss_fry" else None


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
