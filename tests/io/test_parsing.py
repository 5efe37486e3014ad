"""Numbers and text that enter: read whole, or refused with a sentence, whatever they cost."""

import array
import math
from fractions import Fraction

import numpy as np
import pytest
import warp as wp
from hypothesis import given
from hypothesis import strategies as st

from spadwarp.io.arrays import write_exr
from spadwarp.io.paths import file_problem
from spadwarp.io.text import parse_json, parse_toml, read_columns, read_text
from spadwarp.values import (
    ArgumentError,
    ConfigError,
    FileError,
    Interval,
    check_integer,
    check_real,
    parse_number,
    shown,
)


@given(st.floats(allow_nan=False))
def test_a_number_is_what_it_is_written_as(value):
    assert parse_number(repr(value)) == value
    assert parse_number(f" {value!r}\n") == value


def test_numbers_may_be_written_in_several_ways():
    texts = {"2e9": 2e9, ".5": 0.5, "5.": 5.0, "2_000_000": 2e6, "-INF": -math.inf, "+3E-2": 0.03}
    assert {text: parse_number(text) for text in texts} == texts


@pytest.mark.parametrize(
    ("problem", "texts"),
    [
        ("is not a number", ["nan", "", "-", "1e", "²", "\u0663", "0x10", "1__0", "_1", "1_", "1,5", "1 2", "one"]),
        ("beyond the largest number", ["1e999", "9" * 5000, "-1e309"]),
    ],
)
def test_what_is_no_number_or_would_become_infinite_is_refused(problem, texts):
    for text in texts:
        with pytest.raises(ValueError, match=problem):
            parse_number(text)


def test_intervals_read_and_print_alike():
    for text in ("(0, 1]", "[-1e9, inf)", "[1, 18446744073709551615]", "(0, inf]", "[0.5, 1e-5)"):
        assert str(Interval.read(text)) == text
    assert 0 not in Interval.read("(0, 1]") and 1 in Interval.read("(0, 1]")
    assert math.inf in Interval.read("(0, inf]") and math.inf not in Interval.read("(0, inf)")
    assert math.nan not in Interval.read("[-inf, inf]")


def test_integral_numbers_are_integers():
    for value in (5, 5.0, 5e0, np.int64(5), np.float32(5), np.array(5), Fraction(5)):
        found = check_integer("photons", value, "[1, 10]")
        assert found == 5 and type(found) is int
    assert check_integer("seed", 2**64 - 1, "[0, 18446744073709551615]") == 2**64 - 1
    assert check_real("relative_error", np.float32(0.5), "(0, 1)") == 0.5


NO_INTEGER = [5.5, math.nan, math.inf, "5", None, True, np.True_, np.array([5]), [5], 1j, int]
NO_NUMBER = ["0.5", None, True, [0.5], {}, float, np.str_("0.5"), np.complex128(0.5 + 1.0j), np.timedelta64(5, "ns")]


@pytest.mark.parametrize(
    ("check", "interval", "problem", "values"),
    [
        (check_integer, "[1, 10]", ".* is not an integer in", NO_INTEGER),
        (check_integer, "[1, 10]", ".{1,60} is outside", [0, 11, 10**400, -(10**5000), 1e300]),
        (check_real, "(0, 1)", ".{1,60} is outside", [math.nan, math.inf, -math.inf, 10**400, 1.0]),
        (check_real, "(0, 1)", ".* is not a number", NO_NUMBER),
    ],
)
def test_numbers_of_another_kind_or_out_of_range_are_refused(check, interval, problem, values):
    for value in values:
        with pytest.raises(ArgumentError, match=f"^name = {problem}"):
            check("name", value, interval)


def test_values_are_quoted_shortly():
    deep = []
    for _ in range(100_000):
        deep = [deep]
    for value in (deep, "x" * 10**6, 10**5000, list(range(10**6)), {"a": deep}):
        assert len(shown(value)) <= 60
    assert shown((1.0, "a")) == "[1.0, 'a']"
    assert shown(array.array("d", [1.0])) == "array('d', [1.0])"
    assert len(shown(wp.zeros(100, device="cpu"))) <= 60


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("a = " + "[" * 5000 + "]" * 5000, "nested too deeply"),
        ("a = " + "{a = " * 5000 + "1" + "}" * 5000, "nested too deeply"),
        ("a = " + "[" * 40 + "]" * 40, "is nested more than 32 deep"),
        (".".join(["a"] * 50_000) + " = 1", "a key in line 1 has 64 parts or more"),
        ("x = 1\n[" + " . ".join(['"a"'] * 50_000) + "]", "a key in line 2 has 64 parts or more"),
        ("a.b = " + "9" * 5000, "Exceeds the limit"),
        ("a.b = [0, 1e999]", "'1e999' is beyond the largest number"),
        ("a.b = 99999999999999999999", r"a\.b = 99999999999999999999 is outside \[-2\^63, 2\^64\)"),
        ("a.b = [07:32:00]", r"a\.b\[0\] = 07:32:00 is a date or a time of day"),
        ("a = 1979-05-27", "a = 1979-05-27 is a date"),
        ('a = "b\\u0000c"', "a = 'b.x00c' holds a NUL"),
        ("a = 1\na = 2", "not valid TOML"),
    ],
)
def test_what_no_field_takes_is_refused_with_its_key_and_file(text, problem):
    with pytest.raises(ConfigError, match=problem) as caught:
        parse_toml(text, source="scene.toml")
    assert str(caught.value).startswith("scene.toml: ") and len(str(caught.value)) < 300


def test_long_texts_are_no_keys_and_json_that_is_nested_too_deeply_is_refused():
    text = "a.b = " + repr("x." * 60) + "\nc = [" + "1.5, " * 1000 + "]\n"
    assert parse_toml(text)["c"][-1] == 1.5
    with pytest.raises(ValueError, match="nested too deeply"):
        parse_json("[" * 100_000)


def test_files_that_are_none_are_named(tmp_path):
    assert file_problem(__file__) is None
    assert file_problem(tmp_path) == "is not a file"
    assert file_problem(tmp_path / "none") == "no such file"
    assert file_problem("a\0b") == "no such file"
    assert file_problem("x" * 300) == "cannot be read: File name too long"
    for name, problem in ((tmp_path, "Is a directory"), ("x" * 300, "too long"), ("a\0b", "no name of a file")):
        with pytest.raises(FileError, match=problem):
            read_text(name)
    with pytest.raises(FileError, match="/dev/zero: has more than 100 bytes"):
        read_text("/dev/zero", largest=100)


def test_columns_may_have_a_title_comments_and_more_columns(tmp_path):
    path = tmp_path / "table.csv"
    path.write_text("# from a paper\ntime,value,error\n0,1,0.1\n\n 1.5 ,2e0\n")
    assert read_columns(path, {"time": "[0, 2]", "value": "[0, 2]"}).tolist() == [[0, 1], [1.5, 2]]
    path.write_bytes("time (ns),Größe\n1,2\n".encode())
    with pytest.raises(ConfigError, match=r"line 1: 'time \(ns\)' has another unit than the column, time_ps"):
        read_columns(path, {"time_ps": "[0, 2]", "value": "[0, 2]"})
    path.write_bytes("Größe".encode("latin-1"))
    with pytest.raises(FileError, match="save it as UTF-8"):
        read_text(path)


def test_files_may_have_names_that_are_not_unicode(tmp_path):
    path = tmp_path / "a\udcff.exr"
    written = write_exr(path, {"Z": np.ones((2, 3), np.float32)})
    assert written.read_bytes()[:4] == b"\x76\x2f\x31\x01"
