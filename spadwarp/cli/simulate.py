"""Commands that trace light: `simulate`, `merge`; and `analytic`, by the analytic model."""

from __future__ import annotations

import importlib
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager, redirect_stdout, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import spadwarp
from spadwarp.cli import options as opt
from spadwarp.cli.app import INTERRUPTED, complain, fail, note, running, say, wrong
from spadwarp.cli.options import command
from spadwarp.cli.outputs import answer, check_outputs, progress
from spadwarp.values import ArgumentError, ConfigError, address_space, count

if TYPE_CHECKING:
    from spadwarp import Ray, Result, Scene
    from spadwarp.cli.outputs import Report
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
    photons: opt.Photons | None = None,
    time: opt.Seconds | None = None,
    seed: int | None = None,
    overrides: list[str] | None = None,
    threads: int | None = None,
    records: bool = False,
    relative_error: float | None = None,
    derivatives: str | None = None,
    reconstruct: bool | None = None,
    resume: Path | None = None,
    checkpoint: float = 60.0,
    first_photon: int = 0,
    shard: opt.Part | None = None,
    trajectory: Path | None = None,
    frame_rate: float | None = None,
    method: opt.Method = "matched",
    tags: bool = False,
) -> None:
    """Trace photons through a scene into histograms, or through each frame of a scene that moves.

    Writes result.h5 (for `spadwarp info` and `spadwarp.load`), the complete scene.toml, depth.exr, truth.exr and
    pictures. Ctrl-C or SIGTERM ends the run and writes the photons traced so far; after a crash, --resume continues
    from the last checkpoint. With laser.wavelengths_nm: these files for each line, spectrum.h5 and spectrum.png.
    With --trajectory: sequence.h5 (counts, depth, truth; with --tags detections) and
    sequence.gif.

    Args:
        scene (SCENE): Scene file (TOML), or the name of a scene of `spadwarp list scenes`; none with --resume.
        photons (N|auto): Photons to emit, such as 2e9. auto: until the noise of the simulation is small beside that of
            a frame's photons in the median pixel of the target, a tenth of its variance, or until --relative-error or
            --time; the default where the scene gives no number.
        time (SECONDS): Of auto at most, reconstruction included, without loading kernels; by default 60. It asks for
            auto.
        seed: Key of the random numbers. By default the scene's.
        threads: CPU threads; by default one for each core.
        records: Also write the terminal state of every photon: records.h5.
        relative_error (X): Stop at this relative error of the bins that decide the depth (0.02: 2 %), or after
            a number of --photons.
        derivatives (NAME,...): Also the derivatives of the histogram by these parameters, 8 at most:
            medium.absorption, medium.scattering, medium.anisotropy, medium.layers[0].scattering,
            targets[0].reflectance, ...; short, absorption, where one alone can be meant. medium.grid.absorption,
            .scattering, .extinction: by block of cells; with :NX:NY:NZ by so many blocks along its edges,
            divisors of the numbers of cells, else by one. Memory grows with their product.
        reconstruct: Also the light without most of its noise, smoothed by what is known of the scene exactly; it stands
            in result.h5 beside what was traced. By default with --photons auto; `spadwarp reconstruct` does it later.
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
      spadwarp simulate plane_5m --relative-error 0.02 --derivatives absorption,scattering --out run2/
      spadwarp simulate --resume run1/ --photons 4e9
      spadwarp simulate staircase_5m --photons 1e10 --device cuda:all --out run3/
      spadwarp simulate staircase_5m --photons 1e12 --ray auto --shard 3/64 --out part3/
      spadwarp simulate staircase_5m --trajectory poses.csv --frame-rate 10 --out moving/
    """
    if trajectory is None:
        opt.refuse("needs --trajectory", "--frame-rate", "--method", "--tags")
    else:
        text = "cannot be combined with --trajectory"
        opt.refuse(text, "--resume", "--ray", "--workers", "--threads", "--shard", "--first-photon")
        opt.refuse(text, "--records", "--relative-error", "--derivatives", "--reconstruct", "--time")
    if ray is None:
        spadwarp.device.start_devices(devices)
    asked: Any = "auto" if photons is None and time is not None else photons
    earlier = None
    if resume is not None:
        text = "cannot be combined with --resume: the run has it"
        opt.refuse(text, "SCENE", "--out", "--mesh", "--seed", "--set", "--records", "--derivatives")
        opt.refuse(text, "--first-photon", "--shard")
        out = resume if resume.is_dir() else resume.parent
        earlier = _earlier(resume, asked)
        read = earlier.scene
    elif scene is None or out is None:
        hint, text = ("--out", "a directory, --out out/") if scene else ("SCENE", "a scene file, or --resume DIR")
        wrong(f"is missing; give {text}", hint)
    elif trajectory is not None:
        drawn = {"frame_rate": frame_rate, "photons": asked, "seed": seed, "methods": (method,), "tags": tags}
        _simulate_moving(scene, trajectory, out, opt.read_scene(scene, overrides, mesh=mesh), device=devices, **drawn)
        return
    else:
        read = opt.read_scene(scene, overrides, mesh=mesh, photons=asked, seed=seed)
    engine = opt.read_engine(ray, workers)
    if read.laser.wavelengths_nm:
        limits: dict[str, Any] = {"time": time, "relative_error": relative_error}
        own = spadwarp.RunOptions(threads=threads)
        return _simulate_lines(read, out, scene, **limits, device=devices, engine=engine, run=own)
    if reconstruct and not read.has_straight_sight:
        wrong("knows neither [surface] nor scan.mode = 'trajectory'", "--reconstruct")
    if records:
        _check_records(read, whole=not (first_photon or shard))
    names = _parameters(read, derivatives, earlier)
    _prepare(read, devices, engine, names)
    _prepare_directory(out, read, earlier, scene, derivatives=len(names), records=records, checkpoint=checkpoint > 0)
    device = None if devices is None or engine else spadwarp.device.pick_devices(devices)[0].alias
    automatic = reconstruct is None and read.transport.photons == "auto" and read.has_straight_sight
    if read.transport.photons == "auto" and (reconstruct or automatic):
        time = spadwarp.transport.tracing_time(read, time, device)
    # Ray reports the loss of a worker on stdout, which is for results.
    with redirect_stdout(sys.stderr), _while_pictures_load(progress(), read) as report:
        result = spadwarp.simulate(
            read,
            photons=None if earlier is None or asked is None else read.transport.photons,
            time=time,
            device=devices,
            engine=engine,
            progress=report,
            relative_error=relative_error,
            derivatives=names,
            run=spadwarp.RunOptions(
                threads=threads,
                first_photon=first_photon,
                shard=shard,
                resume=earlier,
                checkpoint=out / spadwarp.files.CHECKPOINT if checkpoint > 0 else None,
                checkpoint_every=checkpoint,
            ),
        )
    if (reconstruct or automatic) and result.batches > 1:
        note("the light is reconstructed")
        result = spadwarp.reconstruct(result, device=device)
    files = spadwarp.files.write_run(result, out, device=device, keep=() if earlier is None else ("records.h5",))
    if records and not result.partial:
        note("the photons are traced again for their records")
        traced = spadwarp.transport.trace(read, photons=result.photons, device=device, progress=progress())
        files.written.append(spadwarp.transport.save_records(traced, out / "records.h5", scene=read))
    _answer(result, files)
    if result.partial:
        wanted = "" if read.transport.photons == "auto" else f" of {count(result.requested[1] - result.requested[0])}"
        done = f"{count(result.photons)}{wanted} photons"
        without = "; no records were written" if records else ""
        fail(f"interrupted after {done}, which are written and marked partial{without}", INTERRUPTED)
    _say_error(result, relative_error, out)


