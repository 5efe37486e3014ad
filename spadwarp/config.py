"""Scenes: TOML in, frozen and validated models out.

`load_scene` reads a file, `Scene.from_dict` takes tables, `Scene.with_overrides` changes a scene. A section may name a
`preset`; the file's own fields lie over it and overrides over both. SI units, except where a name carries its unit.
"""

from __future__ import annotations

import bisect
import itertools
import math
import os
import tomllib
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any, ClassVar, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    PrivateAttr,
    ValidationError,
    field_validator,
    model_validator,
)

from . import _layers
from ._layers import parse_override
from ._problems import describe
from .catalog import PHASE_TABLES, PRESETS, WATER_INDICES
from .errors import ConfigError, FileError

__all__ = [
    "SPEED_OF_LIGHT",
    "Analytic",
    "Camera",
    "Detector",
    "Domain",
    "Gate",
    "Laser",
    "Layer",
    "Medium",
    "Output",
    "Scan",
    "Scene",
    "Target",
    "Transport",
    "load_scene",
    "parse_override",
]

SPEED_OF_LIGHT = 299_792_458.0  # [m/s], vacuum
PLANCK = 6.626_070_15e-34  # [J s]

Overrides = Mapping[str, Any] | Sequence[str]


def _whole(value: Any) -> Any:
    """TOML writes 2e9 as a float; a whole one is as good as an integer."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _listed(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value


def _padded(value: Any) -> Any:
    """Four coefficients of distortion lack k3, as OpenCV allows."""
    value = _listed(value)
    return (*value, 0.0) if isinstance(value, tuple) and len(value) == 4 else value


def _sized(value: Any) -> Any:
    return (value,) if isinstance(value, (int, float)) and not isinstance(value, bool) else _listed(value)


def _three(value: Any) -> Any:
    return (value,) * 3 if isinstance(value, (int, float)) and not isinstance(value, bool) else _listed(value)


Whole = Annotated[int, BeforeValidator(_whole)]
Vector = Annotated[tuple[float, float, float], BeforeValidator(_listed)]
Brown = Annotated[tuple[float, float, float, float, float], BeforeValidator(_padded)]
Bound = Annotated[float, Field(ge=-math.inf, le=math.inf, allow_inf_nan=True)]
Corner = Annotated[tuple[Bound, Bound, Bound], BeforeValidator(_three)]
Size = Annotated[tuple[Annotated[float, Field(gt=0)], ...], BeforeValidator(_sized), Field(min_length=1, max_length=3)]
Scale = Annotated[tuple[float, float, float], BeforeValidator(_three)]


class Section(BaseModel):
    """One table of a scene: frozen, strict about types, unknown keys refused."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True, allow_inf_nan=False, protected_namespaces=())
    section: ClassVar[str] = ""

    @model_validator(mode="before")
    @classmethod
    def _expand_preset(cls, fields: Any) -> Any:
        return _layers.merge_section(cls.section, {}, fields) if isinstance(fields, Mapping) else fields

    @field_validator("preset", check_fields=False)
    @classmethod
    def _known_preset(cls, name: str | None) -> str | None:
        if name is not None and name not in PRESETS[cls.section]:
            raise ValueError("preset", tuple(PRESETS[cls.section]))
        return name

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal section again, without those that are None."""
        return {name: value for name, value in self if value is not None}


class _Water(Section):
    """What water does to light: two of four coefficients, or chlorophyll, from which they follow."""

    section: ClassVar[str] = "medium"
    preset: str | None = Field(None, description="a named water, see `spadwarp presets medium`")
    absorption: float = Field(0.0, ge=0, description="absorption coefficient a [1/m]")
    scattering: float = Field(0.0, ge=0, description="scattering coefficient b [1/m]")
    extinction: float = Field(0.0, gt=0, description="extinction (beam attenuation) coefficient c = a + b [1/m]")
    albedo: Annotated[float, Field(ge=0, le=1)] | Literal["paper"] = Field(
        0.0,
        description='single-scattering albedo b/c, or "paper": uniform in (0, 0.97) at each collision',
    )
    chlorophyll: float | None = Field(
        None, ge=0, le=30, description="chlorophyll of the open ocean, in place of coefficients [mg/m³]"
    )

    @model_validator(mode="after")
    def _complete(self) -> Self:
        # What was given stays in model_fields_set, from where to_dict() knows it.
        if self.chlorophyll is None:
            self.__dict__.update(_layers.complete_medium({name: getattr(self, name) for name in self.given}))
        elif self.given or self.preset is not None:
            raise ValueError(f"chlorophyll = {self.chlorophyll} goes without {', '.join(self.given or ['preset'])}")
        return self

    @property
    def given(self) -> tuple[str, ...]:
        """Names of the two coefficients that define the water, none with chlorophyll; the others follow."""
        return tuple(name for name in _layers.COEFFICIENTS if name in self.model_fields_set)

    @property
    def attenuation_length(self) -> float:
        """1/c [m]."""
        return 1.0 / self.extinction

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal section again: of the coefficients the given ones."""
        hidden = set(_layers.COEFFICIENTS) - set(self.given)
        return {name: value for name, value in super().to_dict().items() if name not in hidden}


