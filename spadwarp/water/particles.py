"""Scattering and absorption of particles from what they are: two components after Kopelevich, or Mie's theory of sizes.

>>> particles = spadwarp.water.mie_particles(
...     spadwarp.water.power_law(4.0, smallest=0.1e-6, largest=50e-6), 532.0, index=1.10 + 0.001j, concentration=0.5
... )
>>> water = spadwarp.water.mixture([particles], salinity=35.0)
>>> spadwarp.water.save_phase_table(water, "harbour.csv")
>>> spadwarp.water.save_matrix_table(water, "harbour_matrix.csv")

Diameters are in metres, concentrations in parts per million of volume, cm³ of particles in a m³ of water.
"""

from __future__ import annotations

import math
import os
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.arrays import Floats
from spadwarp.io import write_text
from spadwarp.values import ArgumentError, check_integer, check_real
from spadwarp.water.scattering_matrix import MATRIX_COLUMNS, rayleigh_matrix
from spadwarp.water.seawater import (
    Coefficients,
    check_ranges,
    molecular_density,
    pure_water_absorption,
    pure_water_scattering,
    refractive_index,
    table_columns,
)

__all__ = ["ParticleOptics", "SizeDistribution", "kopelevich_particles", "log_normal", "mie_particles", "mixture"]
__all__ += ["power_law", "save_matrix_table", "save_phase_table", "single_size"]

_ANGLES = np.concatenate([np.geomspace(0.01, 10.0, 181)[:-1], np.linspace(10.0, 180.0, 341)])  # [°]
_PPM = 1e-6
_DIAMETERS = "[1e-9, 1e-2] m"
# Of a sphere's size parameter: beyond it a table has more than a million angles.
_LARGEST = 2e4


@dataclass(frozen=True, eq=False, kw_only=True)
class ParticleOptics(Coefficients):
    """Optical properties at one wavelength of particles, or of water with particles in it."""

    angles_deg: Floats  # scattering angles `[n]` [°], ascending to 180
    density: Floats  # phase function at them [1/sr], of unit integral over the sphere
    matrix: Floats | None = None
    """Elements m12, m22, m33, m34 and m44 of the scattering matrix at them, each over the phase function `[n, 5]`; None
    where only the phase function is known (Kopelevich's components)."""

    @cached_property
    def mean_cosine(self) -> float:
        """⟨cosθ⟩ of the scattering angle."""
        return self._integral(lambda t: 1.0 - t)

    @cached_property
    def backscatter_fraction(self) -> float:
        """Part of the scattered light that is scattered by more than 90°, b_b/b."""
        return self._integral(lambda t: np.asarray(t > 1.0, float))

    def _integral(self, of_t: Any) -> float:
        from spadwarp_kernels import interpolated_density, sphere_integral

        density = interpolated_density(np.radians(self.angles_deg), self.density)
        return sphere_integral(lambda t: density(t) * of_t(t))


@dataclass(frozen=True, eq=False)
class SizeDistribution:
    """How many particles have which diameter: its `text` in words, ascending diameters `[n]` [m] in equal steps of the
    logarithm, and numbers of particles about each of them `[n]`, of any scale."""

    text: str
    diameters: Floats
    numbers: Floats

    @property
    def volume(self) -> float:
        """Mean volume of a particle [m³]."""
        return float((self.numbers * math.pi / 6.0 * self.diameters**3).sum() / self.numbers.sum())


def power_law(slope: float, *, smallest: float, largest: float, sizes: int = 200) -> SizeDistribution:
    """Junge's distribution, dN/dD ∝ D^−slope between two diameters [m]; in the sea the slope is 3 to 5, mostly near 4.

    `sizes` is how many diameters stand for it. Raises `ArgumentError` for a value out of its range.
    """
    slope = check_real("slope", slope, "[0, 10]")
    smallest = check_real("smallest", smallest, _DIAMETERS)
    largest = check_real("largest", largest, f"({smallest}, 1e-2] m")
    edges = np.geomspace(smallest, largest, check_integer("sizes", sizes, "[2, 10000]") + 1)
    diameters = np.sqrt(edges[1:] * edges[:-1])
    text = f"power law of slope {slope:g} from {smallest * 1e6:g} to {largest * 1e6:g} um"
    return SizeDistribution(text, diameters, diameters ** (1.0 - slope))


