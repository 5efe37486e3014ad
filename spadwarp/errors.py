"""The exceptions that spadwarp raises on purpose; all derive from `SpadwarpError`."""

from __future__ import annotations

import errno
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

try:
    import resource
except ImportError:  # Windows
    resource = None  # type: ignore[assignment]

__all__ = ["ArgumentError", "ConfigError", "DeviceError", "FileError", "MeshError", "SpadwarpError", "SpadwarpWarning"]
__all__ += ["in_words"]


class SpadwarpError(Exception):
    """Base of every error that spadwarp raises on purpose; its text is meant for the user as it is."""


class ArgumentError(SpadwarpError, ValueError):
    """An argument of a public function that is out of range, of the wrong shape, missing or one too many."""


class ConfigError(SpadwarpError):
    """A scene that cannot be used.

    The text has one line for each problem and names file, field, value and allowed range:
    `scene.toml: medium.g = 1.2 is outside (-1, 1)`.
    """

    def __init__(self, problems: str | Iterable[str], *, source: str | Path | None = None) -> None:
        """`problems`: one line each, without the file; `source`: the file they are in (None: made in Python)."""
        lines = [problems] if isinstance(problems, str) else list(problems)
        self.problems: tuple[str, ...] = tuple(lines)
        self.source = None if source is None else str(source)
        prefix = f"{source}: " if source else ""
        super().__init__("\n".join(prefix + line for line in lines))


class MeshError(SpadwarpError):
    """A mesh that cannot be used: missing, unreadable, empty, not finite or without area."""


class FileError(SpadwarpError):
    """A file that cannot be read or written, or that does not hold what it should."""


class DeviceError(SpadwarpError):
    """A device that does not exist, or has too little memory for what was asked."""


class SpadwarpWarning(UserWarning):
    """A success that may still mislead; its text is meant for the user as it is."""


@contextmanager
def kernel_errors() -> Iterator[None]:
    """Turns what the kernel library refuses into an `ArgumentError` of spadwarp: numbers that pass one by one, but
    together leave the range of what is computed with."""
    import spadwarp_kernels as sk

    try:
        yield
    except sk.ArgumentError as error:
        raise ArgumentError(str(error)) from error


# What the loader and threads say when memory is short, which Python then reports as another error.
_SHORT_OF_MEMORY = ("memory", "map segment", "start new thread", "bad_alloc")


def in_words(error: BaseException) -> str | None:
    """A sentence for an error that spadwarp did not raise but can foresee; None for any other, which is a bug.

    Foreseen are those of the system (files, memory, threads), text that is not Unicode, and input that is nested too
    deeply.
    """
    short = isinstance(error, MemoryError) or (isinstance(error, OSError) and error.errno == errno.ENOMEM)
    # Python's parser loses the MemoryError and says "error return without exception set".
    limit, text = address_space(), " ".join(str(error).split())[:300] or type(error).__name__
    short = short or (isinstance(error, SystemError) and limit is not None)
    if isinstance(error, OSError | ImportError | RuntimeError):
        short = short or any(words in str(error).lower() for words in _SHORT_OF_MEMORY)
    if short:
        most = "" if limit is None else f" (this process may use {limit / 2**30:.3g} GiB, see ulimit -v)"
        return f"not enough memory{most}" + (f": {text}" if str(error) else "")
    if isinstance(error, OSError) and error.strerror:
        names = " and ".join(str(name) for name in (error.filename, error.filename2) if name is not None)
        return f"{names}: {error.strerror}" if names else error.strerror
    if isinstance(error, UnicodeError):
        return f"text that cannot be read or written: {text}"
    if isinstance(error, RecursionError):
        return "the input is nested too deeply"
    if isinstance(error, ImportError):
        return f"a package cannot be loaded, see `spadwarp doctor`: {text}"
    return None if error.__cause__ is None else in_words(error.__cause__)


def address_space() -> int | None:
    """Bytes that this process may map, such as `ulimit -v` sets; None without a limit."""
    if resource is None:
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    return None if limit == resource.RLIM_INFINITY else limit


def need_memory(gibibytes: float, name: str) -> None:
    """Raises `MemoryError` where a limit leaves less than what `name` needs to be loaded.

    Libraries that meet the limit while they are loaded end the process, or wait for ever.
    """
    limit = address_space()
    if limit is not None and limit < gibibytes * 2**30:
        raise MemoryError(f"{name} needs {gibibytes:g} GiB")