class Layer(_Water):
    """Water from a plane on, up to the next layer; given as a medium is."""

    start: float = Field(..., description="where it begins along `layer_axis`, the world's z if not given [m]")
    anisotropy: float | None = Field(
        None, gt=-1, lt=1, description="mean cosine g of the scattering angle; the medium's if not given"
    )

    @model_validator(mode="before")
    @classmethod
    def _expand_preset(cls, fields: Any) -> Any:
        if not isinstance(fields, Mapping):
            return fields
        whole = _layers.merge_section(cls.section, {}, fields)
        # A preset has indices, but one pair of them holds for all layers: the medium's.
        return {name: value for name, value in whole.items() if name in fields or name in cls.model_fields}


# Fields that a phase function needs and no other takes.
_PHASE_FIELDS = {"two_term_henyey_greenstein": ("g1", "g2", "alpha"), "tabulated": ("phase_table",)}


class Medium(_Water):
    """The water. Give exactly two of absorption, scattering, extinction, albedo, or chlorophyll; all four can be read.

    What chlorophyll, temperature and salinity imply follows the laser's wavelength (532 nm outside a scene). With
    `layers` it is the water before the first of them.
    """

    phase_function: Literal["henyey_greenstein", "two_term_henyey_greenstein", "fournier_forand", "tabulated"] = Field(
        "henyey_greenstein", description="law of the scattering angle"
    )
    anisotropy: float = Field(
        0.924, gt=-1, lt=1, description="henyey_greenstein: mean cosine g of the scattering angle"
    )
    g1: float | None = Field(None, gt=-1, lt=1, description="two_term_henyey_greenstein: g of the first term")
    g2: float | None = Field(None, gt=-1, lt=1, description="two_term_henyey_greenstein: g of the second term")
    alpha: float | None = Field(None, ge=0, le=1, description="two_term_henyey_greenstein: weight of the first term")
    particle_index: float = Field(
        1.10, gt=1, le=1.35, description="fournier_forand: index n of the particles over that of the water"
    )
    junge_slope: float = Field(3.5835, ge=3.05, lt=5, description="fournier_forand: slope µ of the size distribution")
    phase_table: str | None = Field(
        None,
        description="tabulated: the path of a .csv file of angle [°] and value of any scale, or "
        + " or ".join(f'"{name}"' for name in PHASE_TABLES),
    )
    group_index: float = Field(
        WATER_INDICES["seawater"][1],
        ge=1,
        le=3,
        description='index for the time of flight; "seawater" and "fresh" stand for 1.3638 and 1.3566',
    )
    phase_index: float = Field(
        WATER_INDICES["seawater"][0],
        ge=1,
        le=3,
        description='refractive index; "seawater" and "fresh" stand for 1.3415 and 1.3350',
    )
    temperature: float | None = Field(
        None, ge=0, le=30, description="gives the indices that are not given, with salinity 35 [°C]"
    )
    salinity: float | None = Field(None, ge=0, le=40, description="the same, with temperature 20 [g/kg]")
    layers: Annotated[tuple[Layer, ...], BeforeValidator(_listed)] = Field(
        (), description="other waters further along `layer_axis`, in its order"
    )
    layer_axis: Vector = Field((0.0, 0.0, 1.0), description="direction across the layers, in the world; not 0")
    _molecular_share: float = PrivateAttr(0.0)

    @field_validator("phase_index", "group_index", mode="before")
    @classmethod
    def _named_index(cls, value: Any, info: Any) -> Any:
        if isinstance(value, str):
            if value not in WATER_INDICES:
                raise ValueError(f"is neither a number nor one of {', '.join(map(repr, WATER_INDICES))}")
            return WATER_INDICES[value][info.field_name == "group_index"]
        return value

    @field_validator("phase_table")
    @classmethod
    def _known_table(cls, value: str | None) -> str | None:
        if value is not None and value not in PHASE_TABLES and not value.lower().endswith(".csv"):
            raise ValueError("choice", tuple(PHASE_TABLES), "the path of a .csv file")
        return value

    @model_validator(mode="after")
    def _fields_of_the_phase_function(self) -> Self:
        for law, names in _PHASE_FIELDS.items():
            missing = [name for name in names if getattr(self, name) is None]
            if law == self.phase_function and missing:
                raise ValueError(f"needs {', '.join(missing)} with phase_function = {law!r}")
            if law != self.phase_function and len(missing) < len(names):
                given = next(name for name in names if name not in missing)
                raise ValueError(f"{given} = {getattr(self, given)!r} goes with phase_function = {law!r} only")
        return self

    @model_validator(mode="after")
    def _resolved(self) -> Self:
        if not any(self.layer_axis):
            raise ValueError(f"layer_axis = {list(self.layer_axis)} has no length")
        for i, layer in enumerate(self.layers):
            if i and layer.start <= self.layers[i - 1].start:
                before = self.layers[i - 1].start
                raise ValueError(f"layers[{i}].start = {layer.start} is outside ({before}, inf), the layer before it")
            if (layer.albedo == "paper") != (self.albedo == "paper"):
                raise ValueError(
                    f"layers[{i}].albedo = {layer.albedo!r} does not go with {self.albedo!r}, the medium's"
                )
            # A preset may bring one with it, which is no more than what the medium's own preset may.
            own = PRESETS["medium"][layer.preset].values.get("anisotropy") if layer.preset else None
            if self.phase_function != "henyey_greenstein" and layer.anisotropy not in (None, own):
                raise ValueError(
                    f"layers[{i}].anisotropy = {layer.anisotropy} goes with phase_function = 'henyey_greenstein' only;"
                    " layers share any other"
                )
        self._follow(Laser.model_fields["wavelength_nm"].default)
        return self

    def _follow(self, wavelength_nm: float) -> None:
        """Sets what depends on the wavelength."""
        from .water import water_optics

        temperature = 20.0 if self.temperature is None else self.temperature
        salinity = 35.0 if self.salinity is None else self.salinity

        self.__dict__["layers"] = tuple(layer.model_copy() for layer in self.layers)
        for water in self.waters:
            names = [] if water.chlorophyll is None else [*_layers.COEFFICIENTS]
            if water is self and self.follows_wavelength:
                names += [name for name in ("phase_index", "group_index") if name not in self.model_fields_set]
            if not names:
                continue
            optics = water_optics(
                wavelength_nm, chlorophyll=water.chlorophyll or 0.0, temperature=temperature, salinity=salinity
            )
            water.__dict__.update({name: getattr(optics, name) for name in names})
            if water is self and self.chlorophyll is not None and not self.layers:
                self._molecular_share = optics.water_scattering / optics.scattering

    @property
    def phase_parameters(self) -> dict[str, float | str]:
        """The fields that `phase_function` takes."""
        names = {"henyey_greenstein": ("anisotropy",), "fournier_forand": ("particle_index", "junge_slope")}
        return {name: getattr(self, name) for name in {**names, **_PHASE_FIELDS}[self.phase_function]}

    @property
    def molecular_share(self) -> float:
        """Part of the scattering that is the water's own, beside `phase_function`, which is then of particles alone.

        Known with chlorophyll, 0 without it; 0 with layers too, which share one phase function.
        """
        return self._molecular_share

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

        Raises `ValueError` outside [400, 700] if anything depends on it.
        """
        medium = self.model_copy()
        medium._follow(wavelength_nm)
        return medium

    @property
    def waters(self) -> tuple[Medium | Layer, ...]:
        """Itself and its layers, in the order of `layer_axis`."""
        return (self, *self.layers)

    def optical_depth(self, begin: Sequence[float], end: Sequence[float]) -> float:
        """∫c ds on the straight way between two points of the world [m]."""
        length = math.dist(begin, end)
        if not self.layers or length == 0.0:
            return self.extinction * length
        scale = math.hypot(*self.layer_axis)
        first, last = sorted(
            sum(a * x for a, x in zip(self.layer_axis, point, strict=True)) / scale for point in (begin, end)
        )
        edges = [-math.inf, *(layer.start for layer in self.layers), math.inf]
        if first == last:
            return length * self.waters[bisect.bisect_right(edges, first) - 1].extinction
        parts = (
            water.extinction * max(0.0, min(high, last) - max(low, first))
            for water, (low, high) in zip(self.waters, itertools.pairwise(edges), strict=True)
        )
        return length / (last - first) * math.fsum(parts)

    def to_dict(self) -> dict[str, Any]:
        """The fields that make an equal section again: of the coefficients the given ones, of the indices too."""
        hidden = {"layers", "layer_axis"}
        if self.follows_wavelength:
            hidden |= {"phase_index", "group_index"} - self.model_fields_set
        fields = {name: value for name, value in super().to_dict().items() if name not in hidden}
        if self.layers:
            fields |= {"layer_axis": self.layer_axis, "layers": [layer.to_dict() for layer in self.layers]}
        return fields


class Laser(Section):
    """The pulsed source. Photons leave it at the middle of the pulse, time 0."""

    section: ClassVar[str] = "laser"
    preset: str | None = Field(None, description="a named laser, see `spadwarp presets laser`")
    position: Vector = Field((0.0, 0.0, 0.0), description="place [m]")
    direction: Vector = Field((0.0, 0.0, 1.0), description="axis of the beam; any length but 0; a scan aims it itself")
    frame: Literal["camera", "world"] = Field(
        "camera", description="frame of position and direction: a laser moves with the camera, or stands in the world"
    )
    profile: Literal["uniform_cone", "gaussian", "collimated", "measured"] = Field(
        "uniform_cone", description="even over a cone; exp(-2 tan²α/tan²θ); parallel; or an image"
    )
    profile_image: str | None = Field(
        None, description="irradiance across a measured beam: .npy, .exr or .png (linear), rows downwards"
    )
    half_angle_deg: float = Field(
        15.0,
        gt=0,
        le=180,
        description="half angle θ of the cone, 1/e² half angle of the gaussian, half the image's width [°]",
    )
    beam_radius: float = Field(0.0, ge=0, description="radius of the collimated beam [m]; 0 is a pencil beam")
    wavelength_nm: float = Field(532.0, gt=0, description="vacuum wavelength [nm]")
    pulse_energy: float = Field(37.5e-9, gt=0, description="energy of one pulse [J]")
    repetition_rate: float = Field(20e6, gt=0, description="pulses per second [Hz]")
    pulse_fwhm_ps: float = Field(85.0, ge=0, description="pulse duration, full width at half maximum [ps]")

    @model_validator(mode="after")
    def _has_a_beam(self) -> Self:
        if not any(self.direction):
            raise ValueError(f"direction = {list(self.direction)} has no length")
        if self.profile in ("gaussian", "measured") and self.half_angle_deg >= 90:
            raise ValueError(
                f"half_angle_deg = {self.half_angle_deg} is outside (0, 90), the range of a {self.profile} profile"
            )
        if (self.profile == "measured") != (self.profile_image is not None):
            raise ValueError(f"profile_image = {self.profile_image!r} does not go with profile = {self.profile!r}")
        return self

    @property
    def half_angle(self) -> float:
        """θ [rad]."""
        return math.radians(self.half_angle_deg)

    @property
    def axis(self) -> tuple[float, float, float]:
        """`direction` as a unit vector."""
        x, y, z = self.direction
        length = math.hypot(x, y, z)
        return (x / length, y / length, z / length)

    @property
    def photons_per_pulse(self) -> float:
        """E0·λ/(hc)."""
        return self.pulse_energy * self.wavelength_nm * 1e-9 / (PLANCK * SPEED_OF_LIGHT)


class Camera(Section):
    """A view through a round aperture: a pinhole's, or a thin lens's where `focus_distance` is given.

    The view is given by `horizontal_fov_deg`, by `focal_length` with `pixel_pitch_um`, or by OpenCV's `fx` (with `fy`,
    `cx`, `cy`), which `calibration` reads from a file; the aperture by `aperture_diameter`, or by `f_number` with
    `focal_length`.
    """

    section: ClassVar[str] = "camera"
    preset: str | None = Field(None, description="a named camera, see `spadwarp presets camera`")
    width: Whole = Field(..., ge=1, le=16384, description="pixels in a row")
    height: Whole = Field(..., ge=1, le=16384, description="rows")
    horizontal_fov_deg: float | None = Field(None, gt=0, lt=180, description="full horizontal field of view [°]")
    focal_length: float | None = Field(None, gt=0, description="focal length [m]")
    pixel_pitch_um: float | None = Field(None, gt=0, description="side of a pixel [µm]")
    fx: float | None = Field(None, gt=0, description="focal length along rows [pixels], as OpenCV writes it")
    fy: float | None = Field(None, gt=0, description="focal length along columns [pixels]; fx if not given")
    cx: float | None = Field(
        None,
        description="column of the optical axis, 0 at the first pixel's centre as in OpenCV; default: the middle",
    )
    cy: float | None = Field(None, description="row of the optical axis, likewise")
    distortion: Brown = Field((0.0,) * 5, description="Brown's lens distortion k1, k2, p1, p2, k3, OpenCV's order")
    calibration: str | None = Field(
        None,
        description="OpenCV's YAML or JSON file, whose fx, fy, cx, cy and distortion take its place",
    )
    aperture_diameter: float | None = Field(None, gt=0, description="diameter of the entrance aperture [m]")
    f_number: float | None = Field(None, gt=0, description="focal length over aperture diameter")
    focus_distance: float | None = Field(
        None,
        gt=0,
        le=math.inf,
        allow_inf_nan=True,
        description="thin lens: depth that is imaged sharply [m], inf is infinity; not given: pinhole, all of it sharp",
    )
    position: Vector = Field((0.0, 0.0, 0.0), description="lens centre in the world [m]")
    rotation_deg: Vector = Field(
        (0.0, 0.0, 0.0), description="turns from the world's axes about x, the turned y, then z [°]"
    )

    @model_validator(mode="before")
    @classmethod
    def _read_calibration(cls, fields: Any) -> Any:
        if not isinstance(fields, Mapping) or not isinstance(fields.get("calibration"), str):
            return fields
        from .calibration import load_calibration

        read = load_calibration(fields["calibration"])
        for name in ("width", "height"):
            if fields.get(name, read.get(name)) != read.get(name, fields.get(name)):
                raise ValueError(f"{name} = {fields[name]} is not {read[name]}, the image's of the calibration")
        return {**read, **{name: value for name, value in fields.items() if name != "calibration"}}

    @model_validator(mode="after")
    def _determined(self) -> Self:
        given = [name for name in ("horizontal_fov_deg", "pixel_pitch_um", "fx") if getattr(self, name) is not None]
        if len(given) != 1:
            raise ValueError(
                "needs one of horizontal_fov_deg, fx, and pixel_pitch_um with focal_length"
                + (f"; given: {', '.join(given)}" if given else "")
            )
        if (self.aperture_diameter is None) == (self.f_number is None):
            raise ValueError("needs either aperture_diameter or f_number with focal_length")
        if self.focal_length is None and (self.pixel_pitch_um is not None or self.f_number is not None):
            raise ValueError(
                f"focal_length is missing; {'pixel_pitch_um' if self.f_number is None else 'f_number'} needs it"
            )
        for name in ("fy", "cx", "cy"):
            if self.fx is None and getattr(self, name) is not None:
                raise ValueError(f"{name} = {getattr(self, name)} goes with fx only")
        if self.focus_distance is not None and self.focus_distance <= (self.focal_length or 0.0):
            raise ValueError(
                f"focus_distance = {self.focus_distance} is outside ({self.focal_length}, inf], beyond the focal length"
            )
        if any(self.distortion):
            from .imaging import is_invertible

            if not is_invertible(self):
                raise ValueError(
                    f"distortion = {list(self.distortion)} folds the image: some of its {self.width} x {self.height} "
                    "pixels show no direction, or two"
                )
        return self

    @property
    def focal_pixels(self) -> tuple[float, float]:
        """Focal length in pixels along rows and columns, fx and fy: image distance over pixel pitch."""
        if self.fx is not None:
            return self.fx, self.fy or self.fx
        tangent = self.pixel_tangent
        return 1.0 / tangent, 1.0 / tangent

    @property
    def principal_point(self) -> tuple[float, float]:
        """Image coordinates (column, row) of the optical axis, (0.5, 0.5) being the first pixel's centre."""
        return (
            self.width / 2.0 if self.cx is None else self.cx + 0.5,
            self.height / 2.0 if self.cy is None else self.cy + 0.5,
        )

    @property
    def pixel_tangent(self) -> float:
        """Pixel pitch over image distance; the geometric mean of both directions where fx and fy differ.

        The image distance is the focal length or, where a thin lens is focused nearer than infinity, 1/(1/f − 1/d).
        """
        if self.horizontal_fov_deg is not None:
            return 2.0 * math.tan(math.radians(self.horizontal_fov_deg) / 2.0) / self.width
        if self.fx is not None:
            return 1.0 / math.sqrt(self.fx * (self.fy or self.fx))
        assert self.pixel_pitch_um is not None and self.focal_length is not None
        return self.pixel_pitch_um * 1e-6 / self.focal_length * (1.0 - self.focal_length * self.inverse_focus)

    @property
    def inverse_focus(self) -> float:
        """1 over the depth that is imaged sharply [1/m]; 0 for a pinhole, and for a lens focused at infinity."""
        return 0.0 if self.focus_distance is None else 1.0 / self.focus_distance

    @property
    def is_plain(self) -> bool:
        """Whether it is a pinhole with square pixels about the optical axis and without distortion."""
        fx, fy = self.focal_pixels
        middle = (self.width / 2.0, self.height / 2.0)
        return fx == fy and self.principal_point == middle and not any(self.distortion) and self.focus_distance is None

    @property
    def view_box(self) -> tuple[float, float, float, float]:
        """Least and largest tangents (left, top, right, bottom) of what the image shows."""
        if any(self.distortion):
            from .imaging import view_box

            return view_box(self)
        (fx, fy), (cx, cy) = self.focal_pixels, self.principal_point
        return -cx / fx, -cy / fy, (self.width - cx) / fx, (self.height - cy) / fy

    @property
    def horizontal_fov(self) -> float:
        """Full horizontal field of view [rad]."""
        left, _, right, _ = self.view_box
        return math.atan(right) - math.atan(left)

    @property
    def vertical_fov(self) -> float:
        """Full vertical field of view [rad]."""
        _, top, _, bottom = self.view_box
        return math.atan(bottom) - math.atan(top)

    @property
    def aperture_radius(self) -> float:
        """Radius of the entrance aperture [m]."""
        if self.aperture_diameter is not None:
            return self.aperture_diameter / 2.0
        assert self.focal_length is not None and self.f_number is not None
        return self.focal_length / self.f_number / 2.0

    @property
    def aperture_area(self) -> float:
        """Area of the entrance aperture [m²]."""
        return math.pi * self.aperture_radius**2


