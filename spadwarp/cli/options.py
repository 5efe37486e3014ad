"""Commands from functions: options from a signature, their help from its docstring; and how values are read."""

from __future__ import annotations

import inspect
import math
import re
import tomllib
from collections.abc import Callable, Mapping, Sequence
from decimal import Decimal, InvalidOperation
from functools import partial
from importlib.resources import files
from pathlib import Path
from types import UnionType
from typing import TYPE_CHECKING, Annotated, Any, Literal, Union, get_args, get_origin, get_type_hints

import typer

import spadwarp
from spadwarp.cli.app import Command, app, complain, running, wrong
from spadwarp.values import parse_number, quantity, shown, suggestion

if TYPE_CHECKING:
    from spadwarp import Ray, Result, Scene

Method = Literal["peak", "centroid", "matched", "likelihood"]
"""`spadwarp.frames.METHODS`, known without loading it."""
Channel = Literal["I", "co", "cross", "raman", "fluorescence"]
"""`spadwarp.result.CHANNELS`, known without loading it."""

SHARED = tomllib.loads((files("spadwarp.cli") / "options.toml").read_text(encoding="utf-8"))
"""Options that mean the same in every command."""
_COMMON = {"overwrite": bool, "quiet": bool, "json": Path | None}


def command(*, name: str | None = None, prints_result: bool = False) -> Callable[[Callable[..., None]], Any]:
    """Makes a command of a function: its parameters become arguments, those behind `*` options.

    Kinds and defaults come from the signature; an annotated function reads the text. Metavar and help are those of the
    docstring's section `Args`, `parameter (METAVAR): help`, else of `SHARED`. A trailing "_" is no part of an option's
    name. Each command has --overwrite, --quiet and --json, which `running` holds; `prints_result`: also with --quiet.
    """

    def register(function: Callable[..., None]) -> Callable[..., None]:
        text, described = _documentation(function)
        hints = {**_COMMON, **get_type_hints(function, include_extras=True)}
        made, names = [], {}
        common = [
            inspect.Parameter(one, inspect.Parameter.KEYWORD_ONLY, default=False if kind is bool else None)
            for one, kind in _COMMON.items()
        ]
        for one in (*inspect.signature(function).parameters.values(), *common):
            shared = SHARED.get(one.name, {})
            metavar, about = described.get(one.name, (shared.get("metavar", ""), shared.get("help", "")))
            long = shared.get("option", "--" + one.name.rstrip("_").replace("_", "-"))
            names[one.name] = long if one.kind is inspect.Parameter.KEYWORD_ONLY else metavar.strip("[]")
            made.append(_parameter(one, hints[one.name], metavar, about, names[one.name]))

        def run(context: typer.Context, **values: Any) -> None:
            for common in _COMMON:
                setattr(running, common, values.pop(common, None))
            running.prints_result = prints_result
            source = context.get_parameter_source
            running.given = frozenset(names[one] for one in values if getattr(source(one), "name", "") != "DEFAULT")
            function(**{one: _plain(value) for one, value in values.items()})

        run.__doc__ = text
        here = inspect.Parameter("context", inspect.Parameter.KEYWORD_ONLY, annotation=typer.Context)
        vars(run)["__signature__"] = inspect.Signature([here, *made])
        app.command(name or function.__name__, cls=Command)(run)
        return function

    return register


def _documentation(function: Callable[..., None]) -> tuple[str, dict[str, tuple[str, str]]]:
    """The docstring without its section `Args`, and of each parameter there metavar and help."""
    before, _, rest = inspect.cleandoc(function.__doc__ or "").partition("\nArgs:\n")
    section, _, after = rest.partition("\n\n")
    found = re.findall(r"^ {4}(\w+)(?: \((.+?)\))?: (.*(?:\n {8,}.*)*)", section, re.MULTILINE)
    return f"{before}\n{after}", {name: (metavar, " ".join(text.split())) for name, metavar, text in found}


def _parameter(one: inspect.Parameter, kind: Any, metavar: str, text: str, name: str) -> inspect.Parameter:
    """The parameter as typer takes it."""
    inner = get_args(kind)[0] if get_origin(kind) in (Union, UnionType) else kind
    repeated = get_origin(inner) is list
    item: Any = get_args(inner)[0] if repeated else inner
    extra: dict[str, Any] = {"help": text}
    if get_origin(item) is Annotated:
        item, extra["parser"] = get_args(item)
        repeated = repeated or get_origin(item) is dict
    elif item in (int, float):
        extra["parser"] = whole_number if item is int else real_number
    elif get_origin(item) is Literal:
        words = get_args(item)
        metavar, extra["parser"] = metavar or "|".join(words), partial(_word, words)
    kinds: dict[Any, str] = {int: "N", float: "X", Path: "PATH" if repeated else "FILE", str: "NAME"}
    extra["metavar"] = metavar or kinds.get(item)
    if "parser" in extra and item is not float:  # which decides what typer makes of the text
        item = str
    if one.default in (None, inspect.Parameter.empty):
        extra["show_default"] = False
    if one.kind is not inspect.Parameter.KEYWORD_ONLY:
        about: Any = typer.Argument(**extra)
    else:
        pair = one.default is True or (inner is bool and one.default is None)
        names = [f"{name}/--no-{name[2:]}"] if pair else [name]
        about = typer.Option(*names, *(["-q"] if one.name == "quiet" else []), **extra)
    annotation = Annotated[list[item] if repeated else item, about]  # type: ignore[valid-type]
    return one.replace(kind=inspect.Parameter.KEYWORD_ONLY, annotation=annotation)


