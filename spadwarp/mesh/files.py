"""What trimesh passes over in mesh files, checked: indices, shapes, sizes that a file declares."""

from __future__ import annotations

import json
import struct
from pathlib import Path
from typing import TYPE_CHECKING

from spadwarp.errors import MeshError

if TYPE_CHECKING:
    import trimesh

__all__ = ["check_sizes", "check_triangles"]

_JSON_CHUNK = 0x4E4F534A


def check_triangles(mesh: trimesh.Trimesh, name: str) -> None:
    """Raises `MeshError` where vertices are not points or faces refer to none."""
    if mesh.vertices.shape[1:] != (3,):
        raise MeshError(f"{name}: its vertices have {mesh.vertices.shape[-1]} coordinates; three are needed")
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise MeshError(f"{name}: a face refers to a vertex that does not exist")


def check_sizes(path: Path, name: str) -> None:
    """Raises `MeshError` for a GLB file that declares more numbers than it has bytes, for which memory would be taken.

    What is no GLB file is left to its reader.
    """
    if path.suffix.lower() != ".glb":
        return
    size = path.stat().st_size
    try:
        with path.open("rb") as file:
            _, _, _, length, kind = struct.unpack("<4sIIII", file.read(20))
            accessors = json.loads(file.read(min(length, size))).get("accessors", []) if kind == _JSON_CHUNK else []
        counts = [int(accessor["count"]) for accessor in accessors]
    except (OSError, struct.error, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise MeshError(f"{name}: not a readable mesh file ({type(error).__name__}: {error})") from error
    if counts and not 0 <= min(counts) <= max(counts) <= size:
        raise MeshError(f"{name}: declares {max(counts)} numbers in a file of {size} bytes")