class Scan(Section):
    """How the beam moves over the scene."""

    section: ClassVar[str] = "scan"
    mode: Literal["none", "confocal"] = Field(
        "none", description="confocal: the beam visits the pixels in turn and each sees its own light alone"
    )
    distance: float = Field(
        math.inf,
        gt=0,
        le=math.inf,
        allow_inf_nan=True,
        description="range at which a confocal beam crosses its pixel's line of sight [m]; inf is parallel",
    )


class Detector(Section):
    """The SPAD array and its timing electronics."""

    section: ClassVar[str] = "detector"
    preset: str | None = Field(None, description="a named detector, see `spadwarp presets detector`")
    pdp: float = Field(0.247, ge=0, le=1, description="photon detection probability of the active area")
    fill_factor: float = Field(0.2, gt=0, le=1, description="active part of a pixel's area, microlenses included")
    jitter_fwhm_ps: float = Field(200.0, ge=0, description="timing jitter, full width at half maximum [ps]")
    irf: str = Field(
        "gaussian",
        description='instrument response: "gaussian", "exponentially_modified_gaussian", or the path of a .csv file',
    )
    irf_tail_ps: float = Field(100.0, gt=0, description="time constant of the exponential tail [ps]")
    dark_count_rate: float = Field(100.0, ge=0, description="median dark counts per second and pixel [1/s]")
    dark_count_spread: float = Field(
        0.0, ge=0, description="relative (log-normal) spread of the dark count rate over pixels"
    )
    hot_pixel_fraction: float = Field(0.0, ge=0, le=1, description="part of the pixels that are hot")
    hot_pixel_rate: float = Field(1e4, ge=0, description="dark count rate of a hot pixel [1/s]")
    ambient_rate: float = Field(0.0, ge=0, description="detected background counts per second and pixel [1/s]")
    mode: Literal["first_photon", "free_running"] = Field(
        "first_photon", description="one count a pulse, or as many as come"
    )
    dead_time_ns: float = Field(0.0, ge=0, description="dead time after a count, free-running [ns]")
    afterpulsing_probability: float = Field(0.0, ge=0, lt=1, description="probability that a count causes another")
    afterpulsing_time_constant_ns: float = Field(50.0, gt=0, description="decay time of afterpulsing [ns]")
    crosstalk_probability: float = Field(0.0, ge=0, lt=1, description="probability that a count fires a neighbour")
    fold: bool = Field(True, description="fold time modulo the pulse period, as a detector sees it")
    pulses: Whole = Field(20_000, ge=1, le=2**63 - 1, description="pulses in one exposure")
    counter_depth: Whole = Field(
        0, ge=0, le=2**31 - 1, description="largest count a histogram bin holds; 0 is unlimited"
    )

    @field_validator("irf")
    @classmethod
    def _known_irf(cls, value: str) -> str:
        if value not in (names := ("gaussian", "exponentially_modified_gaussian")) and not value.lower().endswith(
            ".csv"
        ):
            raise ValueError("choice", names, "the path of a .csv file")
        return value

    @property
    def pde(self) -> float:
        """Photon detection efficiency: PDP × fill factor."""
        return self.pdp * self.fill_factor


