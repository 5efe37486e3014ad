"""Sections of a scene that stand alone: what is around camera and laser, the detector, and settings of a run."""

from __future__ import annotations

import math
from typing import Annotated, ClassVar, Literal, Self

import numpy as np
from numpy.typing import NDArray
from pydantic import Field, model_validator

from spadwarp.limits import SEED, bounds
from spadwarp.scene.sections import (
    AnyFile,
    Corner,
    CsvFile,
    Direction,
    FilePath,
    Scale,
    Section,
    Size,
    Vector,
    Whole,
    unit_vector,
)
from spadwarp.water.daylight import refracted_cosine
from spadwarp.water.seawater import RANGES

__all__ = ["Analytic", "Daylight", "Detector", "Domain", "Gate", "Output", "Scan", "Target", "Transport"]


class Target(Section):
    """One mesh: sized and scaled, then rotated, then moved."""

    displaces: ClassVar = {"builtin": ("mesh",), "mesh": ("builtin", "size")}
    builtin: str | None = Field(None, min_length=1)
    """a built-in mesh, such as "staircase"; see `spadwarp list targets`"""
    mesh: AnyFile = None
    """path of a mesh file, relative to the scene file"""
    size: Size | None = None
    """extent of plane, box, sphere; one number, two for x and y, or three [m]"""
    subdivisions: Whole = Field(0, ge=0, le=12)
    """times that every face is split into four"""
    scale: Scale = (1.0, 1.0, 1.0)
    """factor, one or three; mesh units to metres"""
    rotation_deg: Vector = (0.0, 0.0, 0.0)
    """rotations about the target's own x, then its new y, then its new z [°]"""
    translation: Vector = (0.0, 0.0, 0.0)
    """shift in the world [m], the camera's frame if it has no pose"""
    reflectance: Annotated[float, Field(ge=0, le=1)] | Literal["from_file"] = 0.5
    """Lambertian reflectance of both sides; "from_file": colours and textures of the mesh file"""
    reflectance_scale: float = Field(1.0, ge=1e-9, le=1e9)
    """factor on a reflectance that is "from_file", the file's"""
    colour_encoding: Literal["srgb", "linear"] = "srgb"
    """how the file's colours and images stand for reflectance; "linear" is proportional"""
    specular: float = Field(0.0, ge=0, le=1)
    """reflectance of the facets of a rough specular lobe; 0 is none"""
    roughness: float = Field(0.2, ge=0.01, le=1)
    """width of that lobe: GGX parameter α"""
    specular_index: float = Field(1.5, ge=1, le=10)
    """phase index of its facets, by which they polarise light; polarised light alone"""

    @model_validator(mode="after")
    def _one_mesh(self) -> Self:
        if (self.builtin is None) == (self.mesh is None):
            raise ValueError("needs either builtin or mesh")
        if not all(self.scale):
            self._refuse("scale", "holds a zero")
        if self.size is not None and self.builtin is None:
            self._refuse("size", "goes with builtin only; a mesh file takes scale")
        if self.reflectance == "from_file":
            if self.mesh is None:
                self._refuse("reflectance", "goes with mesh only; a builtin takes a number")
        elif self.reflectance + self.specular > 1:
            raise ValueError(
                f"specular = {self.specular:g} and reflectance = {self.reflectance:g} reflect more than arrives:"
                " their sum is outside [0, 1]"
            )
        self._only_with("reflectance = 'from_file'", self.reflectance == "from_file", "reflectance_scale")
        return self


Index = Annotated[float, Field(ge=1, le=1e9)]


class OutsideIndex(Section):
    """Faces of the domain that reflect as the boundary of two media: walls of a tank, the surface seen from below.

    A face that has no index lets all light out.
    """

    x_low: Index | None = None
    """phase index behind the face at the lower bound in x"""
    x_high: Index | None = None
    """the same at the upper bound in x"""
    y_low: Index | None = None
    """the same at the lower bound in y"""
    y_high: Index | None = None
    """the same at the upper bound in y"""
    z_low: Index | None = None
    """the same at the lower bound in z"""
    z_high: Index | None = None
    """the same at the upper bound in z"""


