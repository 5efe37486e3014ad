"""Kernels and Warp functions that are made for a choice, once for each."""

import functools
import os
import threading
from collections.abc import Callable
from typing import ParamSpec, TypeVar

P = ParamSpec("P")
R = TypeVar("R")

_making = threading.RLock()


def _free() -> None:
    global _making
    _making = threading.RLock()


if hasattr(os, "register_at_fork"):
    os.register_at_fork(after_in_child=_free)  # a thread that made something is not in the child


def made_once(make: Callable[P, R]) -> Callable[P, R]:
    """`functools.cache` for what makes Warp functions and kernels: in all threads one after the other.

    Where two threads make a function of one name, Warp may give both the later one, and a kernel is then made of the
    parts of another.
    """
    made = functools.cache(make)

    @functools.wraps(make)
    def once(*args: P.args, **kwargs: P.kwargs) -> R:
        with _making:
            return made(*args, **kwargs)

    return once
