"""Paths of files in the tables of a scene: absolute in memory, relative to a scene file beside them."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

__all__ = ["FILE_FIELDS", "with_absolute_paths", "with_paths_from"]

FILE_FIELDS = (
    ("medium", "phase_table", ".csv"),
    ("medium", "matrix_table", ".csv"),
    ("detector", "irf", ".csv"),
    ("camera", "calibration", ""),
    ("laser", "profile_image", ""),
    ("laser", "spectrum", ".csv"),
    ("detector", "filter_table", ".csv"),
)
"""Fields with the path of a file, beside `mesh` of a target and `file` of a grid: section, name, the ending that makes
text a path."""


def with_absolute_paths(tables: Mapping[str, Any], folder: Path) -> dict[str, Any]:
    """The tables with paths that are relative to a folder made absolute."""
    return _changed(tables, lambda value: _without_dots(folder / os.path.expanduser(value)))


def with_paths_from(tables: Mapping[str, Any], folder: str | os.PathLike[str]) -> dict[str, Any]:
    """The tables of a scene in memory with the paths that a scene file in a folder has.

    Relative for files in the folder or in the one above it, with the folders in these: what is moved together stays
    together. Absolute for others.
    """
    here = os.path.abspath(folder)
    above = os.path.dirname(here)
    root = above if os.path.dirname(above) != above else here  # that of a disk holds all files

    def shortened(value: str) -> str:
        place = os.path.abspath(value)
        if not Path(place).is_relative_to(root):
            return place
        relative = os.path.relpath(place, here)
        return Path(relative).as_posix() if _is_same(os.path.join(here, relative), place) else place

    return _changed(tables, shortened)


def _without_dots(path: Path) -> str:
    short = os.path.normpath(path)
    return short if ".." in path.parts and _is_same(short, path) else str(path)


def _is_same(one: str | Path, other: str | Path) -> bool:
    """Whether two paths lead to one place; links may make a difference of `..`."""
    try:
        return os.path.realpath(one) == os.path.realpath(other)
    except (OSError, ValueError):  # no path at all
        return False


def _changed(tables: Mapping[str, Any], change: Callable[[str], str]) -> dict[str, Any]:
    """The tables with other paths of files."""

    def path(fields: Any, name: str, ending: str = "") -> Any:
        value = fields.get(name) if isinstance(fields, Mapping) else None
        if isinstance(value, str) and value.lower().endswith(ending):
            return {**fields, name: change(value)}
        return fields

    changed = dict(tables)
    targets = tables.get("targets")
    if isinstance(targets, Mapping):
        changed["targets"] = {index: path(target, "mesh") for index, target in targets.items()}
    elif isinstance(targets, (list, tuple)):
        changed["targets"] = [path(target, "mesh") for target in targets]
    for section, name, ending in FILE_FIELDS:
        if section in changed:
            changed[section] = path(changed[section], name, ending)
    medium = changed.get("medium")
    if isinstance(medium, Mapping) and "grid" in medium:
        changed["medium"] = {**medium, "grid": path(medium["grid"], "file")}
    return changed
