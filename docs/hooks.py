"""For MkDocs: pages that live elsewhere in the repository, notebooks, and links between all of them.

Links in the sources lead from file to file, so that they work where the files are read; here they become those of the
site. What a link leads to that is not on the site keeps its text. Notebooks are executed; those with outputs are kept
in out/notebooks until the notebook changes. With SPADWARP_NOTEBOOKS=plain they are shown without outputs.
"""

from __future__ import annotations

import hashlib
import os
import posixpath
import re
from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
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
    """Adds the pages from elsewhere, and a page for each notebook."""
    for source, page in ELSEWHERE.items():
        files.append(File.generated(config, page, content=(ROOT / source).read_text(encoding="utf-8")))
    for path in sorted((ROOT / "docs" / "notebooks").glob("*.ipynb")):
        for name, content in notebook_page(path):
            files.append(File.generated(config, f"notebooks/{name}", content=content))
    return files


def notebook_page(path: Path) -> Iterator[tuple[str, str | bytes]]:
    """A notebook with its outputs as Markdown, and its pictures: names and contents."""
    from nbconvert import MarkdownExporter

    folder = f"{path.stem}_files"
    body, resources = MarkdownExporter().from_notebook_node(
        executed(path), {"output_files_dir": folder, "unique_key": path.stem}
    )
    title, _, text = body.partition("\n")
    download = f'<a href="{path.name}" download>Download this notebook</a>'
    yield f"{path.stem}.md", f"{title}\n\n{download}\n{text}"
    yield from resources["outputs"].items()


def executed(path: Path) -> Any:
    """The notebook with the outputs of its cells; an error in a cell ends the build."""
    import nbformat
    from nbclient import NotebookClient

    source = path.read_bytes()
    kept = ROOT / "out" / "notebooks" / f"{path.stem}-{hashlib.sha256(source).hexdigest()[:16]}.ipynb"
    if os.environ.get("SPADWARP_NOTEBOOKS") == "plain":
        return nbformat.read(path, as_version=4)
    if kept.exists():
        return nbformat.read(kept, as_version=4)
    with TemporaryDirectory() as folder:
        notebook = nbformat.reads(source.decode("utf-8"), as_version=4)
        NotebookClient(notebook, timeout=600, resources={"metadata": {"path": folder}}).execute()
    kept.parent.mkdir(parents=True, exist_ok=True)
    nbformat.write(notebook, kept)
    return notebook


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
        on_site = on_site and re.sub(r"\.ipynb$", ".md", on_site)
        if on_site is None or (ROOT / place).is_dir():
            return text
        relative = os.path.relpath(on_site, posixpath.dirname(here) or ".").replace(os.sep, "/")
        return f"{picture}[{text}]({relative}{hash_}{anchor})"

    parts, last = [], 0
    for fence in _FENCE.finditer(markdown):
        parts += [_LINK.sub(link, markdown[last : fence.start()]), fence.group()]
        last = fence.end()
    return "".join([*parts, _LINK.sub(link, markdown[last:])])
