"""Commands about learning: `dataset`, `train`, `evaluate`."""

from __future__ import annotations

import sys
from contextlib import redirect_stdout
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import spadwarp
from spadwarp.cli import options as opt
from spadwarp.cli.app import complain, note, running, say, wrong
from spadwarp.cli.options import command
from spadwarp.cli.outputs import answer, check_outputs, progress, rows, show_table, write_json, written
from spadwarp.values import count

if TYPE_CHECKING:
    from spadwarp.evaluation import Evaluation, FreshScores, PhotonSweep, SceneScores


@command()
def dataset(
    recipe: Path,
    *,
    out: Path,
    part: opt.Part | None = None,
    overrides: list[str] | None = None,
    devices: str | None = None,
    processes: int = 4,
    ray: str | None = None,
    workers: int | None = None,
) -> None:
    """Make a dataset of labelled depth frames, or its missing and damaged shards.

    The same recipe gives the same files. An interrupted call can be repeated: complete shards are kept. `spadwarp
    info`, `view` and `export` take its folder.

    Args:
        recipe (RECIPE): Recipe (TOML), or the name of one of `spadwarp list datasets`.
        out (DIR): The dataset's folder.
        part (K/N): Only part K of N of the dataset: every N-th shard from the K-th; for several machines.
        processes: Largest number of processes per GPU; fewer for few shards or cores.

    \b
    Examples:
      spadwarp dataset configs/datasets/small.toml --out data/small/
      spadwarp dataset configs/datasets/lu2024.toml --out data/lu2024/ --device cuda:all --part 3/64
    """
    read = spadwarp.dataset.load_recipe(recipe)
    if overrides:
        read = read.with_overrides(overrides)
    engine = opt.read_engine(ray, workers)
    if running.json is not None and out.resolve() in running.json.resolve().parents:
        wrong(f"{running.json} is in the dataset's folder", "--json")
    check_outputs(inputs=(recipe,))
    common: dict[str, Any] = {"device": devices, "processes": processes, "engine": engine, "part": part or (1, 1)}
    with redirect_stdout(sys.stderr):  # where Ray reports the loss of a worker: stdout is for results
        found = spadwarp.dataset.make_dataset(read, out, progress=progress("frames"), **common)
    summary = {"folder": found.folder, "frames": found.frames, "made": list(found.made), "kept": len(found.kept)}
    summary |= {"broken": list(found.broken), "missing": len(found.missing)}
    shown = {"folder": found.folder, "made": f"{count(len(found.made))} shards, {count(found.frames)} frames"}
    shown["kept"] = f"{count(len(found.kept))} shards" + ", complete before" * (not found.made and not found.missing)
    answer(summary, shown={**shown, "broken": summary["broken"], "missing": summary["missing"]})


@command()
def train(recipe: Path, *, out: Path, overrides: list[str] | None = None, device: str | None = None) -> None:
    """Train a denoiser on scenes that are drawn as it goes, or on the clean scenes of a dataset.

    New noise is drawn for each step. Writes weights (safetensors), log.jsonl, curves.png and a checkpoint, also at
    Ctrl-C or SIGTERM; the same command resumes the training. Another recipe needs a new folder. Prints the PSNR [dB] of
    the network and of its input, on drawn scenes; or on noisy frames of the dataset's validation split, where that of
    the best median filter stands beside them.

    Args:
        recipe (RECIPE): Training recipe (TOML), or the name of one of `spadwarp list training`.
        overrides (SECTION.FIELD=VALUE): Overrides a field of RECIPE, such as data=DIR, seed=3, optimiser.steps=2e4; may
            be repeated.

    \b
    Example:
      spadwarp train configs/training/pyramid.toml --out runs/pyramid/
      spadwarp train short --set data=data/small/ --out runs/short/
    """
    chosen = spadwarp.denoise.load_training_recipe(recipe, overrides or ())
    names = (f"{chosen.model}.safetensors", "log.jsonl", "curves.png", "checkpoint.pt")
    check_outputs(out, names, inputs=(recipe,), resume=True)
    trained = spadwarp.denoise.train(chosen, out, device=device, progress=progress("steps"), notify=note)
    shown: dict[str, Any] = {"psnr": trained.psnr, "input_psnr": trained.input_psnr}
    if chosen.data is not None and chosen.model != "histograms":  # by the noise of the frames that the user has
        options: dict[str, Any] = {"models": ["median"], "split": "validation", "frames": 4, "weights": trained.weights}
        found = spadwarp.evaluation.evaluate(chosen.data, device=device, **options)
        methods = {"psnr": "own", "input_psnr": "input", "median_psnr": "median"}
        shown |= {name: found.mean(method).psnr for name, method in methods.items()}
    if shown["psnr"] < shown["input_psnr"]:
        complain("the network makes frames worse than they are: more steps, or the recipe `short`, help", "warning")
    answer({**shown, "seconds": trained.seconds, "weights": trained.weights})


