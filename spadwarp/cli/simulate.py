"""`spadwarp simulate`: a scene in, a directory of results out."""

from __future__ import annotations

import math
import os
import tempfile
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import INTERRUPTED, app, complain, fail, say
from spadwarp.cli._progress import progress
from spadwarp.errors import ConfigError, FileError

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

    from spadwarp import Result, Scene

_RECORD_BYTES = 52  # of one photon's terminal state, id included
_OTHER_BYTES = 16 << 20  # pictures, maps, text
_NAMES = ("result.h5", "records.h5", "scene.toml", "depth.exr", "truth.exr")
_CHECKPOINT = "checkpoint.h5"  # there while a run is not finished
_PICTURES = tuple(
    f"{name}.{ending}" for name in ("depth", "intensity", "histogram", "truth") for ending in ("png", "pdf")
)


@app.command()
def simulate(
    scene_path: Annotated[
        Path | None,
        typer.Argument(metavar="SCENE", help="Scene file (TOML); none with --resume.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Directory for what is written.", show_default=False)
    ] = None,
    mesh: opt.Mesh = None,
    device: opt.Devices = None,
    engine_name: opt.EngineName = "local",
    ray_address: opt.RayAddress = None,
    workers: opt.Workers = None,
    photons: opt.Photons = None,
    seed: opt.Seed = None,
    overrides: opt.Overrides = None,
    threads: opt.Threads = None,
    records: Annotated[
        bool, typer.Option("--records", help="Also write the terminal state of every photon: records.h5.")
    ] = False,
    uncertainty: Annotated[
        bool,
        typer.Option("--uncertainty", help="Keep batches, for the standard error of every bin; twice the memory."),
    ] = False,
    relative_error: Annotated[
        float | None,
        typer.Option(
            metavar="X",
            help="Stop when the bins that decide the depth are known this well (0.02: 2 %); --photons is then the most "
            "that are traced, rounded up to whole batches.",
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Go on with the finished, interrupted or killed run in DIR until it has --photons in all (by default "
            "what it was asked for), and write it back there.",
        ),
    ] = None,
    checkpoint: Annotated[
        float,
        typer.Option(
            min=0.0,
            metavar="SECONDS",
            help="How often what is done is kept in --out, for --resume after a crash; more seldom if writing takes "
            "long. 0: never.",
        ),
    ] = 60.0,
    first_photon: Annotated[
        int,
        typer.Option(
            parser=opt.whole_number, metavar="ID", help="Id of the first photon; `spadwarp merge` adds the runs."
        ),
    ] = 0,
    shard_text: Annotated[
        str | None,
        typer.Option(
            "--shard", metavar="I/N", help="Only part I of N equal parts of the photons; `spadwarp merge` adds them."
        ),
    ] = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Trace photons through a scene into histograms.

    Writes to the output directory: result.h5 (everything, for `spadwarp info` and `spadwarp.load_result`), scene.toml
    (the full scene as it was run), depth.exr, truth.exr and pictures. Ctrl-C or SIGTERM ends the run and writes what
    is done; after a crash --resume goes on from the last checkpoint.

    \b
    Examples:
      spadwarp simulate configs/scenes/staircase_15m.toml --out out/
      spadwarp simulate configs/scenes/harbour_5m.toml --mesh bust.stl --device cuda:0 \\
          --photons 2e9 --seed 7 --out run1/ --set medium.extinction=0.9
      spadwarp simulate configs/scenes/plane_5m.toml --relative-error 0.02 --photons 1e8 --out run2/
      spadwarp simulate --resume run1/ --photons 4e9
      spadwarp simulate configs/scenes/staircase_5m.toml --photons 1e10 --device cuda:all --out run3/
      spadwarp simulate configs/scenes/staircase_5m.toml --photons 1e12 --engine ray --ray-address auto --out run4/
      spadwarp simulate configs/scenes/staircase_5m.toml --photons 1e12 --shard 3/64 --out part3/
    """
    earlier = None
    if resume is not None:
        given: dict[str, Any] = {"SCENE": scene_path, "--out": out, "--mesh": mesh, "--seed": seed, "--set": overrides}
        given |= {
            "--first-photon": first_photon,
            "--shard": shard_text,
            "--records": records,
            "--overwrite": overwrite,
        }
        if clash := [name for name, value in given.items() if value]:
            raise typer.BadParameter(f"goes without {', '.join(clash)}: the run knows them", param_hint="--resume")
        out = resume if resume.is_dir() else resume.parent
        earlier = _earlier(resume, photons)
        scene = earlier.scene
    else:
        if scene_path is None or out is None:
            raise typer.BadParameter("is missing", param_hint="SCENE" if scene_path is None else "--out")
        scene = opt.read_scene(scene_path, mesh=mesh, overrides=overrides, photons=photons, seed=seed)
    if records and (first_photon or shard_text):
        raise typer.BadParameter("needs all photons from photon 0 on", param_hint="--records")
    shard = None if shard_text is None else _shard(shard_text)
    engine = opt.read_engine(engine_name, ray_address, workers)
    if records and scene.transport.photons >= 2**31:
        raise ConfigError(f"--records: photons = {scene.transport.photons} is outside [1, {2**31 - 1}]")
    for message in spadwarp.check(scene):
        if message.level == "warning":
            complain(str(message))
    kept = out / _CHECKPOINT
    if kept.exists() and earlier is None and not overwrite:
        problem = f"{out} has a run that was not finished; --resume {out} goes on with it, --overwrite begins anew"
        raise typer.BadParameter(problem, param_hint="--out")
    batches = uncertainty or relative_error is not None or (earlier is not None and earlier.batch_size > 0)
    needed = bytes_needed(scene, records=records, batches=batches, checkpoint=checkpoint > 0)
    opt.prepare_directory(out, overwrite=overwrite or earlier is not None, needed=needed)
    if earlier is None:
        _forget(kept)
    if json_path is not None:
        opt.check_writable(json_path.parent)

    with progress(quiet=quiet) as report:
        result = spadwarp.simulate(
            scene,
            photons=photons if earlier is not None else None,
            device=device,
            engine=engine,
            threads=threads,
            progress=report,
            uncertainty=uncertainty,
            relative_error=relative_error,
            first_photon=first_photon,
            shard=shard,
            resume=earlier,
            checkpoint=kept if checkpoint > 0 else None,
            checkpoint_every=checkpoint,
        )
    single = opt.one_device(device, engine)
    written, frame = write_run(result, out, device=single)
    _forget(kept)
    if records and not result.partial:
        written.append(_write_records(scene, result.photons, out, device=single, quiet=quiet))
    spared = {"records.h5"} if earlier is not None else set()
    for name in {*_NAMES, *_PICTURES} - spared:  # left from an earlier run, they would be taken for this one's
        if out / name not in written:
            (out / name).unlink(missing_ok=True)

    if not quiet:
        say(described(result, frame, written))
    error = result.relative_error if _has_errors(result) else None
    opt.write_json({**result.summary(), "relative_error": error, "files": written}, json_path)
    if relative_error is not None and not result.partial and (error is None or error > relative_error):
        reached = "is not known" if error is None else f"is {100 * error:.3g} %"
        complain(f"warning: the error {reached} after all photons, not {100 * relative_error:.3g} %")
    if result.partial:
        left_out = "; no records were written" if records else ""
        asked = result.requested[1] - result.requested[0]
        fail(
            f"interrupted after {opt.count(result.photons)} of {opt.count(asked)} photons, "
            f"which are written and marked partial{left_out}",
            INTERRUPTED,
        )


def _earlier(place: Path, photons: int | None) -> Result:
    """The run to resume: its result or its checkpoint, whichever is newer; its scene asks for as many photons as it
    shall have."""
    if place.is_dir():
        there = [path for name in ("result.h5", _CHECKPOINT) if (path := place / name).is_file()]
        place = max(there, key=lambda path: path.stat().st_mtime_ns, default=place)
    earlier = opt.load_run(place)
    start, stop = earlier.requested
    wanted = stop - start if photons is None else photons
    if wanted <= earlier.photons:
        raise ConfigError(f"--photons: {wanted} is no more than the {earlier.photons} that {place} has")
    if photons is None:
        return earlier
    return replace(earlier, scene=earlier.scene.with_overrides(transport={"photons": photons}))


def _forget(checkpoint: Path) -> None:
    """Removes a checkpoint, and what a killed run has left of one."""
    for path in (checkpoint, *checkpoint.parent.glob(f".{checkpoint.name}.*.tmp")):
        path.unlink(missing_ok=True)


def _shard(text: str) -> tuple[int, int]:
    number, _, parts = text.partition("/")
    if not (number.isdecimal() and parts.isdecimal()):
        raise typer.BadParameter(f"{text!r} is not a part such as 3/64", param_hint="--shard")
    return int(number), int(parts)


def _has_errors(result: Result) -> bool:
    return result.second_moment is not None and result.photons >= 2 * result.batch_size


def bytes_needed(scene: Scene, *, records: bool, batches: bool, checkpoint: bool = False) -> int:
    """Upper bound of what a run writes; compression takes off most of it."""
    tallies = (5 if batches else 3) * 8 * scene.camera.width * scene.camera.height * scene.gate.bins
    return (
        (2 if checkpoint else 1) * tallies + _OTHER_BYTES + (_RECORD_BYTES * scene.transport.photons if records else 0)
    )


def write_run(result: Result, out: Path, *, device: str | None) -> tuple[list[Path], NDArray[np.float64]]:
    """Files of a result as its `[output]` asks for, the one that nothing can replace first, and the depth frame."""
    from spadwarp.result.file import save_depth_exr, save_truth_maps
    from spadwarp.viz.result import write_previews

    scene, output = result.scene, result.scene.output
    written: list[Path] = []
    if output.result:
        written.append(_save(result, out / "result.h5"))
    text = out / "scene.toml"
    try:
        text.write_text(scene.to_toml(), encoding="utf-8")
    except OSError as error:
        raise FileError(f"{text}: cannot be written: {error.strerror}") from error
    written.append(text)
    options: dict[str, Any] = {}
    if output.depth_method in ("matched", "likelihood"):
        from spadwarp.frames import detector_response

        options["irf"] = detector_response(scene.detector, scene.laser)
    frame = result.depth(method=output.depth_method, device=device, **options)
    if output.exr:
        written += [save_depth_exr(result, frame, out / "depth.exr"), save_truth_maps(result, out / "truth.exr")]
    if output.png or output.pdf:
        formats = [ending for ending in ("png", "pdf") if getattr(output, ending)]
        written += write_previews(result, out, depth=frame, method=output.depth_method, formats=formats)
    return written, frame


def _save(result: Result, path: Path) -> Path:
    """Saves the result, if need be elsewhere: hours of photons are not given up because a disk has become full."""
    try:
        return result.save(path)
    except FileError as error:
        refuge = Path(tempfile.gettempdir()) / f"spadwarp-{os.getpid()}-result.h5"
        result.save(refuge)
        raise FileError(f"{error}\n{refuge}: the result is here instead") from error


def _write_records(scene: Scene, photons: int, out: Path, *, device: str | None, quiet: bool) -> Path:
    from spadwarp.transport.records import save_records

    if not quiet:
        complain("the photons again, for their records")
    with progress(quiet=quiet) as report:
        records = spadwarp.trace(scene, photons=photons, device=device, progress=report)
    return save_records(records, out / "records.h5", scene=scene)


def described(result: Result, frame: NDArray[np.float64], written: list[Path]) -> str:
    """A run in a few lines."""
    import numpy as np

    summary, truth = result.summary(), result.truth.depth
    seconds = result.timing["trace"]
    collected = summary["collected_fraction"]
    ledger = summary["ledger"]
    returned = np.isfinite(frame)
    lines = {
        "photons": f"{opt.count(result.photons)}, seed {result.seed}, on {result.provenance['device']} "
        f"in {seconds:.3g} s ({result.photons / seconds:.3g}/s)",
        "collected": f"{sum(collected.values()):.3g} of the emitted light: "
        + ", ".join(f"{name.replace('_', '-')} {part:.3g}" for name, part in collected.items()),
        "detections": f"{summary['detections_per_pulse']:.3g} a pulse, all pixels together",
        "depth": f"{returned.sum()} of {frame.size} pixels"
        + (f", {np.nanmin(frame):.2f} to {np.nanmax(frame):.2f} m" if returned.any() else ""),
    }
    both = returned & np.isfinite(truth)
    if both.any():
        error = np.median(np.abs(frame - truth)[both])
        lines["truth"] = (
            f"{np.isfinite(truth).sum()} of {frame.size} pixels, {np.nanmin(truth):.2f} to {np.nanmax(truth):.2f} m; "
            f"median error of the depth {1000 * error:.3g} mm"
        )
    if _has_errors(result) and math.isfinite(result.relative_error):
        lines["error"] = (
            f"{100 * result.relative_error:.3g} % in the bins that decide the depth, or less, in 95 % of the pixels"
        )
    parts = sorted(ledger["fractions"].items(), key=lambda entry: -abs(entry[1]))
    lines["ledger"] = ("closes exactly: " if ledger["exact"] else f"OFF BY {ledger['difference']} UNITS: ") + ", ".join(
        f"{name} {100 * part:.3g} %" for name, part in parts if part
    )
    lines["written"] = ", ".join(path.name for path in written) + f" in {written[0].parent}"
    return opt.rows(lines)
