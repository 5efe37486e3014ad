"""Photon records: how each photon ended, and their HDF5 file."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

import spadwarp_kernels as sk
from spadwarp.device import pick_device
from spadwarp.errors import ArgumentError
from spadwarp.io.hdf5 import Coordinate, name_dimensions, read_hdf5, write_hdf5
from spadwarp.limits import SEED, check_integer
from spadwarp.mesh import build_mesh
from spadwarp.scene import Scene, SceneLike, as_scene
from spadwarp.scene.camera import to_world
from spadwarp.scene.pose import rotation_matrix
from spadwarp.transport.derivatives import is_block_name, resolve_derivatives
from spadwarp.transport.model import build_model, transport_spec
from spadwarp.transport.plan import LAUNCH_SIZE
from spadwarp.transport.simulation import Progress
from spadwarp.transport.workers import DeviceWorker

__all__ = ["PhotonRecords", "load_records", "save_records", "trace"]

FORMAT = "spadwarp records"
FORMAT_VERSION = 1

_ARRAYS: dict[str, tuple[Any, tuple[int, ...]]] = {
    "id": (np.uint64, ()),
    "position": (np.float32, (3,)),
    "direction": (np.float32, (3,)),
    "weight": (np.float32, ()),
    "path": (np.float32, ()),
    "collisions": (np.int32, ()),
    "reason": (np.int32, ()),
}
_AXES: Coordinate = (["x", "y", "z"], "1", "of the world")
_DIMENSIONS = {
    "id": (("photon",), "1", "of the photon"),
    "position": (("photon", "axis"), "m", "where the history ended"),
    "direction": (("photon", "axis"), "1", "of the last flight"),
    "weight": (("photon",), "1", "remaining weight"),
    "path": (("photon",), "m", "geometric path"),
    "collisions": (("photon",), "1", "events, surfaces included"),
    "reason": (("photon",), "1", "index into reasons"),
    "log_derivatives": (("photon", "parameter"), "1", "derivative of the logarithm of what the history has met"),
}
_READ_ME = (
    "One row per photon, as its history ended: position [m] and direction in the world (for a camera without pose its "
    "frame, +x right, +y down, +z forward), weight, geometric path [m], collisions (surfaces included), reason (index "
    "into reasons)."
)


@dataclass(frozen=True, eq=False)
class PhotonRecords:
    """How each photon ended.

    Attributes:
        id: uint64 `[N]`.
        position: float32 `[N, 3]`, where it ended [m].
        direction: float32 `[N, 3]`, unit vector of its last flight.
        weight: float32 `[N]`, remaining weight.
        path: float32 `[N]`, geometric path [m].
        collisions: int32 `[N]`, events, surfaces included.
        reason: int32 `[N]`, index into `reasons`.
        reasons: Names of the entries of the energy balance: weight_cutoff, max_collisions, max_path, lateral_limit,
            exit_x_low, ...
        energy_balance: As in `Result`, with its unit.
        derivatives: Names of the P parameters that were asked for.
        log_derivatives: float32 `[N, P]`, ∂ ln f/∂parameter of the photon's flights and events f so far: the
            derivative of the expectation of anything that the records tell is the mean of this times this.
    """

    id: NDArray[np.uint64]
    position: NDArray[np.float32]
    direction: NDArray[np.float32]
    weight: NDArray[np.float32]
    path: NDArray[np.float32]
    collisions: NDArray[np.int32]
    reason: NDArray[np.int32]
    reasons: tuple[str, ...]
    energy_balance: dict[str, int]
    energy_balance_unit: float
    derivatives: tuple[str, ...] = ()
    log_derivatives: NDArray[np.float32] = field(default_factory=lambda: np.zeros((0, 0), np.float32))

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
    photons = check_integer("photons", scene.transport.photons if photons is None else photons, "[1, 2147483647]")
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
    arrays = [name for name in _ARRAYS if name != "id"] + (["log_derivatives"] if names else [])
    size = LAUNCH_SIZE["cuda" if model.device.is_cuda else "cpu"]
    worker = DeviceWorker(model, spec, seed=seed, launch_size=size)
    parts: list[dict[str, NDArray[Any]]] = []
    for first in range(0, photons, size):
        stop = min(first + size, photons)
        worker.data.records = sk.make_records(stop - first, device=model.device, derivatives=len(names))
        worker.launch(first, stop)
        parts.append({name: getattr(worker.data.records, name).numpy() for name in arrays})
        if progress is not None:
            progress("trace", stop, photons)
    energy_balance, _ = sk.read_ledger(worker.data)
    camera = scene.camera
    if camera.is_posed:
        for part in parts:
            part["position"] = to_world(camera, part["position"]).astype(np.float32)
            part["direction"] = (part["direction"] @ rotation_matrix(camera.rotation_deg).T).astype(np.float32)
    return PhotonRecords(
        id=np.arange(photons, dtype=np.uint64),
        **{name: np.concatenate([part[name] for part in parts]) for name in parts[0]},
        reasons=sk.LEDGER_ENTRIES,
        energy_balance=energy_balance,
        energy_balance_unit=sk.LEDGER_UNIT,
        derivatives=names,
    )


def save_records(records: PhotonRecords, path: str | Path, *, scene: Scene | None = None) -> Path:
    """Writes the terminal states of photons to one HDF5 file; returns its path.

    Args:
        records: From `spadwarp.transport.trace`.
        path: The file; an existing one is replaced when the new one is whole.
        scene: The scene they were traced in, to be stored with them.

    Raises:
        FileError: The file cannot be written.
    """
    with write_hdf5(path) as file:
        file.attrs.update(
            {
                "format": FORMAT,
                "format_version": FORMAT_VERSION,
                "read_me": _READ_ME,
                "reasons": list(records.reasons),
                "energy_balance_unit": records.energy_balance_unit,
            }
        )
        for name in _ARRAYS:
            file.create_dataset(name, data=getattr(records, name), compression="gzip", compression_opts=1, shuffle=True)
        if records.derivatives:
            file.attrs["derivatives"] = list(records.derivatives)
            file.create_dataset(
                "log_derivatives", data=records.log_derivatives, compression="gzip", compression_opts=1, shuffle=True
            )
        file.create_dataset("energy_balance", data=json.dumps(records.energy_balance))  # integers without limit
        if scene is not None:
            file.create_dataset("config", data=scene.to_toml())
        parameters: Coordinate = (list(records.derivatives), "1", "of the scene")
        name_dimensions(file, {"photon": len(records.id), "axis": _AXES, "parameter": parameters}, _DIMENSIONS)
    return Path(path)


def load_records(path: str | Path) -> PhotonRecords:
    """Reads what `save_records` wrote.

    Raises:
        FileError: No such file, not photon records, or damaged; says which.
    """
    with read_hdf5(path, FORMAT, version=FORMAT_VERSION) as file:
        count = len(file.stored("id", np.uint64, (None,)))
        arrays = {name: file.array(name, kind, (count, *shape)) for name, (kind, shape) in _ARRAYS.items()}
        reasons = np.ravel(file.attribute("reasons")).tolist()
        if not all(isinstance(name, str) for name in reasons):
            file.refuse("reasons", "are not names")
        if count and not 0 <= arrays["reason"].min() <= arrays["reason"].max() < len(reasons):
            file.refuse("reason", f"is outside [0, {len(reasons)}) for some photons")
        names: list[Any] = np.ravel(file.attribute("derivatives", [])).tolist()
        if bool(names) != ("log_derivatives" in file) or not all(isinstance(name, str) for name in names):
            file.refuse("derivatives", "are not the names of derivatives")
        if names:
            arrays["log_derivatives"] = file.array("log_derivatives", np.float32, (count, len(names)))
        return PhotonRecords(
            **arrays,
            derivatives=tuple(names),
            reasons=tuple(reasons),
            energy_balance=file.integers("energy_balance"),
            energy_balance_unit=file.real("energy_balance_unit", "(0, inf)"),
        )
