"""Sections of a scene that stand alone: what is around camera and laser, the detector, settings of a run, and the light
inside the water: where it is tallied, and sun and sky as its source."""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import Annotated, ClassVar, Literal, NamedTuple

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from spadwarp.io.hdf5 import Coordinate
from spadwarp.scene.pose import sideways, unit_vector
from spadwarp.scene.sections import Corner, CsvFile, Direction, FilePath, Scale, Section, Size, Vector, Whole, field
from spadwarp.values import SEED, bounds
from spadwarp.water.daylight import refracted_cosine
from spadwarp.water.seawater import RANGES

__all__ = ["Analytic", "Daylight", "Detector", "Domain", "Flux", "Gate", "Output", "Scan", "Sun", "Target", "Transport"]


class Target(Section):
    """One mesh: sized and scaled, then rotated, then moved."""

    displaces: ClassVar = {"builtin": ("mesh",), "mesh": ("builtin", "size")}
    builtin: str | None = Field(None, min_length=1)
    """a built-in mesh, such as "staircase"; see `spadwarp list targets`"""
    mesh: Annotated[str | None, FilePath()] = field(None, "path of a mesh file, relative to the scene file")
    size: Size | None = field(None, "extent of plane, box, sphere; one number, two for x and y, or three [m]")
    subdivisions: Whole = field(0, "times that every face is split into four", "[0, 12]")
    scale: Scale = field((1.0, 1.0, 1.0), "factor, one or three; mesh units to metres")
    rotation_deg: Vector = field((0.0, 0.0, 0.0), "rotations about the target's own x, the new y, the new z [°]")
    translation: Vector = field((0.0, 0.0, 0.0), "shift in the world [m], the camera's frame if it has no pose")
    reflectance: Annotated[float, Field(ge=0, le=1)] | Literal["from_file"] = 0.5
    """Lambertian reflectance of both sides; "from_file": colours and textures of the mesh file"""
    reflectance_scale: float = field(1.0, 'factor on a reflectance that is "from_file", the file\'s', "[1e-9, 1e9]")
    colour_encoding: Literal["srgb", "linear"] = "srgb"
    """how the file's colours and images stand for reflectance; "linear" is proportional"""
    specular: float = field(0.0, "reflectance of the facets of a rough specular lobe; 0 is none", "[0, 1]")
    roughness: float = field(0.2, "width of that lobe: GGX parameter α", "[0.01, 1]")
    specular_index: float = field(1.5, "phase index of its facets; for polarised light alone", "[1, 10]")

    def _problems(self) -> Iterator[str]:
        if (self.builtin is None) == (self.mesh is None):
            yield "needs either builtin or mesh"
        if not all(self.scale):
            yield self._that("scale", "holds a zero")
        if self.size is not None and self.builtin is None:
            yield self._that("size", "goes with builtin only; a mesh file takes scale")
        if self.reflectance == "from_file":
            if self.mesh is None:
                yield self._that("reflectance", "goes with mesh only; a builtin takes a number")
        elif self.reflectance + self.specular > 1:
            yield (
                f"specular = {self.specular:g} and reflectance = {self.reflectance:g} reflect more than arrives:"
                " their sum is outside [0, 1]"
            )
        yield from self._only_with("reflectance = 'from_file'", self.reflectance == "from_file", "reflectance_scale")


Index = Annotated[float, Field(ge=1, le=1e9)]


class OutsideIndex(Section):
    """Faces of the domain that reflect as the boundary of two media: walls of a tank, the surface seen from below.

    A face that has no index lets all light out.
    """

    x_low: Index | None = field(None, "phase index behind the face at the lower bound in x")
    x_high: Index | None = field(None, "the same at the upper bound in x")
    y_low: Index | None = field(None, "the same at the lower bound in y")
    y_high: Index | None = field(None, "the same at the upper bound in y")
    z_low: Index | None = field(None, "the same at the lower bound in z")
    z_high: Index | None = field(None, "the same at the upper bound in z")


