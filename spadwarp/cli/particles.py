"""`spadwarp particles`: scattering and phase function of particles in water."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say
from spadwarp.errors import ArgumentError

if TYPE_CHECKING:
    from spadwarp.water import ParticleOptics, SizeDistribution


def _number(text: str, metavar: str = "X") -> typer.models.OptionInfo:
    option: typer.models.OptionInfo = typer.Option(
        parser=opt.real_number, metavar=metavar, help=text, show_default=False
    )
    return option


def _length(text: str) -> typer.models.OptionInfo:
    option: typer.models.OptionInfo = typer.Option(parser=opt.in_unit("m"), metavar="D", help=text, show_default=False)
    return option


@app.command()
def particles(
    wavelength_nm: Annotated[
        float, typer.Argument(parser=opt.in_unit("nm"), metavar="NM", help="Vacuum wavelength, 400 to 700 [nm].")
    ],
    out: Annotated[
        Path | None,
        typer.Option(metavar="FILE", help="The phase function as .csv, for medium.phase_table.", show_default=False),
    ] = None,
    matrix: Annotated[
        Path | None,
        typer.Option(
            metavar="FILE", help="Mie: the scattering matrix as .csv, for medium.matrix_table.", show_default=False
        ),
    ] = None,
    small: Annotated[float | None, _number("Kopelevich: mineral particles below 1 um [ppm].")] = None,
    large: Annotated[float | None, _number("Kopelevich: organic particles above 1 um [ppm].")] = None,
    index: Annotated[float | None, _number("Mie: index over that of the water, such as 1.05 or 1.15.", "N")] = None,
    absorbing: Annotated[float, _number("Mie: imaginary part of that index, 0 to 0.01.", "K")] = 0.0,
    concentration: Annotated[float | None, _number("Mie: volume of the particles [ppm].", "PPM")] = None,
    slope: Annotated[float | None, _number("Mie: power law of diameters, mostly near 4.")] = None,
    smallest: Annotated[float | None, _length("Of the power law, such as 0.1um [m].")] = None,
    largest: Annotated[float | None, _length("Of the power law, such as 50um [m].")] = None,
    median: Annotated[float | None, _length("Mie: log-normal diameters, median of the number [m].")] = None,
    deviation: Annotated[float | None, _number("Of the log-normal law: geometric standard deviation, > 1.")] = None,
    diameter: Annotated[float | None, _length("Mie: particles of one diameter [m].")] = None,
    temperature: Annotated[float, _number("Of the water [degrees Celsius].", "T")] = 20.0,
    salinity: Annotated[float, _number("Of the water [g/kg].", "S")] = 35.0,
    water: Annotated[bool, typer.Option("--water/--no-water", help="Add the water's own optics.")] = True,
    overwrite: opt.Overwrite = False,
    json_path: opt.Json = None,
) -> None:
    """Scattering, absorption and phase function from particle sizes.

    Either in two components after Kopelevich (--small, --large), or by Mie's theory (--index, --concentration and a law
    of sizes), which needs miepython: pip install 'spadwarp[mie]'.

    \b
    Examples:
      spadwarp particles 532 --small 0.05 --large 0.2 --out coast.csv
      spadwarp particles 532 --index 1.1 --absorbing 5e-4 --concentration 1 --slope 4 --smallest 0.1um --largest 50um
      spadwarp particles 532 --index 1.19 --concentration 2 --diameter 3um
    """
    outputs = opt.check_outputs(files={"--out": out, "--matrix": matrix}, json=json_path, overwrite=overwrite)
    mie = {"--index": index, "--concentration": concentration}
    if (small is None and large is None) == (index is None):
        raise typer.BadParameter("give --small and --large, or --index with --concentration and sizes")
    others = {"--slope": slope, "--smallest": smallest, "--largest": largest, "--median": median}
    others |= {"--deviation": deviation, "--diameter": diameter, "--concentration": concentration}
    if index is None and (given := [name for name, value in others.items() if value is not None]):
        raise typer.BadParameter(f"goes with --index, not with --small and --large: {', '.join(given)}")
    for option, field, file in (("--out", "phase_table", out), ("--matrix", "matrix_table", matrix)):
        if file is not None and file.suffix.lower() != ".csv":
            raise typer.BadParameter(f"{file} does not end in .csv, as medium.{field} must", param_hint=option)
    if index is None and matrix is not None:
        raise typer.BadParameter("goes with --index: Kopelevich's components have no matrix", param_hint="--matrix")
    if index is None:
        parts = spadwarp.water.kopelevich_particles(wavelength_nm, small=small or 0.0, large=large or 0.0)
        text = f"Kopelevich, {small or 0:g} ppm below and {large or 0:g} ppm above 1 um"
    else:
        if concentration is None:
            raise typer.BadParameter("is missing", param_hint="--concentration")
        sizes = _sizes(slope, smallest, largest, median, deviation, diameter)
        parts = spadwarp.water.mie_particles(
            sizes,
            wavelength_nm,
            index=complex(index, absorbing),
            concentration=concentration,
            temperature=temperature,
            salinity=salinity,
        )
        text = f"Mie, {mie['--concentration']:g} ppm of index {index:g}, {sizes.text}"
    whole = spadwarp.water.mixture([parts], water=water, temperature=temperature, salinity=salinity)
    say(opt.rows({"particles": text, **_lines(whole)}))
    if out is not None:
        spadwarp.water.save_phase_table(whole, out)
        say(f"written: {out}; in the scene:\n{_toml(whole, out)}")
    if matrix is not None:
        spadwarp.water.save_matrix_table(whole, matrix)
        say(f"written: {matrix}; in the scene, for polarised light:\n{_matrix_toml(matrix)}")
    outputs.write_json(
        {
            "wavelength_nm": wavelength_nm,
            **{name: getattr(whole, name) for name in _NAMES},
            "water": water,
            "file": out,
            "matrix_file": matrix,
        }
    )


_NAMES = ("absorption", "scattering", "extinction", "albedo", "mean_cosine", "backscatter_fraction")


def _sizes(
    slope: float | None,
    smallest: float | None,
    largest: float | None,
    median: float | None,
    deviation: float | None,
    diameter: float | None,
) -> SizeDistribution:
    """The law of sizes that the options give."""
    given = {"--slope": slope, "--median": median, "--diameter": diameter}
    if sum(value is not None for value in given.values()) != 1:
        raise typer.BadParameter("one law of sizes is needed: --slope, --median or --diameter")
    if slope is not None:
        if smallest is None or largest is None:
            raise typer.BadParameter("goes with --smallest and --largest", param_hint="--slope")
        return spadwarp.water.power_law(slope, smallest=smallest, largest=largest)
    if median is not None:
        if deviation is None:
            raise typer.BadParameter("goes with --deviation", param_hint="--median")
        return spadwarp.water.log_normal(median, deviation=deviation)
    if diameter is None:
        raise ArgumentError("diameter is missing")
    return spadwarp.water.single_size(diameter)


def _lines(optics: ParticleOptics) -> dict[str, str]:
    return {
        "absorption": f"{optics.absorption:.4g} 1/m",
        "scattering": f"{optics.scattering:.4g} 1/m",
        "extinction": f"{optics.extinction:.4g} 1/m, attenuation length {1.0 / optics.extinction:.4g} m",
        "albedo": f"{optics.albedo:.4g}",
        "mean cosine": f"{optics.mean_cosine:.4g}",
        "scattered by more than 90°": f"{optics.backscatter_fraction:.4g}",
    }


def _toml(optics: ParticleOptics, path: Path) -> str:
    return (
        "[medium]\n"
        f"absorption = {optics.absorption:.6g}\n"
        f"scattering = {optics.scattering:.6g}\n"
        'phase_function = "tabulated"\n'
        f'phase_table = "{path.as_posix()}"'
    )


def _matrix_toml(path: Path) -> str:
    return f'[medium]\nscattering_matrix = "tabulated"\nmatrix_table = "{path.as_posix()}"'
