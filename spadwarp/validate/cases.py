"""The cases, their runs, and how their quantities are judged together."""

from __future__ import annotations

import itertools
import math
import tempfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.limits import check_choice, check_integer
from spadwarp.mesh import load_target
from spadwarp.scene import Target
from spadwarp.scene.pose import rotation_angles
from spadwarp.units import path_from_time
from spadwarp.validate import references
from spadwarp.validate.measure import (
    PENCIL,
    Case,
    Estimate,
    Quantity,
    Run,
    ScoreMeans,
    batch_means,
    holm,
    point_source,
    quantities,
    scene,
    slab_domain,
    two_sided_p,
)
from spadwarp.viz import draw_validation

__all__ = ["CASES", "FAMILY_LEVEL", "CaseResult", "draw_results", "report", "run", "scattered_once", "vessel_reading"]
__all__ += ["white_vessel"]

CASES: dict[str, Case] = {}
"""The reference cases by name."""


def _case(name: str, summary: str) -> Callable[[Callable[[Run], list[Quantity]]], Callable[[Run], list[Quantity]]]:
    """Adds a function to `CASES`."""

    def register(measure: Callable[[Run], list[Quantity]]) -> Callable[[Run], list[Quantity]]:
        CASES[name] = Case(name, summary, measure)
        return measure

    return register


# Cases in water alone, from the records of how each photon ended

# In a half-space photons of little weight scatter for long; roulette ends them without a bias.
_ROULETTE: dict[str, Any] = {"termination": "roulette", "weight_cutoff": 0.05}
_FORWARD = {"extinction": 1.0, "albedo": 1.0, "anisotropy": 0.924}


def _leaving(records: Any, reason: str) -> NDArray[np.float64]:
    """Weight of the photons that ended for this reason, 0 for the others."""
    return records.weight * (records.reason == records.reasons.index(reason))


def _in_bins(weight: NDArray, value: NDArray, edges: tuple[float, ...]) -> list[NDArray]:
    """The weights whose value lies in [low, high) of each bin; the last bin has its upper edge as well."""
    bins = np.where(value == edges[-1], len(edges) - 2, np.digitize(value, edges) - 1)
    return [weight * (bins == i) for i in range(len(edges) - 1)]


def _bin_names(label: str, edges: tuple[float, ...]) -> list[str]:
    return [label.format(f"{low:g}–{high:g}") for low, high in itertools.pairwise(edges)]


def _both_faces(records: Any) -> list[NDArray]:
    return [_leaving(records, "exit_z_low"), _leaving(records, "exit_z_high")]


def _cosine(records: Any) -> list[NDArray]:
    return [records.direction[:, 2]]


def _medium(slab: references.Slab) -> dict[str, Any]:
    return {"extinction": 1.0, "albedo": slab.albedo, "anisotropy": slab.anisotropy}


@_case("slab", "Slabs and half-spaces, index-matched, normal incidence: adding–doubling, published rows")
def _slabs(run: Run) -> list[Quantity]:
    measured = []
    for slab in references.SLABS:
        end = _ROULETTE if slab.albedo < 1 else {}
        tables = scene(_medium(slab), PENCIL, domain=slab_domain(slab.optical_depth), **end)
        names, expected = (f"R, {slab.text}", f"T, {slab.text}"), (slab.reflected, slab.transmitted)
        both = quantities(names, run.means(tables, _both_faces), expected)
        measured += both[:1] if math.isinf(slab.optical_depth) else both
    return measured


@_case(
    "slab-derivatives",
    "Derivatives of slabs by absorption, scattering, anisotropy: adding–doubling, differentiated numerically",
)
def _slab_derivatives(run: Run) -> list[Quantity]:
    # A table of the phase function has no anisotropy.
    kinds = ("absorption", "scattering", "anisotropy")[: 2 if run.tables else 3]

    def slopes(records: Any) -> list[NDArray]:
        return [face * score for face in _both_faces(records) for score in records.log_derivatives.T.astype(np.float64)]

    measured = []
    for slab in references.SLAB_DERIVATIVES:
        medium = {"extinction": 1.0, "albedo": slab.albedo, "anisotropy": slab.anisotropy}
        tables = scene(medium, PENCIL, domain=slab_domain(slab.optical_depth), **_ROULETTE)
        names = [f"∂{face}/∂{kind}, {slab.text}" for face in "RT" for kind in kinds]
        expected = [*slab.reflected[: len(kinds)], *slab.transmitted[: len(kinds)]]
        measured += quantities(names, run.means(tables, slopes, derivatives=kinds), expected)
    return measured