class Gate(Section):
    """The time bins after the pulse leaves the laser."""

    section: ClassVar[str] = "gate"
    preset: str | None = Field(None, description="named electronics, see `spadwarp presets gate`")
    start_ns: float = Field(0.0, ge=0, description="begin of the first bin [ns]")
    bin_width_ps: float = Field(..., gt=0, description="width of a bin [ps]")
    bins: Whole = Field(..., ge=1, le=1_000_000, description="number of bins")

    @property
    def start(self) -> float:
        """Begin of the first bin [s]."""
        return self.start_ns * 1e-9

    @property
    def bin_width(self) -> float:
        """[s]."""
        return self.bin_width_ps * 1e-12

    @property
    def stop(self) -> float:
        """End of the last bin [s]."""
        return self.start + self.bins * self.bin_width


class Target(Section):
    """One mesh: sized and scaled, then rotated, then moved."""

    section: ClassVar[str] = "targets"
    builtin: str | None = Field(None, min_length=1, description='a mesh that comes with spadwarp, such as "staircase"')
    mesh: str | None = Field(None, description="path of a mesh file, relative to the scene file")
    size: Size | None = Field(
        None, description="extent of plane, box, sphere; one number, two for x and y, or three [m]"
    )
    subdivisions: Whole = Field(0, ge=0, le=12, description="times that every face is split into four")
    scale: Scale = Field((1.0, 1.0, 1.0), description="factor, one or three; mesh units to metres")
    rotation_deg: Vector = Field(
        (0.0, 0.0, 0.0), description="turns about the target's own x, then the turned y, then z [°]"
    )
    translation: Vector = Field(
        (0.0, 0.0, 0.0), description="shift in the world [m], the camera's frame if it has no pose"
    )
    reflectance: Annotated[float, Field(ge=0, le=1)] | Literal["from_file"] = Field(
        0.5, description='Lambertian reflectance of both sides; "from_file": colours and textures of the mesh file'
    )
    reflectance_scale: float = Field(1.0, gt=0, description='factor on the reflectance "from_file"')
    colour_encoding: Literal["srgb", "linear"] = Field(
        "srgb", description='how the file\'s colours and images stand for reflectance; "linear" is proportional'
    )
    specular: float = Field(
        0.0, ge=0, le=1, description="reflectance of the facets of a rough specular lobe; 0 is none"
    )
    roughness: float = Field(0.2, ge=0.01, le=1, description="width of that lobe: GGX parameter α")

    @model_validator(mode="after")
    def _one_mesh(self) -> Self:
        if (self.builtin is None) == (self.mesh is None):
            raise ValueError("needs either builtin or mesh")
        if not all(self.scale):
            raise ValueError(f"scale = {list(self.scale)} holds a zero")
        if self.size is not None and self.builtin is None:
            raise ValueError(f"size = {list(self.size)} goes with builtin only; a mesh file takes scale")
        if self.reflectance == "from_file":
            if self.mesh is None:
                raise ValueError("reflectance = 'from_file' goes with mesh only; a builtin takes a number")
        elif self.reflectance + self.specular > 1:
            raise ValueError(
                f"specular = {self.specular:g} and reflectance = {self.reflectance:g} reflect more than arrives:"
                " their sum is outside [0, 1]"
            )
        elif self.reflectance_scale != 1:
            raise ValueError(f"reflectance_scale = {self.reflectance_scale:g} goes with reflectance = 'from_file' only")
        return self