class Domain(Section):
    """Where the water is, in the world; camera and laser must be inside. A photon that comes to a face leaves, and is
    gone, unless the face has an `outside_index`: there it is reflected, by Fresnel's formulas for unpolarised light."""

    shape: Literal["unbounded", "slab", "box"] = field("unbounded", "slab: bounded in z; box: in x, y and z")
    lower: Corner = field((-math.inf,) * 3, "lower corner [m]; one number for all three; a slab uses z")
    upper: Corner = field((math.inf,) * 3, "upper corner [m]; one number for all three; a slab uses z")
    outside_index: OutsideIndex | None = None
    """phase index behind the faces that reflect, such as `{y_low = 1.0}`: 1 is air, a very large number a mirror"""
    max_reflections: Whole = Field(2, ge=0, le=8)
    """longest chain of reflections on the way from a scattering to the lens; light by longer ones is left out"""

    def _problems(self) -> Iterator[str]:
        for axis, low, high in zip("xyz", *self.bounds, strict=True):
            if not low < high:
                yield f"lower = {low} is outside (-inf, {high}) m, {high} being upper in {axis}"
        for name in self.reflecting:
            bound = self.bounds[name.endswith("high")]["xyz".index(name[0])]
            if math.isinf(bound):
                yield (
                    f"outside_index.{name}: the domain has no such face with shape = {self.shape!r}; a slab has z_low "
                    "and z_high, a box all six, each where lower or upper is finite"
                )

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

    sun_elevation_deg: float = field(..., "height of the sun above the horizon [°]", RANGES["sun_elevation_deg"])
    depth: float = field(..., "of the lens below the surface [m]", "[0, 10000]")
    sun_azimuth_deg: float = Field(90.0, ge=-360, le=360)
    """horizontal angle from the world's z axis, or without one from its x axis, to below the sun, towards +x [°]"""
    up: Direction = field((0.0, -1.0, 0.0), "direction of the surface in the world; any length but 0")
    aerosol_optical_depth: float = Field(0.084, **bounds(RANGES["aerosol_optical_depth"]))
    """vertical optical depth of the aerosol at 500 nm: 0.05 very clear air, 0.3 haze"""
    cloud_factor: float = field(1.0, "irradiance over that of a clear sky", "[0, 2]")

    @property
    def down(self) -> NDArray[np.float64]:
        """Unit vector away from the surface, in the world."""
        return -np.asarray(unit_vector(self.up))

    def sun_direction(self, index: float) -> NDArray[np.float64]:
        """Unit vector in which the sun's light goes in water of a refractive index, in the world."""
        cosine = refracted_cosine(self.sun_elevation_deg, index)
        return cosine * self.down - math.sqrt(1.0 - cosine**2) * sideways(self.down, self.sun_azimuth_deg)


