"""The reference cases, how they are measured, and how their quantities are judged together."""

from __future__ import annotations

import hashlib
import itertools
import math
import tempfile
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.mesh import load_target
from spadwarp.scene import Scene, Target, phase_function
from spadwarp.scene.pose import rotation_angles
from spadwarp.transport import simulate, trace
from spadwarp.validate import references
from spadwarp.values import check_choice, check_integer, path_from_time, time_from_path
from spadwarp.viz import draw_validation

__all__ = ["CASES", "FAMILY_LEVEL", "Case", "CaseResult", "draw_results", "report", "run"]

BLOCK = 1 << 20  # photons whose records are held at a time
BATCHES = 32  # independent runs behind a standard error of a histogram


class Estimate(NamedTuple):
    """A measured number with its standard error, and the degrees of freedom of that error (inf: exactly known)."""

    value: float
    standard_error: float
    degrees: float = math.inf


class Quantity(NamedTuple):
    """One measured number of a case beside its reference."""

    name: str  # what was measured, with its unit
    estimate: Estimate
    reference: float
    reference_error: float = 0.0  # standard error of the reference, 0 where it is known
    rounding: float = 0.0  # half a unit of the last published digit: z counts from the edge of this interval

    @property
    def standard_error(self) -> float:
        """Of the difference between value and reference."""
        return math.hypot(self.estimate.standard_error, self.reference_error)

    @property
    def z(self) -> float:
        """Standard normal deviate of the difference; without any error 0 for equality and ±inf else.

        As likely as Student's t, by Wallace (1959): within 0.04 from seven degrees of freedom on.
        """
        distance, degrees = self.estimate.value - self.reference, self.estimate.degrees
        difference = math.copysign(max(abs(distance) - self.rounding, 0.0), distance)
        if self.standard_error == 0.0:
            return math.copysign(math.inf, difference) if difference else 0.0
        t = difference / self.standard_error
        if math.isinf(degrees):
            return t
        z = math.sqrt(degrees * math.log1p(t * t / degrees)) * (8 * degrees + 1) / (8 * degrees + 3)
        return math.copysign(z, t)


def quantities(names: Iterable[str], estimates: Iterable[Estimate], references: Iterable[float]) -> list[Quantity]:
    """One quantity for each name, estimate and reference, which are equally many."""
    return [Quantity(*row) for row in zip(names, estimates, references, strict=True)]


def block_means(blocks: Iterable[ArrayLike]) -> list[Estimate]:
    """Means over photons of scores that arrive block by block, `[N, scores]` or `[N]`."""
    count, total, square = 0, np.zeros(1), np.zeros(1)
    for block in blocks:
        scores = np.asarray(block, np.float64)
        scores = scores.reshape(len(scores), -1)
        count, total, square = count + len(scores), total + scores.sum(axis=0), square + (scores**2).sum(axis=0)
    mean = total / count
    variance = np.maximum(square / count - mean**2, 0.0) / max(count - 1, 1)
    return [Estimate(float(m), float(v)) for m, v in zip(mean, np.sqrt(variance), strict=True)]


def batch_means(batches: ArrayLike) -> list[Estimate]:
    """Estimates from independent runs of equal size: `[batches, quantities]`, at least two batches."""
    array = np.asarray(batches, np.float64)
    array = array.reshape(len(array), -1)
    error = array.std(axis=0, ddof=1) / math.sqrt(len(array))
    return [Estimate(float(m), float(e), len(array) - 1.0) for m, e in zip(array.mean(axis=0), error, strict=True)]


def two_sided_p(z: float) -> float:
    """Probability that a standard normal number is at least as far from zero."""
    return math.erfc(abs(z) / math.sqrt(2.0))


def holm(p_values: Iterable[float]) -> list[float]:
    """Holm's family-wise p-values (1979), in the order given: reject where below the level of the whole family."""
    p = np.array([*p_values])
    order = np.argsort(p, kind="stable")
    adjusted = np.empty_like(p)
    adjusted[order] = np.maximum.accumulate(np.minimum(1.0, np.arange(p.size, 0, -1) * p[order]))
    return adjusted.tolist()


