"""Pages of the documentation, and what stands in them."""

import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
README = ROOT / "README.md"
PAGES = sorted((ROOT / "docs").glob("*.md"))
_FENCE = re.compile(r"^```(\w*)\n(.*?)^```", re.MULTILINE | re.DOTALL)


def by_name(path):
    return path.name


def text_of(page):
    return page.read_text(encoding="utf-8")


def prose(page):
    """The text without blocks of code."""
    return _FENCE.sub("", text_of(page))


def blocks(page, *languages):
    """Language and code of all blocks, or of those in some languages."""
    return [block for block in _FENCE.findall(text_of(page)) if not languages or block[0] in languages]


def lines(code):
    """Commands of a shell block, one each, without comments."""
    return [re.sub(r"\s+#.*", "", line).strip() for line in code.replace("\\\n", " ").splitlines()]


def commands(page):
    return [line for _, code in blocks(page, "sh", "bash") for line in lines(code)]