class Detector(Section):
    """The SPAD array and its timing electronics."""

    section: ClassVar[str] = "detector"
    displaces: ClassVar = {
        "filter_fwhm_nm": ("filter_table",),
        "filter_table": ("filter_centre_nm", "filter_fwhm_nm", "filter_peak"),
    }
    preset: str | None = field(None, "a named detector, see `spadwarp list presets detector`")
    pdp: float = field(0.247, "photon detection probability of the active area", "[0, 1]")
    fill_factor: float = field(0.2, "active part of a pixel's area, microlenses included", "(0, 1]")
    jitter_fwhm_ps: float = field(200.0, "timing jitter, full width at half maximum [ps]", "[0, 1e12]")
    irf: Annotated[str, FilePath(".csv", ("gaussian", "exponentially_modified_gaussian"))] = "gaussian"
    """instrument response: "gaussian", "exponentially_modified_gaussian", or the path of a .csv file"""
    irf_tail_ps: float = field(100.0, "time constant of the exponential tail [ps]", "[1e-12, 1e12]")
    dark_count_rate: float = field(100.0, "median dark counts per second and pixel [1/s]", "[0, 1e15]")
    dark_count_spread: float = field(0.0, "relative (log-normal) spread of the dark count rate over pixels", "[0, 10]")
    hot_pixel_fraction: float = field(0.0, "part of the pixels that are hot", "[0, 1]")
    hot_pixel_rate: float = field(1e4, "dark count rate of a hot pixel [1/s]", "[0, 1e15]")
    ambient_rate: float = field(0.0, "detected background counts per second and pixel [1/s]", "[0, 1e15]")
    filter_centre_nm: float | None = Field(None, ge=1e-9, le=1e6)
    """wavelength of largest transmission of the filter before the detector [nm]; default: the laser's"""
    filter_fwhm_nm: float | None = Field(None, ge=1e-6, le=1e6)
    """full width at half maximum of its Gaussian transmission [nm]; without it there is no filter"""
    filter_peak: float = field(1.0, "its largest transmission", "(0, 1]")
    filter_table: CsvFile = field(None, "a measured filter in place of these: .csv of wavelength [nm] and transmission")
    mode: Literal["first_photon", "free_running"] = field("first_photon", "one count a pulse, or as many as come")
    dead_time_ns: float = field(0.0, "dead time after a count, free-running [ns]", "[0, 1e12]")
    afterpulsing_probability: float = field(0.0, "probability that a count causes another", "[0, 1)")
    afterpulsing_time_constant_ns: float = field(50.0, "decay time of afterpulsing [ns]", "[1e-12, 1e12]")
    crosstalk_probability: float = field(0.0, "probability that a count fires a neighbour", "[0, 1)")
    wrap: bool = field(True, "time of flight modulo the pulse period (range aliasing), as a detector sees it")
    pulses_per_frame: Whole = field(20_000, "laser pulses in one frame of counts", "[1, 9223372036854775807]")
    max_count: Whole = field(0, "largest count a histogram bin holds; 0 is unlimited", "[0, 2147483647]")
    min_significance: float = field(4.0, "of pixels with a depth, −log10 of false alarms a pixel; 0: all", "[0, 1000]")

    def _problems(self) -> Iterator[str]:
        for name in ("filter_centre_nm", "filter_fwhm_nm", "filter_peak"):
            if getattr(self, name) == Detector.model_fields[name].default:
                continue
            if self.filter_table is not None:
                yield self._that(name, "cannot be combined with filter_table")
            if self.filter_fwhm_nm is None:
                yield self._that(name, "needs filter_fwhm_nm")

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
    preset: str | None = field(None, "named electronics, see `spadwarp list presets gate`")
    start_ns: float = field(0.0, "begin of the first bin [ns]", "[0, 1e12]")
    bin_width_ps: float = field(..., "width of a bin [ps]", "[1e-12, 1e15]")
    bins: Whole = field(..., "number of bins", "[1, 1000000]")

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
    """How the beam moves over the scene: over the pixels of a camera that stands still, or with laser and camera.

    Laser and camera move from shot to shot by `trajectory`: the image has a row of pixels for each line, turn or, of a
    push-broom array, shot, and `camera.horizontal_fov_deg` is what one shot sees. The platform flies along a straight
    line or as a file says; the pattern deflects beam and line of sight together from the camera's axis.
    """

    mode: Literal["none", "confocal", "trajectory"] = "none"
    """confocal: the beam visits the pixels, each sees its own light; trajectory: laser and camera move"""
    distance: float = field(math.inf, "confocal: where beam and sight cross [m]; inf is parallel", "[1e-6, inf]")
    pattern: Literal["fixed", "raster", "conical", "elliptic", "rosette", "push_broom"] = "raster"
    """trajectory: none; lines along x; a cone, a turn a row; an ellipse; two prisms that turn; a row of pixels"""
    half_angle_deg: float = field(15.0, "trajectory: half the angle that the pattern spans along x [°]", "(0, 80]")
    half_angle_y_deg: float = field(10.0, "elliptic: the same along y [°]", "(0, 80]")
    rosette_ratio: float = field(2.6, "rosette: speed of the second prism over that of the first", "[0.01, 1000]")
    velocity: Vector = (0.0, 0.0, 0.0)
    """trajectory: of the platform in the world [m/s]; it starts at the camera's pose and keeps its attitude"""
    path: CsvFile = None
    """trajectory: .csv of time and pose, as `load_trajectory` reads it, in place of velocity: the first shot is at its
    first time, and the camera's own pose is an origin near it"""

    def _problems(self) -> Iterator[str]:
        of_trajectory = "pattern", "half_angle_deg", "half_angle_y_deg", "rosette_ratio", "velocity", "path"
        yield from self._only_with("mode = 'trajectory'", self.mode == "trajectory", *of_trajectory)


