"""The exceptions that spadwarp raises on purpose; all derive from `SpadwarpError`."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager

__all__ = ["ArgumentError", "ConfigError", "DeviceError", "FileError", "MeshError", "SpadwarpError"]


class SpadwarpError(Exception):
    """Base of every error that spadwarp raises on purpose; its text is meant for the user as it is."""


class ArgumentError(SpadwarpError, ValueError):
    """An argument of a public function that is out of range, of the wrong shape, missing or one too many."""


class ConfigError(SpadwarpError):
    """A scene that cannot be used.

    The text has one line for each problem and names file, field, value and allowed range:
    `scene.toml: medium.g = 1.2 is outside (-1, 1)`.
    """

    def __init__(self, problems: str | Iterable[str], *, source: str | None = None) -> None:
        """`problems`: one line each, without the file; `source`: the file they are in (None: made in Python)."""
        lines = [problems] if isinstance(problems, str) else list(problems)
        self.problems: tuple[str, ...] = tuple(lines)
        self.source = source
        prefix = f"{source}: " if source else ""
        super().__init__("\n".join(prefix + line for line in lines))


class MeshError(SpadwarpError):
    """A mesh that cannot be used: missing, unreadable, empty, not finite or without area."""


class FileError(SpadwarpError):
    """A file that cannot be read or written, or that does not hold what it should."""


class DeviceError(SpadwarpError):
    """A device that does not exist, or has too little memory for what was asked."""


@contextmanager
def kernel_errors() -> Iterator[None]:
    """Turns what the kernel library refuses into an `ArgumentError` of spadwarp: numbers that pass one by one, but
    together leave the range of what is computed with."""
    import spadwarp_kernels as sk

    try:
        yield
    except sk.ArgumentError as error:
        raise ArgumentError(str(error)) from error
