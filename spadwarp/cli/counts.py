"""Commands from counts to depth: `detect`, `depth`, `fit`, `denoise`."""

from __future__ import annotations

import dataclasses
import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, get_args

import typer

import spadwarp
from spadwarp.cli import options as opt
from spadwarp.cli.app import complain, note, say, wrong
from spadwarp.cli.options import command
from spadwarp.cli.outputs import answer, check_outputs, progress, rows, show_table, write_json, written
from spadwarp.values import ArgumentError, ConfigError, FileError, count, percent, rounded

if TYPE_CHECKING:
    from spadwarp import Result, Scene
    from spadwarp.frames import Recording
    from spadwarp.inverse import EstimateMap

_LASER = ("pulse_energy", "average_power", "peak_power", "repetition_rate", "pulse_fwhm_ps", "linewidth_nm", "spectrum")
_DETECTOR_FIELDS = ("detector", "daylight", *(f"laser.{name}" for name in _LASER))
"""What a detector sees of a scene; the rest has decided which photons came."""
_NOISE = 0.1  # part of the bound's information that is noise of the simulation, from which on it is said


@command()
def detect(
    run: Path,
    *,
    out: Path,
    pulses: int | None = None,
    frames: int = 1,
    seed: int = 0,
    method: list[opt.Method] | None = None,
    coates: bool = False,
    tags: bool = False,
    window: tuple[str, str] | None = None,
    pixel: tuple[int, int] | None = None,
    channel: opt.Channel = "I",
    overrides: list[str] | None = None,
    device: str | None = None,
) -> None:
    """Frames of counts that the camera would record.

    Writes frames.h5 (counts, depth of each estimator, its significance, intensity, the Cramér–Rao bound) and frame.png.
    Pixels below detector.min_significance have no depth. --set takes fields of detector and daylight, and of the laser
    energy or power, repetition_rate, pulse_fwhm_ps and spectrum.

    Args:
        run (RUN): A result, or its directory.
        pulses: Pulses per frame; by default detector.pulses_per_frame.
        frames: Frames to record.
        method: Estimator of depth; may be repeated. By default all four; the last is drawn.
        coates: Correct pile-up (Coates) before depth is estimated.
        tags: Also keep the time tag of every detection.
        window (NS BINS): Start [ns] and bins of the detector's window, such as 10 512. By default the run's gate.
        pixel (ROW COLUMN): Also draw the counts of this pixel.

    \b
    Example:
      spadwarp detect run1/ --pulses 1e6 --frames 100 --out frames/ --set detector.dark_count_rate=1e3
    """
    recorded = None if window is None else _window(window)
    result = _with_detector(opt.load_run(run, channel), overrides)
    scene, methods = result.scene, list(dict.fromkeys(method or get_args(opt.Method)))
    bins = recorded[1] if recorded else scene.gate.bins
    if pixel is not None and not (0 <= pixel[0] < scene.camera.height and 0 <= pixel[1] < scene.camera.width):
        wrong(f"{pixel[0]} {pixel[1]} is outside 0 0 to {scene.camera.height - 1} {scene.camera.width - 1}", "--pixel")
    shots = scene.detector.pulses_per_frame if pulses is None else pulses
    counted = min(shots, bins) if scene.detector.mode == "first_photon" else bins
    needed = max(frames, 0) * scene.camera.width * scene.camera.height * (4 * counted + 4 * len(methods) + 8)
    check_outputs(out, ("frames.h5", "frame.png"), inputs=(run,), needed=needed + (16 << 20))
    if overrides:
        opt.warn_of(scene)
    options: dict[str, Any] = {"pulses": pulses, "frames": frames, "seed": seed, "methods": methods, "tags": tags}
    options |= {"undo_pile_up": coates, "window": recorded, "device": device, "progress": progress("frames")}
    recording = spadwarp.frames.record_frames(result, out / "frames.h5", **options)
    for text in (*recording.file.notes, *_bound_noise(recording, result.photons)):
        complain(text, "note")
    files = [recording.file.path, spadwarp.viz.draw(recording.file, out / "frame.png", pixel=pixel)]
    found = _recorded(recording, frames)
    each, limit = found["detections_per_pulse_and_pixel"], spadwarp.analytic.PILE_UP
    light = float(result.detections.sum(axis=2).mean())
    lost = light > 0.0 and recording.file.target_noise_ratio == math.inf  # all of it, which is said already
    if each > limit and scene.detector.mode == "first_photon" and not (coates or lost):
        text = f"pile-up: {each:.2g} detections per pulse and pixel, more than {limit:g}, shift depth towards the laser"
        less = "laser.pulse_energy" if light > 0.5 * each else "dark counts and ambient light"
        complain(f"{text}; less {less}, or --coates", "warning")
    answer({**found, "channel": channel, "files": files})