class Transport(Section):
    """How photons are traced."""

    photons: Annotated[Whole, Field(ge=1, le=10**12)] | Literal["auto"] = "auto"
    """photons to emit; "auto": until the noise of the simulation is small beside that of a frame's photons, or its time
    is over"""
    seed: Whole = field(0, "key of the random numbers; one seed gives the same bits", SEED)
    estimator: Literal["analog", "next_event", "guided", "none"] = "guided"
    """what scores: the photon itself, every event, or guided flights; none: the camera sees nothing, for flux alone"""
    points_per_flight: Annotated[Whole, Field(ge=1, le=3)] | Literal["auto"] = "auto"
    """points at which `guided` scores a flight: more leave less noise and take longer; "auto": 2, where it can be"""
    termination: Literal["cutoff", "roulette"] = field("cutoff", "drop light photons (biased), or Russian roulette")
    weight_cutoff: float = field(2e-4, "analog weight below which a photon ends; 0 is never", "[0, 1)")
    max_collisions: Whole = field(64, "events of one photon, surfaces included; the last counts", "[1, 2147483647]")
    max_path: float | None = field(None, "longest geometric path [m]; the gate's end if not given", "(0, 1e12]")
    lateral_limit: float = field(math.inf, "photons end where |x| or |y| of the camera frame is this [m]", "(0, inf]")
    axis_threshold: float = field(0.9998, "|u_z| from which the near-axis rule acts; 1 turns it off (exact)", "(0, 1]")


IRRADIANCES = ("downward", "upward", "scalar_downward", "scalar_upward")
_Edge = Annotated[int, Field(ge=1, le=1024)]
_Position = Annotated[float, Field(ge=-1e9, le=1e9)]


class FluxArray(NamedTuple):
    """An array of a section's tally."""

    entries: slice  # those of its section in the whole tally, the rows one after another
    columns: slice  # its part of each row
    dimensions: dict[str, Coordinate]
    unit: str
    meaning: str
    value: NDArray[np.float64]  # of a tally unit over the photons; of a shape that broadcasts

    @property
    def shape(self) -> tuple[int, ...]:
        return tuple(len(coordinate[0]) for coordinate in self.dimensions.values())