def _say_error(result: Result, wanted: float | None, out: Path) -> None:
    """Warns of a run that has not reached the error wanted of it."""
    error = result.relative_error if result.batches > 1 else None
    if wanted is not None and (error is None or error > wanted):
        reached = "is not known" if error is None else f"is {100 * error:.3g} %"
        number = result.scene.transport.photons
        late = number != "auto" and result.photons < number
        why = "since rare heavy photons arrived late" if late else f"after {count(result.photons)} photons"
        complain(f"warning: the error {reached} {why}, not {100 * wanted:.3g} %; --resume {out} adds photons")


def _simulate_lines(scene: Scene, out: Path, source: Path | None, **options: Any) -> None:
    """Traces and writes the lines of `laser.wavelengths_nm`."""
    text = "cannot be combined with laser.wavelengths_nm"
    opt.refuse(text, "--resume", "--shard", "--first-photon", "--records", "--reconstruct", "--derivatives")
    names = [*spadwarp.files.RUN_FILES, "spectrum.h5", "spectrum.png"]
    lines = scene.laser.wavelengths_nm
    folders = [] if isinstance(lines, str) else [spadwarp.files.line_folder("", line) for line in lines]
    needed = max(len(lines), 1) * spadwarp.files.bytes_needed(scene)
    check_outputs(out, [*names, *map(str, folders)], inputs=(source, *scene.files), needed=needed)
    _prepare(scene, options["device"], options["engine"], ())
    with redirect_stdout(sys.stderr), _while_pictures_load(progress(), scene) as report:
        spectrum = spadwarp.transport.simulate_spectrum(scene, progress=report, **options)
    files = spadwarp.files.write_spectrum(spectrum, out, device=None if options["engine"] else options["device"])
    rows = {f"{line:.9g} nm": one.summary() for line, one in spectrum.results.items()}
    shown = {name: f"{row['detections_per_pulse']:.3g} detections per pulse" for name, row in rows.items()}
    answer({"kind": "spectrum", "lines": rows, "files": files}, shown=shown)
    if spectrum.partial:
        fail(f"interrupted after {len(rows)} lines, which are written", INTERRUPTED)


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
                wrong(f"{text!r} is not of the form NAME:NX:NY:NZ", "--derivatives")
            blocks = [int(count) for count in counts]
    return spadwarp.transport.resolve_derivatives(scene, plain, blocks)