@_case("layers", "Three layers of different waters, illuminated from either side: adding–doubling")
def _stacks(run: Run) -> list[Quantity]:
    measured = []
    for stack in references.STACKS:
        waters: list[dict[str, float]] = []
        depth = 0.0
        for anisotropy, albedo, extinction, thickness in stack.layers:
            waters.append({"start": depth, "extinction": extinction, "albedo": albedo, "anisotropy": anisotropy})
            depth += thickness
        first = {name: value for name, value in waters[0].items() if name != "start"}
        tables = scene({**first, "layers": waters[1:]}, PENCIL, domain=slab_domain(depth), **_ROULETTE)
        names = (f"R, layers of {stack.text}", f"T, layers of {stack.text}")
        measured += quantities(names, run.means(tables, _both_faces), (stack.reflected, stack.transmitted))
    return measured


@_case("exit-cosines", "What leaves a slab, by exit cosine: adding–doubling")
def _exit_cosines(run: Run) -> list[Quantity]:
    measured = []
    edges = references.EXIT_COSINE_EDGES
    for slab, face, fractions in references.EXIT_COSINES:
        tables = scene(_medium(slab), PENCIL, domain=slab_domain(slab.optical_depth), **_ROULETTE)

        def scores(records: Any, face: str = face) -> list[NDArray]:
            diffuse = _leaving(records, face) * (records.collisions > 0)
            return _in_bins(diffuse, np.abs(records.direction[:, 2]), edges)

        side = {"exit_z_low": "R", "exit_z_high": "T"}[face]
        names = _bin_names(f"{side}, exit cosine {{}}, {slab.text}", edges)
        measured += quantities(names, run.means(tables, scores), fractions)
    return measured


@_case("time-resolved", "Time-resolved reflectance of a half-space: doubling, inverse Laplace transform")
def _time_resolved(run: Run) -> list[Quantity]:
    pulse = references.TIME_RESOLVED
    medium = {"scattering": pulse.scattering, "absorption": pulse.absorption, "anisotropy": pulse.anisotropy}
    tables = scene(medium, PENCIL, domain=slab_domain(math.inf), max_path=pulse.edges[-1] + 1.0)
    estimates = run.means(tables, lambda r: _in_bins(_leaving(r, "exit_z_low"), r.path, pulse.edges))
    return quantities(_bin_names("R, path {} m", pulse.edges), estimates, pulse.fractions)


@_case("moments", "Infinite medium: exact moments after a fixed path and after five collisions")
def _moments(run: Run) -> list[Quantity]:
    def place(records: Any) -> list[NDArray]:
        x = records.position.astype(np.float64)
        return [x[:, 2], (x**2).sum(axis=1)]

    isotropic = scene({"extinction": 1.0, "albedo": 1.0, "anisotropy": 0.0}, PENCIL, max_path=5.0)
    collided = scene(_FORWARD, PENCIL, max_collisions=5)
    # A record keeps the direction of its last flight: the sixth has scattered five times.
    flown = scene(_FORWARD, PENCIL, max_collisions=6)
    after_path = ("⟨z⟩ [m], g 0, path 5", "⟨r²⟩ [m²], g 0, path 5")
    after_collisions = [f"{name}, g 0.924, 5 collisions" for name in ("⟨z⟩ [m]", "⟨r²⟩ [m²]", "⟨cosθ⟩")]
    return [
        *quantities(after_path, run.means(isotropic, place), references.AFTER_PATH),
        *quantities(
            after_collisions,
            [*run.means(collided, place), *run.means(flown, _cosine)],
            references.AFTER_COLLISIONS,
        ),
    ]


@_case("near-axis", "The near-axis rule's bias: density of the cosine from collision to collision")
def _near_axis(run: Run) -> list[Quantity]:
    measured = []
    for threshold, reference in references.NEAR_AXIS.items():
        tables = scene(_FORWARD, PENCIL, max_collisions=6, axis_threshold=threshold)
        rule = "rule off" if threshold == 1.0 else f"threshold {threshold:g}"
        measured += quantities([f"⟨cosθ⟩, g 0.924, 5 collisions, {rule}"], run.means(tables, _cosine), [reference])
    return measured


