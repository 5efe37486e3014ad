"""Targets: built-in shapes and mesh files, with their colours, placed in the world."""

from spadwarp.mesh.targets import BUILTINS, SIZED_BUILTINS, TriangleMesh, build_mesh, builtin_names, load_target

__all__ = ["BUILTINS", "SIZED_BUILTINS", "TriangleMesh", "build_mesh", "builtin_names", "load_target"]
