"""Photon records: how each photon ended, and their HDF5 file."""

from __future__ import annotations

import json
import threading
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import spadwarp_kernels as sk
from spadwarp.device import pick_device
from spadwarp.io.hdf5 import PACKED, Coordinate, name_dimensions, read_hdf5, write_hdf5
from spadwarp.mesh import build_mesh
from spadwarp.result.tallies import is_block_name
from spadwarp.scene import Scene, SceneLike, as_scene
from spadwarp.scene.camera import to_world
from spadwarp.scene.pose import rotation_matrix
from spadwarp.transport.derivatives import resolve_derivatives
from spadwarp.transport.model import build_model, transport_spec
from spadwarp.transport.plan import LAUNCH_SIZE
from spadwarp.transport.simulation import Progress
from spadwarp.transport.workers import DeviceWorker
from spadwarp.values import SEED, ArgumentError, check_integer

__all__ = ["PhotonRecords", "load_records", "save_records", "trace"]

FORMAT = "spadwarp records"
FORMAT_VERSION = 1

# Type, dimensions, unit, meaning.
_ARRAYS: dict[str, tuple[Any, tuple[str, ...], str, str]] = {
    "id": (np.uint64, ("photon",), "1", "of the photon"),
    "position": (np.float32, ("photon", "axis"), "m", "where the history ended"),
    "direction": (np.float32, ("photon", "axis"), "1", "of the last flight"),
    "weight": (np.float32, ("photon",), "1", "remaining weight"),
    "path": (np.float32, ("photon",), "m", "geometric path"),
    "collisions": (np.int32, ("photon",), "1", "events, surfaces included"),
    "reason": (np.int32, ("photon",), "1", "index into reasons"),
    "log_derivatives": (np.float32, ("photon", "parameter"), "1", "derivative of the logarithm of what was met"),
}
_READ_ME = "One row per photon. World: for a camera without pose its frame, +x right, +y down, +z forward."


@dataclass(frozen=True, eq=False)
class PhotonRecords:
    """How each photon ended."""

    id: NDArray[np.uint64]  # uint64 `[N]`
    position: NDArray[np.float32]  # float32 `[N, 3]`, where it ended [m]
    direction: NDArray[np.float32]  # float32 `[N, 3]`, unit vector of its last flight
    weight: NDArray[np.float32]  # float32 `[N]`, remaining weight
    path: NDArray[np.float32]  # float32 `[N]`, geometric path [m]
    collisions: NDArray[np.int32]  # int32 `[N]`, events, surfaces included
    reason: NDArray[np.int32]  # int32 `[N]`, index into `reasons`
    reasons: tuple[str, ...]
    """Names of the entries of the energy balance: weight_cutoff, max_collisions, max_path, lateral_limit, exit_x_low,
    ..."""
    energy_balance: dict[str, int]  # as in `Result`, with its unit
    energy_balance_unit: float
    derivatives: tuple[str, ...] = ()  # names of the P parameters that were asked for
    log_derivatives: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))
    """float32 `[N, P]`, ∂ ln f/∂parameter of the photon's flights and events f so far: the derivative of the
    expectation of anything that the records tell is the mean of this times this."""

    def ended(self, *names: str) -> NDArray[np.bool_]:
        """Mask of the photons that ended for one of the named reasons."""
        return np.isin(self.reason, [self.reasons.index(name) for name in names])