class Flux(Section):
    """Where the light in the water is tallied: a box of voxels and gates of time (fluence), or planes (irradiance,
    radiance). Several in one run; in the world's frame."""

    name: str = Field(pattern=r"^[A-Za-z][A-Za-z0-9_]*$", max_length=64)
    """name in the result, of letters, digits and _"""
    voxels: tuple[_Edge, _Edge, _Edge] | None = None
    """number of voxels of a box along x, y and z; along an edge without bounds 1"""
    lower: Corner = field((-math.inf,) * 3, "lower corner of the box [m]; one number for all three")
    upper: Corner = field((math.inf,) * 3, "upper corner of the box [m]; one number for all three")
    gates: Whole = field(1, "number of gates of time; more than one need gate_width_ps", "[1, 4096]")
    gate_start_ns: float = field(0.0, "begin of the first gate [ns]", "[0, 1e12]")
    gate_width_ps: float | None = field(None, "width of a gate [ps]; not given: all times", "[1e-3, 1e15]")
    estimator: Literal["track", "collision"] = "track"
    """by the way of each photon through the voxels (less noise a photon), or by its collisions (less noise a second on
    a GPU where a voxel is .1 free paths wide or more)"""
    positions: tuple[_Position, ...] | None = Field(None, min_length=1, max_length=65536)
    """of planes along `axis` [m], rising"""
    axis: Direction = field((0.0, 0.0, 1.0), "normal of the planes, downwards; any length but 0")
    radius: float = field(math.inf, "of the part of each plane that is tallied [m]; inf: all of it", "(0, inf]")
    centre: Vector = field((0.0, 0.0, 0.0), "a point of the line through the centres of these discs [m]")
    polar_bins: Whole = field(0, "bins of radiance in the angle between ray and axis, 0 to 180°; 0: none", "[0, 1024]")
    azimuth_bins: Whole = field(1, "bins of radiance in the azimuth, 0 to 360°", "[1, 1024]")

    def _problems(self) -> Iterator[str]:
        if (self.voxels is None) == (self.positions is None):
            yield "needs either voxels or positions"
        for k, (low, high, count) in enumerate(zip(self.lower, self.upper, self.voxels or (), strict=False)):
            if not low < high:
                yield f"lower = {low} is outside (-inf, {high}) m, {high} being upper in {'xyz'[k]}"
            if count > 1 and math.isinf(high - low):
                yield f"voxels[{k}] = {count} needs lower and upper in {'xyz'[k]}"
        if self.gates > 1 and self.gate_width_ps is None:
            yield self._that("gates", "needs gate_width_ps")
        if any(a >= b for a, b in zip(self.positions or (), (self.positions or ())[1:], strict=False)):
            yield "positions do not rise"
        of_voxels = "lower", "upper", "gates", "gate_start_ns", "gate_width_ps", "estimator"
        yield from self._only_with("voxels", self.voxels is not None, *of_voxels)
        of_planes = "axis", "radius", "centre", "polar_bins", "azimuth_bins"
        yield from self._only_with("positions", self.positions is not None, *of_planes)

    @property
    def kind(self) -> str:
        """What the kernels call it."""
        return "planes" if self.voxels is None else self.estimator

    @property
    def size(self) -> int:
        """Entries of the tally."""
        if self.voxels is not None:
            return math.prod(self.voxels) * self.gates
        return len(self.positions or ()) * (len(IRRADIANCES) + self.polar_bins * self.azimuth_bins)

    @property
    def edges(self) -> tuple[float, ...]:
        """Of a voxel along x, y and z [m]; infinite without bounds."""
        return tuple((b - a) / n for a, b, n in zip(self.lower, self.upper, self.voxels or (), strict=False))

    @property
    def normal(self) -> NDArray[np.float64]:
        """Unit vector of the axis."""
        return np.asarray(unit_vector(self.axis))

    def scale(self, absorption: float) -> float:
        """Tally units per metre of weight times length, or per weight that crosses a plane: a power of two with which
        2^40 photons keep voxels below 2^62 that hold 4 times the longest way across one, or without bounds the mean
        way to absorption. Fewer in large volumes, whose low 16 bits a GPU keeps apart."""
        if self.voxels is None:
            return 2.0**20
        longest = 4.0 * math.hypot(*self.edges)
        longest = min(longest, 4.0 / absorption if absorption > 0.0 else longest)
        return 2.0 ** math.floor((22.0 if self.size < 1 << 22 else 14.0) - math.log2(min(longest, 1e6)))

    def arrays(self, absorption: float, first: int = 0) -> dict[str, FluxArray]:
        """Those of its part of the tally, which begins at an entry, by name; `absorption`: the least [1/m]."""
        unit, entries = 1.0 / self.scale(absorption), slice(first, first + self.size)
        if self.voxels is not None:
            width = self.gate_width_ps
            gates = 0.0 if width is None else self.gate_start_ns * 1e-9 + width * 1e-12 * (np.arange(self.gates) + 0.5)
            meaning = "time of flight, middle of a gate"
            dimensions: dict[str, Coordinate] = {"gate": (np.atleast_1d(gates), "s", meaning)}
            for axis, low, edge, count in zip("xyz", self.lower, self.edges, self.voxels, strict=True):
                centres = low + edge * (np.arange(count) + 0.5) if math.isfinite(edge) else np.zeros(1)
                dimensions[axis] = (centres, "m", f"middle of a voxel in {axis}; 0 without bounds")
            volume = math.prod(edge for edge in self.edges if math.isfinite(edge))
            text = "fluence per emitted photon, times tally units; along edges without bounds its integral"
            value = np.array(unit / volume)
            return {"fluence": FluxArray(entries, slice(None), dimensions, "1/m^2", text, value)}
        area = math.pi * self.radius**2 if math.isfinite(self.radius) else 1.0
        area_unit = "1" if math.isinf(self.radius) else "1/m^2"
        rows: dict[str, Coordinate] = {"position": (np.array(self.positions), "m", "of a plane along its axis")}
        text = "irradiance per emitted photon, of planes without bounds what crosses them"
        kinds: Coordinate = (list(IRRADIANCES), "1", "along the axis or against it; of a plane or scalar")
        columns = slice(len(IRRADIANCES))
        found = FluxArray(entries, columns, {**rows, "kind": kinds}, area_unit, text, np.array(unit / area))
        if not self.polar_bins:
            return {"irradiance": found}
        polar = np.linspace(0.0, np.pi, self.polar_bins + 1)
        azimuth = np.linspace(0.0, 2 * np.pi, self.azimuth_bins + 1)
        bins: dict[str, Coordinate] = {
            "polar": (0.5 * (polar[1:] + polar[:-1]), "rad", "angle between ray and axis, middle of a bin"),
            "azimuth": (0.5 * (azimuth[1:] + azimuth[:-1]), "rad", "about the axis, middle of a bin"),
        }
        solid = -np.diff(np.cos(polar))[:, None] * np.diff(azimuth)
        columns, text, value = slice(len(IRRADIANCES), None), "radiance per emitted photon", unit / area / solid
        radiance = FluxArray(entries, columns, rows | bins, f"{area_unit}/sr", text, value)
        return {"irradiance": found, "radiance": radiance}


