"""Commands that look at files: `info`, `view`, `export`."""

from __future__ import annotations

import dataclasses
import glob
from pathlib import Path
from typing import Annotated, Any, Literal

import typer

import spadwarp
from spadwarp.cli import options as opt
from spadwarp.cli.app import fail, running, say, wrong
from spadwarp.cli.options import command
from spadwarp.cli.outputs import answer, check_outputs, in_bytes, progress, readable, rows, write_json


@command(prints_result=True)
def info(path: Path, *, verify: bool = False) -> None:
    """Contents of any of our files; of a result also how it was made; of a mesh file size, unit, orientation, holes.

    A result's includes the energy balance: where the emitted light went.

    Args:
        path (FILE): A result, checkpoint, frames, analytic file, records, dataset or shard, or their directory; or a
            mesh file (STL, OBJ, PLY, OFF, GLB, USD).
        verify: Compare every file of a dataset with its checksum; exit code 1 if something is missing or damaged.

    \b
    Examples:
      spadwarp info out/result.h5
      spadwarp info data/small/ --verify
    """
    check_outputs(inputs=(path,))
    if verify:
        wrong = spadwarp.dataset.verify_dataset(path)
        write_json({"folder": path, "wrong": wrong})
        if wrong:
            fail("\n".join(wrong) + "\n`spadwarp dataset` makes them again")
        say(f"{path}: complete")
    elif _is_mesh(path):
        mesh = spadwarp.mesh.describe_mesh(path)
        answer({"kind": "mesh", **dataclasses.asdict(mesh), "hints": mesh.hints})
    elif (path / "recipe.toml").is_file():
        manifest = spadwarp.dataset.read_manifest(path)
        size = sum(one["bytes"] for one in manifest["files"].values())
        facts = {"kind": "dataset", "bytes": size, **manifest, "files": len(manifest["files"])}
        facts |= {
            name: f"{one['frames']} frames of {', '.join(one['targets'])}" for name, one in facts.pop("splits").items()
        }
        del facts["targets"]
        ratio = {k: v for k, v in spadwarp.files.summary(spadwarp.load(path)).items() if k == "noise_ratio"}
        say(readable(facts | ratio))
        write_json({"kind": "dataset", **manifest, **ratio})
    else:
        loaded = spadwarp.load(path)
        if isinstance(loaded, spadwarp.Result) and (problem := spadwarp.result.noise_problem(loaded)):
            say(problem)
        summary = spadwarp.files.summary(loaded)
        shown = dict(summary)
        if (balance := shown.pop("energy_balance", None)) is not None:  # where the emitted light went
            verdict = "exact" if balance["exact"] else f"OFF BY {balance['difference']} UNITS"
            parts = {**balance["fractions"], "sum": sum(balance["fractions"].values())}
            fractions = {name: f"{100 * part:10.6f} %" for name, part in parts.items() if part or name == "sum"}
            say(readable({"energy_balance": {"verdict": verdict, **fractions}}))
        answer(summary, shown=shown)


def _is_mesh(path: Path) -> bool:
    return path.suffix.lower() in spadwarp.io.MESH_ENDINGS


# Options of `view` by what is drawn.
_KINDS = {".gif": "video", ".mp4": "video", ".png": "picture"}
_DRAWN = {
    "page": ("--method", "--frame", "--channel"),
    "video": ("--frame", "--window", "--pictures", "--fps", "--linear", "--flux"),
    "picture": ("--pictures", "--split"),
    "picture of a mesh": (),
}
_Window = Annotated[tuple[float, float], opt.from_to("ns")]