class Domain(Section):
    """Where the water is, in the world; camera and laser must be inside. A photon that comes to a face leaves, and is
    gone, unless the face has an `outside_index`: there it is reflected, by Fresnel's formulas for unpolarised light."""

    shape: Literal["unbounded", "slab", "box"] = "unbounded"
    """slab: bounded in z; box: in x, y and z"""
    lower: Corner = (-math.inf,) * 3
    """lower corner [m]; one number for all three; a slab uses z"""
    upper: Corner = (math.inf,) * 3
    """upper corner [m]; one number for all three; a slab uses z"""
    outside_index: OutsideIndex | None = None
    """phase index behind the faces that reflect, such as `{y_low = 1.0}`: 1 is air, a very large number a mirror"""
    max_reflections: Whole = Field(2, ge=0, le=8)
    """longest chain of reflections on the way from a scattering to the lens; light by longer ones is left out"""

    @model_validator(mode="after")
    def _ordered(self) -> Self:
        for axis, low, high in zip("xyz", *self.bounds, strict=True):
            if not low < high:
                raise ValueError(f"lower = {low} is outside (-inf, {high}), {high} being upper in {axis}")
        for name in self.reflecting:
            bound = self.bounds[name.endswith("high")]["xyz".index(name[0])]
            if math.isinf(bound):
                raise ValueError(
                    f"outside_index.{name}: the domain has no such face with shape = {self.shape!r}; a slab has z_low "
                    "and z_high, a box all six, each where lower or upper is finite"
                )
        return self

    @property
    def reflecting(self) -> dict[str, float]:
        """Phase index behind each face that reflects, by the face's name."""
        return {} if self.outside_index is None else self.outside_index.to_dict()

    @property
    def bounds(self) -> tuple[tuple[float, float, float], tuple[float, float, float]]:
        """Lower and upper corner as they act [m]; infinite where the shape has no bound."""
        free = {"unbounded": 3, "slab": 2, "box": 0}[self.shape]
        low, high = (-math.inf,) * free + self.lower[free:], (math.inf,) * free + self.upper[free:]
        return (low[0], low[1], low[2]), (high[0], high[1], high[2])


class Daylight(Section):
    """Sun and clear sky over calm water, from which the ambient light of each pixel follows, on top of
    `detector.ambient_rate`."""

    sun_elevation_deg: float = Field(..., **bounds(RANGES["sun_elevation_deg"]))
    """height of the sun above the horizon, 90 less its zenith angle [°]"""
    depth: float = Field(..., ge=0, le=1e4)
    """of the lens below the surface [m]"""
    sun_azimuth_deg: float = Field(90.0, ge=-360, le=360)
    """horizontal angle from the world's z axis, or without one from its x axis, to below the sun, towards +x [°]"""
    up: Direction = (0.0, -1.0, 0.0)
    """direction of the surface in the world; any length but 0"""
    aerosol_optical_depth: float = Field(0.084, **bounds(RANGES["aerosol_optical_depth"]))
    """vertical optical depth of the aerosol at 500 nm: 0.05 very clear air, 0.3 haze"""
    cloud_factor: float = Field(1.0, ge=0, le=2)
    """irradiance over that of a clear sky"""

    @property
    def down(self) -> NDArray[np.float64]:
        """Unit vector away from the surface, in the world."""
        return -np.asarray(unit_vector(self.up))

    def sun_direction(self, index: float) -> NDArray[np.float64]:
        """Unit vector in which the sun's light goes in water of a refractive index, in the world."""
        down = self.down
        ahead = np.array([0.0, 0.0, 1.0]) - down[2] * down
        if np.linalg.norm(ahead) < 1e-6:
            ahead = np.array([1.0, 0.0, 0.0]) - down[0] * down
        ahead /= np.linalg.norm(ahead)
        azimuth = math.radians(self.sun_azimuth_deg)
        towards_sun = math.cos(azimuth) * ahead + math.sin(azimuth) * np.cross(down, ahead)
        cosine = refracted_cosine(self.sun_elevation_deg, index)
        return cosine * down - math.sqrt(1.0 - cosine**2) * towards_sun


