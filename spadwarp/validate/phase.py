"""Cases of other phase functions than Henyey–Greenstein, which all other cases use."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.validate import references
from spadwarp.validate.camera import scattered_once
from spadwarp.validate.case import PENCIL, Case, Run, scene
from spadwarp.validate.statistics import Estimate, Quantity, batch_means, quantities

__all__ = ["CASES"]


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


CASES = (
    Case(
        "fournier-forand",
        "Fournier–Forand: its closed integral, exact moments, light scattered once by quadrature",
        _fournier_forand,
    ),
)
