"""The reference values of the cases, from references.toml, which has their meaning and source."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any, NamedTuple

from spadwarp.io.text import read_toml

_VALUES = read_toml(Path(__file__).with_name("references.toml"))


class Slab(NamedTuple):
    """Index-matched, normal incidence: fractions that leave it, `transmitted` with the direct beam; or derivatives."""

    anisotropy: float
    albedo: float
    optical_depth: float
    reflected: Any
    transmitted: Any

    @property
    def text(self) -> str:
        depth = "half-space" if math.isinf(self.optical_depth) else f"τ {self.optical_depth:g}"
        return f"g {self.anisotropy:g}, ω {self.albedo:g}, {depth}"


class Stack(NamedTuple):
    """Layers from the illuminated side on: (anisotropy, albedo, extinction [1/m], thickness [m]); normal incidence."""

    layers: list[list[float]]
    reflected: float
    transmitted: float

    @property
    def text(self) -> str:
        return "τ " + ", ".join(f"{extinction * thickness:g}" for *_, extinction, thickness in self.layers)


def _placed(values: dict[str, Any]) -> dict[str, tuple[slice, slice, Any]]:
    return {place: (slice(*rows), slice(*columns), value) for place, (rows, columns, value) in values.items()}


SLABS = tuple(Slab(*row) for row in _VALUES["slabs"])
SLAB_DERIVATIVES = tuple(Slab(*row) for row in _VALUES["slab_derivatives"])
_FROM_FIRST, _FROM_LAST = _VALUES["through_layers"]
STACKS = (Stack(_VALUES["layers"], *_FROM_FIRST), Stack(_VALUES["layers"][::-1], *_FROM_LAST))
EXIT_COSINE_EDGES = _VALUES["exit_cosine_edges"]
EXIT_COSINES = tuple((SLABS[number], face, values) for number, face, values in _VALUES["exit_cosines"])
TIME_RESOLVED_MEDIUM, TIME_RESOLVED_EDGES = _VALUES["time_resolved_medium"], _VALUES["time_resolved_edges"]
TIME_RESOLVED, AFTER_PATH, AFTER_COLLISIONS = (
    _VALUES[name] for name in ("time_resolved", "after_path", "after_collisions")
)
NEAR_AXIS, CUTOFF = dict(_VALUES["near_axis"]), dict(_VALUES["cutoff"])
FLUENCE_ABSORPTION, FLUENCE_PATH = _VALUES["fluence_absorption"], _VALUES["fluence_path"]
FLUENCE_EDGES, FLUENCE = _VALUES["fluence_edges"], _VALUES["fluence"]
CUBE60, CUBE60_ROUNDING = _VALUES["cube60"], _VALUES["cube60_rounding"]
FOURNIER_FORAND_ANGLE, FOURNIER_FORAND = _VALUES["fournier_forand_angle"], _VALUES["fournier_forand"]
FOURNIER_FORAND_SINGLE_SCATTER = _VALUES["fournier_forand_single_scatter"]
SINGLE_SCATTER, LAMBERTIAN = _placed(_VALUES["single_scatter"]), _placed(_VALUES["lambertian"])