def log_normal(median: float, *, deviation: float, sizes: int = 200) -> SizeDistribution:
    """Diameters whose logarithm is normal: median of the number [m], geometric standard deviation > 1; to 5 of these.

    Raises `ArgumentError` for a value out of its range.
    """
    median, deviation = check_real("median", median, _DIAMETERS), check_real("deviation", deviation, "(1, 10]")
    reach = np.linspace(-5.0, 5.0, check_integer("sizes", sizes, "[2, 10000]"))
    # Volume, and with it light, is of the larger ones: 3 σ² further.
    reach = reach + 2.0 * math.log(deviation)
    text = f"log-normal of median {median * 1e6:g} um and geometric deviation {deviation:g}"
    return SizeDistribution(text, median * deviation**reach, np.exp(-0.5 * reach**2))


def single_size(diameter: float) -> SizeDistribution:
    """Particles of one diameter [m]."""
    diameter = check_real("diameter", diameter, _DIAMETERS)
    return SizeDistribution(f"diameter {diameter * 1e6:g} um", np.array([diameter]), np.ones(1))


def mie_particles(
    distribution: SizeDistribution,
    wavelength_nm: float,
    *,
    index: complex,
    concentration: float,
    temperature: float = 20.0,
    salinity: float = 35.0,
) -> ParticleOptics:
    """Homogeneous spheres in water by Mie's theory, computed by the library miepython (extra `mie`).

    b = Σ N(D)·πD²/4·Q_sca(D), a likewise with Q_ext − Q_sca; the phase function is the sum of (|S1|² + |S2|²)/2 over b,
    and the scattering matrix follows from S1 and S2 in the same way (Bohren & Huffman 1983, eq 4.77). 1 - ⟨cosθ⟩ and
    b_b are those of the series within 0.1 % up to a size parameter of 1000, 0.13 mm of diameter in green light.

    Args:
        distribution: `power_law`, `log_normal`, `single_size`, or numbers and diameters of your own.
        wavelength_nm: In vacuum, 400 to 700 [nm].
        index: Of the particles over that of the water, n + ik with k ≥ 0: organic matter 1.02 to 1.08, minerals 1.14 to
            1.22, k 0 to 0.01.
        concentration: Volume of the particles [ppm], cm³ in a m³ of water.
        temperature, salinity: Of the water [°C], [g/kg].

    Raises `ArgumentError`: a value out of its range; `FileError`: miepython is not installed.
    """
    import miepython

    check_ranges(wavelength_nm=wavelength_nm, temperature=temperature, salinity=salinity)
    concentration = check_real("concentration", concentration, "(0, 1e6] ppm")
    real, absorbing = check_real("index.real", complex(index).real, "[0.5, 5]"), complex(index).imag
    check_real("index.imag", absorbing, "[0, 5]")
    diameters = np.asarray(distribution.diameters, np.float64)
    numbers = np.asarray(distribution.numbers, np.float64)
    if diameters.shape != numbers.shape or diameters.ndim != 1 or not (diameters > 0).all() or not numbers.sum() > 0:
        raise ArgumentError("distribution: diameters > 0 and numbers are two lists of one length")
    in_water = wavelength_nm * 1e-9 / refractive_index(wavelength_nm, temperature=temperature, salinity=salinity)
    parameters = math.pi * diameters / in_water
    if parameters.max() > _LARGEST:
        limit = _LARGEST * in_water / math.pi
        raise ArgumentError(f"distribution: diameter {diameters.max():.3g} m is above {limit:.3g} m")
    per_volume = concentration * _PPM / (numbers * math.pi / 6.0 * diameters**3).sum() * numbers  # [1/m³]
    relative, cosines = complex(real, -absorbing), np.cos(_nodes(parameters.max()))
    lost = scattered = 0.0
    pattern = np.zeros((6, cosines.size))
    for parameter, diameter, count in zip(parameters, diameters, per_volume, strict=True):
        q_lost, q_scattered, *_ = miepython.efficiencies_mx(relative, parameter)
        section = count * 0.25 * math.pi * diameter**2
        lost, scattered = lost + section * q_lost, scattered + section * q_scattered
        s1, s2 = _amplitudes(miepython.coefficients(relative, parameter), cosines)
        both, across, along = s2 * s1.conj(), np.abs(s1) ** 2, np.abs(s2) ** 2
        # m22 is m11 and m44 is m33, of each sphere.
        elements = ((across + along) / 2, (along - across) / 2, (across + along) / 2, both.real, both.imag, both.real)
        pattern += section / parameter**2 * np.stack(elements)
    angles = _angles(parameters.max())
    m11, *others = (_between_nodes(element, angles) for element in pattern)
    matrix = np.stack(others, axis=-1) / m11[:, None]
    return _optics(wavelength_nm, max(float(lost - scattered), 0.0), float(scattered), angles, m11, matrix)


