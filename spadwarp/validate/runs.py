"""What a case needs of the simulator: scenes from few words, photon records in blocks, independent runs."""

from __future__ import annotations

import hashlib
import math
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from spadwarp.scene import Scene, phase_function
from spadwarp.units import time_from_path
from spadwarp.validate.statistics import Quantity

__all__ = ["PENCIL", "Case", "Run", "point_source", "scene"]

BLOCK = 1 << 20  # photons whose records are held at a time
BATCHES = 32  # independent runs behind a standard error of a histogram

# A point source of pencil light along +z, and the camera and the gate of scenes that have no use for them.
PENCIL = {"profile": "collimated", "beam_radius": 0.0}
_BLIND = {"width": 1, "height": 1, "horizontal_fov_deg": 1.0, "aperture_diameter": 0.01}

# The exact transport: no rule of thumb, no limit.
_EXACT = {"axis_threshold": 1.0, "weight_cutoff": 0.0, "max_collisions": 2**31 - 1}


@dataclass(frozen=True)
class Run:
    """How the cases are run: photons for each scene, seed, device (None: the default one).

    With a folder for `tables` every Henyey–Greenstein function goes through a file of angles and values, but for those
    of layers, which cannot have a table each.
    """

    photons: int
    seed: int
    device: str | None = None
    tables: Path | None = None

    def records(self, tables: Mapping[str, Any], *, key: str | None = None) -> Iterator[Any]:
        """`PhotonRecords` of blocks of photons; random numbers of its own for each scene, or for each `key`."""
        from spadwarp.transport.records import trace

        traced = self._scene(tables)
        for block, start in enumerate(range(0, self.photons, BLOCK)):
            count = min(BLOCK, self.photons - start)
            yield trace(traced, photons=count, seed=self._seed(key or repr(tables), block), device=self.device)

    def results(self, tables: Mapping[str, Any]) -> Iterator[Any]:
        """`Result`s of `BATCHES` independent runs; each scene has random numbers of its own."""
        from spadwarp.transport.simulation import simulate

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
        about: What is checked, and where the reference comes from.
        measure: Runs it.
    """

    name: str
    about: str
    measure: Callable[[Run], list[Quantity]]


def scene(
    medium: Mapping[str, Any],
    laser: Mapping[str, Any],
    *,
    camera: Mapping[str, Any] = _BLIND,
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
