"""How far a call is, in a notebook or on a terminal: `progress_bar`."""

from __future__ import annotations

import html
import sys
import time
from collections.abc import Callable
from typing import Any

__all__ = ["progress_bar"]

_PAUSE = 0.2  # between two reports [s]


def progress_bar(unit: str = "photons") -> Callable[[str, int, int], None]:
    """A bar for the argument `progress` of `spadwarp.simulate` and others: one call, one bar.

    In a notebook it is drawn below the cell, elsewhere it is a line of text on standard error.

        spadwarp.simulate(scene, photons=2e6, progress=spadwarp.viz.progress_bar())

    Args:
        unit: What is counted, such as "photons", "frames" or "steps".
    """
    return _Bar(unit)


class _Bar:
    """What is called with a stage, what is done and what is to be done; the latter is 0 where nothing is counted."""

    def __init__(self, unit: str) -> None:
        self._unit = unit
        self._shown = 0.0
        self._first: tuple[float, int] | None = None  # when counting began, and at what number
        self._handle: Any = None
        self._notebook = _in_notebook()

    def __call__(self, stage: str, done: int, total: int) -> None:
        now = time.monotonic()
        if not total:
            self._show(0.0, "loading kernels; the first run of a kind compiles them" if stage == "compile" else stage)
            return
        if self._first is None:
            self._first = now, done
        if done < total and now - self._shown < _PAUSE:
            return
        self._shown = now
        seconds = now - self._first[0]
        rate = (done - self._first[1]) / seconds if seconds > 0.05 else 0.0
        text = f"{100 * done / total:.0f} %, {done} of {total} {self._unit}"
        if rate:
            left = f"{(total - done) / rate:.0f} s left" if done < total else f"in {seconds:.1f} s"
            text += f", {rate:.3g} {self._unit}/s, {left}"
        self._show(done / total, text)
        if done >= total and not self._notebook:
            print(file=sys.stderr)

    def _show(self, part: float, text: str) -> None:
        if not self._notebook:
            print(f"\r{text:<76}", end="", file=sys.stderr, flush=True)
            return
        from IPython.display import HTML, display

        shown = HTML(f"<progress value='{part:.4f}' max='1'></progress> {html.escape(text)}")
        if self._handle is None:
            self._handle = display(shown, display_id=True)
        else:
            self._handle.update(shown)


def _in_notebook() -> bool:
    """Whether a kernel of Jupyter runs this."""
    ipython = sys.modules.get("IPython")
    shell = ipython.get_ipython() if ipython is not None else None
    return shell is not None and hasattr(shell, "kernel")
