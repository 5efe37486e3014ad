"""Numbers on the command line: finite, or refused with the name of the option."""

import pytest
import typer

from helpers.cli import run
from spadwarp.cli import app


def commands(group, path=()):
    for name, command in group.commands.items():
        yield from commands(command, (*path, name)) if hasattr(command, "commands") else [((*path, name), command)]


def needed(command, besides):
    """Arguments and options that the command needs, besides one."""
    values = {"--format": "npy"}
    for one in command.params:
        if one.required and one is not besides:
            yield from [one.opts[0], values.get(one.opts[0], "1")] if one.param_type_name == "option" else ["1"]


def real_numbers():
    """Every option and argument of every command that takes real numbers."""
    for path, command in commands(typer.main.get_command(app)):
        for one in command.params:
            kind = str(getattr(getattr(one, "type_descriptor", one), "annotation", getattr(one, "type", "")))
            if "float" in kind.lower():
                yield pytest.param(path, command, one, id=" ".join([*path, one.opts[0]]))


REAL = list(real_numbers())


def test_there_are_options_with_real_numbers():
    assert len(REAL) > 20


@pytest.mark.parametrize("value", ["nan", "-inf", "1e999"])
@pytest.mark.parametrize(("path", "command", "one"), REAL)
def test_a_real_option_is_finite(path, command, one, value):
    is_option = one.param_type_name == "option"
    given = [one.opts[0], *[value] * one.nargs] if is_option else ["--", value]
    complaint = run(*path, *needed(command, one), *given, code=2).stderr
    assert (one.opts[0] if is_option else one.metavar) in complaint
    assert value in complaint or "is not a finite number" in complaint or one.nargs > 1


@pytest.mark.parametrize("text", ["nan:5", "1:inf", "1e999:2", "1:²", "1e308 km:2"])
def test_a_range_is_finite(text, scene):
    assert "range" in run("plan", scene, "--range", text, code=2).stderr
