"""How cases are measured: scenes, records in blocks, independent runs; from scores to z values and one verdict."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.scene import Scene, phase_function
from spadwarp.transport import simulate, trace
from spadwarp.values import time_from_path

__all__ = ["PENCIL", "Estimate", "Quantity", "Run", "batch_means", "block_means", "holm", "point_source"]
__all__ += ["quantities", "scene", "slab_domain", "two_sided_p"]

BLOCK = 1 << 20  # photons whose records are held at a time
BATCHES = 32  # independent runs behind a standard error of a histogram


class Estimate(NamedTuple):
    """A measured number with its standard error, and the degrees of freedom of that error (inf: exactly known)."""

    value: float
    standard_error: float
    degrees: float = math.inf


@dataclass(frozen=True)
class Quantity:
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


def quantities(
    names: Iterable[str], estimates: Iterable[Estimate], references: Iterable[float], *, rounding: float = 0.0
) -> list[Quantity]:
    """One quantity for each name, estimate and reference, which are equally many."""
    rows = zip(names, estimates, references, strict=True)
    return [Quantity(name, estimate, reference, rounding=rounding) for name, estimate, reference in rows]


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
