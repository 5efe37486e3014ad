"""Commands that trace light: `simulate`, `merge`; and `analytic`, by the analytic model."""

from __future__ import annotations

import importlib
import math
import threading
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

import spadwarp
from spadwarp.cli import options as opt
from spadwarp.cli.app import INTERRUPTED, complain, fail, running, say
from spadwarp.cli.options import command
from spadwarp.cli.outputs import answer, check_outputs, write_json
from spadwarp.cli.text import count, progress, readable, rows, written
from spadwarp.values import ArgumentError, ConfigError, address_space, parse_number

if TYPE_CHECKING:
    from types import ModuleType

    from spadwarp import Ray, Result, Scene
    from spadwarp.analytic import AnalyticResult
    from spadwarp.cli.text import Report
    from spadwarp.files import RunFiles


@command()
def simulate(
    scene: Path | None = None,
    *,
    out: Path | None = None,
    mesh: Path | None = None,
    devices: str | None = None,
    ray: str | None = None,
    workers: int | None = None,
    photons: int | None = None,
    seed: int | None = None,
    overrides: list[str] | None = None,
    threads: int | None = None,
    records: bool = False,
    uncertainty: bool = False,
    relative_error: float | None = None,
    derivatives: str | None = None,
    resume: Path | None = None,
    checkpoint: float = 60.0,
    first_photon: int = 0,
    shard: str | None = None,
    trajectory: Path | None = None,
    frame_rate: float | None = None,
    method: opt.Method = "matched",
    tags: bool = False,
) -> None:
    """Trace photons through a scene into histograms, or through each frame of a scene that moves.

    Writes to the output directory: result.h5 (the complete result, for `spadwarp info` and `spadwarp.load_result`),
    scene.toml (the complete scene of the run), depth.exr, truth.exr and pictures. Ctrl-C or SIGTERM ends the run and
    writes the photons traced so far; after a crash, --resume continues from the last checkpoint.

    With --trajectory: sequence.h5 with counts, depth, truth and, with --tags, detections of all frames, and
    sequence.gif, which shows them.

    Args:
        scene (SCENE): Scene file (TOML), or the name of a scene of `spadwarp list scenes`; none with --resume.
        seed: Key of the random numbers. By default the scene's.
        threads: CPU threads; by default one for each core.
        records: Also write the terminal state of every photon: records.h5.
        uncertainty: Keep batches for the standard error of every bin; twice the memory. --photons is rounded up to
            whole batches.
        relative_error (X): Stop at this relative error of the bins that decide the depth (0.02: 2 %); --photons is then
            the largest number of photons, rounded up to whole batches.
        derivatives (NAME,...): Also the derivatives of the histogram by these parameters, 8 at most:
            medium.absorption, medium.scattering, medium.anisotropy, medium.layers[0].scattering,
            targets[0].reflectance, ...; short, absorption, where one alone can be meant. medium.grid.absorption,
            .scattering, .extinction: by block of cells; with :NX:NY:NZ by so many blocks along its edges,
            divisors of the numbers of cells, else by one. Memory grows with their product.
        resume (DIR): Resume the finished, interrupted or killed run in DIR until it has --photons in total (by default
            those it was started with), and write the result there.
        checkpoint (SECONDS): Time between checkpoints in --out, for --resume after a crash; longer where writing takes
            long. 0: none.
        first_photon (ID): Id of the first photon; `spadwarp merge` adds the runs.
        shard (I/N): Only part I of N equal parts of the photons; `spadwarp merge` adds them.
        trajectory (CSV): Simulate a scene that moves: columns time [s] and fields of the scene, such as
            camera.position[0], targets[0].translation[2]; a frame for each row.
        frame_rate (HZ): Frames a second between the rows of --trajectory.
        method: Estimator of the depth of a scene that moves.
        tags: Also keep every detection of a scene that moves.

    \b
    Examples:
      spadwarp simulate configs/scenes/staircase_15m.toml --out out/
      spadwarp simulate configs/scenes/harbour_5m.toml --mesh bust.stl --device cuda:0 \\
          --photons 2e9 --seed 7 --out run1/ --set medium.extinction=0.9
      spadwarp simulate configs/scenes/plane_5m.toml --relative-error 0.02 --photons 1e8 --out run2/
      spadwarp simulate configs/scenes/plane_5m.toml --derivatives absorption,scattering --out run5/
      spadwarp simulate --resume run1/ --photons 4e9
      spadwarp simulate configs/scenes/staircase_5m.toml --photons 1e10 --device cuda:all --out run3/
      spadwarp simulate configs/scenes/staircase_5m.toml --photons 1e12 --ray auto --out run4/
      spadwarp simulate configs/scenes/staircase_5m.toml --photons 1e12 --shard 3/64 --out part3/
      spadwarp simulate staircase_5m --trajectory poses.csv --frame-rate 10 --out moving/
    """
    if trajectory is not None:
        text = "cannot be combined with --trajectory"
        opt.refuse(text, "--resume", "--ray", "--workers", "--threads", "--shard", "--first-photon")
        opt.refuse(text, "--records", "--uncertainty", "--relative-error", "--derivatives")
        if scene is None or out is None:
            raise _missing(scene)
        drawn = {"frame_rate": frame_rate, "photons": photons, "seed": seed, "methods": (method,), "tags": tags}
        _simulate_moving(scene, trajectory, out, opt.read_scene(scene, overrides, mesh=mesh), device=devices, **drawn)
        return
    opt.refuse("needs --trajectory", "--frame-rate", "--method", "--tags")
    earlier = None
    if resume is not None:
        text = "cannot be combined with --resume: the run has it"
        opt.refuse(text, "SCENE", "--out", "--mesh", "--seed", "--set", "--records", "--derivatives")
        opt.refuse(text, "--first-photon", "--shard")
        out = resume if resume.is_dir() else resume.parent
        earlier = _earlier(resume, photons)
        photons, read = None if photons is None else earlier.scene.transport.photons, earlier.scene
    else:
        if scene is None or out is None:
            raise _missing(scene)
        read = opt.read_scene(scene, overrides, mesh=mesh, photons=photons, seed=seed)
        photons = None
    if records:
        _check_records(read, whole=not (first_photon or shard))
    part, engine = opt.read_part(shard, "--shard"), opt.read_engine(ray, workers)
    run = _prepared(devices, engine)
    _warn(read, devices)
    batches = uncertainty or relative_error is not None or (earlier is not None and earlier.batch_size > 0)
    names = _parameters(read, derivatives, earlier)
    sizes: dict[str, Any] = {"batches": batches, "records": records, "checkpoint": checkpoint > 0}
    needed = run.bytes_needed(read, derivatives=len(names), **sizes)
    _check_run(out, resume=earlier is not None, inputs=(scene, *read.files), needed=needed)
    pictures = _load_pictures(read)
    with progress() as report:
        result = spadwarp.simulate(
            read,
            photons=photons,
            device=devices,
            engine=engine,
            progress=_joined_at_the_end(report, pictures),
            uncertainty=uncertainty,
            relative_error=relative_error,
            derivatives=names,
            run=spadwarp.RunOptions(
                threads=threads,
                first_photon=first_photon,
                shard=part,
                resume=earlier,
                checkpoint=out / run.CHECKPOINT if checkpoint > 0 else None,
                checkpoint_every=checkpoint,
            ),
        )
    device = opt.one_device(devices, engine)
    files = run.write_run(result, out, device=device, keep=() if earlier is None else ("records.h5",))
    if records and not result.partial:
        files.written.append(_write_records(read, result.photons, out, device=device))
    say(readable(_brief(result, files)) + f"\nwritten: {written(files.written)}")
    error = result.relative_error if _has_errors(result) else None
    write_json({**result.summary(), "relative_error": error, "files": files.written})
    if result.partial:
        _fail_as_interrupted(result, records)
    if relative_error is not None and (error is None or error > relative_error):
        reached = "is not known" if error is None else f"is {100 * error:.3g} %"
        late = result.photons < read.transport.photons
        why = "since rare heavy photons arrived late" if late else "after all photons"
        complain(f"warning: the error {reached} {why}, not {100 * relative_error:.3g} %; --resume {out} adds photons")