def _window(window: tuple[str, str]) -> tuple[float, int]:
    """Start [s] and bins."""
    try:
        return 1e-9 * opt.from_unit("ns")(window[0]), opt.whole_number(window[1])
    except typer.BadParameter as error:
        wrong(error.message, "--window")


def _with_detector(result: Result, overrides: list[str] | None) -> Result:
    """The result with another detector; other fields would belong to another run."""
    for one in overrides or []:
        field = one.partition("=")[0].strip()
        if not any(field == known or field.startswith(f"{known}.") for known in _DETECTOR_FIELDS):
            raise ConfigError(f"--set: {field} is not a field of {', '.join(_DETECTOR_FIELDS)}; simulate again")
    return dataclasses.replace(result, scene=result.scene.with_overrides(overrides or []))


def _recorded(recording: Recording, frames: int) -> dict[str, Any]:
    import numpy as np

    file, noise, bound = recording.file, recording.bound.noise, recording.file.bound_depth()
    bound = bound[~np.isnan(bound)]
    median = float(np.median(bound)) if bound.size else math.inf
    per_pixel = recording.detections / (frames * file.shape[1] * file.shape[2])
    return {
        "pulses": file.pulses,
        "frames": frames,
        "seed": file.seed,
        "detections_per_frame_and_pixel": per_pixel,
        "detections_per_pulse_and_pixel": per_pixel / file.pulses,
        "bound": {
            "pixels": int(bound.size),
            "median_m": median if math.isfinite(median) else None,
            "noise_fraction": noise if math.isfinite(noise) else None,
        },
        "depth": {name: dataclasses.asdict(error) for name, error in recording.errors.items()},
        "noise_ratio": file.target_noise_ratio if math.isfinite(file.target_noise_ratio or 0.0) else None,
        "notes": list(file.notes),
    }


def _bound_noise(recording: Recording, photons: int) -> list[str]:
    """How much of the bound's information was noise, and the photons that would leave a tenth."""
    noise = recording.bound.noise
    if not noise > _NOISE or recording.bound.problem is not None:
        return []
    return [
        f"{percent(noise)} % of the information in the median pixel was noise of the simulation; the Cramér–Rao bound "
        + ("is without it, and only roughly known" if noise > 0.3 else "is without it")
        + f"; about {recording.bound_photons:.1e} photons instead of {photons:.1e} would make that a tenth"
    ]


_SEEN = {"group_index": opt.real_number, "horizontal_fov_deg": opt.from_unit("°")}
_DepthInputs = Annotated[dict[str, Any], opt.items(opt.MEASURED | _SEEN)]