_PICTURES = ("metrics", "samples", "rescaled", "detail", "ranking", "photons", "reliability")
_REPORT = ("report.html", "scores.json", *(f"{name}.png" for name in _PICTURES))


@command(prints_result=True)
def evaluate(
    data: Path | None = None,
    *,
    models: str = "all",
    split: str = "test",
    frames: int = 20,
    bm3d_frames: int = 0,
    crop: tuple[int, int] | None = None,
    report: Path | None = None,
    weights: Path | None = None,
    seed: int | None = None,
    fresh: int | None = None,
    device: str | None = None,
) -> None:
    """Compare denoisers by scene type, on a dataset, or on frames with few photons.

    Without DATA: scenes before a wall, above a floor and in open water, with backscatter from in front, from the whole
    gate and from near-range; gains, errors near rims and inside, targets missed and invented. With --fresh: the network
    for histograms against classical estimates, each with the tuning that the truth prefers, on histograms that nobody
    has seen, half of them rendered by transport. On a dataset: PSNR, SSIM and entropy over the gate, errors
    in millimetres, steps resolved. On a Monte Carlo result: frames of 1 to 100 signal photons a pixel at several
    signal-to-background ratios, RMSE beside the Cramér-Rao bound.

    Args:
        data ([DATA]): A dataset's folder; or a Monte Carlo result. Without it, scenes of the package that no training
            saw.
        models (NAMES): "all", or a list: median, gating, bm3d, usdn, dncnn, pyramid; for results all of `denoise`.
        split: test, validation, train or all.
        frames: Frames of each target and level.
        bm3d_frames: Frames of each level for BM3D, up to a minute each.
        crop (WIDTH HEIGHT): Only the middle part of each frame [pixels]; 128 96 makes BM3D faster.
        report (DIR): Also write report.html, its pictures and scores.json there; for a result only photons.png.
        weights: Weights of spadwarp train, compared as "your weights"; with --fresh in place of the package's.
        seed: Seed of the noise, except that of a dataset; by default 0. With --fresh also of the scenes; by default of
            the clock.
        fresh (N): Histograms of N fresh scenes; about 10 s each on two cores.

    \b
    Examples:
      spadwarp evaluate --report report/
      spadwarp evaluate --fresh 20
      spadwarp evaluate data/small/ --weights runs/short/pyramid.safetensors --report report/
      spadwarp evaluate data/lu2024/ --models bm3d,pyramid --frames 7 --bm3d-frames 20 --crop 128 96
      spadwarp evaluate out/result.h5 --report photons/
    """
    evaluation = spadwarp.evaluation
    chosen = [name.strip() for name in ("median,gating,usdn,dncnn,pyramid" if models == "all" else models).split(",")]
    check_outputs(report, _REPORT, inputs=(data, weights), option="--report")
    options: dict[str, Any] = {"models": chosen, "seed": seed or 0}
    run: Any = evaluation.evaluate_scenes
    show: Any = _show_scenes
    write: Any = evaluation.write_scene_report
    of_run = data is not None and (data.is_file() or (data / "result.h5").is_file())
    if fresh is not None or data is None or of_run:
        opt.refuse("is for a dataset", "--split", "--frames", "--bm3d-frames", "--crop")
    if fresh is not None:
        opt.refuse("cannot be combined with --fresh, which makes scenes of its own", "DATA", "--models", "--report")
        run, show, write, options = evaluation.evaluate_fresh, _show_fresh, None, {"scenes": fresh, "seed": seed}
    elif data is not None and of_run:
        if problem := spadwarp.result.noise_problem(result := opt.load_run(data)):
            complain(problem, "warning")  # it counts as light here
        run, show = partial(evaluation.photon_sweep, result), _show_photons
        options["models"] += ["histograms"] * (models == "all")

        def write(found: PhotonSweep, folder: Path) -> list[Path]:
            return [evaluation.draw_photon_sweep(found, folder / "photons.png")]

    elif data is not None:
        run, show, write = partial(evaluation.evaluate, data), _show_gains, evaluation.write_report
        bm3d_frames = bm3d_frames or (20 if "bm3d" in chosen else 0)
        options = {"models": chosen, "split": split, "frames": frames, "bm3d_frames": bm3d_frames, "crop": crop}
    found = run(weights=weights, device=device, progress=progress("frames" if fresh is None else "scenes"), **options)
    files = [] if report is None or write is None else write(found, report)
    show(found)
    written(files)
    write_json({**found.to_dict(), "files": files})


