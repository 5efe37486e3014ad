"""Cases with a camera or a mesh, from histograms and from the energy ledger."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.mesh import load_target
from spadwarp.scene import Target
from spadwarp.scene.pose import rotation_angles
from spadwarp.validate import references
from spadwarp.validate.case import Case, Run, point_source, scene
from spadwarp.validate.statistics import Estimate, Quantity, ScoreMeans, batch_means, quantities

__all__ = ["CASES", "scattered_once", "vessel_reading", "white_vessel"]

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

_SIGNED = ("roulette", "importance_sampling_residual")  # entries of the ledger whose mean is 0


def scattered_once(medium: dict[str, Any]) -> dict[str, Any]:
    """The scene of `references.SINGLE_SCATTER` in any water."""
    laser = {"position": [-0.1, 0.0, 0.0], "profile": "uniform_cone", "half_angle_deg": 2.5}
    # The quadrature images through a point; a lens would blur the beam where it crosses the view at 1 m.
    camera = {**_CAMERA, "pinhole": True}
    return scene(medium, laser, camera=camera, path_edges=(2.0, 7.0, 5), max_collisions=1, estimator="guided")


def _single_scatter(run: Run) -> list[Quantity]:
    tables, places = scattered_once(_WATER), references.SINGLE_SCATTER
    sums = [
        [result.histogram[rows, columns].sum(axis=(0, 1)) for rows, columns, _ in places.values()]
        for result in run.results(tables)
    ]
    names = [f"path {k + 2}–{k + 3} m, {place}" for place, (_, _, bins) in places.items() for k in range(len(bins))]
    expected = [fraction for _, _, bins in places.values() for fraction in bins]
    return quantities(names, batch_means(np.reshape(sums, (len(sums), -1))), expected)


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


CASES = (
    Case(
        "single-scatter", "Light scattered once, by path and pixel: quadrature over the same geometry", _single_scatter
    ),
    Case("lambertian", "Light reflected once by a plane, by pixel: quadrature", _lambertian),
    Case("ledger", "Emitted weight is accounted for to the last unit; signed entries have mean zero", _ledger),
    Case("reciprocity", "Laser and camera change places before a target in turbid water", _reciprocity),
    Case(
        "white-vessel",
        "Even light in a closed vessel that loses none, into a wide lens: energy over volume",
        _white_vessel,
    ),
    Case(
        "mean-path",
        "Mean path 4V/S in a closed convex mesh, whatever the scattering (Blanco & Fournier 2003)",
        _mean_path,
    ),
)
