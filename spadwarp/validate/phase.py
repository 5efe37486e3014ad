"""Cases of other phase functions than Henyey–Greenstein, whose own numbers are in every other case."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.validate import references as known
from spadwarp.validate.camera import scattered_once
from spadwarp.validate.runs import PENCIL, Case, Run, scene
from spadwarp.validate.statistics import Quantity, ScoreMeans, batch_means

__all__ = ["CASES"]


def _fournier_forand(run: Run) -> list[Quantity]:
    law = {"phase_function": "fournier_forand", "particle_index": 1.10, "junge_slope": 3.5835}
    white = {"extinction": 1.0, "albedo": 1.0, **law}

    def measured(events: int, *scores: Any) -> list:
        means = ScoreMeans()
        for records in run.records(scene(white, PENCIL, max_collisions=events)):
            means.add(np.stack([score(records) for score in scores], axis=1))
        return means.estimates()

    def cosine(records: Any) -> NDArray[np.float64]:
        return records.direction[:, 2].astype(np.float64)

    def turned_less(records: Any) -> NDArray[np.float64]:
        u = records.direction.astype(np.float64)
        return (np.hypot(u[:, 0], u[:, 1]) < np.sin(np.radians(known.FOURNIER_FORAND_ANGLE))) * (u[:, 2] > 0.0)

    # A record keeps the direction of its last flight: the second has scattered once, the sixth five times.
    once = measured(2, lambda r: cosine(r) < 0.0, turned_less, cosine)
    (five,) = measured(6, cosine)
    places = measured(
        5, lambda r: r.position[:, 2].astype(np.float64), lambda r: (r.position.astype(np.float64) ** 2).sum(axis=1)
    )
    names = (
        "scattered by more than 90°",
        f"scattered by less than {known.FOURNIER_FORAND_ANGLE:g}°",
        "⟨cosθ⟩, 1 collision",
        "⟨cosθ⟩, 5 collisions",
        "⟨z⟩ [m], 5 collisions",
        "⟨r²⟩ [m²], 5 collisions",
    )
    quantities = [
        Quantity(name, estimate, reference)
        for name, estimate, reference in zip(names, [*once, five, *places], known.FOURNIER_FORAND, strict=True)
    ]
    tables = scattered_once({"extinction": 0.3, "albedo": 0.8, **law})
    bins = batch_means([result.histogram.sum(axis=(0, 1)) for result in run.results(tables)])
    return quantities + [
        Quantity(f"scattered once, path {k + 2}–{k + 3} m", estimate, reference)
        for k, (estimate, reference) in enumerate(zip(bins, known.FOURNIER_FORAND_SINGLE_SCATTER, strict=True))
    ]


CASES = (
    Case(
        "fournier-forand",
        "Fournier–Forand: its closed integral, exact moments, light scattered once by quadrature",
        _fournier_forand,
    ),
)