@_case("cutoff", "The weight cut-off's bias: orders of scattering from doubling")
def _cutoff(run: Run) -> list[Quantity]:
    water = {"extinction": 1.0, "albedo": 0.8, "anisotropy": 0.0}
    measured = []
    for cutoff, reference in references.CUTOFF.items():
        end: dict[str, Any] = {"weight_cutoff": cutoff} if cutoff else _ROULETTE
        tables = scene(water, PENCIL, domain=slab_domain(math.inf), **end)
        rule = f"cut-off {cutoff:g}" if cutoff else "no cut-off"
        reflected = run.means(tables, lambda r: [_leaving(r, "exit_z_low")])
        measured += quantities([f"R, half-space, g 0, ω 0.8, {rule}"], reflected, [reference])
    return measured


@_case("fluence", "Isotropic time-resolved fluence in an infinite medium: Fourier–Laplace solution")
def _fluence(run: Run) -> list[Quantity]:
    shells = references.FLUENCE
    medium = {"scattering": 1.0, "absorption": shells.absorption, "anisotropy": 0.0}
    tables = scene(medium, point_source(0.0, 0.0, 0.0), max_path=shells.path)

    def scores(records: Any) -> list[NDArray]:
        radius = np.linalg.norm(records.position.astype(np.float64), axis=1)
        # Unscattered light lies at the outermost edge, but for rounding.
        return _in_bins(_leaving(records, "max_path"), np.minimum(radius, 0.999 * shells.path), shells.edges)

    names = _bin_names(f"light at {{}} m after a path of {shells.path:g} m", shells.edges)
    return quantities(names, run.means(tables, scores), shells.fractions)


@_case("cube60", "Absorption in MCX's cube60 benchmark: published")
def _cube60(run: Run) -> list[Quantity]:
    medium = {"absorption": 5.0, "scattering": 1000.0, "anisotropy": 0.01, "group_index": 1.37}
    cube = {"shape": "box", "lower": [0.0] * 3, "upper": [0.06] * 3}
    sources = {
        "absorbed, pencil at (29, 29, 0) mm": {**PENCIL, "position": [0.029, 0.029, 0.0]},
        "absorbed, isotropic at (29, 29, 29) mm": point_source(0.029, 0.029, 0.029),
    }
    gate = path_from_time(5e-9, medium["group_index"])
    absorbed = []
    for source in sources.values():
        tables = scene(medium, source, domain=cube, max_path=gate)
        absorbed += run.means(tables, lambda r: [1.0 - r.weight.astype(np.float64)])
    return quantities(sources, absorbed, references.CUBE60, rounding=references.CUBE60_ROUNDING)


# Other phase functions than Henyey–Greenstein, which all other cases use


@_case("fournier-forand", "Fournier–Forand: its closed integral, exact moments, light scattered once by quadrature")
def _fournier_forand(run: Run) -> list[Quantity]:
    law = {"phase_function": "fournier_forand", "particle_index": 1.10, "junge_slope": 3.5835}
    white = {"extinction": 1.0, "albedo": 1.0, **law}

    def measured(events: int, *scores: Any) -> list[Estimate]:
        tables = scene(white, PENCIL, max_collisions=events)
        return run.means(tables, lambda records: [score(records) for score in scores])

    def cosine(records: Any) -> NDArray[np.float64]:
        return records.direction[:, 2].astype(np.float64)

    def deflected_less(records: Any) -> NDArray[np.float64]:
        u = records.direction.astype(np.float64)
        limit = np.sin(np.radians(references.FOURNIER_FORAND_ANGLE))
        return (np.hypot(u[:, 0], u[:, 1]) < limit) * (u[:, 2] > 0.0)

    # A record keeps the direction of its last flight: the second has scattered once, the sixth five times.
    once = measured(2, lambda r: cosine(r) < 0.0, deflected_less, cosine)
    five = measured(6, cosine)
    places = measured(
        5, lambda r: r.position[:, 2].astype(np.float64), lambda r: (r.position.astype(np.float64) ** 2).sum(axis=1)
    )
    names = (
        "scattered by more than 90°",
        f"scattered by less than {references.FOURNIER_FORAND_ANGLE:g}°",
        "⟨cosθ⟩, 1 collision",
        "⟨cosθ⟩, 5 collisions",
        "⟨z⟩ [m], 5 collisions",
        "⟨r²⟩ [m²], 5 collisions",
    )
    tables = scattered_once({"extinction": 0.3, "albedo": 0.8, **law})
    bins = batch_means([result.histogram.sum(axis=(0, 1)) for result in run.results(tables)])
    paths = [f"scattered once, path {k + 2}–{k + 3} m" for k in range(len(bins))]
    return [
        *quantities(names, [*once, *five, *places], references.FOURNIER_FORAND),
        *quantities(paths, bins, references.FOURNIER_FORAND_SINGLE_SCATTER),
    ]


