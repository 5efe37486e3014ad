"""Photon records in HDF5."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING

from spadwarp.errors import FileError, SpadwarpError
from spadwarp.files import atomic_path

if TYPE_CHECKING:
    from spadwarp.config import Scene
    from spadwarp.simulation import PhotonRecords

__all__ = ["FORMAT", "load_records", "save_records"]

FORMAT = "spadwarp records"
FORMAT_VERSION = 1

_ARRAYS = ("id", "position", "direction", "weight", "path", "collisions", "reason")
_READ_ME = (
    "One row a photon, as its history ended: position [m] and direction in the camera frame (+x right, +y down, "
    "+z forward), weight, geometric path [m], collisions (surfaces included), reason (index into reasons)."
)


def save_records(records: PhotonRecords, path: str | Path, *, scene: Scene | None = None) -> Path:
    """Writes the terminal states of photons to one HDF5 file; returns its path.

    Args:
        records: From `spadwarp.trace`.
        path: The file; an existing one is replaced when the new one is whole.
        scene: What they were traced in, to be kept beside them.

    Raises:
        FileError: The file cannot be written.
    """
    import h5py

    with atomic_path(path) as temporary, h5py.File(temporary, "w") as file:
        file.attrs.update(
            {
                "format": FORMAT,
                "format_version": FORMAT_VERSION,
                "read_me": _READ_ME,
                "reasons": list(records.reasons),
                "ledger_unit": records.ledger_unit,
            }
        )
        for name in _ARRAYS:
            file.create_dataset(name, data=getattr(records, name), compression="gzip", compression_opts=1, shuffle=True)
        file.create_dataset("ledger", data=json.dumps(records.ledger))  # integers without limit
        if scene is not None:
            file.create_dataset("config", data=scene.to_toml())
    return Path(path)


def load_records(path: str | Path) -> PhotonRecords:
    """Reads what `save_records` wrote.

    Raises:
        FileError: No such file, not photon records, or damaged; says which.
    """
    import h5py

    from spadwarp.simulation import PhotonRecords

    if not Path(path).is_file() or not h5py.is_hdf5(path):
        raise FileError(f"{path}: {'not an HDF5 file' if Path(path).is_file() else 'no such file'}")
    try:
        with h5py.File(path, "r") as file:
            if file.attrs.get("format") != FORMAT or file.attrs["format_version"] > FORMAT_VERSION:
                raise FileError(f"{path}: not photon records of format version {FORMAT_VERSION} or older")
            return PhotonRecords(
                **{name: file[name][...] for name in _ARRAYS},
                reasons=tuple(file.attrs["reasons"]),
                ledger=json.loads(file["ledger"].asstr()[()]),
                ledger_unit=float(file.attrs["ledger_unit"]),
            )
    except SpadwarpError:
        raise
    except (OSError, RuntimeError, KeyError, ValueError) as error:
        raise FileError(f"{path}: damaged or not readable: {error}") from error
