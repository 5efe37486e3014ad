"""`spadwarp video`: light in flight as a video; frames of a scene that moves."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import app, say
from spadwarp.cli._progress import progress


@app.command()
def video(
    run: Annotated[
        Path,
        typer.Argument(
            metavar="RUN",
            help="A result, frames, an analytic file, a dataset or a shard of one, or their directory; with "
            "--trajectory a scene file (TOML).",
            show_default=False,
        ),
    ],
    out: Annotated[
        Path,
        typer.Option(
            metavar="FILE",
            help="Name of the video, .gif or .mp4; .mp4 needs ffmpeg. With --trajectory a directory.",
        ),
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
    trajectory: Annotated[
        Path | None,
        typer.Option(
            metavar="CSV",
            help="Simulates a scene that moves: columns time [s] and fields of the scene, such as camera.position[0], "
            "targets[0].translation[2]; a frame for each row.",
        ),
    ] = None,
    frame_rate: Annotated[
        float | None,
        typer.Option(parser=opt.real_number, metavar="HZ", help="Frames a second between the rows of --trajectory."),
    ] = None,
    overrides: opt.Overrides = None,
    photons: opt.Photons = None,
    pulses: Annotated[
        int | None,
        typer.Option(parser=opt.whole_number, metavar="N", help="Pulses of a frame; by default the detector's."),
    ] = None,
    seed: opt.Seed = None,
    method: Annotated[opt.Estimator, typer.Option(help="Estimator of the depth of a scene that moves.")] = (
        opt.Estimator.matched
    ),
    tags: Annotated[bool, typer.Option("--tags", help="Also keep every detection of a scene that moves.")] = False,
    device: opt.Device = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
) -> None:
    """A video of light in flight, from time bin to time bin; or of a scene that moves.

    With --trajectory each frame is simulated: DIR/sequence.h5 holds counts, depth, truth and, with --tags, detections
    of all frames, DIR/sequence.gif shows them. --photons, --pulses, --seed, --method and --set are for that.

    \b
    Examples:
      spadwarp video out/
      spadwarp video out/ --out light.mp4 --window 40:55 --fps 20
      spadwarp video staircase_5m --trajectory poses.csv --frame-rate 10 --out moving/
    """
    if trajectory is not None:
        _moving(
            run,
            trajectory,
            Path("moving") if out == Path("light.gif") else out,
            quiet=quiet,
            overwrite=overwrite,
            overrides=overrides,
            drawn={"pictures": pictures, "fps": fps},
            frame_rate=frame_rate,
            photons=photons,
            pulses=pulses,
            seed=seed,
            methods=(method.value,),
            tags=tags,
            device=device,
        )
        return
    given = {"--frame-rate": frame_rate, "--set": overrides, "--photons": photons, "--pulses": pulses, "--seed": seed}
    for option in (option for option, value in given.items() if value is not None):
        raise typer.BadParameter("needs --trajectory", param_hint=option)
    opt.check_outputs(files={"--out": out}, inputs=(run,), overwrite=overwrite)
    scale: Literal["log", "linear"] = "linear" if linear else "log"
    times = None if window is None else opt.from_to(window, "ns", "--window")
    path = spadwarp.viz.video(run, out, window_ns=times, pictures=pictures, fps=fps, scale=scale, frame=frame)
    if not quiet:
        say(f"written: {path} ({opt.in_bytes(path.stat().st_size)})")


def _moving(
    scene: Path,
    trajectory: Path,
    out: Path,
    *,
    quiet: bool,
    overwrite: bool,
    overrides: list[str] | None,
    drawn: dict[str, Any],
    **options: Any,
) -> None:
    """Simulates the frames, and shows them."""
    base = opt.read_scene(scene, mesh=None, overrides=overrides)
    names = ("sequence.h5", "sequence.gif")
    opt.check_outputs(out, names, inputs=(scene, trajectory), overwrite=overwrite)
    with progress(quiet=quiet, unit="frames") as report:
        file = spadwarp.frames.simulate_sequence(base, trajectory, out / names[0], progress=report, **options)
    path = spadwarp.viz.video(file, out / names[1], **drawn)
    if not quiet:
        times = file.trajectory.times
        table = {
            "frames": f"{opt.count(file.frames)}, from {times[0]:g} to {times[-1]:g} s",
            "moving": ", ".join(file.trajectory.fields),
            "written": f"{file.path}, {path}",
        }
        say(opt.rows(table))