def _plain(value: Any) -> Any:
    """The tables of a repeated option as one."""
    if isinstance(value, list):
        tables = [item for item in value if isinstance(item, dict)]
        return {name: item for table in tables for name, item in table.items()} if tables else value
    return value


# Values, each read from its text; what is wrong with them is a `typer.BadParameter`


def _word(known: Sequence[str], text: str) -> str:
    """One of the known words."""
    if text not in known:
        raise typer.BadParameter(f"{shown(text)} is not one of {', '.join(known)}{suggestion(text, known)}")
    return text


def whole_number(text: str | int) -> int:
    """An integer from `2000000`, `2_000_000`, `2e6` or `2.0e6`."""
    try:
        value = Decimal(text)
    except InvalidOperation:
        value = Decimal("nan")
    if not value.is_finite() or value.adjusted() > 30 or value != value.to_integral_value():
        raise typer.BadParameter(f"{text!r} is not a whole number, such as 2000000 or 2e6")
    return int(value)


def real_number(text: str | float) -> float:
    """A finite number, such as `0.02` or `1e-3`."""
    try:
        number = parse_number(str(text))
    except ValueError as error:
        raise typer.BadParameter(f"{shown(text)} {error}") from None
    if math.isinf(number):
        raise typer.BadParameter(f"{text} is not a finite number")
    return number


def from_unit(unit: str, bare: float = math.inf) -> Callable[[str | float], float]:
    """A number in the unit, or with one of its own: `0.01` or `1cm` for m; a bare one above `bare` is not meant so."""

    def parse(text: str | float) -> float:
        word = str(text).strip()
        try:
            number = real_number(word) if word[-1:] in "0123456789." else quantity(word, unit)
        except ValueError as error:
            raise typer.BadParameter(f"{shown(text)} {error}") from None
        if word[-1:] in "0123456789." and number > bare:
            raise typer.BadParameter(
                f"{word} without a unit is in {unit}; write the unit, such as {word}m{unit} or {word}{unit}"
            )
        return number

    return parse


def from_to(unit: str) -> Callable[[str], tuple[float, float]]:
    """Two numbers of the unit from `2:3`, `2,3` or `80cm:1.2m`; both have a unit of their own, or none of them."""

    def parse(text: str) -> tuple[float, float]:
        parts = [part.strip() for part in re.split("[:,]", text)]
        if len(parts) != 2 or "" in parts:
            raise typer.BadParameter(f"{shown(text)} is not FROM:TO, two numbers such as 2:3 or 2{unit}:3{unit}")
        first, second = map(from_unit(unit), parts)
        bare = [part for part in parts if part[-1] in "0123456789."]
        if len(bare) == 1:
            (other,) = {*parts} - {*bare}
            problem = f"{other} has a unit and {bare[0]} has none; write the unit of both"
            raise typer.BadParameter(f"{shown(text)} is ambiguous: {problem}")
        if first > second:
            raise typer.BadParameter(f"{shown(text)} is FROM:TO; {parts[0]} is more than {parts[1]}")
        return first, second

    return parse


def items(readers: Mapping[str, Callable[[str], Any]]) -> Callable[[str], dict[str, Any]]:
    """Values by name from `NAME=VALUE,NAME=VALUE`, each read by the reader of its name; a bare name is true."""

    def parse(text: str) -> dict[str, Any]:
        found: dict[str, Any] = {}
        for one in re.split(r",(?=\s*[a-z_]+\s*(?:=|,|$))", text):
            name, equals, value = (part.strip() for part in one.partition("="))
            if name not in readers:
                hint = suggestion(name, [*readers])
                raise typer.BadParameter(f"{shown(name)} is not one of {', '.join(readers)}{hint}")
            if bool(equals) == (readers[name] is bool):
                raise typer.BadParameter(f"{shown(one)} is not of the form {name if equals else f'{name}=VALUE'}")
            try:
                found[name] = readers[name](value) if equals else True
            except typer.BadParameter as error:
                raise typer.BadParameter(f"{name} = {error.message}") from None
        return found

    return parse


