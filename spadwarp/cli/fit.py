"""`spadwarp fit`: water, surfaces and depth from counts."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import spadwarp
from spadwarp.cli import _measured as measured
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, complain, say
from spadwarp.cli._progress import progress
from spadwarp.cli._tables import new_table
from spadwarp.cli._unknowns import Prior, UnknownNames, pairs
from spadwarp.units import percent, rounded

if TYPE_CHECKING:
    from rich.table import Table

    from spadwarp.inverse import EstimateMap, Fit


@app.command()
def fit(
    counts: Annotated[
        Path,
        typer.Argument(
            metavar="COUNTS",
            help="Frames (.h5, or their directory), or measured histograms: .npy, .mat, .h5, .ptu.",
            show_default=False,
        ),
    ],
    scene_path: opt.ScenePath,
    unknown: UnknownNames,
    out: opt.Out,
    start: Annotated[
        list[str] | None,
        typer.Option(
            metavar="NAME=VALUE",
            help="Where to start; may be repeated. By default absorption and scattering from the backscatter, the "
            "others from the scene.",
        ),
    ] = None,
    prior: Prior = None,
    pulses: Annotated[
        int | None,
        typer.Option(parser=opt.whole_number, metavar="N", help="Pulses of a frame, if COUNTS does not hold them."),
    ] = None,
    photons: Annotated[
        int | None,
        typer.Option(
            parser=opt.whole_number,
            metavar="N",
            help="Photons of an iteration at most. By default 2e7 on the CPU, 4e8 on a GPU.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(parser=opt.whole_number, metavar="N", help="Key of the random numbers.")] = 0,
    dataset: measured.Dataset = None,
    axes: measured.Axes = None,
    image_size: measured.ImageSize = None,
    tag_unit_ps: measured.TagUnit = None,
    bin_width_ps: measured.BinWidth = None,
    gate_start_ns: measured.GateStart = None,
    irf_fwhm_ps: measured.IrfFwhm = None,
    irf: measured.Irf = None,
    sum_frames: measured.SumFrames = False,
    overrides: opt.Overrides = None,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Water, reflectance, background and depth from counts, by maximum likelihood.

    The model is the whole chain: transport, instrument response, noise, pile-up or dead time. SCENE has the camera, the
    laser and all that is known. Writes fit.png (counts, fit, residuals), scene.toml (with the estimates), and NAME.npy
    and NAME_error.npy for each unknown of the pixels.

    \b
    Examples:
      spadwarp fit frames/ harbour_5m --unknown absorption,scattering,reflectance --out fit/
      spadwarp fit counts.npy scene.toml --pulses 1e6 --unknown absorption,scattering,depth:pixel \\
          --start medium.absorption=0.1 --out fit/
    """
    from spadwarp.files import fit_files, write_fit

    scene = opt.read_scene(scene_path, mesh=None, overrides=overrides)
    given = measured.facts(
        dataset, axes, image_size, tag_unit_ps, bin_width_ps, gate_start_ns, irf_fwhm_ps, irf, sum_frames
    )
    unknowns = spadwarp.inverse.read_unknowns(scene, unknown)
    outputs = opt.check_outputs(
        out,
        fit_files(unknowns),
        json=json_path,
        inputs=(counts, scene_path, irf, *scene.files),
        overwrite=overwrite,
        needed=16 << 20,
    )
    with progress(quiet=quiet) as report:
        found = spadwarp.fit(
            spadwarp.files.locate(counts),
            scene,
            unknown=unknown,
            initial_guess={name: value for name, (value,) in pairs(start, 1, "--start").items()} or None,
            prior={name: (mean, deviation) for name, (mean, deviation) in pairs(prior, 2, "--prior").items()},
            pulses=pulses,
            photons=photons,
            seed=seed,
            device=device,
            progress=report,
            **given,
        )
    for text in found.warnings:
        complain(f"warning: {text}")
    written = write_fit(found, out)
    if not quiet:
        if found.estimates:
            opt.show_table(_table(found))
        lines = {f"{name} of each pixel": _of_pixels(one) for name, one in found.maps.items()}
        lines["counts"] = f"{opt.count(found.counts.sum())} of {opt.count(found.pulses)} pulses"
        lines["fit"] = (
            f"{'converged' if found.converged else 'not converged'} after {len(found.iterations)} renderings of "
            f"{found.photons:.2e} photons in all, {found.seconds:.3g} s"
        )
        lines["written"] = ", ".join(path.name for path in written) + f" in {out}"
        say(opt.rows(lines))
    outputs.write_json({**found.to_dict(), "files": written})


def _table(found: Fit) -> Table:
    table = new_table("estimate", "value", "±", "95 % interval", "start", "noise of\nsimulation")
    for one in found.estimates.values():
        table.add_row(
            f"{one.name} [{one.unit}]" if one.unit else one.name,
            rounded(one.value, one.standard_error),
            f"{one.standard_error:.2g}",
            " to ".join(rounded(end, one.standard_error) for end in one.interval),
            rounded(one.initial_guess, one.standard_error),
            f"{percent(one.simulation)} %",
        )
    return table


def _of_pixels(one: EstimateMap) -> str:
    import numpy as np

    known = np.isfinite(one.value)
    if not known.any():
        return "known in none"
    median, error = (float(np.median(part[known])) for part in (one.value, one.standard_error))
    text = (
        f"known in {opt.count(known.sum())} of {opt.count(known.size)}; median {median:.5g}, standard error {error:.2g}"
    )
    return f"{text} {one.unit}".rstrip()
