"""Cases in water alone, from the records of how each photon ended."""

from __future__ import annotations

import itertools
import math
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.units import path_from_time
from spadwarp.validate import references as known
from spadwarp.validate.runs import PENCIL, Case, Run, point_source, scene, slab_domain
from spadwarp.validate.statistics import Quantity, ScoreMeans

__all__ = ["CASES"]

# Photons of little weight would wander in a half-space for long; roulette ends them without a bias.
_ROULETTE: dict[str, Any] = {"termination": "roulette", "weight_cutoff": 0.05}


def _leaving(records: Any, reason: str) -> NDArray[np.float64]:
    """Weight of the photons that ended for this reason, 0 for the others."""
    return records.weight * (records.reason == records.reasons.index(reason))


def _in_bins(weight: NDArray, value: NDArray, edges: tuple[float, ...]) -> list[NDArray]:
    """The weights whose value lies in [low, high) of each bin; the last bin has its upper edge as well."""
    bins = np.where(value == edges[-1], len(edges) - 2, np.digitize(value, edges) - 1)
    return [weight * (bins == i) for i in range(len(edges) - 1)]


def _measure(run: Run, tables: dict[str, Any], scores: Callable[[Any], list[NDArray]]) -> list:
    means = ScoreMeans()
    for records in run.records(tables):
        means.add(np.stack(scores(records), axis=1))
    return means.estimates()


def _slabs(run: Run) -> list[Quantity]:
    quantities = []
    for slab in known.SLABS:
        medium = {"extinction": 1.0, "albedo": slab.albedo, "anisotropy": slab.anisotropy}
        tables = scene(medium, PENCIL, domain=slab_domain(slab.optical_depth), **(_ROULETTE if slab.albedo < 1 else {}))
        estimates = _measure(run, tables, lambda r: [_leaving(r, "exit_z_low"), _leaving(r, "exit_z_high")])
        names = [("R", slab.reflected), ("T", slab.transmitted)]
        for (name, reference), estimate in zip(names, estimates, strict=True):
            if not math.isinf(slab.optical_depth) or name == "R":
                quantities.append(Quantity(f"{name}, {slab.text}", estimate, reference))
    return quantities


def _stacks(run: Run) -> list[Quantity]:
    quantities = []
    for stack in known.STACKS:
        waters: list[dict[str, float]] = []
        depth = 0.0
        for anisotropy, albedo, extinction, thickness in stack.layers:
            waters.append({"start": depth, "extinction": extinction, "albedo": albedo, "anisotropy": anisotropy})
            depth += thickness
        first = {name: value for name, value in waters[0].items() if name != "start"}
        tables = scene({**first, "layers": waters[1:]}, PENCIL, domain=slab_domain(depth), **_ROULETTE)
        estimates = _measure(run, tables, lambda r: [_leaving(r, "exit_z_low"), _leaving(r, "exit_z_high")])
        for name, estimate, reference in zip("RT", estimates, (stack.reflected, stack.transmitted), strict=True):
            quantities.append(Quantity(f"{name}, layers of {stack.text}", estimate, reference))
    return quantities


def _exit_cosines(run: Run) -> list[Quantity]:
    quantities = []
    edges = known.EXIT_COSINE_EDGES
    for slab, face, fractions in known.EXIT_COSINES:
        medium = {"extinction": 1.0, "albedo": slab.albedo, "anisotropy": slab.anisotropy}
        tables = scene(medium, PENCIL, domain=slab_domain(slab.optical_depth), **_ROULETTE)

        def scores(records: Any, face: str = face) -> list[NDArray]:
            diffuse = _leaving(records, face) * (records.collisions > 0)
            return _in_bins(diffuse, np.abs(records.direction[:, 2]), edges)

        side = {"exit_z_low": "R", "exit_z_high": "T"}[face]
        quantities += [
            Quantity(f"{side}, exit cosine {low:g}–{high:g}, {slab.text}", estimate, fraction)
            for (low, high), estimate, fraction in zip(
                itertools.pairwise(edges), _measure(run, tables, scores), fractions, strict=True
            )
        ]
    return quantities


def _time_resolved(run: Run) -> list[Quantity]:
    pulse = known.TIME_RESOLVED
    medium = {"scattering": pulse.scattering, "absorption": pulse.absorption, "anisotropy": pulse.anisotropy}
    tables = scene(medium, PENCIL, domain=slab_domain(math.inf), max_path=pulse.edges[-1] + 1.0)

    def scores(records: Any) -> list[NDArray]:
        return _in_bins(_leaving(records, "exit_z_low"), records.path, pulse.edges)

    return [
        Quantity(f"R, path {low:g}–{high:g} m", estimate, fraction)
        for (low, high), estimate, fraction in zip(
            itertools.pairwise(pulse.edges), _measure(run, tables, scores), pulse.fractions, strict=True
        )
    ]


