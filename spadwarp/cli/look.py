"""`spadwarp view` and `video`: a run as a page for a browser, light in flight as a film."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Literal

import typer

import spadwarp
from spadwarp.cli._app import app, say
from spadwarp.cli._options import Device, Quiet, arguments_checked, in_bytes

Run = Annotated[
    Path,
    typer.Argument(metavar="RUN", help="A result or frames, or the directory of one of them.", show_default=False),
]
Frame = Annotated[int, typer.Option(min=0, metavar="N", help="Which frame, of frames.")]


@app.command()
def view(
    run: Run,
    out: Annotated[Path, typer.Option(metavar="FILE", help="The page to write.")] = Path("view.html"),
    method: Annotated[
        str | None,
        typer.Option(metavar="NAME", help='Estimator of depth: "peak", "centroid", "matched" or "likelihood".'),
    ] = None,
    frame: Frame = 0,
    device: Device = None,
    quiet: Quiet = False,
) -> None:
    """A run as one HTML file: click a pixel to see its histogram.

    Depth as a point cloud coloured by its error; depth, truth, error and intensity as images; the histogram of a pixel
    with its components and the instrument response. Opens in any browser, without a network.

    \b
    Examples:
      spadwarp view out/
      spadwarp view frames/frames.h5 --frame 3 --out frame.html
    """
    with arguments_checked():
        path = spadwarp.view(run, out, method=method, frame=frame, device=device)
    if not quiet:
        say(f"written: {path} ({in_bytes(path.stat().st_size)})")


@app.command()
def video(
    run: Run,
    out: Annotated[Path, typer.Option(metavar="FILE", help="Ends in .gif, or in .mp4, which needs ffmpeg.")] = Path(
        "light.gif"
    ),
    window: Annotated[
        str | None, typer.Option(metavar="FROM,TO", help="Times of flight [ns]; by default all with light in them.")
    ] = None,
    pictures: Annotated[int, typer.Option(min=1, metavar="N", help="At most; bins are merged.")] = 120,
    fps: Annotated[float, typer.Option(metavar="N", help="Pictures per second, up to 50.")] = 12.0,
    linear: Annotated[bool, typer.Option("--linear", help="A linear colour scale, not four decades.")] = False,
    frame: Frame = 0,
    quiet: Quiet = False,
) -> None:
    """Light in flight: what each pixel receives, bin after bin.

    \b
    Examples:
      spadwarp video out/
      spadwarp video out/ --out light.mp4 --window 40,55 --fps 20
    """
    scale: Literal["log", "linear"] = "linear" if linear else "log"
    with arguments_checked():
        path = spadwarp.video(run, out, window_ns=_window(window), pictures=pictures, fps=fps, scale=scale, frame=frame)
    if not quiet:
        say(f"written: {path} ({in_bytes(path.stat().st_size)})")


def _window(text: str | None) -> tuple[float, float] | None:
    if text is None:
        return None
    try:
        start, stop = (float(word) for word in text.split(","))
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not FROM,TO, two numbers", param_hint="--window") from None
    return start, stop
