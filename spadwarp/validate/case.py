"""What the cases share: their scenes, photon records in blocks, independent runs."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.scene import Scene, phase_function
from spadwarp.transport import simulate, trace
from spadwarp.units import time_from_path
from spadwarp.validate.statistics import Estimate, Quantity, ScoreMeans

__all__ = ["PENCIL", "Case", "Run", "point_source", "scene"]

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
