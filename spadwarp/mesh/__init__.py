"""Targets: built-in shapes and mesh files, with their colours, placed in the world."""

from spadwarp.io.paths import MESH_ENDINGS
from spadwarp.mesh.builtins import BUILTINS, SIZED_BUILTINS, builtin_names, make_builtin
from spadwarp.mesh.focus import focus_distance
from spadwarp.mesh.preview import MeshSummary, describe_mesh, guess_unit
from spadwarp.mesh.targets import TriangleMesh, build_mesh, load_target

__all__ = [
    "BUILTINS",
    "MESH_ENDINGS",
    "SIZED_BUILTINS",
    "MeshSummary",
    "TriangleMesh",
    "build_mesh",
    "builtin_names",
    "describe_mesh",
]
__all__ += ["focus_distance", "guess_unit", "load_target", "make_builtin"]
