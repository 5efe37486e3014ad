"""How cases are measured: scenes, records in blocks, independent runs; from scores to z values and one verdict."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.scene import Scene, phase_function
from spadwarp.transport import simulate, trace
from spadwarp.units import time_from_path

__all__ = ["PENCIL", "Case", "Estimate", "Quantity", "Run", "ScoreMeans", "batch_means", "holm", "point_source"]
__all__ += ["quantities", "scene", "slab_domain", "two_sided_p"]


@dataclass(frozen=True)
class Estimate:
    """A measured number with its standard error, and the degrees of freedom of that error (inf: exactly known)."""

    value: float
    standard_error: float
    degrees: float = math.inf


@dataclass(frozen=True)
class Quantity:
    """One measured number of a case beside its reference.

    Attributes:
        name: What was measured, with its unit.
        estimate: The simulator's value.
        reference: The known value.
        reference_error: Standard error of the reference, 0 where it is known.
        rounding: Half a unit of the last published digit: the reference lies within it, and z counts from its edge.
    """

    name: str
    estimate: Estimate
    reference: float
    reference_error: float = 0.0
    rounding: float = 0.0

    @property
    def standard_error(self) -> float:
        """Of the difference between value and reference."""
        return math.hypot(self.estimate.standard_error, self.reference_error)

    @property
    def z(self) -> float:
        """Standard normal deviate of the difference; without any error 0 for equality and ±inf else."""
        distance = self.estimate.value - self.reference
        difference = math.copysign(max(abs(distance) - self.rounding, 0.0), distance)
        if self.standard_error == 0.0:
            return math.copysign(math.inf, difference) if difference else 0.0
        return _normal_from_t(difference / self.standard_error, self.estimate.degrees)


def quantities(
    names: Iterable[str], estimates: Iterable[Estimate], references: Iterable[float], *, rounding: float = 0.0
) -> list[Quantity]:
    """One quantity for each name, estimate and reference, which are equally many."""
    return [
        Quantity(name, estimate, reference, rounding=rounding)
        for name, estimate, reference in zip(names, estimates, references, strict=True)
    ]


@dataclass
class ScoreMeans:
    """Means over photons of several scores that arrive block by block: `add` arrays `[N, scores]` or `[N]`."""

    count: int = 0
    total: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))
    square: NDArray[np.float64] = field(default_factory=lambda: np.zeros(1))

    def add(self, scores: ArrayLike) -> None:
        array = np.asarray(scores, np.float64)
        array = array.reshape(len(array), -1)
        self.count += len(array)
        self.total = self.total + array.sum(axis=0)
        self.square = self.square + (array**2).sum(axis=0)

    def estimates(self) -> list[Estimate]:
        """One estimate a score."""
        mean = self.total / self.count
        variance = np.maximum(self.square / self.count - mean**2, 0.0) / max(self.count - 1, 1)
        return [Estimate(float(m), float(v)) for m, v in zip(mean, np.sqrt(variance), strict=True)]


def batch_means(batches: ArrayLike) -> list[Estimate]:
    """Estimates from independent runs of equal size: `[batches, quantities]`, at least two batches."""
    array = np.asarray(batches, np.float64)
    array = array.reshape(len(array), -1)
    error = array.std(axis=0, ddof=1) / math.sqrt(len(array))
    degrees = float(len(array) - 1)
    return [Estimate(float(m), float(e), degrees) for m, e in zip(array.mean(axis=0), error, strict=True)]


def two_sided_p(z: float) -> float:
    """Probability that a standard normal number is at least as far from zero."""
    return math.erfc(abs(z) / math.sqrt(2.0))


def holm(p_values: Iterable[float]) -> list[float]:
    """Holm's family-wise p-values (1979), in the order given: reject where below the level of the whole family."""
    p: Sequence[float] = list(p_values)
    adjusted = [0.0] * len(p)
    largest = 0.0
    for rank, i in enumerate(sorted(range(len(p)), key=p.__getitem__)):
        largest = max(largest, min(1.0, (len(p) - rank) * p[i]))
        adjusted[i] = largest
    return adjusted


