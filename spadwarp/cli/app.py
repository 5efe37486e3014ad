"""The application to which all commands belong: messages in case of errors, and the exit codes.

0 done, 1 failed, 2 wrong use (options, or a scene that is not valid), 70 a bug of spadwarp, 130 interrupted.
"""

from __future__ import annotations

import difflib
import io
import itertools
import os
import platform
import shlex
import sys
import tempfile
import traceback
import warnings
from contextlib import AbstractContextManager, ExitStack, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import typer
from typer.core import TyperCommand, TyperGroup

import spadwarp
from spadwarp.values import ArgumentError, ConfigError, SpadwarpError, SpadwarpWarning, UnforeseenArgument, in_words

FAILED, WRONG_USE, BUG, INTERRUPTED = 1, 2, 70, 130


@dataclass
class Running:
    """The command that runs: its common options, and the names of all that are given."""

    quiet: bool = False
    prints_result: bool = False  # also with --quiet
    overwrite: bool = False
    json: Path | None = None
    given: frozenset[str] = frozenset()


running = Running()
_resources = ExitStack()  # of the command that runs
Value = TypeVar("Value")


# Commands by stage of work, in the order of the help.
STAGES = {
    "Begin": ("init", "list", "doctor"),
    "Plan": ("check", "plan", "sweep", "water"),
    "Simulate": ("simulate", "merge", "reconstruct", "analytic"),
    "Counts and depth": ("detect", "depth", "fit", "denoise"),
    "Look at results": ("info", "view", "export"),
    "Datasets and training": ("dataset", "train", "evaluate"),
    "Trust and speed": ("validate", "bench"),
}


_UsageError: Any = typer.BadParameter.__base__  # of click, which newer versions of typer hold inside


class Command(TyperCommand):
    """An unknown option is said to be another command's, a value in two words to be one."""

    def parse_args(self, ctx: Any, args: list[str]) -> list[str]:
        words = list(args)
        try:
            return super().parse_args(ctx, args)
        except _UsageError as error:
            name, near = getattr(error, "option_name", None), getattr(error, "possibilities", None) or ()
            if name is not None:
                every = ctx.parent.command.commands if ctx.parent else {}
                owners = [other for other, one in every.items() if any(name in option.opts for option in one.params)]
                error.possibilities = [] if owners else difflib.get_close_matches(name, near, cutoff=0.75)
                error.message += f"; {', '.join(owners[:4])} {'have' if owners[1:] else 'has'} it" if owners else ""
            for number, unit in itertools.pairwise(words):
                if number[-1:].isdigit() and unit.isalpha() and f"({unit})" in error.message:
                    error.message += f"; write {number}{unit} as one word"
            raise


class _Commands(TyperGroup):
    """Errors end a command with a sentence, never with a traceback; warnings are one line; help by stage of work."""

    def main(self, *args: Any, **options: Any) -> Any:
        for stream in (sys.stdout, sys.stderr):
            if isinstance(stream, io.TextIOWrapper):  # a terminal may lack some of our letters; "?" stands for them
                stream.reconfigure(errors="replace")
        try:
            return super().main(*args, **options)
        except Exception as error:
            if isinstance(error, OSError) and error.filename is None and sys.stdout is sys.__stdout__:
                sys.stdout = io.StringIO()  # Python would else try to write to it again
            text, code = _described(error)
            with suppress(OSError):
                complain(text, "error")
            sys.exit(code)

    def format_commands(self, ctx: Any, formatter: Any) -> None:
        """A heading for each stage, and the whole first sentence of each command."""
        width = max(map(len, self.commands))
        for stage, names in STAGES.items():
            with formatter.section(stage):
                rows = [(f"{name:<{width}}", self.commands[name].get_short_help_str(limit=200)) for name in names]
                formatter.write_dl(rows)

    def invoke(self, ctx: Any) -> Any:
        with warnings.catch_warnings(), _resources:
            said = set[str]()

            def show(message: Warning | str, *_: Any, **__: Any) -> None:
                if str(message) not in said:  # once, however often a command reads a mesh
                    said.add(str(message))
                    complain(str(message), "warning")

            warnings.showwarning = show
            warnings.filterwarnings("default", category=SpadwarpWarning)
            try:
                answer = super().invoke(ctx)
                if sys.stdout is not None:  # as in `spadwarp info out/ >&-`
                    sys.stdout.flush()  # a full disk shows here, not when Python ends
                return answer
            except KeyboardInterrupt as stop:
                fail(str(stop) or "interrupted; unfinished files were not written", INTERRUPTED)


def _described(error: Exception) -> tuple[str, int]:
    """The error in words, and the exit code."""
    if isinstance(error, UnforeseenArgument) and isinstance(error.__cause__, Exception):
        error = error.__cause__  # what a command hands over it has checked
    text = str(error) if isinstance(error, SpadwarpError) else in_words(error)
    if text is not None:
        return text, WRONG_USE if isinstance(error, ConfigError | ArgumentError) else FAILED
    what = traceback.format_exception_only(error)[-1].strip()
    return f"spadwarp has a bug: {what[:300]}\nplease report it with {_kept(error)}", BUG


def _kept(error: Exception) -> str:
    """The file of the traceback; the traceback itself where no file can be written."""
    lines = (
        f"spadwarp {spadwarp.__version__}, Python {platform.python_version()}, {platform.platform()}",
        shlex.join(sys.argv),
        "".join(traceback.format_exception(error)),
    )
    text = "\n".join(lines)
    try:
        handle, path = tempfile.mkstemp(prefix="spadwarp-bug-", suffix=".txt")
        with os.fdopen(handle, "w", encoding="utf-8", errors="replace") as file:
            file.write(text)
    except OSError:
        return f"this:\n{text}"
    return f"{path}, which says where it happened"


def until_the_end(context: AbstractContextManager[Value]) -> Value:
    """Enters a context that is left when the command ends, however it ends."""
    return _resources.enter_context(context)


def say(text: str = "") -> None:
    """Prints the answer of a command to stdout; with --quiet only where no file holds it."""
    if not running.quiet or running.prints_result:
        typer.echo(text)


def note(text: str) -> None:
    """Prints how far a command is to stderr, but with --quiet."""
    if not running.quiet:
        complain(text)


def complain(text: str, kind: str = "") -> None:
    """Prints to stderr, each line behind its kind: error, warning or, but with --quiet, note."""
    if kind == "note" and running.quiet:
        return
    typer.echo("\n".join(f"{kind}: {line}" for line in text.splitlines()) if kind else text, err=True)


def wrong(text: str, option: str) -> NoReturn:
    """Ends the command for a wrong value of the option."""
    raise typer.BadParameter(text, param_hint=option)


def fail(text: str, code: int = FAILED) -> NoReturn:
    """Ends the command with an error."""
    complain(text, "error")
    raise typer.Exit(code)


# Help in plain text: units in square brackets stay, and nothing is loaded to draw boxes.
app = typer.Typer(
    cls=_Commands,
    no_args_is_help=True,
    add_completion=True,
    pretty_exceptions_enable=False,
    rich_markup_mode=None,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _version(asked: bool) -> None:
    if asked:
        typer.echo(f"spadwarp {spadwarp.__version__}")
        raise typer.Exit


@app.callback()
def _options(
    version: bool = typer.Option(False, "--version", callback=_version, is_eager=True, help="Show the version."),
) -> None:
    """Monte Carlo photon transport for single-photon (SPAD) imaging in scattering water.

    \b
    Examples:
      spadwarp simulate staircase_15m --out out/
      spadwarp info out/result.h5
    """