def numbers(form: str) -> Callable[[str], dict[str, Any]]:
    """A name and the numbers of the form, such as `NAME=MEAN,SD`; one number alone is no tuple."""

    def parse(text: str) -> dict[str, Any]:
        name, _, values = text.partition("=")
        parts = values.split(",")
        if not values or len(parts) != len(form.split(",")):
            raise typer.BadParameter(f"{text!r} is not {form}")
        read = tuple(real_number(part.strip()) for part in parts)
        return {name.strip(): read if len(read) > 1 else read[0]}

    return parse


def _photons(text: str) -> int | Literal["auto"]:
    return "auto" if text == "auto" else whole_number(text)


def _part(text: str) -> tuple[int, int]:
    number, _, parts = text.partition("/")
    if not (number.isdecimal() and parts.isdecimal()):
        raise typer.BadParameter(f"{text!r} is not a part such as 3/64")
    return int(number), int(parts)


def _size(text: str) -> tuple[int, int]:
    """(height, width) of "640x480"."""
    found = re.fullmatch(r"([1-9][0-9]{0,4})[x×]([1-9][0-9]{0,4})", text.strip())
    if found is None:
        raise typer.BadParameter(f"{text!r} is not of the form WIDTHxHEIGHT")
    return int(found[2]), int(found[1])


def number_or_text(text: str) -> float | str:
    """A number, or any other text."""
    try:
        return parse_number(text)
    except ValueError:
        return text


Length = Annotated[float, from_unit("m")]
DepthError = Annotated[float, from_unit("m", bare=0.2)]
Seconds = Annotated[float, from_unit("s")]
Photons = Annotated[int, _photons]
"""A whole number, or "auto"."""
Part = Annotated[tuple[int, int], _part]
"""`3/64`; Python checks the range."""


def _response(text: str) -> Any:
    """The instrument response of --input; that of a file is read when all values are known."""
    if Path(text).suffix.lower() in (".csv", ".npy"):
        return Path(text)
    return spadwarp.frames.instrument_response(pulse_fwhm=0.0, jitter_fwhm=from_unit("s")(text))


# Names of --input and their readers: arguments of `spadwarp.frames.read_histograms`.
MEASURED: dict[str, Callable[[str], Any]] = {"bin_width": from_unit("s"), "gate_start": from_unit("s")}
MEASURED |= {"irf": _response, "axes": str, "dataset": str, "image_size": _size}
MEASURED |= {"tag_unit": from_unit("s"), "sum_frames": bool}
Measured = Annotated[dict[str, Any], items(MEASURED)]


def read_measured(values: dict[str, Any] | None) -> tuple[dict[str, Any], list[Path]]:
    """The values of --input with the instrument response read, and the files that they name."""
    found = values or {}
    if not isinstance(path := found.get("irf"), Path):
        return found, []
    return {**found, "irf": spadwarp.frames.read_response(path, bin_width=found.get("bin_width"))}, [path]


def refuse(text: str, *options: str) -> None:
    """Refuses those of the options that are given."""
    if wrong := [option for option in options if option in running.given]:
        raise typer.BadParameter(text, param_hint=", ".join(wrong))


def given(**values: Any) -> dict[str, Any]:
    """The arguments that have a value."""
    return {name: value for name, value in values.items() if value is not None}


# What commands read


def read_scene(
    path: Path,
    overrides: list[str] | None = None,
    *,
    mesh: Path | None = None,
    photons: int | Literal["auto"] | None = None,
    seed: int | None = None,
) -> Scene:
    """The scene with the options applied: first `--mesh`, then `--set`, then the others."""
    if mesh is None:
        scene = spadwarp.load_scene(path, overrides)
    else:
        # What sized the old target says nothing about the new one.
        replaced = {"targets[0]": {"mesh": str(mesh), "scale": None, "subdivisions": None}}
        scene = spadwarp.load_scene(path, replaced).with_overrides(overrides or [])
    return scene.with_overrides(transport=given(photons=photons, seed=seed))


def warn_of(scene: Scene) -> None:
    """Shows what is implausible in a scene that its command does not check."""
    for message in spadwarp.checks.implausible(scene):
        complain(str(message))


def load_run(place: Path, channel: Channel = "I") -> Result:
    """The result in a file, or in the directory of a run; a checkpoint where there is no result."""
    path = spadwarp.files.locate(place)
    result = spadwarp.result.load_result(place / "result.h5" if path.is_dir() else path)
    return spadwarp.result.analyser_channel(result, channel)


def read_engine(address: str | None, workers: int | None) -> Ray | None:
    """The argument `engine` from --ray and --workers."""
    if address is not None:
        return spadwarp.Ray(None if address == "start" else address, workers)
    if workers is not None:
        wrong("needs --ray", "--workers")
    return None
