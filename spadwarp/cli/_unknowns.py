"""Options that `fit` and `crlb` share."""

from __future__ import annotations

from typing import Annotated

import typer

from spadwarp.cli._options import real_number

UnknownNames = Annotated[
    str,
    typer.Option(
        metavar="NAMES",
        help="What is unknown, with commas between: absorption, scattering, anisotropy, reflectance (or "
        "targets[0].reflectance), background, depth. ':pixel' behind one of the last three gives each pixel its own.",
        show_default=False,
    ),
]
Prior = Annotated[
    list[str] | None,
    typer.Option(
        metavar="NAME=MEAN,SD", help="What is known from elsewhere: mean and standard deviation; may be repeated."
    ),
]


def pairs(texts: list[str] | None, numbers: int, option: str) -> dict[str, tuple[float, ...]]:
    """Name and so many numbers from texts such as `medium.anisotropy=0.92,0.01`."""
    found = {}
    for text in texts or []:
        name, _, values = text.partition("=")
        parts = values.split(",")
        if not values or len(parts) != numbers:
            shape = "NAME=MEAN,SD" if numbers == 2 else "NAME=VALUE"
            raise typer.BadParameter(f"{text!r} is not {shape}", param_hint=option)
        try:
            found[name.strip()] = tuple(real_number(part.strip()) for part in parts)
        except typer.BadParameter as error:
            error.param_hint = option
            raise
    return found
