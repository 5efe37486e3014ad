"""The phase function of a scene's water as a density of the scattering angle, in float64."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.errors import ConfigError
from spadwarp.io.text import read_columns
from spadwarp.scene.medium import Medium
from spadwarp.scene.preset import PHASE_TABLES
from spadwarp.water import molecular_density

__all__ = ["PHASE_COLUMNS", "PhaseFunction", "phase_function"]

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
        from spadwarp_kernels import sphere_integral

        if self.name == "henyey_greenstein":
            return (1.0 - self.molecular_share) * float(self.parameters["anisotropy"])
        return sphere_integral(lambda t: self.over_t(t) * (1.0 - t))

    @cached_property
    def backscatter_fraction(self) -> float:
        """Part of the light that is scattered by more than 90°."""
        from spadwarp_kernels import sphere_integral

        return sphere_integral(lambda t: self.over_t(t) * (t > 1.0))

    def fraction_below(self, angle: float) -> float:
        """Part of the light that is scattered by less than an angle [rad] in (0, π]."""
        from spadwarp_kernels import sphere_integral

        share = math.sin(0.5 * angle) ** 2
        return share * sphere_integral(lambda t: self.over_t(share * t))


def phase_function(medium: Medium) -> PhaseFunction:
    """The phase function of a scene's medium, `phase_function(scene.medium)`.

    Raises `FileError` if its table cannot be read, `ConfigError` if the table is not a phase function.
    """
    import spadwarp_kernels as sk

    density: Callable[[Floats], Floats]
    first_angle = 0.0
    name, parameters = medium.phase_function, medium.phase_parameters
    if name == "tabulated":
        table = str(medium.phase_table)
        path = (
            Path(__file__).parents[1] / "water" / "tables" / PHASE_TABLES[table][0]
            if table in PHASE_TABLES
            else Path(table)
        )
        try:
            angles, values = read_columns(path, PHASE_COLUMNS).T
        except ConfigError as error:
            raise ConfigError(f"medium.phase_table: {error}") from None
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
