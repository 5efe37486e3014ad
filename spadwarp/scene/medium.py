"""Water: the section `medium`, its layers, what it is along a line, and how it scatters."""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import cached_property, partial
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import ArrayLike
from pydantic import Field, PrivateAttr, field_validator

from spadwarp.arrays import Floats
from spadwarp.scene.grid import COEFFICIENTS, Grid, GridCells, cells_of
from spadwarp.scene.laser import Laser
from spadwarp.scene.sections import (
    PRESETS,
    Coordinate,
    CsvFile,
    Direction,
    FilePath,
    Section,
    field,
    field_range,
    file_of,
    from_one,
    read_table,
)
from spadwarp.values import ConfigError, bounds, pulse_speed
from spadwarp.water import rayleigh_matrix, read_matrix_table, scaled_rayleigh_matrix, voss_fry_matrix
from spadwarp.water.seawater import RANGES, WATER_DEPOLARISATION, molecular_density, water_optics

__all__ = ["Layer", "Matrix", "Medium", "PhaseFunction", "phase_function", "scattering_matrix"]

# (phase index, group index) of water at 532 nm and 20 °C, seawater of salinity 35, after Quan & Fry 1995 (`water`).
# Time of flight uses the group index.
WATER_INDICES: dict[str, tuple[float, float]] = {"seawater": (1.3415, 1.3638), "fresh": (1.3350, 1.3566)}

NOTABLE_UNSEEN = 0.01  # `PhaseFunction.unseen_share` of the light that is worth a warning

# Overriding one coefficient of a complete medium keeps this other one.
_KEEPS = {"absorption": "scattering", "scattering": "absorption", "extinction": "albedo", "albedo": "extinction"}


def complete_coefficients(pair: Mapping[str, Any]) -> dict[str, Any]:
    """All four coefficients from exactly two of them, the given ones as they are.

    With `albedo = "lu2024"` absorption and scattering are the means (ω is uniform in (0, 0.97): mean 0.485).
    Raises `ValueError` whose text names the fields, without the section.
    """
    if len(pair) != 2:
        given = ", ".join(pair) or "none"
        raise ValueError(f"needs exactly two of {', '.join(COEFFICIENTS)}, or chlorophyll; given: {given}")
    a, b, c, albedo = (pair.get(name) for name in COEFFICIENTS)  # type: Any, Any, Any, Any
    if albedo == "lu2024":
        if c is None:
            raise ValueError("albedo = 'lu2024' goes with extinction only")
        return {"absorption": c * (1.0 - 0.485), "scattering": c * 0.485, "extinction": c, "albedo": albedo}
    if albedo is not None:
        if c is None:
            rest = albedo if a is None else 1.0 - albedo
            if rest <= 0.0:
                raise ValueError(f"albedo = {albedo} leaves the extinction undetermined; give extinction and albedo")
            c = (b if a is None else a) / rest
        a = c * (1.0 - albedo) if a is None else a
        b = c * albedo if b is None else b
    elif c is None:
        c = a + b
    else:
        part, value = ("scattering", b) if a is None else ("absorption", a)
        if value > c:
            raise ValueError(f"{part} = {value} is outside [0, {c}] 1/m, {c} being the extinction")
        a = c - b if a is None else a
        b = c - a if b is None else b
    share = (b / c if c else 0.0) if albedo is None else albedo
    return {"absorption": a, "scattering": b, "extinction": c, "albedo": share}


MOST_CONSTITUENTS = 4  # as many as the kernels take
MIXTURE = "mixture"  # what `phase_function` reads with several constituents, which each have their own

# Fields of `medium` that belong to a phase function: those that it needs and no other takes, None by default, and those
# with a default, which phase functions may share.
PHASE_FIELDS: dict[str, tuple[tuple[str, ...], tuple[str, ...]]] = {
    "henyey_greenstein": ((), ("anisotropy",)),
    "two_term_henyey_greenstein": (("g1", "g2", "alpha"), ()),
    "fournier_forand": ((), ("particle_index", "junge_slope")),
    "rayleigh": ((), ("depolarisation_ratio",)),
    "tabulated": (("phase_table",), ()),
    MIXTURE: ((), ()),
}

_OWN_FIELDS = tuple(name for needed, _ in PHASE_FIELDS.values() for name in needed)
_LAW_FIELDS = ("phase_function", "anisotropy", *_OWN_FIELDS, "particle_index", "junge_slope")

# Tabulated phase functions: name → file in spadwarp/water/tables, whose head has the source.
PHASE_TABLES = {"petzold-average-particle": "petzold_average_particle.csv", "clean-bubbles": "clean_bubbles.csv"}