def _missing(scene_path: Path | None) -> typer.BadParameter:
    hint, text = ("--out", "a directory, --out out/") if scene_path else ("SCENE", "a scene file, or --resume DIR")
    return typer.BadParameter(f"is missing; give {text}", param_hint=hint)


def _parameters(scene: Scene, names: str | None, earlier: Result | None) -> tuple[str, ...]:
    """By which the histogram is differentiated."""
    if names is None:
        return () if earlier is None else tuple(earlier.derivatives)
    plain, blocks = [], None
    for text in names.split(","):
        name, *counts = (part.strip() for part in text.split(":"))
        plain.append(name)
        if counts:
            if not all(count.isdecimal() for count in counts):
                raise typer.BadParameter(f"{text!r} is not of the form NAME:NX:NY:NZ", param_hint="--derivatives")
            blocks = [int(count) for count in counts]
    return spadwarp.transport.resolve_derivatives(scene, plain, blocks)


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


def _check_run(out: Path, *, resume: bool, **options: Any) -> None:
    """Makes the directory; refuses one that holds another run, or a part of one."""
    from spadwarp.files import CHECKPOINT, RUN_FILES, remove_checkpoint

    if (out / CHECKPOINT).exists() and not (resume or running.overwrite):
        problem = f"{out} has a run that was not finished; --resume {out} resumes it, --overwrite replaces it"
        raise typer.BadParameter(problem, param_hint="--out")
    check_outputs(out, RUN_FILES, resume=resume, **options)
    if not resume:
        remove_checkpoint(out)


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


