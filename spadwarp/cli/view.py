"""`spadwarp view`: a run as a page for a browser."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say


@app.command()
def view(
    run: opt.RunOrFrames,
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page to write.")] = Path("view.html"),
    method: Annotated[
        str | None,
        typer.Option(metavar="NAME", help='Estimator of depth: "peak", "centroid", "matched" or "likelihood".'),
    ] = None,
    frame: opt.Frame = 0,
    channel: opt.ChannelName = opt.Channel.I,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:
    """A run as one HTML file: click a pixel to see its histogram.

    Depth as a point cloud coloured by its error; depth, truth, error and intensity as images; the histogram of a pixel
    with its components and the instrument response. Opens in any browser, without a network connection.

    \b
    Examples:
      spadwarp view out/
      spadwarp view frames/frames.h5 --frame 3 --out frame.html
    """
    opt.check_outputs(files={"--out": out}, inputs=(run,), overwrite=overwrite)
    path = spadwarp.viz.view(run, out, method=method, frame=frame, channel=channel.value, device=device)
    if not quiet:
        say(f"written: {path} ({opt.in_bytes(path.stat().st_size)})")