class PhaseLaw(Section):
    """A phase function: its name, and the fields of its own that it takes."""

    phase_function: Literal[
        "henyey_greenstein", "two_term_henyey_greenstein", "fournier_forand", "rayleigh", "tabulated"
    ] = "henyey_greenstein"
    """law of the scattering angle"""
    anisotropy: float = field(0.924, "henyey_greenstein: mean cosine g of the scattering angle", "(-1, 1)")
    g1: float | None = field(None, "two_term_henyey_greenstein: g of the first term", "(-1, 1)")
    g2: float | None = field(None, "two_term_henyey_greenstein: g of the second term", "(-1, 1)")
    alpha: float | None = field(None, "two_term_henyey_greenstein: weight of the first term", "[0, 1]")
    particle_index: float = field(1.10, "fournier_forand: index n of the particles over that of the water", "(1, 1.35]")
    junge_slope: float = field(3.5835, "fournier_forand: slope µ of the size distribution", "[3.05, 5)")
    phase_table: Annotated[str | None, FilePath(".csv", tuple(PHASE_TABLES))] = None
    """tabulated: "petzold-average-particle", "clean-bubbles", or the path of a .csv file of angle [°] and value of any
    scale"""
    depolarisation_ratio: float = Field(WATER_DEPOLARISATION, **bounds(RANGES["depolarisation_ratio"]))
    """rayleigh, of both: of unpolarised light scattered by 90°, light in the plane of scattering over light across"""

    def _problems(self) -> Iterator[str]:
        yield from super()._problems()
        law = self.phase_function
        for other, (needed, _) in PHASE_FIELDS.items():
            missing = [name for name in needed if getattr(self, name) is None]
            if other == law and missing:
                yield f"needs {', '.join(missing)} with phase_function = {law!r}"
            yield from self._only_with(f"phase_function = {other!r}", other == law, *needed)

    @property
    def phase_parameters(self) -> dict[str, float | str]:
        """The fields that `phase_function` takes."""
        needed, optional = PHASE_FIELDS[self.phase_function]
        return {name: getattr(self, name) for name in (*needed, *optional)}


class Constituent(PhaseLaw):
    """A part of the water: molecules, algae, sediment, bubbles. Its light adds up with that of the others."""

    displaces: ClassVar = {"phase_function": _OWN_FIELDS}
    name: str = field(..., "what it is called in layers, cells and derivatives: letters, digits and _")
    absorption: float = field(0.0, "absorption coefficient at concentration 1 [1/m]", "[0, 1e6]")
    scattering: float = field(0.0, "scattering coefficient at concentration 1 [1/m]", "[0, 1e6]")
    concentration: float = field(1.0, "factor on both coefficients, of any scale", "[0, 1e6]")

    def _problems(self) -> Iterator[str]:
        yield from super()._problems()
        if not self.name.isidentifier():
            yield self._that("name", "is not a word of letters, digits and _")

    @property
    def extinction(self) -> float:
        """Absorption and scattering at concentration 1 [1/m]."""
        return self.absorption + self.scattering


# One for the medium and one for each layer, or one for all.
ByWater = Annotated[tuple[Annotated[float, Field(ge=0, le=1e6)], ...], from_one(1)]


class Inelastic(Section):
    """Light of the laser that the water gives off at another wavelength, as a channel of the result by this name.

    Coefficients are one number for all water, or a list for the medium and its layers.
    """

    process: Literal["raman", "fluorescence"] = "raman"
    """scattering by water, or light of chlorophyll, in all directions"""
    coefficient: ByWater | None = field(None, "what becomes such light, in photons [1/m]; raman: default by wavelength")
    absorption: ByWater = field(..., "of the water at the new wavelength [1/m]")
    scattering: ByWater | None = field(None, "likewise; default: that at the laser's [1/m]")
    passed: float = field(1.0, "part of the new light that the receiver's filter for it passes", "[0, 1]")
    decay_time_ns: float = field(0.0, "fluorescence: after which 1/e of the light is still to come [ns]", "[0, 1e6]")

    def _problems(self) -> Iterator[str]:
        yield from super()._problems()
        fluoresces = self.process == "fluorescence"
        if fluoresces and self.coefficient is None:
            yield "needs coefficient with process = 'fluorescence': absorption by chlorophyll times its quantum yield"
        yield from self._only_with("process = 'fluorescence'", fluoresces, "decay_time_ns")

    def in_waters(self, waters: Sequence[Medium | Layer], wavelength_nm: float) -> list[tuple[float, float, float]]:
        """Of the medium and its layers: `coefficient`, extinction and scattering [1/m].

        The coefficient of Raman scattering by water is 2.7e-4 1/m at 488 nm, falling with the power 5.3 of the
        wavelength in photons (Bartlett, Voss, Sathyendranath & Vodacek, Appl. Opt. 37, 3324, 1998).
        """
        raman = 2.7e-4 * (488.0 / wavelength_nm) ** 5.3
        rows = self.coefficient or (raman,), self.absorption, self.scattering or [one.scattering for one in waters]
        made, absorbed, scattered = ([*row] * (len(waters) if len(row) == 1 else 1) for row in rows)
        return [(s, a + b, b) for s, a, b in zip(made, absorbed, scattered, strict=True)]

    @property
    def anisotropy(self) -> float:
        """A of the phase function, ~ 1 + A cos²θ: of Raman scattering (1 − ρ)/(1 + 3ρ), ρ its depolarisation, 0.17."""
        return (1.0 - 0.17) / (1.0 + 3.0 * 0.17) if self.process == "raman" else 0.0


