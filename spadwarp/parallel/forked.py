"""Calls in copies of this process, which cost no import and no transfer of what they read."""

from __future__ import annotations

import gc
import multiprocessing
import sys
import warnings
from collections.abc import Callable, Sequence
from contextlib import suppress
from multiprocessing.connection import Connection
from multiprocessing.process import BaseProcess
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
        found = [None if copy is None else _result(*copy) for copy in self._running]
        return [call() if item is None else item[0] for call, item in zip(self._calls, found, strict=True)]

    def __enter__(self) -> Forked:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        for process, source in filter(None, self._running):
            source.close()
            process.kill()
            process.join()
        self._running = []


def _begin(call: Callable[[], Any]) -> tuple[BaseProcess, Connection] | None:
    """Process and the connection that its result comes from; None where there is no further process."""
    context = multiprocessing.get_context("fork")
    try:
        source, target = context.Pipe(duplex=False)
        process = context.Process(target=_send, args=(call, source, target), daemon=True)
        with target, warnings.catch_warnings():
            # Python warns of copies of a process with threads; the copy takes none of their locks.
            warnings.simplefilter("ignore", DeprecationWarning)
            process.start()
    except OSError:
        return None
    return process, source


def _send(call: Callable[[], Any], source: Connection, target: Connection) -> None:
    gc.disable()  # arrays of a GPU that are garbage are the parent's to free
    source.close()
    with suppress(BaseException):  # where nothing is sent, the call is made again
        target.send((call(),))


def _result(process: BaseProcess, source: Connection) -> tuple[Any] | None:
    """What the call returned; None if it failed."""
    with suppress(EOFError, OSError):
        if source.poll(_PATIENCE):
            found: tuple[Any] = source.recv()
            return found
    return None
