"""Options: described, and values that are refused by name."""

import numpy as np
import pytest
import typer

from helpers.cli import run
from spadwarp.cli import app
from spadwarp.cli.options import from_to
from spadwarp.cli.outputs import show_table


def test_every_option_says_what_it_is():
    for command in typer.main.get_command(app).commands.values():
        for one in command.params:
            assert one.name == "help" or one.help, (command.name, one.name)


@pytest.mark.parametrize("value", ["nan", "-inf", "1e999", "²"])
@pytest.mark.parametrize("name", ["depth-error", "time", "eye-distance"])
def test_a_real_option_is_finite(name, value, scene):
    assert f"--{name}" in run("plan", scene, f"--{name}={value}", code=2).stderr


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("bin_width", "'bin_width' is not of the form bin_width=VALUE"),
        ("bin_with=5ps", "'bin_with' is not one of bin_width, gate_start, irf"),
        ("bin_width=5m", "bin_width = '5m' is a length; a time is needed"),
        ("axes=tyx,bin_width=nan", "bin_width = 'nan' is not"),
        ("sum_frames=yes", "is not of the form sum_frames"),
        ("image_size=5", "image_size = '5' is not of the form WIDTHxHEIGHT"),
    ],
)
def test_what_a_file_lacks_is_read_with_care(text, words, tmp_path):
    options = ("--input", text, "--out", tmp_path / "out")
    assert words in " ".join(run("depth", tmp_path / "counts.npy", *options, code=2).stderr.split())


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
    assert from_to(unit)(text) == pytest.approx(values)


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
    show_table([{"range [m]": "depth [m]", "error [mm]": "1 [ps]"}])
    printed = capsys.readouterr().out
    assert all(text in printed for text in ("range [m]", "error [mm]", "depth [m]", "1 [ps]"))


def test_a_table_wider_than_the_terminal_is_printed_in_parts(monkeypatch, capsys):
    monkeypatch.setattr("sys.stdout.isatty", lambda: True, raising=False)
    monkeypatch.setenv("COLUMNS", "45")
    titles = [f"quantity {i}" for i in range(6)]
    values = {title: f"{i}.23e-05" for i, title in enumerate(titles)}
    show_table([{"water": name, "range": "5 m", **values} for name in ("clear", "coastal")], keys=2)
    printed = capsys.readouterr().out
    assert all(title in printed for title in titles)
    assert max(map(len, printed.splitlines())) <= 45
    assert printed.count("coastal") == printed.count("range") == 3