class Water(Section):
    """Coefficients of water: two of four coefficients, or chlorophyll, from which they follow."""

    section: ClassVar[str] = "medium"
    alternatives: ClassVar = COEFFICIENTS
    displaces: ClassVar = {
        **dict.fromkeys(COEFFICIENTS, ("chlorophyll", "constituents", "concentrations")),
        "chlorophyll": (*COEFFICIENTS, "preset", "constituents", "concentrations"),
        "constituents": (*COEFFICIENTS, "chlorophyll", *_LAW_FIELDS),
        "concentrations": (*COEFFICIENTS, "chlorophyll", "anisotropy"),
        "temperature": ("phase_index", "group_index"),
        "salinity": ("phase_index", "group_index"),
        "phase_function": _OWN_FIELDS,
    }
    preset: str | None = field(None, "a named water, see `spadwarp list presets medium`")
    absorption: float = field(0.0, "absorption coefficient a [1/m]", "[0, 1e6]")
    scattering: float = field(0.0, "scattering coefficient b [1/m]", "[0, 1e6]")
    extinction: float = field(0.0, "extinction (beam attenuation) coefficient c = a + b [1/m]", "[1e-12, 1e6]")
    albedo: Annotated[float, Field(ge=0, le=1)] | Literal["lu2024"] = 0.0
    """single-scattering albedo b/c, or "lu2024": uniform in (0, 0.97) at each collision"""
    chlorophyll: float | None = field(None, "of open ocean, in place of coefficients [mg/m³]", RANGES["chlorophyll"])

    @classmethod
    def _kept(cls, base: Mapping[str, Any], layer: Mapping[str, Any]) -> dict[str, Any]:
        """Of coefficients what completes those of the layer; a clash is left for validation to report."""
        kept, new = super()._kept(base, layer), [name for name in COEFFICIENTS if layer.get(name) is not None]
        old = {name: kept[name] for name in COEFFICIENTS if name in kept}
        keep = {}
        if len(new) == 1:
            other = _KEEPS[new[0]]
            if len(old) < 2 or (old.get("albedo") == "lu2024" and other not in old and new[0] not in old):
                return kept
            try:
                keep = {other: old[other] if other in old else complete_coefficients(old)[other]}
            except (TypeError, ValueError):
                return kept
        return {name: value for name, value in kept.items() if name not in old} | keep if new else kept

    def _problems(self) -> Iterator[str]:
        yield from super()._problems()
        # What was given stays in model_fields_set, from where to_dict() knows it.
        if self.is_mixture:
            beside = [*self.given, *(["chlorophyll"] if self.chlorophyll is not None else [])]
            if beside:
                yield f"constituents determine the coefficients; {', '.join(beside)} cannot be given"
        elif self.chlorophyll is None:
            self.__dict__.update(complete_coefficients({name: getattr(self, name) for name in self.given}))
            if self.extinction not in (allowed := field_range(type(self), "extinction")):
                yield f"extinction = {self.extinction} is outside {allowed}"
        elif self.given or self.preset is not None:
            others = ", ".join(self.given or ["preset"])
            yield self._that("chlorophyll", f"cannot be combined with {others}")

    @property
    def is_mixture(self) -> bool:
        """Whether the coefficients are those of constituents."""
        return bool(getattr(self, "constituents", ())) or getattr(self, "concentrations", None) is not None

    @property
    def is_natural(self) -> bool:
        """Whether chlorophyll or a preset says that it is of a sea or harbour, not of a tank or a paper's model."""
        return self.chlorophyll is not None or (self.preset or "").startswith(("petzold-", "uwoc-", "jerlov-"))


