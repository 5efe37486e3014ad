"""`spadwarp merge`: runs added up."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say
from spadwarp.cli.simulate import described


@app.command()
def merge(
    runs: Annotated[
        list[Path],
        typer.Argument(metavar="RUN...", help="Results, or their directories.", show_default=False),
    ],
    out: opt.Out,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Add runs of one scene and seed that traced different photons.

    The sum has the same bits as one run of all photons. Writes the same files as `spadwarp simulate`.

    \b
    Example:
      spadwarp simulate configs/scenes/plane_5m.toml --photons 1e8 --out a/
      spadwarp simulate configs/scenes/plane_5m.toml --photons 1e8 --first-photon 1e8 --out b/
      spadwarp merge a/ b/ --out ab/
    """
    from spadwarp.files import RUN_FILES, bytes_needed, write_run

    result = spadwarp.merge(opt.load_run(place) for place in runs)
    needed = bytes_needed(result.scene, batches=result.batch_size > 0, derivatives=len(result.derivatives))
    outputs = opt.check_outputs(
        out, RUN_FILES, json=json_path, inputs=(*runs, *result.scene.files), overwrite=overwrite, needed=needed
    )
    files = write_run(result, out, device=device)
    if not quiet:
        ids = ", ".join(f"{opt.count(start)} to {opt.count(stop - 1)}" for start, stop in result.photon_ranges)
        say(opt.rows({"photon ids": ids}))
        say(described(result, files))
    outputs.write_json({**result.summary(), "photon_ranges": result.photon_ranges, "files": files.written})
