"""`spadwarp simulate`: a scene in, a directory of results out."""

from __future__ import annotations

import importlib
import math
import threading
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import INTERRUPTED, app, complain, fail, say
from spadwarp.cli._progress import progress
from spadwarp.errors import ConfigError, address_space

if TYPE_CHECKING:
    from types import ModuleType

    from spadwarp import Ray, Result, Scene
    from spadwarp.cli._progress import Report
    from spadwarp.files import RunFiles


@app.command()
def simulate(
    scene_path: Annotated[
        Path | None,
        typer.Argument(metavar="SCENE", help="Scene file (TOML); none with --resume.", show_default=False),
    ] = None,
    out: Annotated[
        Path | None, typer.Option(metavar="DIR", help="Directory for the output files.", show_default=False)
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
        typer.Option(
            "--uncertainty",
            help="Keep batches for the standard error of every bin; twice the memory. --photons is rounded up to whole "
            "batches.",
        ),
    ] = False,
    relative_error: Annotated[
        float | None,
        typer.Option(
            parser=opt.real_number,
            metavar="X",
            help="Stop at this relative error of the bins that decide the depth (0.02: 2 %); --photons is then the "
            "largest number of photons, rounded up to whole batches.",
        ),
    ] = None,
    derivatives: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Also the derivatives of the histogram by these parameters, 8 at most: medium.absorption, "
            "medium.scattering, medium.anisotropy, medium.layers[0].scattering, targets[0].reflectance, ...; short, "
            "absorption, where one alone can be meant. medium.grid.absorption, .scattering, .extinction: by block.",
            show_default=False,
        ),
    ] = None,
    blocks: Annotated[
        str | None,
        typer.Option(
            metavar="NX,NY,NZ",
            help="Blocks of cells along the edges of medium.grid, for the derivatives by its coefficients; divisors of "
            "the numbers of cells. Memory grows with their product. By default one block.",
            show_default=False,
        ),
    ] = None,
    resume: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Resume the finished, interrupted or killed run in DIR until it has --photons in total (by default "
            "those it was started with), and write the result there.",
        ),
    ] = None,
    checkpoint: Annotated[
        float,
        typer.Option(
            parser=opt.real_number,
            metavar="SECONDS",
            help="Time between checkpoints in --out, for --resume after a crash; longer where writing takes long. "
            "0: none.",
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

    Writes to the output directory: result.h5 (the complete result, for `spadwarp info` and `spadwarp.load_result`),
    scene.toml (the complete scene of the run), depth.exr, truth.exr and pictures. Ctrl-C or SIGTERM ends the run and
    writes the photons traced so far; after a crash, --resume continues from the last checkpoint.

    \b
    Examples:
      spadwarp simulate configs/scenes/staircase_15m.toml --out out/
      spadwarp simulate configs/scenes/harbour_5m.toml --mesh bust.stl --device cuda:0 \\
          --photons 2e9 --seed 7 --out run1/ --set medium.extinction=0.9
      spadwarp simulate configs/scenes/plane_5m.toml --relative-error 0.02 --photons 1e8 --out run2/
      spadwarp simulate configs/scenes/plane_5m.toml --derivatives absorption,scattering --out run5/
      spadwarp simulate --resume run1/ --photons 4e9
      spadwarp simulate configs/scenes/staircase_5m.toml --photons 1e10 --device cuda:all --out run3/
      spadwarp simulate configs/scenes/staircase_5m.toml --photons 1e12 --engine ray --ray-address auto --out run4/
      spadwarp simulate configs/scenes/staircase_5m.toml --photons 1e12 --shard 3/64 --out part3/
    """
    earlier = None
    if resume is not None:
        given = {"SCENE": scene_path, "--out": out, "--mesh": mesh, "--seed": seed, "--set": overrides}
        more = {"--first-photon": first_photon, "--shard": shard_text, "--records": records}
        more |= {"--derivatives": derivatives, "--blocks": blocks}
        if clash := [name for name, value in (given | more).items() if value]:
            raise typer.BadParameter(f"goes without {', '.join(clash)}: the run has them", param_hint="--resume")
        out = resume if resume.is_dir() else resume.parent
        earlier = _earlier(resume, photons)
        photons, scene = None if photons is None else earlier.scene.transport.photons, earlier.scene
    else:
        if scene_path is None or out is None:
            raise _missing(scene_path)
        scene = opt.read_scene(scene_path, mesh=mesh, overrides=overrides, photons=photons, seed=seed)
        photons = None
    if records:
        _check_records(scene, whole=not (first_photon or shard_text))
    shard = opt.read_part(shard_text, "--shard")
    engine = opt.read_engine(engine_name, ray_address, workers)
    run = _prepared(device, engine)
    _warn(scene, device)
    batches = uncertainty or relative_error is not None or (earlier is not None and earlier.batch_size > 0)
    names = _parameters(scene, derivatives, blocks, earlier)
    sizes: dict[str, Any] = {"batches": batches, "records": records, "checkpoint": checkpoint > 0}
    needed = run.bytes_needed(scene, derivatives=len(names), **sizes)
    inputs = (scene_path, *scene.files)
    options: dict[str, Any] = {"json": json_path, "inputs": inputs, "overwrite": overwrite, "needed": needed}
    outputs = _outputs(out, resume=earlier is not None, **options)
    pictures = _load_pictures(scene)
    with progress(quiet=quiet) as report:
        result = spadwarp.simulate(
            scene,
            photons=photons,
            device=device,
            engine=engine,
            progress=_joined_at_the_end(report, pictures),
            uncertainty=uncertainty,
            relative_error=relative_error,
            derivatives=names,
            run=spadwarp.RunOptions(
                threads=threads,
                first_photon=first_photon,
                shard=shard,
                resume=earlier,
                checkpoint=out / run.CHECKPOINT if checkpoint > 0 else None,
                checkpoint_every=checkpoint,
            ),
        )
    device = opt.one_device(device, engine)
    files = run.write_run(result, out, device=device, keep=() if earlier is None else ("records.h5",))
    if records and not result.partial:
        files.written.append(_write_records(scene, result.photons, out, device=device, quiet=quiet))
    if not quiet:
        say(described(result, files))
    error = result.relative_error if _has_errors(result) else None
    outputs.write_json({**result.summary(), "relative_error": error, "files": files.written})
    if result.partial:
        _fail_as_interrupted(result, records)
    if relative_error is not None and (error is None or error > relative_error):
        reached = "is not known" if error is None else f"is {100 * error:.3g} %"
        why = "after all photons" if result.photons >= scene.transport.photons else "since bright photons came late"
        complain(f"warning: the error {reached} {why}, not {100 * relative_error:.3g} %; --resume {out} adds photons")


def _missing(scene_path: Path | None) -> typer.BadParameter:
    hint, text = ("--out", "a directory, --out out/") if scene_path else ("SCENE", "a scene file, or --resume DIR")
    return typer.BadParameter(f"is missing; give {text}", param_hint=hint)


def _parameters(scene: Scene, names: str | None, blocks: str | None, earlier: Result | None) -> tuple[str, ...]:
    """By which the histogram is differentiated."""
    counts = None if blocks is None else [_count(text) for text in blocks.split(",")]
    if names is None:
        if counts is not None:
            raise typer.BadParameter("goes with --derivatives medium.grid.absorption", param_hint="--blocks")
        return () if earlier is None else tuple(earlier.derivatives)
    return spadwarp.transport.resolve_derivatives(scene, [name.strip() for name in names.split(",")], counts)


def _count(text: str) -> int:
    try:
        return int(text)
    except ValueError:
        raise typer.BadParameter(f"{text!r} is not a whole number; for example 4,4,2", param_hint="--blocks") from None


def _warn(scene: Scene, device: str | None) -> None:
    """Of what the scene's check finds, and of devices that are named twice."""
    for message in spadwarp.check(scene):
        if message.level == "warning":
            complain(str(message))
    names = (device or "").split(",")
    for name in sorted({name for name in names if names.count(name) > 1}):
        complain(f"warning: --device: {name} is named more than once: the same bits, no sooner, with more memory")


def _earlier(place: Path, photons: int | None) -> Result:
    """The run to resume, whose scene asks for as many photons as it shall have."""
    from spadwarp.files import load_resumable

    earlier, place = load_resumable(place)
    start, stop = earlier.requested
    wanted = stop - start if photons is None else photons
    if wanted <= earlier.photons:
        raise ConfigError(f"--photons: {wanted} is no more than the {earlier.photons} that {place} has")
    if photons is None:
        return earlier
    return replace(earlier, scene=earlier.scene.with_overrides(transport={"photons": photons}))


def _check_records(scene: Scene, *, whole: bool) -> None:
    if not whole:
        raise typer.BadParameter("needs all photons from photon 0 on", param_hint="--records")
    if scene.transport.photons >= 2**31:
        raise ConfigError(f"--records: photons = {scene.transport.photons} is outside [1, {2**31 - 1}]")


def _outputs(out: Path, *, resume: bool, overwrite: bool, **options: Any) -> opt.Outputs:
    """Makes the directory; refuses one that holds another run, or a part of one."""
    from spadwarp.files import CHECKPOINT, RUN_FILES, remove_checkpoint

    if (out / CHECKPOINT).exists() and not (resume or overwrite):
        problem = f"{out} has a run that was not finished; --resume {out} resumes it, --overwrite replaces it"
        raise typer.BadParameter(problem, param_hint="--out")
    outputs = opt.check_outputs(out, RUN_FILES, resume=resume, overwrite=overwrite, **options)
    if not resume:
        remove_checkpoint(out)
    return outputs


def _prepared(device: str | None, engine: Ray | None) -> ModuleType:
    """Begins to prepare the compiler of kernels; returns the package `spadwarp.files`, which is loaded meanwhile."""
    if engine is None:
        spadwarp.transport.prepare_kernels(device)
    return importlib.import_module("spadwarp.files")


def _load_pictures(scene: Scene) -> threading.Thread | None:
    """Begins to load what draws the pictures at the end: while kernels are loaded and photons traced, not before, since
    it would hold up this thread."""
    if not (scene.output.png or scene.output.pdf) or address_space() is not None:
        return None
    thread = threading.Thread(target=importlib.import_module, args=("spadwarp.viz",), daemon=True)
    thread.start()
    return thread


def _joined_at_the_end(report: Report | None, pictures: threading.Thread | None) -> Report | None:
    """Progress that waits, when all photons are traced, for what is loaded meanwhile: while Matplotlib is loaded, it
    takes the warnings of every thread for its own, those about the result too."""
    if pictures is None:
        return report

    def reported(stage: str, done: int, total: int) -> None:
        if report is not None:
            report(stage, done, total)
        if total and done >= total:
            pictures.join()

    return reported


def _has_errors(result: Result) -> bool:
    return result.second_moment is not None and result.photons >= 2 * result.batch_size


def _write_records(scene: Scene, photons: int, out: Path, *, device: str | None, quiet: bool) -> Path:
    from spadwarp.transport import save_records

    if not quiet:
        complain("the photons are traced again for their records")
    with progress(quiet=quiet) as report:
        records = spadwarp.transport.trace(scene, photons=photons, device=device, progress=report)
    return save_records(records, out / "records.h5", scene=scene)


def _fail_as_interrupted(result: Result, records: bool) -> None:
    start, stop = result.requested
    left_out = "; no records were written" if records else ""
    fail(
        f"interrupted after {opt.count(result.photons)} of {opt.count(stop - start)} photons, "
        f"which are written and marked partial{left_out}",
        INTERRUPTED,
    )


def described(result: Result, files: RunFiles) -> str:
    """A run in a few lines."""
    import numpy as np

    summary, truth, frame, written = result.summary(), result.truth.depth, files.depth, files.written
    seconds = result.timing.get("trace", 0.0)
    speed = f" ({result.photons / seconds:.3g}/s)" if seconds > 0 else ""
    collected = summary["collected_fraction"]
    ledger = summary["energy_balance"]
    returned = np.isfinite(frame)
    lines = {
        "photons": f"{opt.count(result.photons)}, seed {result.seed}, on {result.provenance.get('device', 'unknown')} "
        f"in {seconds:.3g} s{speed}",
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
    if result.derivatives:
        lines["derivatives"] = "by " + ", ".join(summary["derivatives"])
    if _has_errors(result) and math.isfinite(result.relative_error):
        lines["error"] = (
            f"standard error {100 * result.relative_error:.3g} % or less in the brightest bin of 95 % of the pixels "
            "that see a target"
        )
    parts = sorted(ledger["fractions"].items(), key=lambda entry: -abs(entry[1]))
    lines["ledger"] = (
        "energy balance is exact: " if ledger["exact"] else f"OFF BY {ledger['difference']} UNITS: "
    ) + ", ".join(f"{name} {100 * part:.3g} %" for name, part in parts if part)
    lines["written"] = ", ".join(path.name for path in written) + f" in {written[0].parent}"
    return opt.rows(lines)