# Cases with a camera or a mesh, from histograms and from the energy balance

_WATER = {"extinction": 0.3, "albedo": 0.8, "anisotropy": 0.924}
_CAMERA = {
    "width": 32,
    "height": 32,
    "horizontal_fov_deg": 10.0,
    "aperture_diameter": 2.0 * math.sqrt(1e-4 / math.pi),
}

# A cube of white walls around a wide lens, whose gate opens when the light has become even.
_VESSEL_SIDE, _VESSEL_GATE = 2.0, (6.0, 10.0)
_VESSEL_CAMERA = {
    "width": 2,
    "height": 2,
    "horizontal_fov_deg": 40.0,
    "aperture_diameter": 1.0,
    "focus_distance": math.inf,
}

_SIGNED = ("roulette", "importance_sampling_residual")  # entries of the energy balance whose mean is 0


def scattered_once(medium: dict[str, Any]) -> dict[str, Any]:
    """The scene of `references.SINGLE_SCATTER` in any water."""
    laser = {"position": [-0.1, 0.0, 0.0], "profile": "uniform_cone", "half_angle_deg": 2.5}
    # The quadrature images through a point; a lens would blur the beam where it crosses the view at 1 m.
    camera = {**_CAMERA, "pinhole": True}
    return scene(medium, laser, camera=camera, path_edges=(2.0, 7.0, 5), max_collisions=1, estimator="guided")


@_case("single-scatter", "Light scattered once, by path and pixel: quadrature over the same geometry")
def _single_scatter(run: Run) -> list[Quantity]:
    tables, places = scattered_once(_WATER), references.SINGLE_SCATTER
    sums = [
        [result.histogram[rows, columns].sum(axis=(0, 1)) for rows, columns, _ in places.values()]
        for result in run.results(tables)
    ]
    names = [f"path {k + 2}–{k + 3} m, {place}" for place, (_, _, bins) in places.items() for k in range(len(bins))]
    expected = [fraction for _, _, bins in places.values() for fraction in bins]
    return quantities(names, batch_means(np.reshape(sums, (len(sums), -1))), expected)


@_case("lambertian", "Light reflected once by a plane, by pixel: quadrature")
def _lambertian(run: Run) -> list[Quantity]:
    laser = {"position": [0.1, -0.05, 0.0], "profile": "uniform_cone", "half_angle_deg": 10.0}
    plane = {"builtin": "plane", "size": [20.0, 20.0], "translation": [0.0, 0.0, 5.0], "reflectance": 0.5}
    tables = scene(_WATER, laser, camera=_CAMERA, path_edges=(0.0, 12.0, 12), targets=[plane], max_collisions=1)
    places = references.LAMBERTIAN
    sums = [
        [result.component("ballistic")[rows, columns].sum() for rows, columns, _ in places.values()]
        for result in run.results(tables)
    ]
    names = [f"reflected once, {place}" for place in places]
    return quantities(names, batch_means(sums), [fraction for _, _, fraction in places.values()])


@_case("ledger", "Emitted weight is accounted for to the last unit; signed entries have mean zero")
def _ledger(run: Run) -> list[Quantity]:
    """A scene in which every way to end occurs."""
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
    # The older word for "lu2024": the text of these tables seeds the photons.
    water = {"extinction": 0.6, "albedo": "lu2024", "anisotropy": 0.924}
    measured = []
    for estimator in ("analog", "next_event", "guided"):
        for termination, cutoff in (("cutoff", 0.05), ("roulette", 0.3)):
            rules: dict[str, Any] = {"estimator": estimator, "termination": termination, "weight_cutoff": cutoff}
            missing, gains = 0, []
            for result in run.results(scene(water, laser, **common, **rules)):
                emitted = result.photons / result.energy_balance_unit
                entries = {name: value for name, value in result.energy_balance.items() if name != "emitted"}
                missing += abs(round(emitted) - sum(entries.values()))
                gains.append(
                    [entries.get(entry, 0) / emitted for entry in ("roulette", "importance_sampling_residual")]
                )
            name = f"{estimator}, {termination}"
            measured.append(Quantity(f"ledger units missing, {name}", Estimate(float(missing), 0.0), 0.0))
            roulette, residual = batch_means(gains)
            if termination == "roulette":
                measured.append(Quantity(f"mean {_SIGNED[0]} entry per photon, {name}", roulette, 0.0))
            if estimator == "guided":
                measured.append(Quantity(f"mean {_SIGNED[1]} entry per photon, {name}", residual, 0.0))
    return measured