class Domain(Section):
    """Where the water is, in the world. A photon that leaves it is gone; camera and laser must be inside."""

    section: ClassVar[str] = "domain"
    shape: Literal["unbounded", "slab", "box"] = Field(
        "unbounded", description="slab: bounded in z; box: in x, y and z"
    )
    lower: Corner = Field(
        (-math.inf,) * 3, description="lower corner [m]; one number stands for all three, a slab uses z"
    )
    upper: Corner = Field(
        (math.inf,) * 3, description="upper corner [m]; one number stands for all three, a slab uses z"
    )

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for axis, low, high in zip("xyz", *self.bounds, strict=True):
            if not low < high:
                raise ValueError(f"lower = {low} is outside (-inf, {high}), {high} being upper in {axis}")
        return self

    @property
    def bounds(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Lower and upper corner as they act [m]; infinite where the shape has no bound."""
        free = {"unbounded": 3, "slab": 2, "box": 0}[self.shape]
        low, high = (-math.inf,) * free + self.lower[free:], (math.inf,) * free + self.upper[free:]
        return (low[0], low[1], low[2]), (high[0], high[1], high[2])


class Transport(Section):
    """How photons are traced."""

    section: ClassVar[str] = "transport"
    photons: Whole = Field(1_000_000, ge=1, le=10**12, description="photons to emit")
    seed: Whole = Field(0, ge=0, le=2**64 - 1, description="key of the random numbers; one seed gives the same bits")
    estimator: Literal["analog", "next_event", "guided"] = Field(
        "guided", description="what scores: the photon itself, every event, or guided flights"
    )
    termination: Literal["cutoff", "roulette"] = Field(
        "cutoff", description="drop light photons (biased), or Russian roulette"
    )
    weight_cutoff: float = Field(2e-4, ge=0, lt=1, description="analog weight below which a photon ends; 0 is never")
    max_collisions: Whole = Field(64, ge=1, le=2**31 - 1, description="events of one photon, surfaces included")
    max_path: float | None = Field(None, gt=0, description="longest geometric path [m]; the gate's end if not given")
    lateral_limit: float = Field(
        math.inf,
        gt=0,
        allow_inf_nan=True,
        description="photons end where |x| or |y| in the camera frame reaches this [m]; inf is no limit",
    )
    axis_threshold: float = Field(
        0.9998, gt=0, le=1, description="|u_z| from which the near-axis rule acts; 1 turns it off (exact)"
    )


class Output(Section):
    """What a run writes into its directory."""

    section: ClassVar[str] = "output"
    result: bool = Field(True, description="everything, as HDF5")
    exr: bool = Field(True, description="truth and depth, as EXR")
    png: bool = Field(True, description="pictures for a first look")
    depth_method: Literal["peak", "centroid", "matched"] = Field("centroid", description="how the depth frame is made")


class Analytic(Section):
    """Settings of the analytic simulator; transport does not read them."""

    section: ClassVar[str] = "analytic"
    form: Literal["radiometric", "paper"] = Field(
        "radiometric", description="constants of the lidar equation: radiometry, or eq 7 as printed"
    )
    backscatter: Literal["constant", "single_scatter", "monte_carlo"] = Field(
        "single_scatter", description="time course of the backscatter"
    )
    backscatter_rate: float = Field(
        0.0, ge=0, description="constant backscatter, detections per second in the gate [1/s]"
    )
    backscatter_fraction: float | None = Field(
        None, ge=0, le=1, description="part of the pixels that report backscatter (BS); from the rates if not given"
    )
    count_law: Literal["per_pulse", "per_frame_paper", "per_frame"] = Field(
        "per_pulse", description="at most one count a pulse, or a frame"
    )
    pulses: Whole = Field(20_000, ge=1, le=2**63 - 1, description="pulses of one depth frame, for per_pulse")
    frames: Whole = Field(1000, ge=1, le=2**63 - 1, description="detector frames of one depth frame, for per_frame")
    exposure: float = Field(1e-5, gt=0, description="exposure of one detector frame [s]")


class Scene(BaseModel):
    """Everything a run depends on, checked and frozen."""

    model_config = ConfigDict(frozen=True, extra="forbid", strict=True)

    medium: Medium
    laser: Laser = Laser()
    camera: Camera
    scan: Scan = Scan()
    detector: Detector = Detector()
    gate: Gate
    targets: Annotated[tuple[Target, ...], BeforeValidator(_listed)] = ()
    domain: Domain = Domain()
    transport: Transport = Transport()
    output: Output = Output()
    analytic: Analytic = Analytic()
    _source: Path | None = PrivateAttr(None)

    @model_validator(mode="after")
    def _water_at_the_lasers_wavelength(self) -> Self:
        try:
            self.__dict__["medium"] = self.medium.at_wavelength(self.laser.wavelength_nm)
        except ValueError as error:
            raise ValueError(f"laser.{error}, for which medium.chlorophyll, temperature and salinity hold") from None
        return self

    @classmethod
    def from_dict(cls, tables: Mapping[str, Any], *, source: str | os.PathLike[str] | None = None) -> Scene:
        """A scene from tables as TOML gives them; relative paths in them start at `source`'s folder.

        Raises `ConfigError` with a line for each problem.
        """
        return _build(dict(tables), source=source)

    @property
    def source(self) -> Path | None:
        """The file that the scene came from."""
        return self._source

    @property
    def scan_positions(self) -> int:
        """Places that the beam visits: photon i leaves at place i modulo this."""
        return 1 if self.scan.mode == "none" else self.camera.width * self.camera.height

    @property
    def beam(self) -> Laser:
        """The laser with position and direction in the camera frame."""
        laser, camera = self.laser, self.camera
        if laser.frame == "camera" or not any((*camera.position, *camera.rotation_deg)):
            return laser
        from .pose import rotation_matrix, to_camera

        place, axis = to_camera(camera, laser.position), laser.axis @ rotation_matrix(camera.rotation_deg)
        moved = {"position": tuple(map(float, place)), "direction": tuple(map(float, axis)), "frame": "camera"}
        return laser.model_copy(update=moved)

    def optical_depth(self, begin: Sequence[float], end: Sequence[float]) -> float:
        """∫c ds on the straight way between two points of the camera frame [m]."""
        if self.medium.layers and any((*self.camera.position, *self.camera.rotation_deg)):
            from .pose import to_world

            begin, end = to_world(self.camera, [begin, end]).tolist()
        return self.medium.optical_depth(begin, end)

    @property
    def path_limit(self) -> float:
        """Longest geometric path that counts [m]: `transport.max_path` or the gate's end, whichever is shorter."""
        gate_end = SPEED_OF_LIGHT / self.medium.group_index * self.gate.stop
        return min(self.transport.max_path or gate_end, gate_end)

    def to_dict(self) -> dict[str, Any]:
        """Tables from which `from_dict` makes an equal scene."""
        tables: dict[str, Any] = {}
        for name, section in self:
            tables[name] = [one.to_dict() for one in section] if name == "targets" else section.to_dict()
        if not tables["targets"]:
            del tables["targets"]
        return tables

    def to_toml(self) -> str:
        """The full text that `load_scene` reads back to an equal scene."""
        return _layers.toml_text(self.to_dict())

    def with_overrides(self, overrides: Overrides | None = None, /, **sections: Mapping[str, Any]) -> Scene:
        """A changed scene: `with_overrides({"medium.extinction": 0.9})`, `with_overrides(medium={"extinction": 0.9})`.

        Overrides act as in `load_scene`. Raises `ConfigError`.
        """
        changed = self
        for one in (overrides, sections):
            if one:
                changed = _build(changed.to_dict(), overrides=one, source=self.source, resolve=False)
        return changed

    def __eq__(self, other: object) -> bool:
        """Equal in every field; where it came from does not matter."""
        return isinstance(other, Scene) and self.__dict__ == other.__dict__

    def __hash__(self) -> int:
        return hash(tuple(self.__dict__.values()))


def load_scene(path: str | os.PathLike[str], overrides: Overrides | None = None) -> Scene:
    """Read a scene file.

    `overrides` lie over the file: `["medium.extinction=0.9"]`, `{"medium.extinction": 0.9}` or nested mappings, None
    for a field's default. A medium is given by two coefficients; overriding one keeps another: extinction keeps the
    albedo, albedo the extinction, absorption the scattering, scattering the absorption; overriding two replaces both.
    Relative paths start at the file's folder, those in overrides at the working directory.
    Raises `FileError` if the file cannot be read, `ConfigError` with a line for each problem in it.
    """
    try:
        text = Path(path).read_bytes().decode()
        tables = tomllib.loads(text)
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror}") from None
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ConfigError(f"not valid TOML: {error}", source=str(path)) from None
    return _build(tables, overrides=overrides, source=path)