@command()
def depth(
    path: Path,
    *,
    out: Path,
    method: opt.Method = "centroid",
    channel: opt.Channel = "I",
    inputs: _DepthInputs | None = None,
    background: str | None = None,
    min_significance: float | None = None,
    ply: Path | None = None,
    ply_frame: Literal["camera", "world"] = "camera",
    device: str | None = None,
) -> None:
    """Depth from histograms, simulated or measured.

    Writes depth.npy (all frames), depth.exr and depth.png (the first), and of counts significance.npy. Measured
    histograms are arrays, sparse matrices, cells of time tags, or T3 records; what was inferred is printed. Without a
    field of view, the output is the range along the line of sight, for a laser in the lens.

    Args:
        path (FILE): A result or frames (.h5, or their directory), or measured: .npy, .npz, .mat, .h5, .ptu. Of an
            analytic file, a dataset or a shard its depth frames are written as they are.
        method: Estimator of the arrival time.
        min_significance (S): Of counts, pixels whose significance is below S have no depth: background alone gives more
            with a probability of 10^-S. 0: every pixel has one. By default detector.min_significance of a simulation, 4
            of measured histograms.
        ply: Also write the points of the first frame, with normals.
        ply_frame: Frame of the points: the camera's, or the world for a simulation.

    \b
    Examples:
      spadwarp depth out/result.h5 --method matched --ply points.ply --out depth/
      spadwarp depth counts.npy --method likelihood --out depth/ \\
          --input axes=tyx,bin_width=55ps,gate_start=20ns,group_index=1.3566,irf=200ps
      spadwarp depth tags.mat --input tag_unit=8ps,bin_width=64ps,gate_start=0s,group_index=1 --out depth/
    """
    import numpy as np

    from spadwarp.frames import depth_of, read_histograms

    facts, files = opt.read_measured(inputs)
    seen = {name: facts.get(name) for name in _SEEN}
    if ply is not None and ply.suffix.lower() != ".ply" and not spadwarp.io.is_stream(ply):
        wrong(f"{ply}: points are written as .ply", "--ply")
    place = spadwarp.files.locate(path)
    reduced = spadwarp.files.stored_depth(spadwarp.load(place)) if spadwarp.files.is_own_file(place) else None
    if reduced is None:
        facts = {name: value for name, value in facts.items() if name not in _SEEN}
        histograms = read_histograms(place, channel=channel, **facts)
        if ply is not None and histograms.scene is None and seen["horizontal_fov_deg"] is None:
            wrong(f"{path} has no field of view, which points need: --input horizontal_fov_deg=60", "--ply")
        for text in histograms.notes:
            complain(text, "note")
    pixels = histograms.values[..., 0].size if reduced is None else reduced.values.size
    names = [f"{one}.{ending}" for one in ("depth", "range") for ending in ("npy", "exr", "png")] + ["significance.npy"]
    level, known = _background(background)
    check_outputs(out, names, files={"--ply": ply}, inputs=(path, level, *files), needed=32 * pixels)
    if reduced is None:
        seen |= {"background": known, "min_significance": min_significance}
        reduced = depth_of(histograms, method=method, device=device, **seen)
        for text in reduced.notes:
            complain(text, "note")
    comment = f"{path.name}, {reduced.method}"
    files = spadwarp.files.write_depth(reduced, out, ply=ply, ply_frame=ply_frame, comment=comment)
    found = reduced.values[np.isfinite(reduced.values)]
    of_all: dict[str, Any] = {"min": np.min, "median": np.median, "max": np.max}
    metres = {name: float(of(found)) for name, of in of_all.items()} if found.size else None
    summary = {"pixels": pixels, "pixels_with_return": int(found.size), "metres": metres, "quantity": reduced.quantity}
    if 2 * found.size < pixels and min_significance != 0 and reduced.method != "stored":
        text = "--min-significance 0 gives every pixel one, `spadwarp denoise` uses the pixels around it"
        complain(f"{pixels - found.size} of {pixels} pixels have no significant return and so no depth; {text}", "note")
    answer({**summary, "frames": reduced.frames, "files": files})


def _background(text: str | None) -> tuple[Path | None, Any]:
    """The file of --background, and its value: a law, a number or an array."""
    from spadwarp.frames import BackgroundLaw

    laws = get_args(BackgroundLaw)
    if text is None or text in laws:
        return None, text
    try:
        return None, opt.real_number(text)
    except typer.BadParameter:
        if not text.endswith(".npy"):
            wrong(f"{text!r} is no .npy file, no number of counts and none of {', '.join(laws)}", "--background")
    return Path(text), spadwarp.io.read_npy(text, largest=1 << 29)