def _prepare(scene: Scene, device: str | None, engine: Ray | None, derivatives: tuple[str, ...]) -> None:
    """Begins to load kernels; warns of what the scene's check finds, and of devices that are named twice."""
    mesh = spadwarp.mesh.build_mesh(scene)
    if engine is None:
        spadwarp.transport.prepare_kernels(scene, mesh, device, derivatives=derivatives)
    device = "cpu" if engine is not None else device
    for message in spadwarp.check(scene, mesh, device=device):
        if message.level == "warning":
            complain(str(message))
    names = (device or "").split(",")
    for name in sorted({name for name in names if names.count(name) > 1}):
        complain(f"warning: --device: {name} is named more than once: the same bits, no sooner, with more memory")


def _earlier(place: Path, photons: int | Literal["auto"] | None) -> Result:
    """The run to resume, whose scene asks for as many photons as it shall have."""
    from spadwarp.files import load_resumable

    earlier, place = load_resumable(place)
    start, stop = earlier.requested
    wanted = stop - start if photons is None else photons
    if wanted != "auto" and wanted <= earlier.photons:
        raise ConfigError(f"--photons: {wanted} is no more than the {earlier.photons} that {place} has")
    if photons is None:
        return earlier
    return replace(earlier, scene=earlier.scene.with_overrides(transport={"photons": photons}))


