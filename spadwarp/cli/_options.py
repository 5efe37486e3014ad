"""Options that commands share, with the same meaning in every command, and how they are read."""

from __future__ import annotations

import enum
import math
import re
from collections.abc import Callable
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import spadwarp
from spadwarp.cli._outputs import Json, Out, Outputs, Overwrite, check_outputs, in_bytes  # noqa: F401
from spadwarp.limits import parse_number, shown
from spadwarp.units import quantity

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp import Ray, Result, Scene


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


def in_unit(unit: str) -> Callable[[str | float], float]:
    """A parser for a number in the unit, bare or with a unit of its own: `0.01` or `1cm` for m."""

    def parse(text: str | float) -> float:
        word = str(text).strip()
        try:
            return real_number(word) if word[-1:] in "0123456789." else quantity(word, unit)
        except ValueError as error:
            raise typer.BadParameter(f"{shown(text)} {error}") from None

    parse.__name__ = unit
    return parse


length, duration = in_unit("m"), in_unit("s")


def from_to(text: str, unit: str, option: str) -> tuple[float, float]:
    """Two numbers of the unit from `2:3`, `2,3` or `80cm:1.2m`; both have a unit of their own, or none of them."""
    parts = [part.strip() for part in re.split("[:,]", text)]
    try:
        if len(parts) != 2 or "" in parts:
            raise typer.BadParameter(f"{shown(text)} is not FROM:TO, two numbers such as 2:3 or 2{unit}:3{unit}")
        first, second = map(in_unit(unit), parts)
        bare = [part[-1] in "0123456789." for part in parts]
        if bare[0] != bare[1]:
            with_unit, without = parts[bare.index(False)], parts[bare.index(True)]
            raise typer.BadParameter(
                f"{shown(text)} is ambiguous: {with_unit} has a unit and {without} has none; write the unit of both"
            )
        if first > second:
            raise typer.BadParameter(f"{shown(text)} is FROM:TO; {parts[0]} is more than {parts[1]}")
    except typer.BadParameter as error:
        error.param_hint = option
        raise
    return first, second


ScenePath = Annotated[Path, typer.Argument(metavar="SCENE", help="Scene file (TOML).", show_default=False)]
Mesh = Annotated[
    Path | None,
    typer.Option(
        metavar="FILE",
        help="A mesh (STL, OBJ, PLY, OFF, GLB, USD) that replaces the scene's first target, with the same position, "
        "rotation and reflectance; in metres, or in millimetres with --set 'targets[0].scale=0.001'.",
    ),
]
Overrides = Annotated[
    list[str] | None,
    typer.Option("--set", metavar="SECTION.FIELD=VALUE", help="Overrides a field of the scene; may be repeated."),
]
Photons = Annotated[
    int | None,
    typer.Option(parser=whole_number, metavar="N", help="Photons to emit, such as 2e9. By default the scene's."),
]
Seed = Annotated[
    int | None,
    typer.Option(parser=whole_number, metavar="N", help="Key of the random numbers. By default the scene's."),
]
Device = Annotated[
    str | None,
    typer.Option(metavar="NAME", help='"cpu", "cuda:0", ...; by default the first GPU, else the CPU.'),
]
Devices = Annotated[
    str | None,
    typer.Option(
        "--device",
        metavar="NAME",
        help='"cpu", "cuda:0", "cuda:0,cuda:2", "cuda:all" for every GPU of this host; by default the first GPU, else '
        "the CPU.",
    ),
]
EngineName = Annotated[
    str,
    typer.Option("--engine", metavar="NAME", help='"local" for the devices of this host, "ray" for workers of Ray.'),
]
RayAddress = Annotated[
    str | None,
    typer.Option(
        metavar="HOST:PORT", help='A running Ray cluster, or "auto"; by default Ray is started on this machine.'
    ),
]
Workers = Annotated[
    int | None,
    typer.Option(
        parser=whole_number,
        metavar="N",
        help="Workers of Ray; by default one for each GPU, or one for each machine without a GPU.",
    ),
]
Threads = Annotated[
    int | None, typer.Option(parser=whole_number, metavar="N", help="CPU threads; by default one for each core.")
]
Quiet = Annotated[bool, typer.Option("--quiet", "-q", help="Print only warnings and errors.")]
TorchDevice = Annotated[
    str | None,
    typer.Option("--device", metavar="NAME", help='"cpu", "cuda:0", ...; by default the first GPU, else the CPU.'),
]
RunOrFrames = Annotated[
    Path,
    typer.Argument(
        metavar="RUN",
        help="A result, frames, an analytic file, a dataset or a shard of one; or their directory.",
        show_default=False,
    ),
]
Frame = Annotated[int, typer.Option(parser=whole_number, metavar="N", help="Number of the frame, if RUN holds frames.")]