def _normal_from_t(t: float, degrees: float) -> float:
    """The normal deviate as likely as Student's t, by Wallace (1959): within 0.04 from seven degrees of freedom on."""
    if math.isinf(degrees):
        return t
    z = math.sqrt(degrees * math.log1p(t * t / degrees)) * (8 * degrees + 1) / (8 * degrees + 3)
    return math.copysign(z, t)


BLOCK = 1 << 20  # photons whose records are held at a time
BATCHES = 32  # independent runs behind a standard error of a histogram

# A pencil beam along +z; a camera for scenes that do not need one.
PENCIL = {"profile": "collimated", "beam_radius": 0.0}
_UNUSED_CAMERA = {"width": 1, "height": 1, "horizontal_fov_deg": 1.0, "aperture_diameter": 0.01}

# Exact transport: no approximation, no limit.
_EXACT = {"axis_threshold": 1.0, "weight_cutoff": 0.0, "max_collisions": 2**31 - 1}


@dataclass(frozen=True)
class Run:
    """How the cases are run: photons for each scene, seed, device (None: the default one).

    With a folder for `tables` every Henyey–Greenstein function is read from a file of angles and values, except those
    of layers, which cannot have a table each.
    """

    photons: int
    seed: int
    device: str | None = None
    tables: Path | None = None

    def records(
        self, tables: Mapping[str, Any], *, key: str | None = None, derivatives: Sequence[str] = ()
    ) -> Iterator[Any]:
        """`PhotonRecords` of blocks of photons; random numbers differ from scene to scene, or from `key` to `key`."""
        traced = self._scene(tables)
        for block, start in enumerate(range(0, self.photons, BLOCK)):
            count = min(BLOCK, self.photons - start)
            seed = self._seed(key or repr(tables), block)
            yield trace(traced, photons=count, seed=seed, device=self.device, derivatives=derivatives)

    def means(
        self,
        tables: Mapping[str, Any],
        scores: Callable[[Any], list[NDArray[Any]]],
        *,
        derivatives: Sequence[str] = (),
    ) -> list[Estimate]:
        """Means over photons of the scores `[N]` each that a function makes of `PhotonRecords`."""
        means = ScoreMeans()
        for records in self.records(tables, derivatives=derivatives):
            means.add(np.stack(scores(records), axis=1))
        return means.estimates()

    def results(self, tables: Mapping[str, Any]) -> Iterator[Any]:
        """`Result`s of `BATCHES` independent runs; the random numbers differ from scene to scene."""
        simulated = self._scene(tables)
        photons = max(1, self.photons // BATCHES)
        for batch in range(BATCHES):
            yield simulate(simulated, photons=photons, seed=self._seed(repr(tables), batch), device=self.device)

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


@dataclass(frozen=True)
class Case:
    """One reference case.

    Attributes:
        name: Its key.
        summary: What is checked, and where the reference comes from.
        measure: Runs it.
    """

    name: str
    summary: str
    measure: Callable[[Run], list[Quantity]]


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
    gate = {"start_ns": first * 1e9, "bin_width_ps": width * 1e12, "bins": bins}
    tables: dict[str, Any] = {
        "medium": medium,
        "laser": dict(laser),
        "camera": dict(camera),
        "gate": gate,
        "domain": dict(domain or {}),
        "transport": {**_EXACT, **transport},
    }
    if targets:
        tables["targets"] = targets
    return tables


def point_source(*position: float) -> dict[str, Any]:
    """An isotropic point source at x, y, z [m]."""
    return {"position": list(position), "profile": "uniform_cone", "half_angle_deg": 180.0}


def slab_domain(thickness: float) -> dict[str, Any]:
    """Water between z = 0 and `thickness` [m], which may be infinite."""
    return {"shape": "slab", "lower": [-math.inf, -math.inf, 0.0], "upper": [math.inf, math.inf, thickness]}
