"""Words of older scenes and recipes, and the words for them now: whatever is loaded passes through this table."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

__all__ = ["current_fields", "current_path", "former_path"]

# Paths of fields of a scene or a recipe.
_PATHS = {
    "detector.fold": "detector.wrap",
    "detector.pulses": "detector.pulses_per_frame",
    "analytic.pulses": "analytic.pulses_per_depth_frame",
    "exposure.pulses": "exposure.pulses_per_depth_frame",
}

# Values of fields, by the path or by the name alone.
_VALUES: dict[str, dict[str, str]] = {
    "preset": {"paper": "lu2024"},
    "medium.albedo": {"paper": "lu2024"},
    "analytic.form": {"paper": "lu2024"},
    "analytic.count_law": {"per_frame_paper": "per_frame_lu2024"},
}


def current_path(path: str) -> str:
    """The path of a field now, such as "detector.wrap" for "detector.fold"."""
    return _PATHS.get(path, path)


def former_path(path: str) -> str:
    """The path of a field before it was renamed: random numbers are keyed by it, so that a dataset keeps its bits."""
    return next((old for old, new in _PATHS.items() if new == path), path)


def current_fields(section: str, fields: Mapping[str, Any]) -> dict[str, Any]:
    """Fields of a section by their names now, with the words for their values now."""
    current: dict[str, Any] = {}
    for name, value in fields.items():
        path = current_path(f"{section}.{name}")
        now = path.partition(".")[2]
        words = _VALUES.get(path) or _VALUES.get(now) or {}
        # A table with both names keeps the older one, which is then reported as unknown.
        current[name if now in fields else now] = words.get(value, value) if isinstance(value, str) else value
    return current