class Estimator(enum.StrEnum):
    """`spadwarp.frames.METHODS`, known without loading it."""

    peak = "peak"
    centroid = "centroid"
    matched = "matched"
    likelihood = "likelihood"


class Channel(enum.StrEnum):
    """`spadwarp.result.CHANNELS`, known without loading them."""

    I = "I"
    co = "co"
    cross = "cross"


ChannelName = Annotated[
    Channel,
    typer.Option(
        "--channel",
        help="Which light counts where the camera has an analyser: I (all of it, without the analyser), co or cross.",
    ),
]


def read_scene(
    path: Path, *, mesh: Path | None, overrides: list[str] | None, photons: int | None = None, seed: int | None = None
) -> Scene:
    """The scene with the options applied: first `--mesh`, then `--set`, then the others."""
    if mesh is None:
        scene = spadwarp.load_scene(path, overrides)
    else:
        # What sized the old target says nothing about the new one.
        replaced = {"targets[0]": {"mesh": str(mesh), "scale": None, "subdivisions": None}}
        scene = spadwarp.load_scene(path, replaced).with_overrides(overrides or [])
    given = {"photons": photons, "seed": seed}
    return scene.with_overrides(transport={name: value for name, value in given.items() if value is not None})


def read_engine(name: str, address: str | None, workers: int | None) -> Ray | None:
    """The value for `engine=`."""
    if name not in ("local", "ray"):
        raise typer.BadParameter(f"{name!r} is not local or ray", param_hint="--engine")
    if name == "ray":
        return spadwarp.Ray(address, workers)
    for option, value in {"--ray-address": address, "--workers": workers}.items():
        if value is not None:
            raise typer.BadParameter("needs --engine ray", param_hint=option)
    return None


def one_device(devices: str | None, engine: Ray | None) -> str | None:
    """The device for the work after a run that needs one device."""
    if devices is None or engine is not None:
        return None
    return "cuda:0" if devices == "cuda:all" else devices.split(",")[0]


def load_run(place: Path, channel: Channel = Channel.I) -> Result:
    """The result in a file, or in the directory of a run; a checkpoint where there is no result."""
    path = spadwarp.files.locate(place)
    result = spadwarp.load_result(place / "result.h5" if path.is_dir() else path)
    return spadwarp.result.analyser_channel(result, channel.value)


def read_part(text: str | None, option: str) -> tuple[int, int] | None:
    """The numbers of `3/64`, which Python checks."""
    if text is None:
        return None
    number, _, parts = text.partition("/")
    if not (number.isdecimal() and parts.isdecimal()):
        raise typer.BadParameter(f"{text!r} is not a part such as 3/64", param_hint=option)
    return int(number), int(parts)


# Numbers for people


def count(number: float) -> str:
    """2 000 000"""
    return f"{number:,.0f}".replace(",", " ")


def rows(table: dict[str, str], *, indent: str = "") -> str:
    """Names and values in two columns."""
    width = max(map(len, table), default=0)
    return "\n".join(f"{indent}{name:<{width}}  {value}".rstrip() for name, value in table.items())


def show_table(table: Table, *, keys: int = 1) -> None:
    """A table on stdout, as wide as the terminal; 160 columns elsewhere.

    One that is wider is printed in several parts, each with the first `keys` columns, so that no number is cut off.
    """
    from rich.console import Console

    from spadwarp.cli._tables import parts

    console = Console(highlight=False, markup=False)  # "[m]" is a unit
    if not console.is_terminal:
        console = Console(highlight=False, markup=False, width=160)
    for part in parts(table, console, keys):
        console.print(part)
