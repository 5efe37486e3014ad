"""Text files written: JSON and CSV."""

from __future__ import annotations

import csv
import json
import math
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from spadwarp.io.atomic import atomic_path

__all__ = ["json_text", "write_csv", "write_json", "write_text"]


def json_text(value: Any, *, indent: int = 2) -> str:
    """A value as JSON with a line end; numbers that are not finite become null, paths text."""
    return json.dumps(_plain(value), indent=indent, allow_nan=False) + "\n"


def write_text(text: str, path: str | Path) -> Path:
    """Writes UTF-8 text; returns the path. Raises `FileError`."""
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return Path(path)


def write_json(value: Any, path: str | Path, *, indent: int = 2) -> Path:
    """Writes `json_text` of a value; returns the path. Raises `FileError`."""
    return write_text(json_text(value, indent=indent), path)


def write_csv(table: Sequence[Mapping[str, Any]], path: str | Path) -> Path:
    """Writes rows with the same names as CSV with a header; returns the path. Raises `FileError`."""
    with atomic_path(path) as temporary, temporary.open("w", newline="", encoding="utf-8") as file:
        writer = csv.DictWriter(file, list(table[0]))
        writer.writeheader()
        writer.writerows(table)
    return Path(path)


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {str(name): _plain(item) for name, item in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(item) for item in value]
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return os.fspath(value) if isinstance(value, os.PathLike) else value