_Start = Annotated[dict[str, float], opt.numbers("NAME=VALUE")]
_Prior = Annotated[dict[str, tuple[float, float]], opt.numbers("NAME=MEAN,SD")]


@command(prints_result=True)
def fit(
    path: Path,
    scene: Path | None = None,
    *,
    unknown: str | None = None,
    out: Path | None = None,
    bounds: bool = False,
    start: _Start | None = None,
    prior: _Prior | None = None,
    pulses: int | None = None,
    photons: int | None = None,
    seed: int = 0,
    inputs: opt.Measured | None = None,
    overrides: list[str] | None = None,
    device: str | None = None,
) -> None:
    """Water, reflectance, background and depth from counts, by maximum likelihood; or only how well they can be known.

    The model is the whole chain: transport, instrument response, noise, pile-up or dead time. SCENE has the camera, the
    laser and all that is known. Writes fit.png (counts, fit, residuals), scene.toml (with the estimates), and NAME.npy
    and NAME_error.npy for each unknown of the pixels.

    With --bounds, SCENE stands alone, and nothing is written: Cramér–Rao bounds from one exposure, the least standard
    deviation of any unbiased estimate, when everything that is named is unknown, and when all others are known. Of
    values of the pixels, the table shows the median of the pixels that see a target.

    Args:
        path (COUNTS): Frames (.h5, or their directory), or measured histograms: .npy, .npz, .mat, .h5, .ptu;
            none with --bounds.
        scene (SCENE): Scene file (TOML), or the name of a scene of `spadwarp list scenes`.
        unknown (NAMES): Names of the unknowns, with commas between: absorption, scattering, anisotropy, reflectance (or
            targets[0].reflectance), background, depth. ':pixel' behind one of the last three gives each pixel its own.
        bounds: Only the Cramér–Rao bounds of SCENE.
        start (NAME=VALUE): Where to start; may be repeated. By default absorption and scattering from the backscatter,
            the others from the scene.
        prior (NAME=MEAN,SD): A value known from elsewhere: mean and standard deviation; may be repeated.
        pulses: Pulses of a frame, if COUNTS does not hold them; with --bounds by default detector.pulses_per_frame.
        photons: Photons of an iteration at most. By default 2e7 on the CPU, 4e8 on a GPU.

    \b
    Examples:
      spadwarp fit frames/ harbour_5m --unknown absorption,scattering,reflectance --out fit/
      spadwarp fit counts.npy scene.toml --pulses 1e6 --unknown absorption,scattering,depth:pixel \\
          --start medium.absorption=0.1 --out fit/
      spadwarp fit harbour_5m --bounds --unknown depth,absorption,scattering
    """
    if unknown is None:
        wrong("is missing; name what is not known, such as --unknown absorption,scattering", "--unknown")
    options: dict[str, Any] = {"unknown": unknown, "pulses": pulses, "photons": photons, "seed": seed, "device": device}
    options["prior"] = prior or {}
    if bounds:
        opt.refuse("cannot be combined with --bounds, which takes SCENE alone", "SCENE", "--out", "--start", "--input")
        _bounds(path, opt.read_scene(path, overrides), options)
        return
    if scene is None or out is None:
        hint, text = ("SCENE", "a scene file, or --bounds") if scene is None else ("--out", "a directory, --out fit/")
        wrong(f"is missing; give {text}", hint)
    read, (facts, files) = opt.read_scene(scene, overrides), opt.read_measured(inputs)
    names = spadwarp.files.fit_files(spadwarp.inverse.read_unknowns(read, unknown))
    check_outputs(out, names, inputs=(path, scene, *files, *read.files))
    opt.warn_of(read)
    found = spadwarp.fit(
        spadwarp.files.locate(path), read, initial_guess=start, progress=progress(), **options, **facts
    )
    for text in found.warnings:
        complain(text, "warning")
    files = spadwarp.files.write_fit(found, out)
    if found.estimates:
        show_table(
            {
                "estimate": f"{one.name} [{one.unit}]" if one.unit else one.name,
                "value": rounded(one.value, one.standard_error),
                "±": f"{one.standard_error:.2g}",
                "95 % interval": " to ".join(rounded(end, one.standard_error) for end in one.interval),
                "start": rounded(one.initial_guess, one.standard_error),
                "noise of simulation": f"{percent(one.simulation)} %",
            }
            for one in found.estimates.values()
        )
    lines = {f"{name} of each pixel": _of_pixels(one) for name, one in found.maps.items()}
    lines["goodness of fit"] = found.goodness.summary()
    lines["counts"] = f"{count(found.counts.sum())} of {count(found.pulses)} pulses"
    lines["fit"] = (
        f"{'converged' if found.converged else 'not converged'} after {len(found.iterations)} renderings of "
        f"{found.photons:.2e} photons in all, {found.seconds:.3g} s"
    )
    say(rows(lines))
    written(files)
    write_json({**found.to_dict(), "files": files})