def _show_gains(found: Evaluation) -> None:
    """Of a dataset, by backscatter fraction or photons."""
    titles = spadwarp.evaluation.TITLES
    table = []
    for method in found.ranking():
        row = {"method": titles[method]}
        for level in (*found.levels, None):
            after, before = (found.mean(name, level=level).psnr for name in (method, "input"))
            row[level or "mean"] = f"{after:.2f}" if method == "input" else f"{after - before:+.2f}"
        table.append(row)
    say(f"PSNR of the input, and gain over it [dB], by backscatter fraction or photons; {found.summary}")
    show_table(table)
    for method in found.methods if found.steps else ():
        steps = [item for (name, _), item in found.steps.items() if name == method]
        say(f"{titles[method]}: {sum(s.resolved for s in steps)} of {sum(s.total for s in steps)} steps")


def _show_scenes(found: SceneScores) -> None:
    """Scenes that no training saw, by scene type."""
    for setting, water in found.types():
        names, lines = spadwarp.evaluation.scene_table(found, setting, water)
        say(f"{setting}, backscatter {water}: PSNR of the input and gains over it [dB] by backscatter fraction")
        show_table(dict(zip(names, line, strict=True)) for line in lines)


def _show_fresh(found: FreshScores) -> None:
    """Fresh histograms: the network, and the classical variants that are best on each scene."""
    table = []
    for one in found.scenes:
        best = min(one.classical, key=lambda name: one.classical[name])
        row: dict[str, Any] = {"scene": one.text, "RMSE [mm]": f"{1e3 * one.rmse['histograms']:.1f}"}
        row["own background [mm]"] = f"{1e3 * one.rmse['histograms, own background']:.1f}"
        table.append({**row, "best classical [mm]": f"{1e3 * one.classical[best]:.1f}", "which": best})
    show_table(table)
    say(rows({name.replace("_", " "): value for name, value in found.summary().items()}))


def _show_photons(found: PhotonSweep) -> None:
    """Frames of few photons from a result."""
    titles = {"input": "likelihood of each pixel", **spadwarp.evaluation.TITLES, "bound": "Cramér–Rao bound"}
    say(f"RMSE [mm]; {found.summary}")
    for row, ratio in enumerate(found.sbr):
        methods = {name: values[row] for name, values in found.rmse.items()} | {"bound": found.bound[row]}
        columns = [f"SBR {ratio:g}", *(f"{n:g} photon{'s' * (n != 1)}" for n in found.photons)]
        lines = [[titles[name], *(1e3 * float(one) for one in values)] for name, values in methods.items()]
        show_table(dict(zip(columns, line, strict=True)) for line in lines)