# All elements of a sphere's scattering matrix are polynomials of cosθ, of twice the degree of its series, and thus
# known everywhere from their values at as many angles in equal steps.


def _nodes(parameter: float) -> Floats:
    """Angles [rad] that determine the elements of spheres of a size parameter and of smaller ones."""
    terms = 2 * math.ceil(parameter + 4.05 * parameter ** (1 / 3) + 10.0) + 1
    return math.pi * (np.arange(terms) + 0.5) / terms


def _between_nodes(values: Floats, angles_deg: Floats) -> Floats:
    """An element with such values at other angles."""
    from scipy.fft import dct, idct

    fine = 1 << math.ceil(math.log2(256 * values.size))
    cosines = np.zeros(fine)
    cosines[: values.size] = dct(values, type=2, norm="ortho") * math.sqrt(fine / values.size)
    return np.interp(np.radians(angles_deg), math.pi * (np.arange(fine) + 0.5) / fine, idct(cosines, norm="ortho"))


def _angles(parameter: float) -> Floats:
    """Angles of a table [°]: 32 and more within a ripple of the largest sphere's pattern, 180°/x, so that straight
    lines between them keep 1 - g and b_b within 0.1 %, and a geometric sequence in its forward peak."""
    step, first, ratio = min(0.5, 180.0 / (32.0 * parameter)), min(0.01, 4.0 / parameter), 1000.0 ** (1.0 / 180.0)
    turn = min(step / (ratio - 1.0), 10.0)
    peak = np.geomspace(first, turn, 1 + math.ceil(math.log(turn / first) / math.log(ratio)))
    return np.concatenate([peak[:-1], np.linspace(turn, 180.0, 1 + math.ceil((180.0 - turn) / step))])


def _amplitudes(series: Any, cosine: Floats) -> list[NDArray[np.complex128]]:
    """S1 and S2 from the coefficients a and b of Mie's series (Bohren & Huffman 1983, eqs 4.47 and 4.74)."""
    before, now = np.zeros_like(cosine), np.ones_like(cosine)
    sums = [np.zeros(cosine.shape, complex), np.zeros(cosine.shape, complex)]
    for n, (electric, magnetic) in enumerate(zip(*series, strict=True), start=1):
        slope = n * cosine * now - (n + 1) * before
        weight = (2 * n + 1) / (n * (n + 1))
        sums[0] += weight * (electric * now + magnetic * slope)
        sums[1] += weight * (electric * slope + magnetic * now)
        before, now = now, ((2 * n + 1) * cosine * now - (n + 1) * before) / n
    return sums


def kopelevich_particles(wavelength_nm: float, *, small: float, large: float) -> ParticleOptics:
    """Scattering of marine particles in two components (Kopelevich 1983; Mobley 1994, chapter 3).

    b = 1.34·v_s·(550/λ)^1.7 + 0.312·v_l·(550/λ)^0.3, with measured phase functions of both; without absorption.

    Args:
        wavelength_nm: In vacuum, 400 to 700 [nm].
        small: v_s, mineral particles below 1 µm [ppm]; the sea has 0.01 to 0.2.
        large: v_l, organic particles above 1 µm [ppm]; the sea has 0.01 to 0.4.

    Raises `ArgumentError`: a value out of its range, or no particles.
    """
    check_ranges(wavelength_nm=wavelength_nm)
    small, large = check_real("small", small, "[0, 1e4] ppm"), check_real("large", large, "[0, 1e4] ppm")
    if small + large == 0.0:
        raise ArgumentError("small = 0 and large = 0: no particles")
    angles, *columns = table_columns("kopelevich_particles")
    ratio = 550.0 / wavelength_nm
    parts = ((1.34 * small * ratio**1.7, columns[0]), (0.312 * large * ratio**0.3, columns[1]))
    pattern = sum(b * _between(angles, values, _ANGLES) for b, values in parts)
    return _optics(wavelength_nm, 0.0, parts[0][0] + parts[1][0], _ANGLES, np.asarray(pattern))