def _write_records(scene: Scene, photons: int, out: Path, *, device: str | None) -> Path:
    from spadwarp.transport import save_records

    if not running.quiet:
        complain("the photons are traced again for their records")
    with progress() as report:
        records = spadwarp.transport.trace(scene, photons=photons, device=device, progress=report)
    return save_records(records, out / "records.h5", scene=scene)


def _fail_as_interrupted(result: Result, records: bool) -> None:
    start, stop = result.requested
    left_out = "; no records were written" if records else ""
    fail(
        f"interrupted after {count(result.photons)} of {count(stop - start)} photons, "
        f"which are written and marked partial{left_out}",
        INTERRUPTED,
    )


def _brief(result: Result, files: RunFiles) -> dict[str, Any]:
    """A run in a few numbers."""
    import numpy as np

    summary, truth, frame = result.summary(), result.truth.depth, files.depth
    seconds, balance = result.timing.get("trace", 0.0), summary["energy_balance"]
    error = np.abs(frame - truth)[np.isfinite(frame) & np.isfinite(truth)]
    returned = frame[np.isfinite(frame)]
    return {
        "photons": result.photons,
        "seed": result.seed,
        "device": f"{result.provenance.get('device', 'unknown')}, {seconds:.3g} s"
        + (f", {result.photons / seconds:.3g} photons/s" if seconds > 0 else ""),
        "collected_fraction": summary["collected_fraction"],
        "detections_per_pulse": summary["detections_per_pulse"],
        "depth_m": [float(returned.min()), float(returned.max())] if returned.size else None,
        "median_depth_error_mm": 1000.0 * float(np.median(error)) if error.size else None,
        **({"derivatives": summary["derivatives"]} if result.derivatives else {}),
        **({"relative_error": result.relative_error} if _has_errors(result) else {}),
        "energy_balance": "exact" if balance["exact"] else f"OFF BY {balance['difference']} UNITS",
    }


def _simulate_moving(path: Path, trajectory: Path, out: Path, scene: Scene, **options: Any) -> None:
    """Simulates the frames of a scene that moves, and shows them."""
    names = ("sequence.h5", "sequence.gif")
    check_outputs(out, names, inputs=(path, trajectory, *scene.files))
    with progress("frames") as report:
        file = spadwarp.frames.simulate_sequence(scene, trajectory, out / names[0], progress=report, **options)
    picture = spadwarp.viz.video(file, out / names[1])
    answer({**spadwarp.files.summary(file), "files": [file.path, picture]})


@command()
def merge(runs: list[Path], *, out: Path, device: str | None = None) -> None:
    """Add runs of one scene and seed that traced different photons.

    The sum has the same bits as one run of all photons. Writes the same files as `spadwarp simulate`.

    Args:
        runs (RUN...): Results, or their directories.

    \b
    Example:
      spadwarp simulate configs/scenes/plane_5m.toml --photons 1e8 --out a/
      spadwarp simulate configs/scenes/plane_5m.toml --photons 1e8 --first-photon 1e8 --out b/
      spadwarp merge a/ b/ --out ab/
    """
    from spadwarp.files import RUN_FILES, bytes_needed, write_run

    result = spadwarp.merge(opt.load_run(place) for place in runs)
    needed = bytes_needed(result.scene, batches=result.batch_size > 0, derivatives=len(result.derivatives))
    check_outputs(out, RUN_FILES, inputs=(*runs, *result.scene.files), needed=needed)
    files = write_run(result, out, device=device)
    ids = ", ".join(f"{count(start)} to {count(stop - 1)}" for start, stop in result.photon_ranges)
    say(rows({"photon ids": ids}))
    say(readable(_brief(result, files)) + f"\nwritten: {written(files.written)}")
    write_json({**result.summary(), "photon_ranges": result.photon_ranges, "files": files.written})