@_case("reciprocity", "Laser and camera change places before a target in turbid water")
def _reciprocity(run: Run) -> list[Quantity]:
    """Laser and camera change places: cones of equal half-angle, a box in the beams, many scatterings."""
    half_angle, pixels = 6.0, 64
    camera = {
        "width": pixels,
        "height": pixels,
        "horizontal_fov_deg": 2 * half_angle,
        "aperture_diameter": 1e-3,
    }
    position, direction = np.array([-0.8, 0.3, -0.4]), np.array([0.22, -0.05, 1.0])
    direction /= np.linalg.norm(direction)
    centre = np.array([0.25, 0.1, 3.2])
    turn = _rotation_onto_z(direction)
    weights = _disc_weights(math.radians(half_angle), pixels)

    def measured(at: NDArray, along: NDArray, placement: NDArray, rotation: NDArray) -> list[Estimate]:
        laser = {"position": at.tolist(), "direction": along.tolist(), "half_angle_deg": half_angle}
        block = {
            "builtin": "box",
            "size": [0.7, 0.5, 0.6],
            "rotation_deg": rotation_angles(rotation),
            "translation": placement.tolist(),
        }
        tables = scene(
            {**_WATER, "extinction": 0.6},
            laser,
            camera=camera,
            path_edges=(5.0, 13.0, 4),
            targets=[block],
            max_collisions=20,
            estimator="guided",
        )
        return batch_means([np.einsum("ijt,ij->t", r.histogram, weights) for r in run.results(tables)])

    # Swapped: in the frame x' = turn·(x − position) the laser's place and axis are those of a camera.
    forward = measured(position, direction, centre, np.eye(3))
    backward = measured(turn @ -position, turn @ np.array([0.0, 0.0, 1.0]), turn @ (centre - position), turn)
    names = [f"path {k}–{k + 2} m, laser and camera swapped" for k in range(5, 13, 2)]
    return [
        Quantity(name, estimate, swapped.value, swapped.standard_error)
        for name, estimate, swapped in zip(names, forward, backward, strict=True)
    ]


@_case("mean-path", "Mean path 4V/S in a closed convex mesh, whatever the scattering (Blanco & Fournier 2003)")
def _mean_path(run: Run) -> list[Quantity]:
    """Light between white walls becomes isotropic: its mean path from wall to wall is 4V/S (Blanco & Fournier 2003)."""
    measured = []
    bodies = {
        "box 1 × 2 × 3 m": {"builtin": "box", "size": [1.0, 2.0, 3.0]},
        "sphere of 2 m": {"builtin": "sphere", "size": [2.0]},
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
        targets: list[dict[str, Any]] = [{**target, "reflectance": 1.0}]
        mesh = load_target(Target(**targets[0]))
        expected = 4.0 * abs(mesh.volume) / mesh.area
        for water, medium in waters.items():
            means = ScoreMeans()
            until = [
                scene(medium, point_source(0.1, 0.2, 0.3), targets=targets, max_path=path) for path in (early, late)
            ]
            for first, last in zip(*(run.records(tables, key=body + water) for tables in until), strict=True):
                # Events of one photon between two moments of its life: walls at the rate 1/⟨path⟩, water at the rate c.
                means.add((last.collisions - first.collisions).astype(np.float64))
            (events,) = means.estimates()
            walls = events.value - medium["extinction"] * (late - early)
            path = (late - early) / walls
            estimate = Estimate(path, path / walls * events.standard_error)
            measured.append(Quantity(f"mean path [m], {body}, {water}", estimate, expected))
    return measured


def white_vessel(estimator: str) -> dict[str, Any]:
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
        camera=_VESSEL_CAMERA,
        path_edges=(*_VESSEL_GATE, 4),
        targets=[walls],
        estimator=estimator,
    )


def vessel_reading() -> float:
    """What the camera in `white_vessel` reads: A·Δs/(4πV)·∫cosψ dΩ over its field, of even light in all directions."""
    half = math.tan(math.radians(0.5 * _VESSEL_CAMERA["horizontal_fov_deg"]))
    area = math.pi * (0.5 * _VESSEL_CAMERA["aperture_diameter"]) ** 2
    side = half / math.hypot(1.0, half)
    return area * (_VESSEL_GATE[1] - _VESSEL_GATE[0]) / _VESSEL_SIDE**3 / math.pi * side * math.atan(side)