def mixture(
    parts: Sequence[ParticleOptics], *, water: bool = True, temperature: float = 20.0, salinity: float = 35.0
) -> ParticleOptics:
    """Several kinds of particles of one wavelength together, with the water's own absorption and scattering.

    a and b add up; the phase function is the mean over the scattering, and the scattering matrix that over the light
    scattered by the angle. Raises `ArgumentError` for no parts, or different wavelengths.
    """
    if not parts or len({part.wavelength_nm for part in parts}) != 1:
        raise ArgumentError("parts: particles of one wavelength are needed")
    nm = parts[0].wavelength_nm
    absorption = math.fsum(part.absorption for part in parts)
    weights = [part.scattering for part in parts]
    angles = np.unique(np.concatenate([part.angles_deg for part in parts]))
    patterns = [part.scattering * _between(part.angles_deg, part.density, angles) for part in parts]
    matrices = [_matrix_between(part, angles) for part in parts]
    if water:
        own = pure_water_scattering(nm, temperature=temperature, salinity=salinity)
        cosines = np.cos(np.radians(angles))
        absorption += pure_water_absorption(nm)
        weights.append(own)
        patterns.append(own * molecular_density(1.0 - cosines))
        matrices.append(rayleigh_matrix(cosines))
    whole, known = np.sum(patterns, axis=0), [one for one in matrices if one is not None]
    matrix = None
    if len(known) == len(matrices):
        matrix = np.sum([p[:, None] * m for p, m in zip(patterns, known, strict=True)], axis=0) / whole[:, None]
    return _optics(nm, absorption, math.fsum(weights), angles, whole, matrix)


def save_phase_table(optics: ParticleOptics, path: str | os.PathLike[str]) -> Path:
    """Writes the phase function as a .csv file for `medium.phase_table`; its head has a and b. Raises `FileError`."""
    head = (
        f"absorption {optics.absorption:.6g} 1/m, scattering {optics.scattering:.6g} 1/m, mean cosine "
        f"{optics.mean_cosine:.5f}, backscatter fraction {optics.backscatter_fraction:.5f}"
    )
    return _save(optics, path, head, "angle_deg,value", optics.angles_deg, optics.density[:, None])


def save_matrix_table(optics: ParticleOptics, path: str | os.PathLike[str]) -> Path:
    """Writes the scattering matrix as a .csv file for `medium.matrix_table`, 0° to 180°. Raises `ArgumentError` if it
    is not known, `FileError` if the file cannot be written."""
    if optics.matrix is None:
        raise ArgumentError("optics.matrix: not known; measured phase functions come without a scattering matrix")
    # Straight on, symmetry leaves m12 = m34 = 0.
    rows = np.concatenate([optics.matrix[:1] * (0.0, 1.0, 1.0, 0.0, 1.0), optics.matrix])
    head = "elements of the scattering matrix over m11, the phase function"
    return _save(optics, path, head, ",".join(MATRIX_COLUMNS), np.append(0.0, optics.angles_deg), rows)


def _save(
    optics: ParticleOptics, path: str | os.PathLike[str], head: str, names: str, angles: Floats, rows: Floats
) -> Path:
    lines = [f"# {optics.wavelength_nm:g} nm: {head}", names]
    for angle, row in zip(angles, rows, strict=True):
        lines.append(f"{angle:.9g},{','.join(f'{value:.8g}' for value in row)}")
    return write_text("\n".join(lines) + "\n", Path(path))


def _optics(
    wavelength_nm: float,
    absorption: float,
    scattering: float,
    angles_deg: Floats,
    pattern: Floats,
    matrix: Floats | None = None,
) -> ParticleOptics:
    """With the pattern at the angles, of any scale, as a density."""
    from spadwarp_kernels import interpolated_density

    angles = np.radians(angles_deg)
    density = interpolated_density(angles, pattern)(2.0 * np.sin(0.5 * angles) ** 2)
    return ParticleOptics(
        wavelength_nm=float(wavelength_nm),
        absorption=float(absorption),
        scattering=float(scattering),
        angles_deg=angles_deg,
        density=density,
        matrix=matrix,
    )


def _matrix_between(part: ParticleOptics, angles_deg: Floats) -> Floats | None:
    """The scattering matrix of particles at other angles, straight between theirs."""
    if part.matrix is None:
        return None
    return np.stack([np.interp(angles_deg, part.angles_deg, column) for column in part.matrix.T], axis=-1)


def _between(angles_deg: Floats, values: Floats, others: Floats) -> Floats:
    """A table of a phase function at other angles as a density [1/sr]; its logarithm is straight between the points."""
    from spadwarp_kernels import sphere_integral

    def unscaled(t: Floats) -> Floats:
        degrees = np.degrees(2.0 * np.arcsin(np.sqrt(0.5 * np.asarray(t, np.float64))))
        return np.exp(np.interp(degrees, angles_deg, np.log(np.maximum(values, 1e-300))))

    return unscaled(2.0 * np.sin(0.5 * np.radians(others)) ** 2) / sphere_integral(unscaled)
