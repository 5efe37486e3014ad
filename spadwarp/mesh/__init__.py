"""Targets: built-in shapes and mesh files, with their colours, placed in the world."""

from spadwarp.mesh.builtins import BUILTINS, SIZED_BUILTINS, builtin_names, make_builtin
from spadwarp.mesh.targets import TriangleMesh, build_mesh, load_target

__all__ = ["BUILTINS", "SIZED_BUILTINS", "TriangleMesh", "build_mesh", "builtin_names", "load_target", "make_builtin"]