class Layer(Water):
    """Water from a plane on, up to the next layer; given as a medium is."""

    start: Coordinate = field(..., "where it begins along `layer_axis`, the world's z if not given [m]")
    anisotropy: float | None = field(None, "henyey_greenstein: mean cosine; default: the medium's", "(-1, 1)")
    concentrations: Annotated[dict[str, Annotated[float, Field(ge=0, le=1e6)]] | None, Field()] = None
    """in place of coefficients, of the medium's constituents by name: `{algae = 3.0}`; the others as in the medium"""


class WaterRange(NamedTuple):
    """Extremes over all water of a scene."""

    extinction: float  # the largest [1/m]
    scattering: float  # the largest [1/m]
    absorption: float  # the least [1/m]
    albedo: float  # the largest, of "lu2024" none
    anisotropies: tuple[float, ...]  # mean cosines beside the medium's own, the least and the largest of a grid


class Medium(PhaseLaw, Water):
    """The water. Give exactly two of absorption, scattering, extinction, albedo, or chlorophyll, or constituents; all
    four coefficients can be read.

    What chlorophyll, temperature and salinity imply follows the laser's wavelength (532 nm outside a scene). With
    `layers` it is the water before the first of them.
    """

    scattering_matrix: Literal["none", "rayleigh", "scaled_rayleigh", "voss_fry", "tabulated"] = "none"
    """what scattering does to the polarisation of light, over any phase function; "none": light is not polarised; if
    it is, "voss_fry", or "rayleigh" with that phase function"""
    matrix_table: CsvFile = None
    """tabulated: path of a .csv file of angle [°], m12, m22, m33, m34 and m44 over m11; `spadwarp water` writes one
    """
    largest_polarisation: float = field(0.66, "scaled_rayleigh: polarisation of light at 90°", RANGES["largest"])
    constituents: Annotated[tuple[Constituent, ...], Field(max_length=MOST_CONSTITUENTS)] = ()
    """what the water is made of, in place of coefficients and phase function: their coefficients add up, those of pure
    water among them; at most 4"""
    inelastic: Annotated[tuple[Inelastic, ...], Field(max_length=2)] = ()
    """light of other wavelengths, one of each process, which the absorption has lost; not with grid"""
    group_index: float = Field(WATER_INDICES["seawater"][1], ge=1, le=3)
    """index for the time of flight; "seawater" and "fresh" stand for 1.3638 and 1.3566"""
    phase_index: float = Field(WATER_INDICES["seawater"][0], ge=1, le=3)
    """refractive index; "seawater" and "fresh" stand for 1.3415 and 1.3350"""
    temperature: float | None = field(None, "gives missing indices, with salinity 35 [°C]", RANGES["temperature"])
    salinity: float | None = field(None, "the same, with temperature 20 [g/kg]", RANGES["salinity"])
    layers: tuple[Layer, ...] = field((), "waters further along `layer_axis`")
    layer_axis: Direction = field((0.0, 0.0, 1.0), "direction across the layers, in the world; not 0")
    grid: Grid | None = field(None, "water that varies within a box, cell by cell; not with layers")
    _molecular_share: float = PrivateAttr(0.0)
    _beside: tuple[Medium, ...] = PrivateAttr(())

    @field_validator("phase_index", "group_index", mode="before")
    @classmethod
    def _named_index(cls, value: Any, info: Any) -> Any:
        if isinstance(value, str) and value not in WATER_INDICES:
            raise ValueError(f"is neither a number nor one of {', '.join(map(repr, WATER_INDICES))}")
        return WATER_INDICES[value][info.field_name == "group_index"] if isinstance(value, str) else value

    def _problems(self) -> Iterator[str]:
        law, own_law = self.phase_function, "goes with phase_function = 'henyey_greenstein' only"
        yield from super()._problems()
        yield from self._mixture_problems()
        has_table = self.scattering_matrix == "tabulated"
        if has_table and self.matrix_table is None:
            yield "needs matrix_table with scattering_matrix = 'tabulated'"
        yield from self._only_with("scattering_matrix = 'tabulated'", has_table, "matrix_table")
        for i, layer in enumerate(self.layers):
            if i and layer.start <= (before := self.layers[i - 1].start):
                yield f"layers[{i}].start = {layer.start} is outside ({before}, inf) m, the layer before it"
            if (layer.albedo == "lu2024") != (self.albedo == "lu2024"):
                yield f"layers[{i}].albedo = {layer.albedo!r} does not go with {self.albedo!r}, the medium's"
            # A preset may bring one with it, which is no more than what the medium's own preset may.
            own = PRESETS["medium"][layer.preset].values.get("anisotropy") if layer.preset else None
            if law != "henyey_greenstein" and layer.anisotropy not in (None, own):
                yield f"layers[{i}].anisotropy = {layer.anisotropy} {own_law}; layers share any other"
        processes = [one.process for one in self.inelastic]
        if len(set(processes)) < len(processes):
            yield f"inelastic: {', '.join(processes)} are not different processes"
        if self.inelastic and (self.grid is not None or self.albedo == "lu2024"):
            yield "inelastic goes neither with grid nor albedo = 'lu2024': it takes one water, or layers"
        for k, one in enumerate(self.inelastic):
            for name in ("coefficient", "absorption", "scattering"):
                if len(row := getattr(one, name) or (0.0,)) not in (1, len(self.waters)):
                    yield f"inelastic[{k}].{name}: {len(row)} given; one for all water, or {len(self.waters)} for each"
        if self.grid is not None and self.layers:
            yield f"grid does not go with layers, {len(self.layers)} given; cells can repeat them, from a file"
        if self.grid is not None and self.albedo == "lu2024":
            yield "grid does not go with albedo = 'lu2024', which has no cells; give it a number"
        if self.grid is not None and self.grid.anisotropy is not None and law != "henyey_greenstein":
            yield f"grid.anisotropy = {self.grid.anisotropy} {own_law}; cells share any other"
        self._follow(Laser.model_fields["wavelength_nm"].default)

    def _mixture_problems(self) -> Iterator[str]:
        """Why constituents exclude what is given beside them."""
        names = [one.name for one in self.constituents]
        if len(set(names)) < len(names):
            yield f"constituents: {', '.join(names)} are not different names"
        for i, layer in enumerate(self.layers):
            if layer.is_mixture != self.is_mixture:
                yield f"layers[{i}] needs concentrations with constituents, and without them none"
            if unknown := set(layer.concentrations or ()) - set(names):
                yield f"layers[{i}].concentrations: {', '.join(sorted(unknown))} is not one of {', '.join(names)}"
        if not self.is_mixture:
            if self.grid is not None and self.grid.constituent is not None:
                yield f"grid.constituent = {self.grid.constituent!r} goes with constituents only"
            return
        if others := [name for name in _LAW_FIELDS if name in self.model_fields_set]:
            yield f"constituents have phase functions of their own; {', '.join(others)} cannot be given"
        if self.grid is not None and self.grid.constituent not in names:
            yield f"grid.constituent = {self.grid.constituent!r} is not one of {', '.join(names)}"
        for i, water in enumerate(self.waters, -1):
            place = "" if water is self else f"layers[{i}]."
            if (c := self._mixed(water)["extinction"]) not in (allowed := field_range(type(self), "extinction")):
                yield f"{place}extinction = {c} of the constituents is outside {allowed}"

    def concentrations_in(self, water: Medium | Layer) -> list[float]:
        """Of the constituents, in the medium or in one of its layers."""
        own = getattr(water, "concentrations", None) or {}
        return [own.get(one.name, one.concentration) for one in self.constituents]

    def scattering_in(self, water: Medium | Layer) -> list[float]:
        """Of each constituent, in the medium or one of its layers [1/m]."""
        return [n * one.scattering for n, one in zip(self.concentrations_in(water), self.constituents, strict=True)]

    def shares_in(self, water: Medium | Layer) -> list[float]:
        """Part of each constituent in the scattering of the medium or a layer; where nothing scatters, equal parts."""
        whole = math.fsum(parts := self.scattering_in(water))
        return [part / whole if whole > 0.0 else 1.0 / len(parts) for part in parts]

    def _mixed(self, water: Medium | Layer) -> dict[str, float]:
        """Coefficients of the medium or a layer from constituents [1/m]."""
        numbers, b = self.concentrations_in(water), math.fsum(self.scattering_in(water))
        a = math.fsum(n * one.absorption for n, one in zip(numbers, self.constituents, strict=True))
        return {"absorption": a, "scattering": b, "extinction": a + b}

    def _follow(self, wavelength_nm: float) -> None:
        """Sets what depends on the wavelength."""
        self.__dict__["layers"] = tuple(layer.model_copy() for layer in self.layers)
        if self.is_mixture:
            one = self.constituents[0]  # of one alone the medium scatters by its law, as if that were the medium's
            own = {name: getattr(one, name) for name in _LAW_FIELDS}
            self.__dict__.update(own if len(self.constituents) == 1 else {"phase_function": MIXTURE})
            for water in self.waters:
                mixed = self._mixed(water)
                water.__dict__.update(mixed, albedo=mixed["scattering"] / mixed["extinction"])
        for water in self.waters:
            names = [] if water.chlorophyll is None else [*COEFFICIENTS]
            if water is self and self.follows_wavelength:
                names += [name for name in ("phase_index", "group_index") if name not in self.model_fields_set]
            if not names:
                continue
            optics = water_optics(wavelength_nm, chlorophyll=water.chlorophyll or 0.0, **self.state)
            water.__dict__.update({name: getattr(optics, name) for name in names})
            if water is self and self.chlorophyll is not None and not self.layers:
                self._molecular_share = optics.water_scattering / optics.scattering

    @property
    def state(self) -> dict[str, float]:
        """`temperature` [°C] and `salinity` [g/kg], 20 and 35 where they are not given."""
        return {
            "temperature": 20.0 if self.temperature is None else self.temperature,
            "salinity": 35.0 if self.salinity is None else self.salinity,
        }

    @property
    def pulse_speed(self) -> float:
        """Speed of a pulse, c0 over the group index [m/s]."""
        return pulse_speed(self.group_index)

    @property
    def molecular_share(self) -> float:
        """Part of the scattering that is the water's own, beside `phase_function`, which is then of particles alone.

        Known with chlorophyll, 0 without it; 0 with layers too, which share one phase function.
        """
        return self._molecular_share

    @property
    def particle_scattering(self) -> float:
        """The scattering less that of molecules beside `phase_function` [1/m]."""
        return self.scattering * (1.0 - self.molecular_share)

    @property
    def beside(self) -> tuple[Medium, ...]:
        """The medium at wavelengths whose light rides on the same photons, see `Medium.with_beside`; at most 4."""
        return self._beside

    def with_beside(self, media: Sequence[Medium]) -> Medium:
        """The medium whose photons carry light of other wavelengths, with these media, as well: a run has a channel for
        each, "line 1" and so on."""
        medium = self.model_copy()
        medium._beside = tuple(media)
        return medium

    @property
    def phase_functions(self) -> list[PhaseFunction]:
        """Those of the medium; of layers and cells with an anisotropy of their own; with constituents, of layers and of
        those that cells have shares of. Raises what `phase_function` and `grid_cells` raise."""
        layers = self.layers if self.phase_function == MIXTURE else ()
        of_cells = phase_function(self).constituents if self.grid is not None else ()
        own = () if self.has_phase_table else (PhaseLaw(anisotropy=g) for g in self.range.anisotropies)
        laws = [*(phase_function(self, layer) for layer in layers), *(_law_of(law, "medium") for law in own)]
        return [phase_function(self), *laws, *of_cells]

    @property
    def has_phase_table(self) -> bool:
        """Whether scattering is drawn from a table rather than from Henyey and Greenstein's formula."""
        return self.phase_function != "henyey_greenstein" or self.molecular_share > 0.0

    @property
    def follows_wavelength(self) -> bool:
        """Whether the indices that are not given follow from the laser's wavelength."""
        return any(value is not None for value in (self.chlorophyll, self.temperature, self.salinity))

    def at_wavelength(self, wavelength_nm: float) -> Medium:
        """The medium as light of a vacuum wavelength [nm] meets it.

        Raises `ArgumentError` outside [400, 700] if anything depends on it.
        """
        medium = self.model_copy()
        medium._follow(wavelength_nm)
        return medium

    @property
    def waters(self) -> tuple[Medium | Layer, ...]:
        """The medium and its layers, in the order of `layer_axis`."""
        return (self, *self.layers)

    @property
    def varies(self) -> bool:
        """Whether the water differs from place to place."""
        return bool(self.layers) or self.grid is not None

    @property
    def range(self) -> WaterRange:
        """Extremes over the medium, its layers and its grid. Raises what `grid_cells` raises."""
        rows = [(water.extinction, water.scattering) for water in self.waters]
        extremes = [(c, b, c - b, b / max(c, 1e-30)) for c, b in rows]
        g = [layer.anisotropy for layer in self.layers if layer.anisotropy is not None]
        if self.grid is not None:
            cells = grid_cells(self)
            c, b, own = cells.extinction, cells.scattering, cells.anisotropy
            extremes.append((float(c.max()), float(b.max()), float((c - b).min()), float(cells.albedo.max())))
            g += [] if own is None else [float(own.min()), float(own.max())]
        extinction, scattering, absorption, albedo = zip(*extremes, strict=True)
        return WaterRange(max(extinction), max(scattering), max(0.0, min(absorption)), max(albedo), tuple(g))

    def optical_depth(self, begin: ArrayLike, end: ArrayLike) -> Any:
        """∫c ds along straight lines between points of the world `[..., 3]` [m]; a float between two points."""
        first, last = np.asarray(begin, np.float64), np.asarray(end, np.float64)
        length = np.linalg.norm(last - first, axis=-1)
        if self.grid is not None:
            depth = grid_cells(self).optical_depths(begin, end, self.extinction)
        elif not self.layers:
            depth = self.extinction * length
        else:
            axis = np.array(self.layer_axis) / math.hypot(*self.layer_axis)
            heights = np.array(np.broadcast_arrays(first @ axis, last @ axis))
            starts = [layer.start for layer in self.layers]
            extinction = np.array([water.extinction for water in self.waters])
            here = extinction[np.searchsorted(starts, heights[0], side="right")]
            across = extinction[0] * (heights[1] - heights[0])
            for start, more in zip(starts, np.diff(extinction), strict=True):
                across += more * np.diff(np.maximum(heights - start, 0.0), axis=0)[0]
            way = heights[1] - heights[0]
            depth = length * np.divide(across, way, out=np.broadcast_to(here, way.shape).copy(), where=way != 0.0)
        return depth if np.ndim(depth) else float(depth)

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal section again: of the coefficients the given ones, of the indices too."""
        hidden = {"phase_index", "group_index"} - self.model_fields_set if self.follows_wavelength else set()
        if self.is_mixture:
            hidden |= {*COEFFICIENTS, *_LAW_FIELDS}
        if not self.layers:
            hidden |= {"layers", "layer_axis"}
        return {name: value for name, value in super().to_dict().items() if name not in hidden}


def grid_cells(medium: Medium) -> GridCells:
    """The cells of a medium with a grid. Raises `FileError` if its file cannot be read or has no cells, `ConfigError`
    if `medium.grid` does not say how large the box is, or its frame is not in the file."""
    grid, albedo = medium.grid, medium.albedo
    assert grid is not None and not isinstance(albedo, str)  # see Medium
    stamp = None
    with suppress(OSError):  # the reader says why
        status = Path(grid.file or "").stat()
        stamp = status.st_mtime_ns, status.st_size
    if part := next((one for one in medium.constituents if one.name == grid.constituent), None):
        own = part.scattering / part.extinction if part.extinction > 0.0 else 0.0
        grid = grid.model_copy(update={"extinction": part.extinction, "albedo": own})
    return cells_of(grid, (medium.extinction, albedo, medium.anisotropy), medium.has_phase_table, stamp)


def cell_shares(medium: Medium) -> Floats:
    """Part of each constituent in the scattering of the cells of a medium's grid, `[x, y, z, constituent]`. Raises what
    `grid_cells` raises."""
    cells, names = grid_cells(medium), [one.name for one in medium.constituents]
    scattered = np.array(medium.scattering_in(medium)) + np.zeros((*cells.extinction.shape, 1))
    # What the medium scatters without the cells is part of the cells' own.
    whole = np.maximum(cells.extinction.astype(np.float64) * cells.albedo, medium.scattering)
    scattered[..., names.index(str(medium.grid and medium.grid.constituent))] += whole - medium.scattering
    shares = scattered / np.maximum(scattered.sum(axis=-1, keepdims=True), 1e-30)
    return np.where(scattered.sum(axis=-1, keepdims=True) > 0.0, shares, medium.shares_in(medium))


# Scattering


@dataclass(frozen=True, eq=False)
class PhaseFunction:
    """Probability density of the direction of scattered light, of unit integral over the sphere."""

    name: str  # `medium.phase_function`
    parameters: dict[str, float | str]  # the medium's fields that it takes
    molecular_share: float  # part of the scattering that is the water's own and not of that name
    over_t: Callable[[Floats], Floats]  # the density [1/sr] over t = 1 - cosθ in (0, 2]
    first_angle: float = 0.0  # of a table [rad]; below it the table is continued
    constituents: tuple[PhaseFunction, ...] = ()  # of a mixture

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

    def unseen_share(self, photons: float) -> tuple[float, float]:
        """What so many directions, evenly over the sphere, hardly see of a narrow forward peak.

        Returns:
            The angle [rad] below which ten of the directions are from that of the lens, and the part of the light in
            [0, 1] that is scattered by less, without what the density at that angle would scatter there.
        """
        part = min(10.0 / max(photons, 10.0), 1.0)
        angle = 2.0 * math.asin(math.sqrt(part))
        even = 4.0 * math.pi * part * float(self.over_t(np.array(2.0 * part)))
        return angle, min(max(self.fraction_below(angle) - even, 0.0), 1.0)


def _sphere_integral(density: Callable[[Floats], Floats]) -> float:
    from spadwarp_kernels import sphere_integral

    return sphere_integral(density)


def phase_function(medium: Medium, layer: Layer | None = None) -> PhaseFunction:
    """The phase function of a scene's medium, `phase_function(scene.medium)`; of several constituents the sum of theirs
    by their shares in the scattering, of the medium or of one of its layers.

    Raises `FileError` if its table cannot be read, `ConfigError` if the table is not a phase function.
    """
    if not medium.is_mixture:
        return _law_of(medium, "medium", medium.molecular_share)
    laws = tuple(_law_of(one, f"medium.constituents[{k}]") for k, one in enumerate(medium.constituents))
    if len(laws) == 1:
        return laws[0]
    shares = medium.shares_in(layer or medium)

    def summed(t: Floats) -> Floats:
        return np.sum([share * law.over_t(t) for share, law in zip(shares, laws, strict=True) if share > 0.0], axis=0)

    first_angle = max(law.first_angle for law in laws)
    return PhaseFunction(MIXTURE, {}, 0.0, summed, first_angle, laws)


def constituent_order(medium: Medium) -> list[int]:
    """Several constituents in the order of the kernels' tables: that with the sharpest forward peak first."""
    if medium.phase_function != MIXTURE:
        return []
    forward = [float(law.over_t(np.array(1e-9))) for law in phase_function(medium).constituents]
    return sorted(range(len(forward)), key=lambda k: -forward[k])


