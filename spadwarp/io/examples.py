"""Scenes and recipes that come with the package, by name."""

from __future__ import annotations

import difflib
import os
from pathlib import Path

from spadwarp.errors import FileError

__all__ = ["example_or_path", "examples"]

KINDS = ("scenes", "datasets", "training")


def examples(kind: str) -> dict[str, Path]:
    """Files of a kind, "scenes", "datasets" or "training", by name.

    In a checkout those of `configs/`, else the copies in the package.
    """
    package = Path(__file__).parents[1]
    folder = next((place for place in (package / "configs", package.parent / "configs") if place.is_dir()), package)
    return {path.stem: path for path in sorted((folder / kind).glob("*.toml"))}


def example_or_path(path: str | os.PathLike[str], kind: str) -> Path:
    """A path as it is; but a bare name for which there is no file is that of an example.

    Raises `FileError` for a bare name that is neither.
    """
    place = Path(path)
    if place.suffix or place.name != str(path) or os.path.exists(place):
        return place
    known = examples(kind)
    if place.name not in known:
        named = f"{place.name}.toml"
        close = [named] if os.path.exists(named) else difflib.get_close_matches(place.name, known, n=1)
        hint = f"did you mean {close[0]!r}?" if close else f"known are {', '.join(known)}"
        raise FileError(f"{place}: neither a file nor one of the {kind} that come with spadwarp; {hint}")
    return known[place.name]
