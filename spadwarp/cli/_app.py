"""The application to which all commands belong: messages in case of errors, and the exit codes.

0 done, 1 failed, 2 wrong use (options, or a scene that is not valid), 130 interrupted.
"""

from __future__ import annotations

import warnings
from contextlib import AbstractContextManager, ExitStack
from typing import Any, NoReturn, TypeVar

import typer
from typer.core import TyperGroup

import spadwarp
from spadwarp.errors import ArgumentError, ConfigError, SpadwarpError

FAILED, WRONG_USE, INTERRUPTED = 1, 2, 130


_resources = ExitStack()  # of the command that runs
Value = TypeVar("Value")


class _Commands(TyperGroup):
    """Errors of spadwarp end a command without a traceback; warnings are one line."""

    def invoke(self, ctx: Any) -> Any:
        with warnings.catch_warnings(), _resources:
            warnings.showwarning = _show_warning
            try:
                return super().invoke(ctx)
            except SpadwarpError as error:
                fail(str(error), WRONG_USE if isinstance(error, ConfigError | ArgumentError) else FAILED)
            except MemoryError as error:
                fail(f"not enough memory: {error}")
            except KeyboardInterrupt:
                fail("interrupted; unfinished files were not written", INTERRUPTED)


def _show_warning(message: Warning | str, *_: Any, **__: Any) -> None:
    complain(f"warning: {message}")


def until_the_end(context: AbstractContextManager[Value]) -> Value:
    """Enters a context that is left when the command ends, however it ends."""
    return _resources.enter_context(context)


def say(text: str = "") -> None:
    """Prints the answer of a command to stdout."""
    typer.echo(text)


def complain(text: str) -> None:
    """Prints progress, warnings and errors to stderr."""
    typer.echo(text, err=True)


def fail(text: str, code: int = FAILED) -> NoReturn:
    """Ends the command with an error."""
    complain("\n".join(f"error: {line}" for line in text.splitlines()))
    raise typer.Exit(code)


# Help in plain text: units in square brackets stay, and nothing is loaded to draw boxes.
app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool) -> None:
    if asked:
        say(f"spadwarp {spadwarp.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Show the version."),
) -> None:
    """Monte Carlo photon transport for single-photon (SPAD) imaging in scattering water.

    \b
    Example:
      spadwarp simulate configs/scenes/staircase_15m.toml --out out/
      spadwarp info out/result.h5
    """


def main() -> None:
    """The `spadwarp` command."""
    app(prog_name="spadwarp")