@command()
def view(
    path: Path,
    *,
    out: Path | None = None,
    method: opt.Method | None = None,
    frame: int | None = None,
    channel: opt.Channel = "I",
    window: _Window | None = None,
    pictures: int | None = None,
    fps: float | None = None,
    linear: bool = False,
    flux: str | None = None,
    split: Literal["train", "validation", "test", "all"] | None = None,
    device: str | None = None,
) -> None:
    """A run as a page for a browser, light in flight as a video, a dataset or a mesh as a picture.

    The ending of --out decides. Page: one HTML file, also without a network connection: depth as a point cloud coloured
    by its error; depth, truth, error and intensity as images; click a pixel to see its histogram. Video: the light that
    each pixel receives, from time bin to time bin, or with --flux the light in the water; of a scene that moves its
    frames. Picture: frames of a dataset on one sheet, with true depth, measured depth and recorded photons; or a mesh
    file from several sides.

    Args:
        path (FILE): A result, frames, an analytic file, a dataset or a shard, or their directory; or a mesh file.
        out (FILE): .html for a page, .gif or .mp4 (needs ffmpeg) for a video, .png for a picture of a dataset or mesh.
            By default view.html, and of a mesh NAME.png.
        method: Page: estimator of depth.
        frame: Page and video: number of the frame, if FILE holds frames.
        channel: Page: which light counts where the camera has an analyser: I (all of it), co or cross.
        window (FROM:TO): Video: times of flight, such as 40:55 [ns]; by default those with light.
        pictures: Video: largest number of pictures, by default 120; bins are merged. Dataset: frames, spread evenly
            over the split, by default 20.
        fps (N): Video: pictures per second, up to 50; by default 12.
        linear: Video: a linear colour scale instead of four decades.
        flux (NAME): Video: the light's front in a volume of [[flux]] with gates, gate after gate.
        split: Dataset: split of the frames, by default all.

    \b
    Examples:
      spadwarp view out/
      spadwarp view frames/frames.h5 --frame 3 --out frame.html
      spadwarp view out/ --out light.mp4 --window 40:55 --fps 20
      spadwarp view data/small/ --out sheet.png
    """
    target = out or Path(f"{path.stem}.png" if _is_mesh(path) else "view.html")
    kind = _KINDS.get(target.suffix.lower(), "page")
    if _is_mesh(path):
        if kind != "picture":
            wrong(f"{target} does not end in .png: {path} is a mesh", "--out")
        kind = "picture of a mesh"
    others = {option for options in _DRAWN.values() for option in options} - {*_DRAWN[kind]}
    opt.refuse(f"is not for a {kind} ({target})", *sorted(others))
    if target.suffix.lower() not in (*_KINDS, ".html"):
        wrong(f"{target} does not end in .html, .gif, .mp4 or .png", "--out")
    if kind == "picture" and not path.is_dir() and path.suffix.lower() not in (".h5", ".hdf5"):
        wrong(f"{target} is a picture of a dataset or a mesh, and {path} is none{spadwarp.io.used(path)}", "--out")
    if kind == "picture":
        spadwarp.dataset.read_manifest(path)  # before a folder is made for the picture
    check_outputs(files={"--out": target}, inputs=(path,))
    if kind == "picture of a mesh":
        written = spadwarp.viz.draw_mesh(spadwarp.mesh.describe_mesh(path), target, device=device)
    elif kind == "picture":
        written = spadwarp.viz.draw_dataset(path, target, **opt.given(split=split, frames=pictures))
    elif kind == "video":
        more = opt.given(pictures=pictures, fps=fps, frame=frame, flux=flux)
        written = spadwarp.viz.video(path, target, window_ns=window, scale="linear" if linear else "log", **more)
    else:
        written = spadwarp.viz.view(path, target, method=method, frame=frame or 0, channel=channel, device=device)
    say(f"written: {written} ({in_bytes(written.stat().st_size)})")
    write_json({"file": written})


def _frames(text: str) -> int | slice:
    first, colon, stop = text.partition(":")
    numbers = [int(one) if one else None for one in (first, stop) if not one or one.isdecimal()]
    if len(numbers) != 2 or (not colon and not first):
        raise typer.BadParameter(f"{text!r} is not of the form N or A:B")
    return slice(*numbers) if colon else int(first)


# Formats of frames in the order of writing: those that not every source has go first, so that nothing is written where
# one is refused. The files of each in a folder, as patterns.
_FORMATS: dict[str, tuple[str, ...]] = {"fusion": ("{}.txt", "intensity/{}-[0-9]*.mat", "spad/{}-[0-9]*_p1.mat")}
_FORMATS |= {one: (f"{{}}.{one}", f"{{}}-[0-9]*.{one}") for one in ("ptu", "mat", "npy", "npz", "exr", "png", "xml")}
_FORMATS |= {one: (f"{{}}.{one}",) for one in ("parquet", "las", "laz", "zarr")}
_FORMATS["wdp"] = ("{}-waveforms.wdp", "{}-waveforms.las")
_Format = Literal[
    "npy", "npz", "png", "mat", "ptu", "exr", "xml", "fusion", "las", "laz", "wdp", "parquet", "webdataset", "zarr"
]
_Frames = Annotated[int | slice, _frames]


