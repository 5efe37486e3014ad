"""For MkDocs: pages that live elsewhere in the repository, and links between all of them as the repository has them.

Links in the sources lead from file to file, so that they work where the files are read; here they become those of the
site. What a link leads to that is not on the site keeps its text.
"""

from __future__ import annotations

import os
import posixpath
import re
from pathlib import Path
from typing import Any

from mkdocs.structure.files import File

ROOT = Path(__file__).parents[1]

# File of the repository → page of the site.
ELSEWHERE = {
    "README.md": "index.md",
    "kernels/README.md": "kernels.md",
    "bench/results/README.md": "benchmark.md",
    "CHANGELOG.md": "changelog.md",
    "CONTRIBUTING.md": "contributing.md",
}
_FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)
_LINK = re.compile(r"(!?)\[((?:[^\[\]]|\[[^\]]*\])*)\]\(([^)\s]+)\)")


def on_config(config: Any) -> Any:
    """Pages that the navigation does not name go to its end."""
    named = re.findall(r"[\w/]+\.md", str(config.nav))
    pages = sorted(path.name for path in (ROOT / "docs").glob("*.md"))
    config.nav += [{"More": others}] if (others := [page for page in pages if page not in named]) else []
    return config


def on_files(files: Any, config: Any) -> Any:
    """Adds the pages from elsewhere."""
    for source, page in ELSEWHERE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    return files


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Turns links within the repository into links within the site."""
    here = page.file.src_uri
    source = next((path for path, name in ELSEWHERE.items() if name == here), f"docs/{here}")

    def link(match: re.Match[str]) -> str:
        picture, text, target = match.groups()
        path, hash_, anchor = target.partition("#")
        if not path or re.match(r"[a-z]+:", path):
            return match.group()
        place = posixpath.normpath(posixpath.join(posixpath.dirname(source), path))
        on_site = ELSEWHERE.get(place, place.removeprefix("docs/") if place.startswith("docs/") else None)
        if on_site is None or (ROOT / place).is_dir():
            return text
        relative = os.path.relpath(on_site, posixpath.dirname(here) or ".").replace(os.sep, "/")
        return f"{picture}[{text}]({relative}{hash_}{anchor})"

    parts, last = [], 0
    for fence in _FENCE.finditer(markdown):
        parts += [_LINK.sub(link, markdown[last : fence.start()]), fence.group()]
        last = fence.end()
    return "".join([*parts, _LINK.sub(link, markdown[last:])])