def _law_of(medium: PhaseLaw, section: str, share: float = 0.0) -> PhaseFunction:
    """The phase function of a section, with the water's own as such a share."""
    import spadwarp_kernels as sk

    density: Callable[[Floats], Floats]
    first_angle = 0.0
    name, parameters = medium.phase_function, medium.phase_parameters
    if name == "tabulated":
        path = Path(str(medium.phase_table))
        if str(path) in PHASE_TABLES:
            path = Path(__file__).parents[1] / "water" / "tables" / PHASE_TABLES[str(path)]
        angles, values = read_table(f"{section}.phase_table", path, {"angle_deg": "[0, 180]", "value": "[0, 1e30]"})
        try:
            density = sk.interpolated_density(np.radians(angles), values)
            if angles[-1] < 10.0:
                raise ValueError(f"ends at {angles[-1]:g}°: angles are in degrees, up to 180")
            first_angle = math.radians(float(angles[0]))
        except ValueError as error:
            raise ConfigError(f"{section}.phase_table: {path}: {error}") from None
    else:
        numbers: dict[str, Any] = {"g": medium.anisotropy} if name == "henyey_greenstein" else dict(parameters)
        density = partial(getattr(sk, f"{name}_density"), **numbers)

    def mixed(t: Floats) -> Floats:
        return (1.0 - share) * density(t) + share * molecular_density(t)

    return PhaseFunction(name, parameters, share, mixed if share > 0.0 else density, first_angle)