def _prepare_directory(out: Path, scene: Scene, earlier: Result | None, source: Path | None, **kept: Any) -> None:
    """Makes the directory; refuses one that holds another run, or a part of one."""
    files, resume = spadwarp.files, earlier is not None
    if (out / files.CHECKPOINT).exists() and not (resume or running.overwrite):
        problem = f"{out} has a run that was not finished; --resume {out} resumes it, --overwrite replaces it"
        wrong(problem, "--out")
    needed = files.bytes_needed(scene, **kept)
    check_outputs(out, files.RUN_FILES, resume=resume, inputs=(source, *scene.files), needed=needed)
    if not resume:
        files.remove_checkpoint(out)


@contextmanager
def _while_pictures_load(report: Report | None, scene: Scene) -> Iterator[Report | None]:
    """Loads what draws the pictures in the end while kernels are loaded and photons traced; not before, since it would
    hold up this thread. It is loaded at the end of the block, so that copies of this process can draw.

    The progress waits for it when all photons are traced: while Matplotlib is loaded, it takes the warnings of every
    thread for its own, those about the result too.
    """
    if not (scene.output.png or scene.output.pdf) or address_space() is not None:
        yield report
        return

    def load() -> None:
        with suppress(ImportError):  # raised again where it is needed
            importlib.import_module("spadwarp.viz")

    loading = threading.Thread(target=load, daemon=True)
    loading.start()

    def reported(stage: str, done: int, total: int) -> None:
        if report is not None:
            report(stage, done, total)
        if total and done >= total:
            loading.join()

    try:
        yield reported
    finally:
        loading.join()


def _answer(result: Result, files: RunFiles, **more: Any) -> None:
    """Answers with a run in a few numbers."""
    import numpy as np

    if problem := spadwarp.result.noise_problem(result):
        say(problem)
    summary, error = result.summary(), np.abs(files.depth - result.truth.depth)
    error, returned = error[np.isfinite(error)], files.depth[np.isfinite(files.depth)]
    seconds, balance = result.timing.get("trace", 0.0), summary["energy_balance"]
    rate = f", {result.photons / seconds:.3g} photons/s" if seconds > 0 else ""
    names = ("photons", "seed", "collected_fraction", "detections_per_pulse", "derivatives")
    found = {name: summary[name] for name in names if name in summary} | {
        "device": f"{result.provenance.get('device', 'unknown')}, {seconds:.3g} s{rate}",
        "depth_m": [float(returned.min()), float(returned.max())] if returned.size else None,
        "median_depth_error_mm": 1000.0 * float(np.median(error)) if error.size else None,
    }
    # The relative error is of traced light: beside the noise ratio of reconstructed light it would mislead.
    errors = ("noise_ratio", "relative_error") if result.reconstruction is None else ("noise_ratio",)
    found |= {name: summary[name] for name in errors if result.batches > 1}
    found["energy_balance"] = "exact" if balance["exact"] else f"OFF BY {balance['difference']} UNITS"
    answer({**summary, **more, "files": files.written}, shown=found)


def _check_records(scene: Scene, *, whole: bool) -> None:
    """Whether records of all photons can be kept; `whole`: of photons from 0 on."""
    if not whole:
        wrong("needs all photons from photon 0 on", "--records")
    if scene.transport.photons == "auto" or scene.transport.photons >= 2**31:
        raise ConfigError(f"--records: photons = {scene.transport.photons} is outside [1, {2**31 - 1}]")


def _simulate_moving(path: Path, trajectory: Path, out: Path, scene: Scene, **options: Any) -> None:
    """Simulates the frames of a scene that moves, and shows them."""
    names = ("sequence.h5", "sequence.gif")
    check_outputs(out, names, inputs=(path, trajectory, *scene.files))
    file = spadwarp.frames.simulate_sequence(scene, trajectory, out / names[0], progress=progress("frames"), **options)
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
    files = spadwarp.files
    result = spadwarp.merge(opt.load_run(place) for place in runs)
    needed = files.bytes_needed(result.scene, derivatives=len(result.derivatives))
    check_outputs(out, files.RUN_FILES, inputs=(*runs, *result.scene.files), needed=needed)
    made = files.write_run(result, out, device=device)
    _answer(result, made, photon_ranges=result.photon_ranges)
    say("photon ids  " + ", ".join(f"{count(start)} to {count(stop - 1)}" for start, stop in result.photon_ranges))


