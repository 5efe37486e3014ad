"""`spadwarp video`: light in flight as a video."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say


@app.command()
def video(
    run: opt.RunOrFrames,
    out: Annotated[
        Path, typer.Option(metavar="FILE", help="Name of the video, .gif or .mp4; .mp4 needs ffmpeg.")
    ] = Path("light.gif"),
    window: Annotated[
        str | None,
        typer.Option(metavar="FROM:TO", help="Times of flight, such as 40:55 [ns]; by default those with light."),
    ] = None,
    pictures: Annotated[
        int, typer.Option(parser=opt.whole_number, metavar="N", help="Largest number of pictures; bins are merged.")
    ] = 120,
    fps: Annotated[
        float, typer.Option(parser=opt.real_number, metavar="N", help="Pictures per second, up to 50.")
    ] = 12.0,
    linear: Annotated[bool, typer.Option("--linear", help="A linear colour scale instead of four decades.")] = False,
    frame: opt.Frame = 0,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:
    """A video of light in flight, from time bin to time bin.

    \b
    Examples:
      spadwarp video out/
      spadwarp video out/ --out light.mp4 --window 40:55 --fps 20
    """
    opt.check_outputs(files={"--out": out}, inputs=(run,), overwrite=overwrite)
    scale: Literal["log", "linear"] = "linear" if linear else "log"
    times = None if window is None else opt.from_to(window, "ns", "--window")
    path = spadwarp.viz.video(run, out, window_ns=times, pictures=pictures, fps=fps, scale=scale, frame=frame)
    if not quiet:
        say(f"written: {path} ({opt.in_bytes(path.stat().st_size)})")
