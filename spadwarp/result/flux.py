"""The light inside the water as a result holds it, by section of `[[flux]]`; and its apparent optical properties."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.lib.stride_tricks import as_strided
from numpy.typing import NDArray

from spadwarp.arrays import Floats
from spadwarp.io.hdf5 import Coordinate
from spadwarp.result.tallies import FluxTallies
from spadwarp.scene import Scene
from spadwarp.scene.flux import FluxArray
from spadwarp.values import ArgumentError, ConfigError, check_choice

if TYPE_CHECKING:
    from spadwarp.result.result import Result

__all__ = ["Apparent", "FluxValues", "apparent"]


@dataclass(frozen=True, eq=False, kw_only=True)
class FluxValues:
    """One array of a section, float64, with an axis for each dimension: "fluence" `[gate, x, y, z]` [1/m²],
    "irradiance" `[position, kind]` or "radiance" `[position, polar, azimuth]` [1/sr], of planes with a radius by m².

    By emitted photon: times the energy of a pulse, or the irradiance of the sun, it is that in joules or watts.
    """

    values: Floats
    errors: Floats | None  # standard errors; None without batches
    dimensions: Mapping[str, Coordinate]  # values, unit and meaning of each axis
    unit: str

    def rate(self) -> Floats:
        """Of a fluence the fluence rate [1/(m²·s)]: over the width of the gates.

        Raises `ConfigError` for anything else, and for a fluence of all times.
        """
        gates = np.asarray(self.dimensions.get("gate", ((),))[0], np.float64)
        if len(gates) < 2:
            raise ConfigError("a rate needs a volume with two gates or more")
        return self.values / (gates[1] - gates[0])


def flux_arrays(scene: Scene) -> dict[str, FluxArray]:
    """Of all sections of a scene, such as "around/fluence", in the order of the tally."""
    found, first, absorption = dict[str, FluxArray](), 0, scene.medium.range.absorption
    for section in scene.flux:
        found |= {f"{section.name}/{name}": array for name, array in section.arrays(absorption, first).items()}
        first += section.size
    return found


def part_of(entries: NDArray[Any], array: FluxArray) -> NDArray[Any]:
    """An array of a tally, or of its words: a view."""
    rows, width = array.shape[0], int(np.prod(array.shape[1:]))
    stride = array.stride if "position" in array.dimensions else width
    held, step = entries[..., array.first :], entries.strides[-1]
    view = as_strided(held, (*held.shape[:-1], rows, width), (*held.strides[:-1], stride * step, step))
    return view.reshape(*held.shape[:-1], *array.shape)


def flux_of(result: Result) -> dict[str, dict[str, FluxValues]]:
    """Section → its arrays by name."""
    tallies, sections = result.flux_tallies, dict[str, dict[str, FluxValues]]()
    for name, array in flux_arrays(result.scene).items():
        assert tallies is not None
        section, _, kind = name.partition("/")
        value, errors = array.value / result.photons, None
        counts = part_of(tallies.tallies, array)
        if tallies.second_moment is not None and result.batches > 1:
            errors = result.batch_error(counts[None], part_of(tallies.second_moment, array)) * value
        made = FluxValues(values=counts * value, errors=errors, dimensions=array.dimensions, unit=array.unit)
        sections.setdefault(section, {})[kind] = made
    return sections


def check_flux(scene: Scene, tallies: FluxTallies | None, batches: int) -> None:
    """Refuses tallies that are not those of the scene's sections."""
    size, moments = sum(section.size for section in scene.flux), None if tallies is None else tallies.second_moment
    shapes = [None if one is None else one.shape for one in (None if tallies is None else tallies.tallies, moments)]
    needed = [(size,), (2, size) if batches else None] if scene.flux else [None, None]
    if shapes != needed:
        raise ArgumentError(f"flux_tallies and their second moment have the shapes {shapes}; {needed} are needed")


# Apparent optical properties


@dataclass(frozen=True, eq=False, kw_only=True)
class Apparent:
    """Apparent optical properties of the light through planes, of N positions; each with its standard error, which
    takes the tallies of two as independent: too large where the same photons cross both."""

    position: Floats  # of the planes along their axis [m], `[N]`
    irradiance: Floats  # downward, upward, scalar downward and scalar upward, `[N, 4]`
    reflectance: Floats  # R = E_u/E_d, `[N]`
    mean_cosine_downward: Floats  # E_d over the scalar downward irradiance, `[N]`
    mean_cosine_upward: Floats  # likewise, `[N]`
    mean_cosine: Floats  # (E_d - E_u) over the scalar irradiance, `[N]`
    middle: Floats  # between the planes [m], `[N - 1]`
    attenuation: Floats  # K_d = -d ln E_d/dz between the planes [1/m], `[N - 1]`
    errors: Mapping[str, Floats]  # standard error of each of those above but position and middle, by name


def apparent(result: Result, section: str | None = None) -> Apparent:
    """Diffuse attenuation, irradiance reflectance and mean cosines at the planes of a section of `[[flux]]`.

    `section`: its name; by default that of the first section with planes.

    Raises `ConfigError`: the result has no planes, or no errors; `ArgumentError` for another name.
    """
    names = [one.name for one in result.scene.flux if one.positions is not None]
    if not names:
        raise ConfigError("apparent: the result has no [[flux]] with positions of planes", source=result.scene.source)
    found = flux_of(result)[names[0] if section is None else check_choice("section", section, names)]["irradiance"]
    if found.errors is None:
        raise ConfigError("apparent: the result has no errors; simulate with more photons", source=result.scene.source)
    position, light, error = np.asarray(found.dimensions["position"][0]), found.values, found.errors
    down, up, scalar_down, scalar_up = light.T
    with np.errstate(divide="ignore", invalid="ignore"):
        share = error / light
        pairs = {"reflectance": (1, 0), "mean_cosine_downward": (0, 2), "mean_cosine_upward": (1, 3)}
        values = {name: light[:, a] / light[:, b] for name, (a, b) in pairs.items()}
        errors = {name: values[name] * np.hypot(share[:, a], share[:, b]) for name, (a, b) in pairs.items()}
        scalar = scalar_down + scalar_up
        values["mean_cosine"] = (down - up) / scalar
        # Of the difference, and of the sum below it.
        above, below = np.hypot(error[:, 0], error[:, 1]) / scalar, np.hypot(error[:, 2], error[:, 3]) / scalar
        errors["mean_cosine"] = np.hypot(above, values["mean_cosine"] * below)
        values["attenuation"] = -np.diff(np.log(down)) / np.diff(position)
        errors["attenuation"] = np.hypot(share[1:, 0], share[:-1, 0]) / np.diff(position)
    middle, errors["irradiance"] = 0.5 * (position[1:] + position[:-1]), error
    return Apparent(position=position, irradiance=light, middle=middle, errors=errors, **values)