def _bounds(path: Path, scene: Scene, options: dict[str, Any]) -> None:
    check_outputs(inputs=(path, *scene.files))
    found = spadwarp.inverse.bounds(scene, **options)
    for text in found.warnings:
        complain(text, "warning")
    table = []
    for name, one in found.bounds.items():
        row = found.names.index(name) if name in found.names else 0
        label = f"{name} [{one.unit}]" if one.unit else name
        cells = {
            "unknown": f"{label}, median pixel" if one.per_pixel else label,
            "value": "" if name == "depth" else f"{one.value:.4g}",
            "bound": one.standard_error,
            "bound [%]": "" if one.relative != one.relative else f"{100 * one.relative:.3g}",
            "others known": one.alone,
            "ratio": one.standard_error / one.alone,
        }
        others = enumerate(found.names[:row])
        table.append(cells | {f"with {other}": f"{found.correlation[row, k]:+.3f}" for k, other in others})
    show_table(table)
    say(f"{count(found.counts)} counts expected in {count(found.pulses)} pulses")
    write_json(found.to_dict())


def _of_pixels(one: EstimateMap) -> str:
    import numpy as np

    known = np.isfinite(one.value)
    if not known.any():
        return "known in none"
    median, error = (float(np.median(part[known])) for part in (one.value, one.standard_error))
    text = f"known in {count(known.sum())} of {count(known.size)}; median {median:.5g}, standard error {error:.2g}"
    return f"{text} {one.unit}".rstrip()


_ENDINGS = (".npy", "_target.npy", "_confidence.npy", "_significance.npy", "_second.npy", ".exr", ".png")
_OF_IMAGES = {"channel": str, "scale": opt.real_number, "as_depth": bool}
_DenoiseInputs = Annotated[dict[str, Any], opt.items(opt.MEASURED | _SEEN | _OF_IMAGES)]


def _gate(text: str) -> tuple[str, tuple[float, float]]:
    """Name and value of the argument for a gate in depth, or in time of flight."""
    in_time = "s" in text  # which no unit of length has
    return ("gate_time", opt.from_to("s")(text)) if in_time else ("gate", opt.from_to("m")(text))


