"""Calls in copies of this process, which cost no import and no transfer of what they read."""

from __future__ import annotations

import gc
import os
import pickle
import select
import signal
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from types import TracebackType
from typing import Any

from spadwarp.errors import address_space

__all__ = ["Forked"]

_PATIENCE = 30.0  # seconds


class Forked:
    """Begins calls, each in a process of its own; a context, at whose end none of them runs any more.

    Where processes cannot be copied (not Linux, limited memory), or where one fails or takes half a minute, the call
    is made here, by `results`. Calls must not use a GPU, nor import what another thread may be importing; their results
    are pickled.
    """

    def __init__(self, calls: Sequence[Callable[[], Any]]) -> None:
        self._calls = calls
        possible = sys.platform == "linux" and address_space() is None
        self._running = [_begin(call) if possible else None for call in calls]

    def results(self) -> list[Any]:
        """Of all calls, in their order; waits for them. Raises what they raise."""
        found: list[tuple[Any] | None] = []
        while self._running:
            one = self._running.pop(0)
            found.append(None if one is None else _result(*one))
        return [call() if one is None else one[0] for call, one in zip(self._calls, found, strict=True)]

    def __enter__(self) -> Forked:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for one in self._running:
            if one is not None:
                _end(*one)
        self._running = []


def _begin(call: Callable[[], Any]) -> tuple[int, int] | None:
    """Process and the file that its result comes from; None where there is no further process."""
    try:
        source, target = os.pipe()
    except OSError:
        return None
    try:
        with warnings.catch_warnings():
            # Python warns of copies of a process with threads; the copy takes none of their locks.
            warnings.simplefilter("ignore", DeprecationWarning)
            process = os.fork()
    except OSError:
        os.close(source)
        os.close(target)
        return None
    if process == 0:
        code = 1
        try:
            gc.disable()  # arrays of a GPU that are garbage are the parent's to free
            os.close(source)
            with open(target, "wb") as file:
                pickle.dump((call(),), file)
            code = 0
        finally:
            os._exit(code)
    os.close(target)
    return process, source


def _result(process: int, source: int) -> tuple[Any] | None:
    """What the call returned; None if it failed."""
    data = b""
    try:
        while select.select([source], [], [], _PATIENCE)[0]:
            part = os.read(source, 1 << 16)
            if not part:
                break
            data += part
    finally:
        _end(process, source)
    with suppress(EOFError, pickle.UnpicklingError):
        found: tuple[Any] = pickle.loads(data)
        return found
    return None


def _end(process: int, source: int) -> None:
    os.close(source)
    with suppress(OSError):
        os.kill(process, signal.SIGKILL)
    with suppress(OSError):
        os.waitpid(process, 0)