def trace(
    scene: SceneLike,
    *,
    photons: int | None = None,
    seed: int | None = None,
    device: str | None = None,
    progress: Progress | None = None,
    derivatives: Iterable[str] = (),
) -> PhotonRecords:
    """Traces photons without a camera and returns the terminal state of each.

    Positions and directions are those of the world. Path is limited by `transport.max_path` alone, not by the gate.
    A photon takes 44 bytes, and 4 for each of the `derivatives`.

    Args and raises: as `simulate`.
    """
    scene = as_scene(scene)
    asked: Any = scene.transport.photons if photons is None else photons
    photons = check_integer("photons", asked, "[1, 2147483647]")
    seed = check_integer("seed", scene.transport.seed if seed is None else seed, SEED)
    mesh = build_mesh(scene)
    names = resolve_derivatives(scene, derivatives)
    if any(map(is_block_name, names)):
        raise ArgumentError(
            f"derivatives: photon records have no derivatives by block: {names[-1]}; a histogram has, `simulate`"
        )
    model = build_model(scene, pick_device(device), mesh, camera=False, derivatives=names)
    if progress is not None:
        progress("compile", 0, 0)
    spec = transport_spec(scene, mesh, derivatives=names, estimator="none", records=True)
    arrays = [name for name in _ARRAYS if name != "id" and (names or name != "log_derivatives")]
    size = LAUNCH_SIZE["cuda" if model.device.is_cuda else "cpu"]
    worker = DeviceWorker(model, spec, seed=seed, launch_size=size)
    parts: list[list[NDArray[Any]]] = []
    for first in range(0, photons, size):
        stop = min(first + size, photons)
        worker.data.records = sk.make_records(stop - first, device=model.device, derivatives=len(names))
        worker.trace((first, stop), stopped=threading.Event())
        parts.append([getattr(worker.data.records, name).numpy() for name in arrays])
        if progress is not None:
            progress("trace", stop, photons)
    whole: Any = dict(zip(arrays, map(np.concatenate, zip(*parts, strict=True)), strict=True))
    if (camera := scene.camera).is_posed:
        whole["position"] = to_world(camera, whole["position"]).astype(np.float32)
        whole["direction"] = (whole["direction"] @ rotation_matrix(camera.rotation_deg).T).astype(np.float32)
    return PhotonRecords(
        id=np.arange(photons, dtype=np.uint64),
        **whole,
        reasons=sk.LEDGER_ENTRIES,
        energy_balance=sk.read_ledger(worker.data)[0],
        energy_balance_unit=sk.LEDGER_UNIT,
        derivatives=names,
    )


def save_records(records: PhotonRecords, path: str | Path, *, scene: Scene | None = None) -> Path:
    """Writes the terminal states of photons to one HDF5 file; returns its path.

    Args:
        records: From `spadwarp.transport.trace`.
        path: The file; an existing one is replaced when the new one is whole.
        scene: The scene they were traced in, to be stored with them.

    Raises `FileError`: the file cannot be written.
    """
    head = {"format": FORMAT, "format_version": FORMAT_VERSION, "read_me": _READ_ME, "reasons": list(records.reasons)}
    if records.derivatives:
        head["derivatives"] = list(records.derivatives)
    with write_hdf5(path) as file:
        file.attrs.update({**head, "energy_balance_unit": records.energy_balance_unit})
        for name in _ARRAYS if records.derivatives else list(_ARRAYS)[:-1]:
            file.create_dataset(name, data=getattr(records, name), **PACKED)
        file.create_dataset("energy_balance", data=json.dumps(records.energy_balance))  # integers without limit
        if scene is not None:
            file.create_dataset("config", data=scene.to_toml())
        coordinates: dict[str, Coordinate | int | None] = {
            "photon": len(records.id),
            "axis": (["x", "y", "z"], "1", "of the world"),
            "parameter": (list(records.derivatives), "1", "of the scene"),
        }
        name_dimensions(file, coordinates, {name: entry[1:] for name, entry in _ARRAYS.items()})
    return Path(path)


def load_records(path: str | Path) -> PhotonRecords:
    """Reads what `save_records` wrote.

    Raises `FileError`: no such file, not photon records, or damaged; says which.
    """
    with read_hdf5(path, FORMAT, version=FORMAT_VERSION) as file:
        names: list[Any] = np.ravel(file.attribute("derivatives", [])).tolist()
        if bool(names) != ("log_derivatives" in file) or not all(isinstance(name, str) for name in names):
            file.refuse("derivatives", "are not the names of derivatives")
        sizes = {"photon": len(file.stored("id", np.uint64, (None,))), "axis": 3, "parameter": len(names)}
        arrays: Any = {
            name: file.array(name, kind, [sizes[dimension] for dimension in dimensions])
            for name, (kind, dimensions, *_) in _ARRAYS.items()
            if names or name != "log_derivatives"
        }
        reasons = np.ravel(file.attribute("reasons")).tolist()
        if not all(isinstance(name, str) for name in reasons):
            file.refuse("reasons", "are not names")
        if len(arrays["id"]) and not 0 <= arrays["reason"].min() <= arrays["reason"].max() < len(reasons):
            file.refuse("reason", f"is outside [0, {len(reasons)}) for some photons")
        return PhotonRecords(
            **arrays,
            derivatives=tuple(names),
            reasons=tuple(reasons),
            energy_balance=file.integers("energy_balance"),
            energy_balance_unit=file.real("energy_balance_unit", "(0, inf)"),
        )