@command()
def export(
    path: Path,
    *,
    format: list[_Format],
    out: Path,
    frames: _Frames | None = None,
    split: str = "all",
    factor: int = 8,
    channel: opt.Channel = "I",
    seed: int = 0,
    field: list[str] | None = None,
    frames_per_file: int = 1000,
) -> None:
    """Results, frames and datasets in the formats of other programs.

    \b
    npy     NumPy: [height, width, bin], with frames before that; depth where there are no counts
    npz     the same with its axis time [s], bin_width, gate_start, group_index and true_depth [m]
    png     depth in millimetres, 16 bits, as OpenCV and ROS read it; one file a frame
    mat     MATLAB, one file a frame, as single-photon denoisers read: sparse spad, rates, bin from 1, bin_size [s]
    ptu     PicoQuant T3 image, one record a detection
    exr     images: depth, intensity, truth; one file a frame
    zarr    a result with its axes and its flux: xarray.open_zarr
    xml     the camera's calibration, as OpenCV's cv::FileStorage reads it
    fusion  mat files and a camera image of finer pixels, for sensor fusion: intensity/, spad/ with bin_hr, a list
    Single photons of a result, drawn by its detector, with position and truth, as a lidar delivers them:
    parquet     a table with a row for each: pandas, Hugging Face
    las, laz    LAS 1.4, a point for each, and the same compressed
    wdp         NAME-waveforms: waveforms of all shots, and a .las with a point for each
    A whole dataset in a new folder with a card (README.md) and Croissant metadata (croissant.json):
    parquet     datasets.load_dataset(DIR) of Hugging Face
    webdataset  train-00000.tar, ... of .npy images and one .json a frame
    zarr        xarray.open_zarr(DIR / "frames.zarr", group="train")

    The folder may hold other files, but of a whole dataset. fusion, mat and ptu are for counts (`spadwarp detect`);
    ptu needs spadwarp[formats], las, laz and wdp need spadwarp[las], parquet and zarr need spadwarp[datasets].

    Args:
        path (FILE): A result, frames, an analytic file, a dataset or a shard; or their directory.
        format: Format to write; may be repeated.
        frames (N or A:B): Only frame N, or A to B - 1; by default all.
        split: Split of a dataset: train, validation, test or all.
        factor: fusion: finer pixels of the camera image, each way.
        seed: Of the photons of parquet, las, laz and wdp.
        field: Whole dataset: image of a frame; may be repeated: noisy, clean, label, intensity, bound, normal, albedo,
            prior, and of traced scenes features, counts, expected, polarisation. By default the first five, and
            features.
        frames_per_file: Whole dataset: most frames of a Parquet file or an archive.

    \b
    Examples:
      spadwarp export frames/frames.h5 --format mat --format ptu --out exported/
      spadwarp export data/small/ --split test --frames 0:20 --format exr --out exported/
      spadwarp export data/small/ --format webdataset --field noisy --field clean --out data/small-tar/
    """
    source = spadwarp.files.locate(path)
    if whole := [one for one in format if one not in _FORMATS or (one in ("parquet", "zarr") and source.is_dir())]:
        if len(set(format)) > 1:
            wrong(f"{whole[0]} cannot be combined with other formats", "--format")
        _export_dataset(path, whole[0], out, field, frames_per_file)
        return
    opt.refuse("is for parquet, webdataset and zarr", "--field", "--frames-per-file")
    stem = source.resolve().stem
    names = [name.format(glob.escape(stem)) for one in set(format) for name in _FORMATS[one]]
    needed = source.stat().st_size if source.is_file() else 0
    check_outputs(out, names, inputs=(source,), beside=True, needed=needed)
    lines: dict[str, str] = {}
    files: list[Path] = []
    for one in sorted(set(format), key=[*_FORMATS].index):
        options: dict[str, Any] = {"frames": frames, "split": split}
        if one == "fusion":
            paths = spadwarp.files.export_sensor_fusion(source, out, stem=stem, factor=factor, **options)
        else:
            name = f"{stem}-waveforms.wdp" if one == "wdp" else f"{stem}.{one}"
            paths = spadwarp.export(source, out / name, channel=channel, seed=seed, **options)
        lines[one] = f"{paths[0]}" + (f" to {paths[-1].name} ({len(paths)} files)" if len(paths) > 1 else "")
        files += paths
    say(rows(lines))
    write_json({"files": files})


def _export_dataset(folder: Path, format: str, out: Path, fields: list[str] | None, frames_per_file: int) -> None:
    check_outputs(inputs=(folder,))
    if out.resolve() == folder.resolve() or out.resolve() in folder.resolve().parents:
        wrong(f"{out} holds the dataset", "--out")
    if out.exists() and not running.overwrite and not (out.is_dir() and not any(out.iterdir())):
        wrong(f"{out} exists; --overwrite replaces it", "--out")
    options: dict[str, Any] = {"fields": fields, "frames_per_file": frames_per_file, "overwrite": running.overwrite}
    spadwarp.dataset.export_dataset(folder, out, format, progress=progress("frames"), **options)
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    say(rows({"written": f"{out}, {in_bytes(size)}"}))
    write_json({"folder": out, "bytes": size})