@_case("white-vessel", "Even light in a closed vessel that loses none, into a wide lens: energy over volume")
def _white_vessel(run: Run) -> list[Quantity]:
    measured = []
    for estimator in ("analog", "next_event", "guided"):
        sums = [result.histogram.sum() for result in run.results(white_vessel(estimator))]
        measured += quantities([f"light in the lens, {estimator}"], batch_means(sums), [vessel_reading()])
    return measured


def _rotation_onto_z(direction: NDArray) -> NDArray:
    """A rotation matrix that takes a unit vector to +z."""
    right = np.cross([0.0, 1.0, 0.0], direction)
    right /= np.linalg.norm(right)
    return np.stack([right, np.cross(direction, right), direction])


def _disc_weights(half_angle: float, pixels: int, inner: int = 16) -> NDArray[np.float64]:
    """Weights with which a square camera has the field of a laser's uniform cone: 1/cosψ inside it, 0 outside;
    `[pixels, pixels]`."""
    fine = pixels * inner
    tangent = ((np.arange(fine) + 0.5) / fine * 2.0 - 1.0) * math.tan(half_angle)
    squared = tangent[:, None] ** 2 + tangent**2
    weight = np.sqrt(1.0 + squared) * (squared < math.tan(half_angle) ** 2)
    return weight.reshape(pixels, inner, pixels, inner).mean(axis=(1, 3))


# Their runs

FAMILY_LEVEL = 1e-3
"""Probability that a run of a correct simulator fails, however many quantities it has."""


@dataclass(frozen=True)
class CaseResult:
    """One measured quantity of a case.

    Attributes:
        name: Of the case.
        quantity: What was measured, with its unit.
        value: The simulator's value.
        reference: The known value.
        standard_error: Of the difference; 0 where both must be equal.
        z: The difference in standard deviations of a normal distribution.
        p: Two-sided probability of such a z, corrected for the number of quantities in the run (Holm 1979).
        passed: Whether p exceeds `FAMILY_LEVEL`.
    """

    name: str
    quantity: str
    value: float
    reference: float
    standard_error: float
    z: float
    p: float
    passed: bool


def run(
    cases: Iterable[str] | None = None,
    *,
    photons: int = 1_000_000,
    seed: int = 0,
    device: str | None = None,
    tabulated: bool = False,
    progress: Callable[[Case], None] | None = None,
) -> list[CaseResult]:
    """Runs reference cases and compares them with their references.

    Args:
        cases: Names out of `CASES`; all by default.
        photons: For each scene of a case, at least 1000. A million take a few seconds per case on a GPU; more photons
            find smaller errors.
        seed: Of the random numbers, in [0, 2^40].
        device: As for `spadwarp.simulate`.
        tabulated: Whether every Henyey–Greenstein phase function is first written to a table and read from it.
        progress: Called with each case before it is run.

    Returns:
        One result for each quantity, in the order of the cases.

    Raises:
        ArgumentError: An unknown case, or photons or seed out of range.
    """
    names = list(CASES) if cases is None else list(cases)
    for name in names:
        check_choice("cases: an item", name, [*CASES])
    photons = check_integer("photons", photons, "[1000, 1000000000000]")
    seed = check_integer("seed", seed, "[0, 1099511627776]")
    measured = []
    with tempfile.TemporaryDirectory() as folder:
        setup = Run(photons=photons, seed=seed, device=device, tables=Path(folder) if tabulated else None)
        for name in names:
            if progress is not None:
                progress(CASES[name])
            measured += [(name, quantity) for quantity in CASES[name].measure(setup)]
    return [
        CaseResult(
            name=name,
            quantity=quantity.name,
            value=quantity.estimate.value,
            reference=quantity.reference,
            standard_error=quantity.standard_error,
            z=quantity.z,
            p=p,
            passed=p > FAMILY_LEVEL,
        )
        for (name, quantity), p in zip(measured, holm(two_sided_p(quantity.z) for _, quantity in measured), strict=True)
    ]


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
    return [
        draw_validation(
            [asdict(result) for result in results if result.name == name],
            Path(folder) / f"{name}.png",
            title=f"{name}: {CASES[name].summary}",
        )
        for name in dict.fromkeys(result.name for result in results)
    ]