def _moments(run: Run) -> list[Quantity]:
    def where(records: Any) -> list[NDArray]:
        x = records.position.astype(np.float64)
        return [x[:, 2], (x**2).sum(axis=1)]

    path, count = 5.0, 5
    isotropic = scene({"extinction": 1.0, "albedo": 1.0, "anisotropy": 0.0}, PENCIL, max_path=path)
    z, r2 = _measure(run, isotropic, where)
    quantities = [
        Quantity("⟨z⟩ [m], g 0, path 5", z, known.AFTER_PATH[0]),
        Quantity("⟨r²⟩ [m²], g 0, path 5", r2, known.AFTER_PATH[1]),
    ]
    water = {"extinction": 1.0, "albedo": 1.0, "anisotropy": 0.924}
    z, r2 = _measure(run, scene(water, PENCIL, max_collisions=count), where)
    # A record keeps the direction of its last flight: the sixth has scattered five times.
    (cosine,) = _measure(run, scene(water, PENCIL, max_collisions=count + 1), lambda r: [r.direction[:, 2]])
    return [
        *quantities,
        Quantity("⟨z⟩ [m], g 0.924, 5 collisions", z, known.AFTER_COLLISIONS[0]),
        Quantity("⟨r²⟩ [m²], g 0.924, 5 collisions", r2, known.AFTER_COLLISIONS[1]),
        Quantity("⟨cosθ⟩, g 0.924, 5 collisions", cosine, known.AFTER_COLLISIONS[2]),
    ]


def _near_axis(run: Run) -> list[Quantity]:
    water = {"extinction": 1.0, "albedo": 1.0, "anisotropy": 0.924}
    quantities = []
    for threshold, reference in known.NEAR_AXIS.items():
        tables = scene(water, PENCIL, max_collisions=6, axis_threshold=threshold)
        (cosine,) = _measure(run, tables, lambda r: [r.direction[:, 2]])
        rule = "rule off" if threshold == 1.0 else f"threshold {threshold:g}"
        quantities.append(Quantity(f"⟨cosθ⟩, g 0.924, 5 collisions, {rule}", cosine, reference))
    return quantities


def _cutoff(run: Run) -> list[Quantity]:
    water = {"extinction": 1.0, "albedo": 0.8, "anisotropy": 0.0}
    quantities = []
    for cutoff, reference in known.CUTOFF.items():
        end: dict[str, Any] = {"weight_cutoff": cutoff} if cutoff else _ROULETTE
        tables = scene(water, PENCIL, domain=slab_domain(math.inf), **end)
        (back,) = _measure(run, tables, lambda r: [_leaving(r, "exit_z_low")])
        rule = f"cut-off {cutoff:g}" if cutoff else "no cut-off"
        quantities.append(Quantity(f"R, half-space, g 0, ω 0.8, {rule}", back, reference))
    return quantities


def _fluence(run: Run) -> list[Quantity]:
    shells = known.FLUENCE
    medium = {"scattering": 1.0, "absorption": shells.absorption, "anisotropy": 0.0}
    tables = scene(medium, point_source(0.0, 0.0, 0.0), max_path=shells.path)

    def scores(records: Any) -> list[NDArray]:
        radius = np.linalg.norm(records.position.astype(np.float64), axis=1)
        # the unscattered front lies at the outermost edge but for rounding
        return _in_bins(_leaving(records, "max_path"), np.minimum(radius, 0.999 * shells.path), shells.edges)

    return [
        Quantity(f"light at {low:g}–{high:g} m after a path of {shells.path:g} m", estimate, fraction)
        for (low, high), estimate, fraction in zip(
            itertools.pairwise(shells.edges), _measure(run, tables, scores), shells.fractions, strict=True
        )
    ]


def _cube60(run: Run) -> list[Quantity]:
    medium = {"absorption": 5.0, "scattering": 1000.0, "anisotropy": 0.01, "group_index": 1.37}
    cube = {"shape": "box", "lower": [0.0] * 3, "upper": [0.06] * 3}
    sources = {
        "pencil at (29, 29, 0) mm": {**PENCIL, "position": [0.029, 0.029, 0.0]},
        "isotropic at (29, 29, 29) mm": point_source(0.029, 0.029, 0.029),
    }
    gate = path_from_time(5e-9, medium["group_index"])
    quantities = []
    for (name, source), reference in zip(sources.items(), known.CUBE60, strict=True):
        tables = scene(medium, source, domain=cube, max_path=gate)
        (absorbed,) = _measure(run, tables, lambda r: [1.0 - r.weight.astype(np.float64)])
        quantities.append(Quantity(f"absorbed, {name}", absorbed, reference, rounding=known.CUBE60_ROUNDING))
    return quantities


CASES = (
    Case("slab", "Slabs and half-spaces, index-matched, normal incidence: adding–doubling, published rows", _slabs),
    Case("layers", "Three layers of different waters, illuminated from either side: adding–doubling", _stacks),
    Case("exit-cosines", "What leaves a slab, by exit cosine: adding–doubling", _exit_cosines),
    Case(
        "time-resolved",
        "Time-resolved reflectance of a half-space: doubling, inverse Laplace transform",
        _time_resolved,
    ),
    Case("moments", "Infinite medium: exact moments after a fixed path and after five collisions", _moments),
    Case("near-axis", "The near-axis rule's bias: density of the cosine from collision to collision", _near_axis),
    Case("cutoff", "The weight cut-off's bias: orders of scattering from doubling", _cutoff),
    Case("fluence", "Isotropic time-resolved fluence in an infinite medium: Fourier–Laplace solution", _fluence),
    Case("cube60", "Absorption in MCX's cube60 benchmark: published", _cube60),
)