@command()
def reconstruct(run: Path, *, out: Path | None = None, device: str | None = None) -> None:
    """Smooth the light of a run by what is known of its scene exactly: truth depth, shadows, the laser's footprint.

    The traced light stays in result.h5; `depth`, `detect` and pictures take the reconstructed light, whose error is
    estimated from two halves of the photons. Writes the same files as `spadwarp simulate`.

    Args:
        run (RUN): A result, or its directory.
        out: Directory; by default that of the run.

    \b
    Example:
      spadwarp reconstruct out/
    """
    files, result = spadwarp.files, opt.load_run(run)
    place = out or (run if run.is_dir() else run.parent)
    inputs = () if out is None else (run, *result.scene.files)
    needed = files.bytes_needed(result.scene, derivatives=len(result.derivatives))
    check_outputs(place, files.RUN_FILES, resume=out is None, inputs=inputs, needed=needed)
    result = spadwarp.reconstruct(result, device=device)
    made = files.write_run(result, place, device=device, keep=("records.h5",) if out is None else ())
    _answer(result, made)


# Of --rendered: arguments of `spadwarp.result.load_truth_exr`.
_IMAGES = {"depth": Path, "depth_channel": str, "depth_scale": opt.real_number, "radial": bool, "normal": Path}
_IMAGES |= {"albedo": opt.number_or_text, "albedo_channel": str, "preset": str}
_Images = Annotated[dict[str, Any], opt.items(_IMAGES)]


@command()
def analytic(
    scene: Path,
    *,
    out: Path,
    frames: int = 1,
    seed: int = 0,
    overrides: list[str] | None = None,
    rendered: _Images | None = None,
    profile: Path | None = None,
    device: str | None = None,
) -> None:
    """Depth frames by the analytic model.

    From the scene's targets, or from images rendered with the scene's camera. Writes analytic.h5 (maps, frames, and
    labels of the pixels that report background) and analytic.png.

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
    read, maps = opt.read_scene(scene, overrides), rendered or {}
    if maps and "depth" not in maps:
        wrong(f"{', '.join(maps)} needs depth=EXR", "--rendered")
    if isinstance(albedo := maps.get("albedo"), str):
        maps["albedo"] = Path(albedo)
    if profile is not None and read.analytic.backscatter != "monte_carlo":
        text = f"needs --set analytic.backscatter=monte_carlo; the scene's is {read.analytic.backscatter!r}"
        wrong(text, "--profile")
    inputs = [scene, *read.files, *(value for value in maps.values() if isinstance(value, Path)), profile]
    needed = (5 * max(frames, 0) + 200) * read.camera.width * read.camera.height + (16 << 20)
    check_outputs(out, ("analytic.h5", "analytic.png"), inputs=inputs, needed=needed)
    if frames < 0:
        raise ArgumentError(f"frames = {frames} is outside [0, inf)")
    opt.warn_of(read)
    result = spadwarp.simulate_analytic(
        read,
        truth=spadwarp.result.load_truth_exr(camera=read.camera, **maps) if maps else None,
        frames=min(frames, 1),
        seed=seed,
        device=device,
        backscatter_profile=None if profile is None else opt.load_run(profile),
    )
    files = [result.save(out / "analytic.h5", frames=frames, device=device)]
    files.append(spadwarp.viz.draw(result, out / "analytic.png"))
    notes = spadwarp.analytic.model_notes(read)
    answer({**spadwarp.files.summary(result), "frames": frames, "notes": notes, "files": files})