@dataclass(frozen=True)
class Run:
    """How the cases are run: photons for each scene, seed, device (None: the default one).

    With a folder for `tables` every Henyey–Greenstein function is read from a file of angles and values, except those
    of layers, which cannot have a table each. Random numbers differ from scene to scene, or from `key` to `key`.
    """

    photons: int
    seed: int
    device: str | None = None
    tables: Path | None = None

    def records(self, tables: Mapping[str, Any], *, key: str = "", derivatives: Sequence[str] = ()) -> Iterator[Any]:
        """`PhotonRecords` of blocks of photons."""
        traced = self._scene(tables)
        for block, start in enumerate(range(0, self.photons, BLOCK)):
            count, seed = min(BLOCK, self.photons - start), self._seed(key or repr(tables), block)
            yield trace(traced, photons=count, seed=seed, device=self.device, derivatives=derivatives)

    def by_photon(
        self,
        tables: Mapping[str, Any],
        scores: Callable[[Any], Sequence[NDArray[Any]]],
        derivatives: Sequence[str] = (),
    ) -> list[Estimate]:
        """Means over photons of the scores `[N]` each that a function makes of `PhotonRecords`."""
        return block_means(np.stack(scores(r), axis=1) for r in self.records(tables, derivatives=derivatives))

    def results(self, tables: Mapping[str, Any]) -> Iterator[Any]:
        """`Result`s of `BATCHES` independent runs."""
        simulated, photons = self._scene(tables), max(1, self.photons // BATCHES)
        for batch in range(BATCHES):
            yield simulate(simulated, photons=photons, seed=self._seed(repr(tables), batch), device=self.device)

    def by_run(self, tables: Mapping[str, Any], numbers: Callable[[Any], Any]) -> list[Estimate]:
        """Means over the runs of the numbers that a function makes of a `Result`."""
        return batch_means([numbers(result) for result in self.results(tables)])

    def _scene(self, tables: Mapping[str, Any]) -> Scene:
        medium = tables["medium"]
        if self.tables is None or "phase_function" in medium or "layers" in medium:
            return Scene.from_dict(tables)
        path = self.tables / f"g{medium.get('anisotropy', 0.924)}.csv"
        if not path.exists():
            # Dense at both ends, wherever the peak lies; 1e-5 between the points.
            near = np.concatenate([[0.0], np.geomspace(1e-3, 90.0, 2000)])
            angles = np.concatenate([near, 180.0 - near[-2::-1]])
            law = phase_function(Scene.from_dict(tables).medium)
            np.savetxt(path, np.column_stack([angles, law.density(np.radians(angles))]), fmt="%.9g", delimiter=",")
        changed = {**medium, "phase_function": "tabulated", "phase_table": str(path)}
        return Scene.from_dict({**tables, "medium": changed})

    def _seed(self, key: str, block: int) -> int:
        digest = hashlib.blake2b(f"{self.seed} {block} {key}".encode(), digest_size=8).digest()
        return int.from_bytes(digest, "little")


# Scenes; their text seeds the photons.

PENCIL = {"profile": "collimated", "beam_radius": 0.0}
_UNUSED_CAMERA = {"width": 1, "height": 1, "horizontal_fov_deg": 1.0, "aperture_diameter": 0.01}
_EXACT = {"axis_threshold": 1.0, "weight_cutoff": 0.0, "max_collisions": 2**31 - 1}  # no approximation, no limit


def scene(
    medium: Mapping[str, Any],
    laser: Mapping[str, Any],
    *,
    camera: Mapping[str, Any] = _UNUSED_CAMERA,
    path_edges: tuple[float, float, int] = (0.0, 1e7, 1),
    targets: list[dict[str, Any]] | None = None,
    domain: Mapping[str, Any] | None = None,
    **transport: Any,
) -> dict[str, Any]:
    """Tables of a scene with index 1 and exact transport; `path_edges` is (start [m], stop [m], bins) of the gate."""
    start, stop, bins = path_edges
    medium = {"group_index": 1.0, "phase_index": 1.0, **medium}
    first, width = (time_from_path(path, medium["group_index"]) for path in (start, (stop - start) / bins))
    tables: dict[str, Any] = {
        "medium": medium,
        "laser": dict(laser),
        "camera": dict(camera),
        "gate": {"start_ns": first * 1e9, "bin_width_ps": width * 1e12, "bins": bins},
        "domain": dict(domain or {}),
        "transport": {**_EXACT, **transport},
    }
    return tables | ({"targets": targets} if targets else {})


def point_source(*position: float) -> dict[str, Any]:
    """An isotropic point source at x, y, z [m]."""
    return {"position": list(position), "profile": "uniform_cone", "half_angle_deg": 180.0}


def slab_domain(thickness: float) -> dict[str, Any]:
    """Water between z = 0 and `thickness` [m], which may be infinite."""
    return {"shape": "slab", "lower": [-math.inf, -math.inf, 0.0], "upper": [math.inf, math.inf, thickness]}


Measure = Callable[[Run], Iterator[Quantity]]


@dataclass(frozen=True)
class Case:
    """One reference case: its key, what is checked and where the reference comes from, and its run."""

    name: str
    summary: str
    measure: Measure


CASES: dict[str, Case] = {}
"""The reference cases by name."""


def _case(measure: Measure) -> Measure:
    """Adds a function to `CASES`, by its name and with its docstring."""
    name = measure.__name__.replace("_", "-")
    CASES[name] = Case(name, (measure.__doc__ or "").strip(), measure)
    return measure


# Cases in water alone, from the records of how each photon ended

# In a half-space photons of little weight scatter for long; roulette ends them without a bias.
_ROULETTE: dict[str, Any] = {"termination": "roulette", "weight_cutoff": 0.05}
_FORWARD = {"extinction": 1.0, "albedo": 1.0, "anisotropy": 0.924}


def _leaving(records: Any, reason: str) -> NDArray[np.float64]:
    """Weight of the photons that ended for this reason, 0 for the others."""
    return records.weight * records.ended(reason)


def _both_faces(records: Any) -> list[NDArray]:
    return [_leaving(records, f"exit_z_{face}") for face in ("low", "high")]


def _in_bins(weight: NDArray, value: NDArray, edges: tuple[float, ...]) -> list[NDArray]:
    """The weights whose value lies in [low, high) of each bin; the last bin has its upper edge as well."""
    bins = np.where(value == edges[-1], len(edges) - 2, np.digitize(value, edges) - 1)
    return [weight * (bins == i) for i in range(len(edges) - 1)]


def _bin_names(label: str, edges: tuple[float, ...]) -> list[str]:
    return [label.format(f"{low:g}–{high:g}") for low, high in itertools.pairwise(edges)]


def _cosine(records: Any) -> NDArray:
    return records.direction[:, 2]


def _place(records: Any) -> list[NDArray]:
    x = records.position.astype(np.float64)
    return [x[:, 2], (x**2).sum(axis=1)]


def _slab_scene(slab: references.Slab, **transport: Any) -> dict[str, Any]:
    medium = {"extinction": 1.0, "albedo": slab.albedo, "anisotropy": slab.anisotropy}
    return scene(medium, PENCIL, domain=slab_domain(slab.optical_depth), **transport)


def slab_faces(run: Run, row: references.Slab) -> list[Estimate]:
    """Fractions that a slab reflects and transmits."""
    return run.by_photon(_slab_scene(row, **(_ROULETTE if row.albedo < 1 else {})), _both_faces)


@_case
def slab(run: Run) -> Iterator[Quantity]:
    """Slabs and half-spaces, index-matched, normal incidence: adding–doubling, published rows"""
    for row in references.SLABS:
        faces = slab_faces(run, row)
        both = quantities((f"R, {row.text}", f"T, {row.text}"), faces, (row.reflected, row.transmitted))
        yield from both[:1] if math.isinf(row.optical_depth) else both


@_case
def slab_derivatives(run: Run) -> Iterator[Quantity]:
    """Derivatives of slabs by absorption, scattering, anisotropy: adding–doubling, differentiated numerically"""
    # A table of the phase function has no anisotropy.
    kinds = ("absorption", "scattering", "anisotropy")[: 2 if run.tables else 3]

    def slopes(records: Any) -> list[NDArray]:
        return [face * score for face in _both_faces(records) for score in records.log_derivatives.T.astype(np.float64)]

    for row in references.SLAB_DERIVATIVES:
        names = [f"∂{face}/∂{kind}, {row.text}" for face in "RT" for kind in kinds]
        expected = [*row.reflected[: len(kinds)], *row.transmitted[: len(kinds)]]
        yield from quantities(names, run.by_photon(_slab_scene(row, **_ROULETTE), slopes, kinds), expected)


@_case
def layers(run: Run) -> Iterator[Quantity]:
    """Three layers of different waters, illuminated from either side: adding–doubling"""
    for stack in references.STACKS:
        waters, depth = list[dict[str, float]](), 0.0
        for anisotropy, albedo, extinction, thickness in stack.layers:
            waters.append({"start": depth, "extinction": extinction, "albedo": albedo, "anisotropy": anisotropy})
            depth += thickness
        first = {name: value for name, value in waters[0].items() if name != "start"}
        tables = scene({**first, "layers": waters[1:]}, PENCIL, domain=slab_domain(depth), **_ROULETTE)
        names = (f"R, layers of {stack.text}", f"T, layers of {stack.text}")
        yield from quantities(names, run.by_photon(tables, _both_faces), (stack.reflected, stack.transmitted))


@_case
def exit_cosines(run: Run) -> Iterator[Quantity]:
    """What leaves a slab, by exit cosine: adding–doubling"""
    edges = references.EXIT_COSINE_EDGES
    for row, face, fractions in references.EXIT_COSINES:

        def scores(records: Any, face: str = face) -> list[NDArray]:
            diffuse = _leaving(records, face) * (records.collisions > 0)
            return _in_bins(diffuse, np.abs(records.direction[:, 2]), edges)

        side = {"exit_z_low": "R", "exit_z_high": "T"}[face]
        names = _bin_names(f"{side}, exit cosine {{}}, {row.text}", edges)
        yield from quantities(names, run.by_photon(_slab_scene(row, **_ROULETTE), scores), fractions)


@_case
def time_resolved(run: Run) -> Iterator[Quantity]:
    """Time-resolved reflectance of a half-space: doubling, inverse Laplace transform"""
    medium, edges = references.TIME_RESOLVED_MEDIUM, references.TIME_RESOLVED_EDGES
    tables = scene(medium, PENCIL, domain=slab_domain(math.inf), max_path=edges[-1] + 1.0)
    estimates = run.by_photon(tables, lambda r: _in_bins(_leaving(r, "exit_z_low"), r.path, edges))
    yield from quantities(_bin_names("R, path {} m", edges), estimates, references.TIME_RESOLVED)


@_case
def moments(run: Run) -> Iterator[Quantity]:
    """Infinite medium: exact moments after a fixed path and after five collisions"""
    isotropic = scene({"extinction": 1.0, "albedo": 1.0, "anisotropy": 0.0}, PENCIL, max_path=5.0)
    collided = scene(_FORWARD, PENCIL, max_collisions=5)
    # A record keeps the direction of its last flight: the sixth has scattered five times.
    flown = scene(_FORWARD, PENCIL, max_collisions=6)
    places = ("⟨z⟩ [m]", "⟨r²⟩ [m²]")
    names = [f"{name}, g 0, path 5" for name in places]
    yield from quantities(names, run.by_photon(isotropic, _place), references.AFTER_PATH)
    names = [f"{name}, g 0.924, 5 collisions" for name in (*places, "⟨cosθ⟩")]
    measured = [*run.by_photon(collided, _place), *run.by_photon(flown, lambda r: [_cosine(r)])]
    yield from quantities(names, measured, references.AFTER_COLLISIONS)


@_case
def near_axis(run: Run) -> Iterator[Quantity]:
    """The near-axis rule's bias: density of the cosine from collision to collision"""
    for threshold, reference in references.NEAR_AXIS.items():
        tables = scene(_FORWARD, PENCIL, max_collisions=6, axis_threshold=threshold)
        (mean,) = run.by_photon(tables, lambda r: [_cosine(r)])
        rule = "rule off" if threshold == 1.0 else f"threshold {threshold:g}"
        yield Quantity(f"⟨cosθ⟩, g 0.924, 5 collisions, {rule}", mean, reference)


@_case
def cutoff(run: Run) -> Iterator[Quantity]:
    """The weight cut-off's bias: orders of scattering from doubling"""
    water = {"extinction": 1.0, "albedo": 0.8, "anisotropy": 0.0}
    for cutoff, reference in references.CUTOFF.items():
        end: dict[str, Any] = {"weight_cutoff": cutoff} if cutoff else _ROULETTE
        tables = scene(water, PENCIL, domain=slab_domain(math.inf), **end)
        (reflected,) = run.by_photon(tables, lambda r: [_leaving(r, "exit_z_low")])
        rule = f"cut-off {cutoff:g}" if cutoff else "no cut-off"
        yield Quantity(f"R, half-space, g 0, ω 0.8, {rule}", reflected, reference)


@_case
def fluence(run: Run) -> Iterator[Quantity]:
    """Isotropic time-resolved fluence in an infinite medium: Fourier–Laplace solution"""
    edges, path = references.FLUENCE_EDGES, references.FLUENCE_PATH
    medium = {"scattering": 1.0, "absorption": references.FLUENCE_ABSORPTION, "anisotropy": 0.0}

    def scores(records: Any) -> list[NDArray]:
        radius = np.linalg.norm(records.position.astype(np.float64), axis=1)
        # Unscattered light lies at the outermost edge, but for rounding.
        return _in_bins(_leaving(records, "max_path"), np.minimum(radius, 0.999 * path), edges)

    shells = run.by_photon(scene(medium, point_source(0.0, 0.0, 0.0), max_path=path), scores)
    yield from quantities(_bin_names(f"light at {{}} m after a path of {path:g} m", edges), shells, references.FLUENCE)


@_case
def cube60(run: Run) -> Iterator[Quantity]:
    """Absorption in MCX's cube60 benchmark: published"""
    medium = {"absorption": 5.0, "scattering": 1000.0, "anisotropy": 0.01, "group_index": 1.37}
    cube = {"shape": "box", "lower": [0.0] * 3, "upper": [0.06] * 3}
    sources = {
        "absorbed, pencil at (29, 29, 0) mm": {**PENCIL, "position": [0.029, 0.029, 0.0]},
        "absorbed, isotropic at (29, 29, 29) mm": point_source(0.029, 0.029, 0.029),
    }
    gate = path_from_time(5e-9, medium["group_index"])
    for (name, source), reference in zip(sources.items(), references.CUBE60, strict=True):
        tables = scene(medium, source, domain=cube, max_path=gate)
        (absorbed,) = run.by_photon(tables, lambda r: [1.0 - r.weight.astype(np.float64)])
        yield Quantity(name, absorbed, reference, rounding=references.CUBE60_ROUNDING)


# Another phase function than Henyey–Greenstein, which all other cases use


@_case
def fournier_forand(run: Run) -> Iterator[Quantity]:
    """Fournier–Forand: its closed integral, exact moments, light scattered once by quadrature"""
    law = {"phase_function": "fournier_forand", "particle_index": 1.10, "junge_slope": 3.5835}
    white = {"extinction": 1.0, "albedo": 1.0, **law}
    angle = references.FOURNIER_FORAND_ANGLE

    def measured(events: int, scores: Callable[[Any], list[NDArray]]) -> list[Estimate]:
        return run.by_photon(scene(white, PENCIL, max_collisions=events), scores)

    def deflections(records: Any) -> list[NDArray]:
        u = records.direction.astype(np.float64)
        less = (np.hypot(u[:, 0], u[:, 1]) < np.sin(np.radians(angle))) * (u[:, 2] > 0.0)
        return [u[:, 2] < 0.0, less, u[:, 2]]

    # A record keeps the direction of its last flight: the second has scattered once, the sixth five times.
    estimates = [*measured(2, deflections), *measured(6, lambda r: [_cosine(r)]), *measured(5, _place)]
    names = ["scattered by more than 90°", f"scattered by less than {angle:g}°", "⟨cosθ⟩, 1 collision"]
    names += [f"{name}, 5 collisions" for name in ("⟨cosθ⟩", "⟨z⟩ [m]", "⟨r²⟩ [m²]")]
    yield from quantities(names, estimates, references.FOURNIER_FORAND)
    once = _scattered_once({"extinction": 0.3, "albedo": 0.8, **law})
    bins = run.by_run(once, lambda result: result.histogram.sum(axis=(0, 1)))
    paths = [f"scattered once, path {k + 2}–{k + 3} m" for k in range(len(bins))]
    yield from quantities(paths, bins, references.FOURNIER_FORAND_SINGLE_SCATTER)


# Cases with a camera or a mesh, from histograms and from the energy balance

_WATER = {"extinction": 0.3, "albedo": 0.8, "anisotropy": 0.924}
_CAMERA = {"width": 32, "height": 32, "horizontal_fov_deg": 10.0, "aperture_diameter": 2.0 * math.sqrt(1e-4 / math.pi)}


def _scattered_once(medium: dict[str, Any]) -> dict[str, Any]:
    """The scene of `references.SINGLE_SCATTER` in any water."""
    laser = {"position": [-0.1, 0.0, 0.0], "profile": "uniform_cone", "half_angle_deg": 2.5}
    # The quadrature images through a point; a lens would blur the beam where it crosses the view at 1 m.
    camera = {**_CAMERA, "pinhole": True}
    return scene(medium, laser, camera=camera, path_edges=(2.0, 7.0, 5), max_collisions=1, estimator="guided")


@_case
def single_scatter(run: Run) -> Iterator[Quantity]:
    """Light scattered once, by path and pixel: quadrature over the same geometry"""
    places = references.SINGLE_SCATTER
    estimates = run.by_run(
        _scattered_once(_WATER),
        lambda result: [result.histogram[rows, columns].sum(axis=(0, 1)) for rows, columns, _ in places.values()],
    )
    names = [f"path {k + 2}–{k + 3} m, {place}" for place, (_, _, bins) in places.items() for k in range(len(bins))]
    yield from quantities(names, estimates, [fraction for _, _, bins in places.values() for fraction in bins])


@_case
def lambertian(run: Run) -> Iterator[Quantity]:
    """Light reflected once by a plane, by pixel: quadrature"""
    laser = {"position": [0.1, -0.05, 0.0], "profile": "uniform_cone", "half_angle_deg": 10.0}
    plane = {"builtin": "plane", "size": [20.0, 20.0], "translation": [0.0, 0.0, 5.0], "reflectance": 0.5}
    tables = scene(_WATER, laser, camera=_CAMERA, path_edges=(0.0, 12.0, 12), targets=[plane], max_collisions=1)
    places = references.LAMBERTIAN
    estimates = run.by_run(
        tables, lambda result: [result.component("ballistic")[rows, cols].sum() for rows, cols, _ in places.values()]
    )
    names = [f"reflected once, {place}" for place in places]
    yield from quantities(names, estimates, [fraction for _, _, fraction in places.values()])


@_case
def ledger(run: Run) -> Iterator[Quantity]:
    """Emitted weight is accounted for to the last unit; signed entries have mean zero"""
    # A scene in which every way to end occurs.
    laser = {"profile": "uniform_cone", "half_angle_deg": 15.0}
    target = {"builtin": "staircase", "translation": [0.0, 0.0, 5.0], "reflectance": 0.5}
    common: dict[str, Any] = {
        "camera": _CAMERA,
        "path_edges": (0.0, 15.0, 15),
        "targets": [target],
        "domain": {"shape": "box", "lower": [-4.0, -4.0, -1.0], "upper": [4.0, 4.0, 6.0]},
        "lateral_limit": 3.5,
        "max_collisions": 20,
        "axis_threshold": 0.9998,
    }
    water = {"extinction": 0.6, "albedo": "lu2024", "anisotropy": 0.924}
    signed = ("roulette", "importance_sampling_residual")
    for estimator in ("analog", "next_event", "guided"):
        for termination, least in (("cutoff", 0.05), ("roulette", 0.3)):
            rules: dict[str, Any] = {"estimator": estimator, "termination": termination, "weight_cutoff": least}

            def entries(result: Any) -> list[float]:
                emitted = result.photons / result.energy_balance_unit
                booked = {name: value for name, value in result.energy_balance.items() if name != "emitted"}
                missing = abs(round(emitted) - sum(booked.values()))
                return [missing, *(booked.get(entry, 0) / emitted for entry in signed)]

            missing, *means = run.by_run(scene(water, laser, **common, **rules), entries)
            asked = (termination == "roulette", estimator == "guided")
            name = f"{estimator}, {termination}"
            yield Quantity(f"ledger units missing, {name}", Estimate(missing.value, 0.0), 0.0)
            for entry, mean, is_asked in zip(signed, means, asked, strict=True):
                if is_asked:
                    yield Quantity(f"mean {entry} entry per photon, {name}", mean, 0.0)


@_case
def reciprocity(run: Run) -> Iterator[Quantity]:
    """Laser and camera change places before a target in turbid water"""
    # Cones of equal half-angle, a box in the beams, many scatterings.
    half_angle, pixels = 6.0, 64
    camera = {"width": pixels, "height": pixels, "horizontal_fov_deg": 2 * half_angle, "aperture_diameter": 1e-3}
    position, direction = np.array([-0.8, 0.3, -0.4]), np.array([0.22, -0.05, 1.0])
    direction /= np.linalg.norm(direction)
    centre, ahead = np.array([0.25, 0.1, 3.2]), np.array([0.0, 0.0, 1.0])
    right = np.cross([0.0, 1.0, 0.0], direction)
    right /= np.linalg.norm(right)
    turn = np.stack([right, np.cross(direction, right), direction])  # takes the direction to +z
    weights = _disc_weights(math.radians(half_angle), pixels)

    def measured(at: NDArray, along: NDArray, placement: NDArray, rotation: NDArray) -> list[Estimate]:
        block = {"builtin": "box", "size": [0.7, 0.5, 0.6], "rotation_deg": rotation_angles(rotation)}
        block["translation"] = placement.tolist()
        tables = scene(
            {**_WATER, "extinction": 0.6},
            {"position": at.tolist(), "direction": along.tolist(), "half_angle_deg": half_angle},
            camera=camera,
            path_edges=(5.0, 13.0, 4),
            targets=[block],
            max_collisions=20,
            estimator="guided",
        )
        return run.by_run(tables, lambda result: np.einsum("ijt,ij->t", result.histogram, weights))

    # Swapped: in the frame x' = turn·(x − position) the laser's place and axis are those of a camera.
    forward = measured(position, direction, centre, np.eye(3))
    backward = measured(turn @ -position, turn @ ahead, turn @ (centre - position), turn)
    for k, (one, swapped) in enumerate(zip(forward, backward, strict=True)):
        name = f"path {2 * k + 5}–{2 * k + 7} m, laser and camera swapped"
        yield Quantity(name, one, swapped.value, swapped.standard_error)


def _disc_weights(half_angle: float, pixels: int, inner: int = 16) -> NDArray[np.float64]:
    """Weights `[pixels, pixels]` with which a square camera has the field of a laser's uniform cone: 1/cosψ in it."""
    fine = pixels * inner
    tangent = ((np.arange(fine) + 0.5) / fine * 2.0 - 1.0) * math.tan(half_angle)
    squared = tangent[:, None] ** 2 + tangent**2
    weight = np.sqrt(1.0 + squared) * (squared < math.tan(half_angle) ** 2)
    return weight.reshape(pixels, inner, pixels, inner).mean(axis=(1, 3))


@_case
def mean_path(run: Run) -> Iterator[Quantity]:
    """Mean path 4V/S in a closed convex mesh, whatever the scattering (Blanco & Fournier 2003)"""
    # Light between white walls becomes isotropic: its mean path from wall to wall is 4V/S.
    bodies: dict[str, dict[str, Any]] = {
        "box 1 × 2 × 3 m": {"builtin": "box", "size": [1.0, 2.0, 3.0], "reflectance": 1.0},
        "sphere of 2 m": {"builtin": "sphere", "size": [2.0], "reflectance": 1.0},
    }
    waters = {
        "clear": {"extinction": 1e-6, "albedo": 1.0},
        "c 1 1/m, g 0.924": {"extinction": 1.0, "albedo": 1.0, "anisotropy": 0.924},
        "c 2 1/m, g −0.5": {"extinction": 2.0, "albedo": 1.0, "anisotropy": -0.5},
    }
    # The light has to become isotropic first: with c 2 1/m and g −0.5 the slowest even mode of the box decays as
    # exp(−0.49 path), which left an error of 1.5e-4 of the mean path after 15 m.
    early, late = 30.0, 50.0
    for body, target in bodies.items():
        mesh = load_target(Target(**target))
        for water, medium in waters.items():
            source = point_source(0.1, 0.2, 0.3)
            until = [scene(medium, source, targets=[target], max_path=path) for path in (early, late)]
            # Events of one photon between two moments of its life: walls at the rate 1/⟨path⟩, water at the rate c.
            moments = zip(*(run.records(tables, key=body + water) for tables in until), strict=True)
            (events,) = block_means((last.collisions - first.collisions).astype(np.float64) for first, last in moments)
            walls = events.value - medium["extinction"] * (late - early)
            path = (late - early) / walls
            estimate = Estimate(path, path / walls * events.standard_error)
            yield Quantity(f"mean path [m], {body}, {water}", estimate, 4.0 * abs(mesh.volume) / mesh.area)


# A cube of white walls around a wide lens, whose gate opens when the light has become even.
_VESSEL_SIDE, _VESSEL_GATE = 2.0, (6.0, 10.0)
_VESSEL_LENS = {"width": 2, "height": 2, "horizontal_fov_deg": 40.0, "aperture_diameter": 1.0}
_VESSEL_LENS["focus_distance"] = math.inf


def vessel_scene(estimator: str) -> dict[str, Any]:
    """A closed vessel that loses no light, with water that scatters before and behind the lens.

    The water within 10 cm of the lens is clear: otherwise next_event would have no finite variance.
    """
    water = {"extinction": 0.6, "albedo": 1.0, "anisotropy": 0.5}
    clear = {"start": -0.1, "extinction": 1e-6, "albedo": 1.0}
    behind = {"start": 0.1, "extinction": 0.6, "albedo": 1.0}
    walls = {"builtin": "box", "size": [_VESSEL_SIDE] * 3, "reflectance": 1.0}
    return scene(
        {**water, "layers": [clear, behind]},
        point_source(0.3, -0.2, 0.4),
        camera=_VESSEL_LENS,
        path_edges=(*_VESSEL_GATE, 4),
        targets=[walls],
        estimator=estimator,
    )


def vessel_reading() -> float:
    """What the camera in `vessel_scene` reads: A·Δs/(4πV)·∫cosψ dΩ over its field, of even light in all directions."""
    half = math.tan(math.radians(0.5 * _VESSEL_LENS["horizontal_fov_deg"]))
    area = math.pi * (0.5 * _VESSEL_LENS["aperture_diameter"]) ** 2
    side = half / math.hypot(1.0, half)
    return area * (_VESSEL_GATE[1] - _VESSEL_GATE[0]) / _VESSEL_SIDE**3 / math.pi * side * math.atan(side)


@_case
def white_vessel(run: Run) -> Iterator[Quantity]:
    """Even light in a closed vessel that loses none, into a wide lens: energy over volume"""
    for estimator in ("analog", "next_event", "guided"):
        (light,) = run.by_run(vessel_scene(estimator), lambda result: result.histogram.sum())
        yield Quantity(f"light in the lens, {estimator}", light, vessel_reading())


# Their runs

FAMILY_LEVEL = 1e-3
"""Probability that a run of a correct simulator fails, however many quantities it has."""


@dataclass(frozen=True)
class CaseResult:
    """One measured quantity of a case."""

    name: str  # of the case
    quantity: str  # what was measured, with its unit
    value: float
    reference: float
    standard_error: float  # of the difference; 0 where both must be equal
    z: float  # the difference in standard deviations of a normal distribution
    p: float  # two-sided probability of such a z, corrected for the number of quantities in the run (Holm 1979)
    passed: bool  # whether p exceeds `FAMILY_LEVEL`, or that of the run

    def __str__(self) -> str:
        verdict = "ok" if self.passed else "FAILED"
        if not self.standard_error:
            return f"{self.value:g} ({verdict})"
        return f"{self.value:.5f} ± {self.standard_error:.5f}, known: {self.reference:.5f} ({verdict})"


def judged(measured: Sequence[tuple[str, Quantity]], level: float = FAMILY_LEVEL) -> list[CaseResult]:
    """Results of quantities with the names of their cases; a correct simulator fails with the probability `level`."""
    family = holm(two_sided_p(one.z) for _, one in measured)
    return [
        CaseResult(name, one.name, one.estimate.value, one.reference, one.standard_error, one.z, p, p > level)
        for (name, one), p in zip(measured, family, strict=True)
    ]


def run(
    cases: Iterable[str] | None = None,
    *,
    photons: int = 1_000_000,
    seed: int = 0,
    device: str | None = None,
    tabulated: bool = False,
    progress: Callable[[Case], None] | None = None,
) -> list[CaseResult]:
    """Runs reference cases and compares them with their references: a result for each quantity.

    Args:
        cases: Names out of `CASES`; all by default.
        photons: For each scene of a case, at least 1000. A million take a few seconds per case on a GPU; more photons
            find smaller errors.
        seed: Of the random numbers, in [0, 2^40].
        device: As for `spadwarp.simulate`.
        tabulated: Whether every Henyey–Greenstein phase function is first written to a table and read from it.
        progress: Called with each case before it is run.

    Raises `ArgumentError`: an unknown case, or photons or seed out of range.
    """
    names = list(CASES) if cases is None else list(cases)
    for name in names:
        check_choice("cases: an item", name, [*CASES])
    photons = check_integer("photons", photons, "[1000, 1000000000000]")
    seed = check_integer("seed", seed, "[0, 1099511627776]")
    measured: list[tuple[str, Quantity]] = []
    with tempfile.TemporaryDirectory() as folder:
        setup = Run(photons=photons, seed=seed, device=device, tables=Path(folder) if tabulated else None)
        for name in names:
            if progress is not None:
                progress(CASES[name])
            measured += [(name, quantity) for quantity in CASES[name].measure(setup)]
    return judged(measured)


def report(results: Sequence[CaseResult], *, photons: int, seed: int) -> dict[str, Any]:
    """The results with their cases' summaries as plain values; `spadwarp.io.write_json` writes them."""
    return {
        "photons": photons,
        "seed": str(seed),
        "family_level": FAMILY_LEVEL,
        "passed": all(result.passed for result in results),
        "cases": {result.name: CASES[result.name].summary for result in results},
        "results": [asdict(result) for result in results],
    }


def draw_results(results: Sequence[CaseResult], folder: str | Path) -> list[Path]:
    """One PNG for each case: values over references with their errors, and the z of each quantity; returns the paths.

    Raises `FileError`.
    """
    drawn = []
    for name in dict.fromkeys(result.name for result in results):
        rows, title = [asdict(result) for result in results if result.name == name], f"{name}: {CASES[name].summary}"
        drawn.append(draw_validation(rows, Path(folder) / f"{name}.png", title=title))
    return drawn
