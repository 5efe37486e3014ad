"""Notebooks: a picture with numbers by `html`, how far a call is by `progress_bar`."""

from __future__ import annotations

import base64
import html as markup
import io
import sys
from collections.abc import Callable
from typing import Any

from spadwarp.analytic import AnalyticResult, Proposal
from spadwarp.files import summary
from spadwarp.frames import Frames
from spadwarp.io.text import fact, progress_report
from spadwarp.result import Result
from spadwarp.scene import Scene
from spadwarp.values import SpadwarpError
from spadwarp.viz.result import plot

__all__ = ["html", "progress_bar"]


def progress_bar(unit: str = "photons") -> Callable[[str, int, int], None]:
    """A bar for the argument `progress` of `spadwarp.simulate` and others: one call, one bar.

    In a notebook it is drawn below the cell, elsewhere it is a line of text on standard error.

        spadwarp.simulate(scene, photons=2e6, progress=spadwarp.viz.progress_bar())

    Args:
        unit: What is counted, such as "photons", "frames" or "steps".
    """
    return progress_report(_display() if _in_notebook() else _print, unit)


def _in_notebook() -> bool:
    """Whether a kernel of Jupyter runs this."""
    ipython = sys.modules.get("IPython")
    return hasattr(ipython.get_ipython(), "kernel") if ipython is not None else False


def _print(part: float | None, text: str) -> None:
    print(f"\r{text:<79}", end="\n" if part in (None, 1.0) else "", file=sys.stderr, flush=True)


def _display() -> Callable[[float | None, str], None]:
    """Shows a bar below the cell, at first a new one."""
    from IPython.display import HTML, display

    handle: Any = None

    def show(part: float | None, text: str) -> None:
        nonlocal handle
        bar = HTML(f"<progress value='{part or 0.0:.4f}' max='1'></progress> {markup.escape(text)}")
        if handle is None:
            handle = display(bar, display_id=True)
        else:
            handle.update(bar)

    return show


_HIDDEN = ("kind", "timing", "provenance", "counters", "pilot")


def html(shown: Result | Frames | Scene | AnalyticResult | Proposal) -> str:
    """A picture, but not of a proposal, and a table of numbers as HTML, for `_repr_html_`."""
    picture, style, numbers = "", "style='text-align:left'", dict[str, Any]()
    try:
        if not isinstance(shown, Proposal):
            buffer = io.BytesIO()
            plot(shown).savefig(buffer, format="png", dpi=100)
            data = base64.b64encode(buffer.getvalue()).decode("ascii")
            picture = f"<img src='data:image/png;base64,{data}' style='max-width:100%'>"
        numbers = summary(shown)
    except SpadwarpError as error:  # a mesh that is not there, no device
        picture = f"<p>{markup.escape(str(error))}</p>"
    facts = [fact(name, value) for name, value in numbers.items() if name not in _HIDDEN and value not in ({}, [], ())]
    cells = "".join(
        f"<tr><th {style}>{markup.escape(name)}</th><td {style}>{markup.escape(value)}</td></tr>"
        for name, value in facts
    )
    return f"<div><b>{markup.escape(repr(shown))}</b>{picture}<table>{cells}</table></div>"
