"""`spadwarp water`: optical properties of water."""

from __future__ import annotations

import dataclasses
from typing import Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say


@app.command()
def water(
    wavelength_nm: Annotated[
        float, typer.Argument(parser=opt.in_unit("nm"), metavar="NM", help="Vacuum wavelength, 400 to 700 [nm].")
    ],
    chlorophyll: Annotated[
        float, typer.Option(parser=opt.real_number, metavar="C", help="0 (pure water) to 30 [mg/m3].")
    ] = 0.0,
    temperature: Annotated[
        float, typer.Option(parser=opt.real_number, metavar="T", help="0 to 30 [degrees Celsius].")
    ] = 20.0,
    salinity: Annotated[
        float, typer.Option(parser=opt.real_number, metavar="S", help="0 (fresh) to 40 [g/kg].")
    ] = 35.0,
    overwrite: opt.Overwrite = False,
    json_path: opt.Json = None,
) -> None:
    """Absorption, scattering and indices of water at a wavelength.

    A scene gets them by medium.chlorophyll, temperature and salinity.

    \b
    Example:
      spadwarp water 532 --chlorophyll 0.5 --temperature 10 --salinity 35
    """
    outputs = opt.check_outputs(json=json_path, overwrite=overwrite)
    optics = spadwarp.water.water_optics(
        wavelength_nm, chlorophyll=chlorophyll, temperature=temperature, salinity=salinity
    )
    say(
        opt.rows(
            {
                "absorption": f"{optics.absorption:.4g} 1/m, of pure water {optics.water_absorption:.4g}",
                "scattering": f"{optics.scattering:.4g} 1/m, of pure water {optics.water_scattering:.4g}",
                "extinction": f"{optics.extinction:.4g} 1/m, attenuation length {1.0 / optics.extinction:.4g} m",
                "albedo": f"{optics.albedo:.4g}",
                "phase index": f"{optics.phase_index:.5f}",
                "group index": f"{optics.group_index:.5f}",
            }
        )
    )
    asked = {"chlorophyll": chlorophyll, "temperature": temperature, "salinity": salinity}
    outputs.write_json({**asked, **dataclasses.asdict(optics), "extinction": optics.extinction})
