"""`spadwarp crlb`: how well one exposure can tell everything that is unknown."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, say
from spadwarp.cli._tables import new_table, short
from spadwarp.cli._unknowns import Prior, UnknownNames, pairs

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp.inverse import Bounds


@app.command()
def crlb(
    scene_path: opt.ScenePath,
    unknown: UnknownNames,
    pulses: Annotated[
        int | None,
        typer.Option(
            parser=opt.whole_number, metavar="N", help="Pulses of the exposure; by default detector.pulses_per_frame."
        ),
    ] = None,
    prior: Prior = None,
    photons: Annotated[
        int | None,
        typer.Option(
            parser=opt.whole_number, metavar="N", help="Photons at most. By default 2e7 on the CPU, 4e8 on a GPU."
        ),
    ] = None,
    seed: Annotated[int, typer.Option(parser=opt.whole_number, metavar="N", help="Key of the random numbers.")] = 0,
    overrides: opt.Overrides = None,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Cramér–Rao bounds of all unknowns together, from one exposure.

    The least standard deviation of any unbiased estimate, with pile-up, noise and instrument response: when everything
    that is named is unknown, and when all others are known. What not knowing the water costs in depth is the ratio.
    Of values of the pixels, the table shows the median of the pixels that see a target.

    \b
    Examples:
      spadwarp crlb harbour_5m --unknown depth,absorption,scattering
      spadwarp crlb staircase_5m --unknown depth:pixel,absorption,scattering,reflectance --pulses 1e6
    """
    scene = opt.read_scene(scene_path, mesh=None, overrides=overrides)
    outputs = opt.check_outputs(json=json_path, inputs=(scene_path, *scene.files), overwrite=overwrite)
    found = spadwarp.inverse.bounds(
        scene,
        unknown=unknown,
        pulses=pulses,
        prior={name: (mean, deviation) for name, (mean, deviation) in pairs(prior, 2, "--prior").items()},
        photons=photons,
        seed=seed,
        device=device,
    )
    for text in found.warnings:
        complain(f"warning: {text}")
    if not quiet:
        opt.show_table(_table(found))
        say(f"{opt.count(found.counts)} counts expected in {opt.count(found.pulses)} pulses")
    outputs.write_json(found.to_dict())


def _table(found: Bounds) -> Table:
    columns = [f"with\n{name}" for name in found.names[:-1]]
    table = new_table("unknown", "value", "bound", "bound [%]", "others\nknown", "ratio", *columns)
    for name, one in found.bounds.items():
        row = found.names.index(name) if name in found.names else -1
        correlations = [f"{x:+.3f}" for x in found.correlation[row, :row]] if row > 0 else []
        label = f"{name} [{one.unit}]" if one.unit else name
        table.add_row(
            f"{label}, median pixel" if one.per_pixel else label,
            "" if name == "depth" else f"{one.value:.4g}",
            short(one.standard_error),
            "" if one.relative != one.relative else f"{100 * one.relative:.3g}",
            short(one.alone),
            f"{one.standard_error / one.alone:.3g}",
            *correlations,
            *[""] * (len(columns) - len(correlations)),
        )
    return table
