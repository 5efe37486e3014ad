"""Cases in water alone, from the records of how each photon ended."""

from __future__ import annotations

import itertools
import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.units import path_from_time
from spadwarp.validate import references
from spadwarp.validate.case import PENCIL, Case, Run, point_source, scene, slab_domain
from spadwarp.validate.statistics import Quantity, quantities

__all__ = ["CASES"]

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


def _slabs(run: Run) -> list[Quantity]:
    measured = []
    for slab in references.SLABS:
        end = _ROULETTE if slab.albedo < 1 else {}
        tables = scene(_medium(slab), PENCIL, domain=slab_domain(slab.optical_depth), **end)
        names, expected = (f"R, {slab.text}", f"T, {slab.text}"), (slab.reflected, slab.transmitted)
        both = quantities(names, run.means(tables, _both_faces), expected)
        measured += both[:1] if math.isinf(slab.optical_depth) else both
    return measured


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


def _time_resolved(run: Run) -> list[Quantity]:
    pulse = references.TIME_RESOLVED
    medium = {"scattering": pulse.scattering, "absorption": pulse.absorption, "anisotropy": pulse.anisotropy}
    tables = scene(medium, PENCIL, domain=slab_domain(math.inf), max_path=pulse.edges[-1] + 1.0)
    estimates = run.means(tables, lambda r: _in_bins(_leaving(r, "exit_z_low"), r.path, pulse.edges))
    return quantities(_bin_names("R, path {} m", pulse.edges), estimates, pulse.fractions)


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


def _near_axis(run: Run) -> list[Quantity]:
    measured = []
    for threshold, reference in references.NEAR_AXIS.items():
        tables = scene(_FORWARD, PENCIL, max_collisions=6, axis_threshold=threshold)
        rule = "rule off" if threshold == 1.0 else f"threshold {threshold:g}"
        measured += quantities([f"⟨cosθ⟩, g 0.924, 5 collisions, {rule}"], run.means(tables, _cosine), [reference])
    return measured


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


CASES = (
    Case("slab", "Slabs and half-spaces, index-matched, normal incidence: adding–doubling, published rows", _slabs),
    Case(
        "slab-derivatives",
        "Derivatives of slabs by absorption, scattering and anisotropy: adding–doubling, differentiated numerically",
        _slab_derivatives,
    ),
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