@command()
def analytic(
    scene: Path,
    *,
    out: Path,
    frames: int = 1,
    seed: int = 0,
    overrides: list[str] | None = None,
    rendered: list[str] | None = None,
    profile: Path | None = None,
    device: str | None = None,
) -> None:
    """Depth frames by the analytic model.

    From the scene's targets, or from images that a game engine or Blender rendered with the scene's camera. Writes
    analytic.h5 (maps, frames, and labels of the pixels that report background) and analytic.png.

    Args:
        frames: Depth frames to draw.
        rendered (NAME=VALUE,...): Images in place of the scene's targets: depth=EXR, depth_channel=NAME, depth_scale=M
            (metres per unit of depth), radial (depth is the distance from the camera, not planar), normal=EXR (world
            normals; else surfaces face the camera), albedo=EXR or a number (diffuse reflectance, 0.5), albedo_channel=
            NAME, preset=unreal or blender (the program whose channels, units and axes hold; unreal: 0.01 m).
        profile (RUN): Result of the same scene whose backscatter is taken; analytic.backscatter = monte_carlo.

    \b
    Examples:
      spadwarp analytic configs/scenes/staircase_15m.toml --frames 1000 --out frames/
      spadwarp analytic scene.toml --out cat/ \\
          --rendered depth=cat_RGBD.EXR,depth_channel=A,normal=cat_Surf_Norm.EXR,albedo=cat_Base_Col.EXR
    """
    read = opt.read_scene(scene, overrides)
    maps = opt.items(rendered, _RENDERED, "--rendered")
    if maps and "depth" not in maps:
        raise typer.BadParameter(f"{', '.join(maps)} needs depth=EXR", param_hint="--rendered")
    if profile is not None and read.analytic.backscatter != "monte_carlo":
        raise typer.BadParameter(
            f"needs --set analytic.backscatter=monte_carlo; the scene's is {read.analytic.backscatter!r}",
            param_hint="--profile",
        )
    check_outputs(
        out,
        ("analytic.h5", "analytic.png"),
        inputs=(scene, *read.files, *(value for value in maps.values() if isinstance(value, Path)), profile),
        needed=(5 * max(frames, 0) + 200) * read.camera.width * read.camera.height + (16 << 20),
    )
    if frames < 0:
        raise ArgumentError(f"frames = {frames} is outside [0, inf)")
    result = spadwarp.simulate_analytic(
        read,
        truth=spadwarp.result.load_truth_exr(camera=read.camera, **maps) if maps else None,
        frames=min(frames, 1),
        seed=seed,
        device=device,
        backscatter_profile=None if profile is None else opt.load_run(profile),
    )
    files = [result.save(out / "analytic.h5", frames=frames, device=device)]
    files.append(spadwarp.viz.draw_analytic(result, out / "analytic.png"))
    notes = spadwarp.analytic.model_notes(read)
    answer({"frames": frames, "seed": seed, **_medians(result), "notes": notes, "files": files})


def _number_or_path(text: str) -> Path | float:
    try:
        return parse_number(text)
    except ValueError:
        return Path(text)


# Arguments of `spadwarp.result.load_truth_exr`.
_RENDERED: dict[str, Callable[[str], Any]] = {
    "depth": Path,
    "depth_channel": str,
    "depth_scale": opt.real_number,
    "radial": bool,
    "normal": Path,
    "albedo": _number_or_path,
    "albedo_channel": str,
    "preset": str,
}


def _medians(result: AnalyticResult) -> dict[str, Any]:
    import numpy as np

    def median(values: Any) -> float:
        return float(np.median(values[there])) if there.any() else math.nan

    there = result.fisher > 0
    return {
        "pixels": int(there.size),
        "pixels_with_target": int(np.isfinite(result.truth.depth).sum()),
        "pixels_with_estimate": int(there.sum()),
        "signal": median(result.signal),
        "backscatter": median(result.backscatter),
        "alpha": median(result.alpha),
        "signal_to_backscatter": median(result.signal_to_backscatter),
        "sigma_time": median(result.sigma_time),
        "sigma_depth": median(result.sigma_depth),
        "outlier_probability": float(result.outlier_probability[there].mean()) if there.any() else math.nan,
        "background_probability": float(result.background_probability[there].mean()) if there.any() else math.nan,
    }