class Detector(Section):
    """The SPAD array and its timing electronics."""

    section: ClassVar[str] = "detector"
    displaces: ClassVar = {
        "filter_fwhm_nm": ("filter_table",),
        "filter_table": ("filter_centre_nm", "filter_fwhm_nm", "filter_peak"),
    }
    preset: str | None = None
    """a named detector, see `spadwarp list presets detector`"""
    pdp: float = Field(0.247, ge=0, le=1)
    """photon detection probability of the active area"""
    fill_factor: float = Field(0.2, gt=0, le=1)
    """active part of a pixel's area, microlenses included"""
    jitter_fwhm_ps: float = Field(200.0, ge=0, le=1e12)
    """timing jitter, full width at half maximum [ps]"""
    irf: Annotated[str, FilePath(".csv", ("gaussian", "exponentially_modified_gaussian"))] = "gaussian"
    """instrument response: "gaussian", "exponentially_modified_gaussian", or the path of a .csv file"""
    irf_tail_ps: float = Field(100.0, ge=1e-12, le=1e12)
    """time constant of the exponential tail [ps]"""
    dark_count_rate: float = Field(100.0, ge=0, le=1e15)
    """median dark counts per second and pixel [1/s]"""
    dark_count_spread: float = Field(0.0, ge=0, le=10)
    """relative (log-normal) spread of the dark count rate over pixels"""
    hot_pixel_fraction: float = Field(0.0, ge=0, le=1)
    """part of the pixels that are hot"""
    hot_pixel_rate: float = Field(1e4, ge=0, le=1e15)
    """dark count rate of a hot pixel [1/s]"""
    ambient_rate: float = Field(0.0, ge=0, le=1e15)
    """detected background counts per second and pixel [1/s]"""
    filter_centre_nm: float | None = Field(None, ge=1e-9, le=1e6)
    """wavelength of largest transmission of the filter before the detector [nm]; default: the laser's"""
    filter_fwhm_nm: float | None = Field(None, ge=1e-6, le=1e6)
    """full width at half maximum of its Gaussian transmission [nm]; without it there is no filter"""
    filter_peak: float = Field(1.0, gt=0, le=1)
    """its largest transmission"""
    filter_table: CsvFile = None
    """a measured filter in place of these: .csv file of wavelength [nm] and transmission"""
    mode: Literal["first_photon", "free_running"] = "first_photon"
    """one count a pulse, or as many as come"""
    dead_time_ns: float = Field(0.0, ge=0, le=1e12)
    """dead time after a count, free-running [ns]"""
    afterpulsing_probability: float = Field(0.0, ge=0, lt=1)
    """probability that a count causes another"""
    afterpulsing_time_constant_ns: float = Field(50.0, ge=1e-12, le=1e12)
    """decay time of afterpulsing [ns]"""
    crosstalk_probability: float = Field(0.0, ge=0, lt=1)
    """probability that a count fires a neighbour"""
    wrap: bool = True
    """time of flight modulo the pulse period (range aliasing), as a detector sees it"""
    pulses_per_frame: Whole = Field(20_000, ge=1, le=2**63 - 1)
    """laser pulses in one frame of counts"""
    max_count: Whole = Field(0, ge=0, le=2**31 - 1)
    """largest count a histogram bin holds; 0 is unlimited"""

    @model_validator(mode="after")
    def _one_filter(self) -> Self:
        for name in ("filter_centre_nm", "filter_fwhm_nm", "filter_peak"):
            if getattr(self, name) == Detector.model_fields[name].default:
                continue
            if self.filter_table is not None:
                self._refuse(name, "cannot be combined with filter_table")
            if self.filter_fwhm_nm is None:
                self._refuse(name, "needs filter_fwhm_nm")
        return self

    @property
    def has_filter(self) -> bool:
        """Whether there is a filter before the detector."""
        return self.filter_fwhm_nm is not None or self.filter_table is not None

    @property
    def pde(self) -> float:
        """Photon detection efficiency: PDP × fill factor; the filter's transmission is left out."""
        return self.pdp * self.fill_factor

    @property
    def noise_rate(self) -> float:
        """Mean counts per second and pixel without light of the laser: dark counts and ambient light [1/s]."""
        return self.dark_count_rate + self.ambient_rate


