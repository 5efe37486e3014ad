"""HTML pages from the templates beside this module."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from spadwarp.io.paths import atomic_path

__all__ = ["write_page"]


def write_page(path: str | Path, template: str, **values: Any) -> None:
    """Writes a page of its own: values are escaped except where the template says `safe`. Raises `FileError`."""
    from jinja2 import Environment, FileSystemLoader, StrictUndefined

    pages = Environment(loader=FileSystemLoader(Path(__file__).parent), autoescape=True, undefined=StrictUndefined)
    pages.policies["json.dumps_kwargs"] = {}  # keys stay in their order
    text = pages.get_template(template).render(values)
    with atomic_path(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
