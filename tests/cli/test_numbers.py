"""Numbers on the command line: finite, or refused with the name of the option."""

import re

import numpy as np
import pytest
import typer

from helpers.cli import run
from spadwarp.cli import app
from spadwarp.cli.options import from_to
from spadwarp.cli.text import new_table, show_table


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
    assert len(REAL) > 10


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


@pytest.mark.parametrize(
    ("text", "unit", "values"),
    [
        ("2:3", "m", (2.0, 3.0)),
        ("1m:10m", "m", (1.0, 10.0)),
        ("80cm,1.2m", "m", (0.8, 1.2)),
        ("10ns,60ns", "ns", (10.0, 60.0)),
        ("0.04 us : 55 ns", "ns", (40.0, 55.0)),
    ],
)
def test_two_numbers_take_units(text, unit, values):
    assert from_to(text, unit, "--range") == pytest.approx(values)


@pytest.mark.parametrize(
    ("command", "option", "text", "words"),
    [
        ("plan", "--range", "1:10m", "'1:10m' is ambiguous: 10m has a unit and 1 has none"),
        ("plan", "--range", "10cm:1", "is ambiguous"),
        ("plan", "--range", "10ns:60ns", "is a time; a length is needed"),
        ("plan", "--range", "1:2:3", "FROM:TO"),
        ("plan", "--range", "9m:8m", "9m is more than 8m"),
        ("sweep", "--vary", "range=1:10cm:5", "is ambiguous"),
        ("sweep", "--vary", "range=1,10cm", "is ambiguous"),
    ],
)
def test_ambiguous_ranges_are_refused(command, option, text, words, scene):
    assert words in " ".join(run(command, scene, option, text, code=2).stderr.split())


def test_a_gate_in_time_needs_the_index(tmp_path):
    np.save(tmp_path / "depth.npy", np.full((8, 8), 14.0))
    common = ("denoise", tmp_path / "depth.npy", "--model", "median", "--out", tmp_path / "out")
    assert "group_index" in run(*common, "--gate", "90ns:110ns", code=2).stderr
    assert "ambiguous" in run(*common, "--gate", "9:11m", code=2).stderr


def test_tables_keep_units_in_brackets(capsys):
    table = new_table("range [m]", "error [mm]")
    table.add_row("depth [m]", "1 [ps]")
    show_table(table)
    printed = capsys.readouterr().out
    assert all(text in printed for text in ("range [m]", "error [mm]", "depth [m]", "1 [ps]"))


def test_a_table_wider_than_the_terminal_is_printed_in_parts(monkeypatch, capsys):
    monkeypatch.setenv("FORCE_COLOR", "1")
    monkeypatch.setenv("COLUMNS", "45")
    titles = [f"quantity {i}" for i in range(6)]
    table = new_table("water", "range", *titles)
    for name in ("clear", "coastal"):
        table.add_row(name, "5 m", *[f"{name[0]} {i}.23e-05" for i in range(6)])
    show_table(table, keys=2)
    printed = re.sub(r"\x1b\[[0-9;]*m", "", capsys.readouterr().out)
    assert "…" not in printed and all(title in printed for title in titles)
    assert max(map(len, printed.splitlines())) <= 45
    assert printed.count("coastal") == printed.count("range") == 3