class Gate(Section):
    """The time bins after the pulse leaves the laser."""

    section: ClassVar[str] = "gate"
    preset: str | None = None
    """named electronics, see `spadwarp list presets gate`"""
    start_ns: float = Field(0.0, ge=0, le=1e12)
    """begin of the first bin [ns]"""
    bin_width_ps: float = Field(..., ge=1e-12, le=1e15)
    """width of a bin [ps]"""
    bins: Whole = Field(..., ge=1, le=1_000_000)
    """number of bins"""

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


class Scan(Section):
    """How the beam moves over the scene."""

    mode: Literal["none", "confocal"] = "none"
    """confocal: the beam visits the pixels in turn and each sees its own light alone"""
    distance: float = Field(math.inf, ge=1e-6, le=math.inf, allow_inf_nan=True)
    """range at which a confocal beam crosses its pixel's line of sight [m]; inf is parallel"""


class Transport(Section):
    """How photons are traced."""

    photons: Whole = Field(1_000_000, ge=1, le=10**12)
    """photons to emit"""
    seed: Whole = Field(0, **bounds(SEED))
    """key of the random numbers; one seed gives the same bits"""
    estimator: Literal["analog", "next_event", "guided"] = "guided"
    """what scores: the photon itself, every event, or guided flights; `none` of the kernel library is not offered here;
    `spadwarp.transport.trace` uses it"""
    points_per_flight: Whole = Field(1, ge=1, le=3)
    """points at which `guided` scores a flight; more leave less noise in the bins of a pixel and take longer"""
    termination: Literal["cutoff", "roulette"] = "cutoff"
    """drop light photons (biased), or Russian roulette"""
    weight_cutoff: float = Field(2e-4, ge=0, lt=1)
    """analog weight below which a photon ends; 0 is never"""
    max_collisions: Whole = Field(64, ge=1, le=2**31 - 1)
    """events of one photon at most, surfaces included; the light of the last one still counts"""
    max_path: float | None = Field(None, gt=0, le=1e12)
    """longest geometric path [m]; the gate's end if not given"""
    lateral_limit: float = Field(math.inf, gt=0, le=math.inf, allow_inf_nan=True)
    """photons end where |x| or |y| in the camera frame reaches this [m]; inf is no limit"""
    axis_threshold: float = Field(0.9998, gt=0, le=1)
    """|u_z| from which the near-axis rule acts; 1 turns it off (exact)"""


class Analytic(Section):
    """Settings of the analytic simulator; transport does not read them."""

    form: Literal["radiometric", "lu2024"] = "radiometric"
    """constants of the lidar equation: radiometry, or eq 7 as printed"""
    backscatter: Literal["constant", "single_scatter", "monte_carlo"] = "single_scatter"
    """time course of the backscatter"""
    backscatter_rate: float = Field(0.0, ge=0, le=1e15)
    """constant backscatter, detections per second in the gate [1/s]"""
    backscatter_fraction: float | None = Field(None, ge=0, le=1)
    """part of the pixels that report backscatter (BS); from the rates if not given"""
    count_law: Literal["per_pulse", "per_frame_lu2024", "per_frame"] = "per_pulse"
    """at most one count a pulse, or a frame"""
    pulses_per_depth_frame: Whole | None = Field(None, ge=1, le=2**63 - 1)
    """pulses of one depth frame, for per_pulse; if not given those of one frame of the detector, pulses_per_frame"""
    frames: Whole = Field(1000, ge=1, le=2**63 - 1)
    """detector frames of one depth frame, for per_frame"""
    exposure: float = Field(1e-5, ge=1e-15, le=1e6)
    """exposure of one detector frame [s]"""


class Output(Section):
    """Files that a run writes into its directory."""

    result: bool = True
    """everything, as HDF5"""
    exr: bool = True
    """truth and depth, as EXR"""
    png: bool = True
    """pictures for a first look"""
    pdf: bool = False
    """the same pictures as vectors, for print"""
    depth_method: Literal["peak", "centroid", "matched", "likelihood"] = "centroid"
    """how the depth frame is made"""
