"""What source files import."""

import ast
import functools
from pathlib import Path

import spadwarp
import spadwarp_kernels

SPADWARP, KERNELS = (Path(package.__file__).parent for package in (spadwarp, spadwarp_kernels))


@functools.cache
def nodes_of(path):
    return list(ast.walk(ast.parse(path.read_text())))


def imported(node, package=()):
    """Full names that an import statement in a file of a package names; the package's own name in parts."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        above = package[: len(package) - node.level + 1] if node.level else ()
        return [".".join([*above, *filter(None, [node.module]), alias.name]) for alias in node.names]
    return []


def names_imported(path, excepted=()):
    """By a file, inside functions too, but not by the nodes that are excepted."""
    top = KERNELS if KERNELS in path.parents else SPADWARP
    package = path.parent.relative_to(top.parent).parts
    return [name for node in nodes_of(path) if node not in excepted for name in imported(node, package)]
