"""Options: described, and values that are refused by name."""

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


@pytest.mark.parametrize(
    ("command", "option", "text", "words"),
    [
        *(("plan", "--depth-error", text, "--depth-error") for text in ("nan", "-inf", "1e999", "²")),
        ("plan", "--eye-distance", "nan", "--eye-distance"),
        *(("plan", "--range", text, "range") for text in ("nan:5", "1:inf", "1e999:2", "1:²", "1e308 km:2")),
        ("plan", "--range", "1:10m", "'1:10m' is ambiguous: 10m has a unit and 1 has none"),
        ("plan", "--range", "10cm:1", "is ambiguous"),
        ("plan", "--range", "10ns:60ns", "is a time; a length is needed"),
        ("plan", "--range", "1:2:3", "FROM:TO"),
        ("plan", "--range", "9m:8m", "9m is more than 8m"),
        ("sweep", "--vary", "range=1:10cm:5", "is ambiguous"),
        ("sweep", "--vary", "range=1,10cm", "is ambiguous"),
        ("depth", "--input", "bin_width", "'bin_width' is not of the form bin_width=VALUE"),
        ("depth", "--input", "bin_with=5ps", "'bin_with' is not one of bin_width, gate_start, irf"),
        ("depth", "--input", "bin_width=5m", "bin_width = '5m' is a length; a time is needed"),
        ("depth", "--input", "axes=tyx,bin_width=nan", "bin_width = 'nan' is not"),
        ("depth", "--input", "sum_frames=yes", "is not of the form sum_frames"),
        ("depth", "--input", "image_size=5", "image_size = '5' is not of the form WIDTHxHEIGHT"),
        ("denoise", "--gate", "90ns:110ns", "group_index"),
        ("denoise", "--gate", "9:11m", "ambiguous"),
        ("fit", "--prior", "medium.anisotropy=0.9", "is not NAME=MEAN,SD"),
        ("fit", "--start", "medium.anisotropy", "is not NAME=VALUE"),
    ],
)
def test_values_are_refused_by_name(command, option, text, words, scene, tmp_path):
    more = {"depth": ("--out", tmp_path / "out"), "denoise": ("--out", tmp_path / "out"), "fit": ("--unknown", "depth")}
    refused = run(command, scene, f"{option}={text}", *more.get(command, ()), code=2).stderr
    assert words in " ".join(refused.split()) and not (tmp_path / "out").exists()


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