def _build(
    tables: dict[str, Any],
    *,
    overrides: Overrides | None = None,
    source: str | os.PathLike[str] | None = None,
    resolve: bool = True,
) -> Scene:
    name = None if source is None else str(source)
    layer: dict[str, Any] = {}
    try:
        if source is not None and resolve:
            tables = _with_paths(tables, Path(source).absolute().parent)
        if overrides:
            layer = _layers.override_layer(overrides)
            tables = _layers.merge_scene(tables, _with_paths(layer, Path.cwd()))
        scene = Scene.model_validate(tables)
    except ConfigError as error:
        raise ConfigError(error.problems, source=name) from None
    except ValidationError as error:
        raise ConfigError(describe(error, Scene, layer), source=name) from None
    scene._source = None if source is None else Path(source)
    return scene


def _with_paths(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The tables with relative paths of files made absolute."""

    def absolute(fields: Any, name: str, ending: str = "") -> Any:
        value = fields.get(name) if isinstance(fields, Mapping) else None
        if isinstance(value, str) and value.lower().endswith(ending):
            return {**fields, name: str(folder / Path(value).expanduser())}
        return fields

    changed = dict(tables)
    targets = tables.get("targets")
    if isinstance(targets, Mapping):
        changed["targets"] = {index: absolute(target, "mesh") for index, target in targets.items()}
    elif isinstance(targets, (list, tuple)):
        changed["targets"] = [absolute(target, "mesh") for target in targets]
    for section, name, ending in (
        ("medium", "phase_table", ".csv"),
        ("detector", "irf", ".csv"),
        ("camera", "calibration", ""),
        ("laser", "profile_image", ""),
    ):
        if section in tables:
            changed[section] = absolute(tables[section], name, ending)
    return changed