class Sun(Section):
    """Sun and sky in place of the laser, through the `[surface]` of the sea, calm or rough. All light is emitted above
    one point, or one period of the waves; as the water is the same along the surface, what crosses a plane anywhere
    stands for what crosses a unit of its area."""

    zenith_deg: float = field(..., "angle of the sun from the vertical, in the air [°]", "[0, 90)")
    azimuth_deg: float = field(0.0, "of the sun's light about the vertical, as that of radiance [°]", "[-360, 360]")
    sky: float = field(0.0, "part of the irradiance on the surface that comes from a sky of even radiance", "[0, 1]")
    irradiance: float = field(1.0, "on the surface, in the air [W/m²]", "(0, 1e6]")

    def direction(self, down: NDArray[np.float64]) -> NDArray[np.float64]:
        """Unit vector in which the sun's light goes in the air, in the frame of `down`, a unit vector."""
        zenith = math.radians(self.zenith_deg)
        return math.cos(zenith) * down + math.sin(zenith) * sideways(down, self.azimuth_deg)


class Analytic(Section):
    """Settings of the analytic simulator; transport does not read them."""

    form: Literal["radiometric", "lu2024"] = field("radiometric", "constants of the lidar equation, or eq 7 as printed")
    backscatter: Literal["constant", "single_scatter", "monte_carlo"] = field("single_scatter", "its time course")
    backscatter_rate: float = field(0.0, "constant backscatter, detections per second in the gate [1/s]", "[0, 1e15]")
    backscatter_fraction: float | None = field(None, "of pixels that report it (BS); default: by the rates", "[0, 1]")
    count_law: Literal["per_pulse", "per_frame_lu2024", "per_frame"] = field("per_pulse", "one at most: pulse or frame")
    pulses_per_depth_frame: Whole | None = Field(None, ge=1, le=2**63 - 1)
    """pulses of one depth frame, for per_pulse; if not given those of one frame of the detector, pulses_per_frame"""
    frames: Whole = field(1000, "detector frames of one depth frame, for per_frame", "[1, 9223372036854775807]")
    exposure: float = field(1e-5, "exposure of one detector frame [s]", "[1e-15, 1e6]")


class Output(Section):
    """Files that a run writes into its directory."""

    result: bool = field(True, "everything, as HDF5")
    exr: bool = field(True, "truth and depth, as EXR")
    png: bool = field(True, "pictures for a first look")
    pdf: bool = field(False, "the same pictures as vectors, for print")
    depth_method: Literal["peak", "centroid", "matched", "likelihood"] = field("centroid", "how depth is found")