def natural_laws(medium: Medium, water: Water, wavelength_nm: float) -> tuple[PhaseFunction, PhaseFunction]:
    """Of the medium or one of its layers with Henyey–Greenstein's law: that law, and what natural water has, molecules
    and Fournier–Forand's particles: of a preset those that fit its b_b/b, else average ones. Raises `ArgumentError`
    outside [400, 700] nm."""
    own = water_optics(wavelength_nm, chlorophyll=0.0, **medium.state).water_scattering
    particles = PhaseLaw(phase_function="fournier_forand")
    name = water.preset or ""
    like = {"uwoc-coastal": "petzold-haoce-11", "petzold-nuc-2240": "petzold-nuc-2040"}.get(name, name)
    if (measured := PRESETS["medium"].get(f"{like}-constituents")) is not None:
        particles = Medium(preset=measured.name).constituents[1]
    g = getattr(water, "anisotropy", None)
    used = _law_of(PhaseLaw(anisotropy=medium.anisotropy if g is None else g), "medium", medium.molecular_share)
    share = min(own / water.scattering, 1.0) if water.scattering > 0.0 else 1.0
    return used, _law_of(particles, "medium", share)


Matrix = Callable[[Floats], Floats]
"""Cosines of the scattering angle `[n]` → m12, m22, m33, m34 and m44, each over m11, `[n, 5]`: I′ = I + m12 Q,
Q′ = m12 I + m22 Q, U′ = m33 U + m34 V, V′ = −m34 U + m44 V with respect to the plane of scattering (Bohren & Huffman
1983, eq 4.77)."""


def scattering_matrix(medium: Medium) -> Matrix | None:
    """The scattering matrix of a scene's medium, over its phase function, `scattering_matrix(scene.medium)`; None for
    "none".

    Raises `FileError` or `ConfigError` if its table cannot be read.
    """
    if medium.scattering_matrix == "tabulated":
        with file_of("medium.matrix_table"):
            return read_matrix_table(str(medium.matrix_table))
    return {
        "none": None,
        "rayleigh": partial(rayleigh_matrix, depolarisation_ratio=medium.depolarisation_ratio),
        "scaled_rayleigh": partial(scaled_rayleigh_matrix, largest=medium.largest_polarisation),
        "voss_fry": voss_fry_matrix,
    }[medium.scattering_matrix]
