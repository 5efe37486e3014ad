"""Checkpoints: when the photons done so far are written to a file."""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable
from pathlib import Path

from spadwarp.errors import FileError
from spadwarp.limits import check_real
from spadwarp.result import Result, save_result

__all__ = ["Checkpoint"]

# Checkpoints take at most this share of the time.
_LARGEST_SHARE = 0.02


class Checkpoint:
    """A file that is written again and again.

    Args:
        path: The file; None: no checkpoints.
        every: Seconds between two of them, at least.

    Attributes:
        photons: In the file; 0 before the first.
    """

    def __init__(self, path: str | Path | None, every: float) -> None:
        self.path, self.photons = path, 0
        self._every = check_real("checkpoint_every", every, "[0, inf]")
        self._written, self._cost = time.monotonic(), 0.0

    def is_due(self) -> bool:
        pause = max(self._every, self._cost / _LARGEST_SHARE)
        return self.path is not None and time.monotonic() >= self._written + pause

    def write(self, collect: Callable[[], Result]) -> None:
        """Writes a result; where that fails the run continues, as the disk may have space again later."""
        assert self.path is not None
        began = time.monotonic()
        try:
            result = collect()
            save_result(result, self.path)
            self.photons = result.photons
        except FileError as error:
            warnings.warn(f"no checkpoint, the run continues: {error}", RuntimeWarning, stacklevel=2)
        self._written = time.monotonic()
        self._cost = self._written - began