@command()
def denoise(
    path: Path,
    *,
    out: Path,
    model: str = "pyramid",
    gate: Annotated[tuple[str, tuple[float, float]], _gate] | None = None,
    profile: Path | None = None,
    background: str | None = None,
    weights: Path | None = None,
    inputs: _DenoiseInputs | None = None,
    mask: float | None = None,
    min_significance: float | None = None,
    device: str | None = None,
    precision: Literal["float32", "float16", "bfloat16"] | None = None,
) -> None:
    """Denoise depth frames.

    Writes for each file: NAME.npy (depth of all frames), NAME_target.npy and NAME_confidence.npy (the probabilities
    that a pixel sees a target, and that its depth is right), NAME.exr (all three of the first frame) and NAME.png.
    Every pixel has a depth, also where there is only water; --mask leaves these out, and --min-significance those whose
    counts are background alone (NAME_significance.npy). Histograms become depth first:
    counts by the likelihood, rates by the log-matched filter where the instrument response is known; counts are then
    denoised with their histograms, and NAME_second.npy has second surfaces in a pixel; but those of a dataset, which
    does not keep their background. Needs pip install "spadwarp[denoise]".

    --input also takes channel=NAME (of an EXR; of a result co or cross), scale=0.01 (metres per unit) and as_depth
    (three dimensions in .npy, .npz, .mat and .h5 are frames of depth, not a histogram).

    Args:
        path (IN): A result or frames (.h5, or their directory); an analytic file, a dataset or a shard, of which the
            stored depth counts; depth (.exr, .npy, .npz, .mat, .h5), measured histograms (the same endings, .ptu), or a
            folder of them.
        model: pyramid, histograms, dncnn, usdn; or median, gating, bm3d; for counts also likelihood, pooled,
            semi-global, total-variation, belief-propagation.
        gate (FROM:TO): Gate in depth, such as 13.5:16 [m]; also in time of flight, such as 90ns:110ns. By default
            that of the file, or the range of its depths.
        profile: .npy with the water's backscatter over the gate in equal bins.
        weights: Weights of spadwarp train. By default the package's.
        mask (P): Leave out pixels that see a target with less than this probability: 0.08 for PyramidNet of depth, 0.5
            for histograms.
        min_significance (S): Of counts, leave out pixels where background alone gives more with a probability of 10^-S.
            By default detector.min_significance of a simulation, 4 of measured histograms.
        precision: Of the layers of pyramid and histograms: float32 (default), bfloat16 (default on a CPU with AMX), or
            float16 (default of pyramid on a GPU).

    \b
    Examples:
      spadwarp denoise out/result.h5 --out denoised/
      spadwarp denoise engine/ --input channel=A,scale=0.01 --gate 13.5:16 --out denoised/
    """
    import numpy as np

    from spadwarp.denoise import denoise_file, depth_files

    facts, files = opt.read_measured(inputs)
    paths = depth_files(path)
    stems = [one.stem for one in paths]
    if twice := sorted({one for one in stems if stems.count(one) > 1}):
        raise FileError(f"{path}: results of several files would be called {twice[0]!r}; name one of the files")
    needed = sum(one.stat().st_size for one in paths if one.is_file())
    names = [stem + ending for stem in stems for ending in _ENDINGS]
    level, known = _background(background)
    check_outputs(out, names, inputs=(*paths, profile, level, weights, *files), needed=needed)
    settings: dict[str, Any] = {"model": model, "weights": weights, "device": device, "mask": mask}
    settings |= dict([] if gate is None else [gate])
    settings |= {"min_significance": min_significance, "background": known, "precision": precision}
    settings["profile"] = None if profile is None else spadwarp.io.read_npy(profile, largest=1 << 20)
    lines: dict[str, str] = {}
    summary: list[dict[str, Any]] = []
    for number, one in enumerate(paths, 1):
        try:
            done = denoise_file(one, out, **settings, **facts)
        except (ConfigError, FileError, ArgumentError) as error:
            text = str(error) if str(one) in str(error) else f"{one}: {error}"
            if len(paths) == 1:
                raise type(error)(text) from None
            complain(text, "error")
            continue
        filled = float(np.isfinite(done.depth).mean())
        target = float((done.target_probability >= done.threshold).mean())
        frames = "1 frame" if len(done.depth) == 1 else f"{count(len(done.depth))} frames"
        shares = f"{100 * filled:.3g} % of the pixels have a depth, {100 * target:.3g} % show a target"
        lines[one.name] = f"{frames}, {shares}"
        facts_of_file = {"file": one, "gate": done.gate, "filled": filled, "target": target}
        summary.append({**facts_of_file, "files": done.files, "notes": done.notes})
        for text in done.notes:
            note(f"{one.name}: {text}")
        if len(paths) > 1:
            note(f"{number} of {len(paths)}")
    say(rows({**lines, "written": f"{sum(len(one['files']) for one in summary)} files in {out}"}))
    write_json({"model": model, "files": summary})
    if len(summary) < len(paths):
        raise FileError(f"{path}: {len(paths) - len(summary)} of {len(paths)} files could not be denoised")
