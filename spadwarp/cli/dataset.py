"""`spadwarp dataset`: make datasets, check them, and look at them."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import Annotated

import typer

import spadwarp
from spadwarp.cli import _options as opt
from spadwarp.cli._app import Commands, app, fail, say
from spadwarp.cli._progress import progress

group = Commands(no_args_is_help=True, rich_markup_mode=None)
app.add_typer(group, name="dataset", help="Datasets of labelled depth frames: make, verify, info, preview, export.")

Folder = Annotated[Path, typer.Argument(metavar="DIR", help="A dataset's folder.", show_default=False)]


@group.command()
def make(
    recipe_path: Annotated[Path, typer.Argument(metavar="RECIPE", help="Recipe (TOML).", show_default=False)],
    out: Annotated[Path, typer.Option(metavar="DIR", help="The dataset's folder.", show_default=False)],
    part: Annotated[
        str | None,
        typer.Option(
            metavar="K/N", help="Only part K of N of the dataset: every N-th shard from the K-th; for several machines."
        ),
    ] = None,
    overrides: Annotated[
        list[str] | None,
        typer.Option("--set", metavar="SECTION.FIELD=VALUE", help="Overrides a field of the recipe; may be repeated."),
    ] = None,
    device: opt.Devices = None,
    processes: Annotated[
        int,
        typer.Option(
            parser=opt.whole_number,
            metavar="N",
            help="Largest number of processes per GPU; fewer for few shards or cores.",
        ),
    ] = 4,
    engine_name: opt.EngineName = "local",
    ray_address: opt.RayAddress = None,
    workers: opt.Workers = None,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """Makes a dataset, or its missing and damaged shards.

    The same recipe gives the same files. An interrupted call can be repeated: complete shards are kept.

    \b
    Examples:
      spadwarp dataset make configs/datasets/small.toml --out data/small/
      spadwarp dataset make configs/datasets/lu2024.toml --out data/lu2024/ --device cuda:all
      spadwarp dataset make configs/datasets/lu2024.toml --out data/lu2024/ --part 3/64
    """
    recipe = spadwarp.dataset.load_recipe(recipe_path)
    if overrides:
        recipe = recipe.with_overrides(overrides)
    engine = opt.read_engine(engine_name, ray_address, workers)
    if json_path is not None and out.resolve() in json_path.resolve().parents:
        raise typer.BadParameter(f"{json_path} is in the dataset's folder", param_hint="--json")
    outputs = opt.check_outputs(json=json_path, inputs=(recipe_path,), overwrite=overwrite)
    with progress(quiet=quiet, unit="frames") as report:
        found = spadwarp.dataset.make_dataset(
            recipe,
            out,
            device=device,
            processes=processes,
            engine=engine,
            part=opt.read_part(part, "--part") or (1, 1),
            progress=report,
        )
    summary = {
        "folder": found.folder,
        "frames": found.frames,
        "made": list(found.made),
        "kept": len(found.kept),
        "broken": list(found.broken),
        "missing": len(found.missing),
    }
    if not quiet:
        table = {"made": f"{opt.count(len(found.made))} shards with {opt.count(found.frames)} frames in {out}"}
        if found.kept:
            table["kept"] = f"{opt.count(len(found.kept))} shards that were complete"
        if found.broken:
            table["replaced"] = "; ".join(found.broken)
        if found.missing:
            table["missing"] = f"{opt.count(len(found.missing))} shards, left to other machines"
        say(opt.rows(table))
    outputs.write_json(summary)


@group.command()
def verify(
    folder: Folder, overwrite: opt.Overwrite = False, quiet: opt.Quiet = False, json_path: opt.Json = None
) -> None:
    """Compares every file of a dataset with its checksum.

    Exit code 1 if something is missing or damaged.

    \b
    Example:
      spadwarp dataset verify data/small/
    """
    outputs = opt.check_outputs(json=json_path, inputs=(folder,), overwrite=overwrite)
    wrong = spadwarp.dataset.verify_dataset(folder)
    outputs.write_json({"folder": folder, "wrong": wrong})
    if wrong:
        fail("\n".join(wrong) + "\n`spadwarp dataset make` makes them again")
    if not quiet:
        say(f"{folder}: complete")


@group.command()
def info(folder: Folder, overwrite: opt.Overwrite = False, json_path: opt.Json = None) -> None:
    """Contents of a dataset.

    \b
    Example:
      spadwarp dataset info data/small/
    """
    from spadwarp.dataset import read_manifest

    outputs = opt.check_outputs(json=json_path, inputs=(folder,), overwrite=overwrite)
    manifest = read_manifest(folder)
    size = sum(one["bytes"] for one in manifest["files"].values())
    table = {
        "name": manifest["name"],
        "frames": f"{opt.count(manifest['frames'])} of {manifest['width']} x {manifest['height']} pixels, "
        f"{opt.count(manifest['scenes'])} scenes, {opt.in_bytes(size)}",
        "depth": f"{manifest['depth_offset']:.6g} m + {manifest['depth_step']:.6g} m per unit",
    }
    for name, split in manifest["splits"].items():
        table[name] = f"{opt.count(split['frames'])} frames: {', '.join(split['targets']) or 'none'}"
    say(opt.rows(table))
    outputs.write_json(manifest)


class ExportFormat(enum.StrEnum):
    """`spadwarp.dataset.EXPORT_FORMATS`, known without loading it."""

    parquet = "parquet"
    webdataset = "webdataset"
    zarr = "zarr"


@group.command(name="export")
def export_command(
    folder: Folder,
    out: Annotated[Path, typer.Option(metavar="DIR", help="A new folder for the files.", show_default=False)],
    format: Annotated[ExportFormat, typer.Option(help="Format of the files.")] = ExportFormat.parquet,
    fields: Annotated[
        list[str] | None,
        typer.Option(
            "--field",
            metavar="NAME",
            help="Image of a frame; may be repeated: noisy, clean, label, intensity, bound, normal, albedo, prior, and "
            "of traced scenes features, counts, expected, polarisation. By default the first five, and features.",
        ),
    ] = None,
    frames_per_file: Annotated[
        int, typer.Option(parser=opt.whole_number, metavar="N", help="Most frames of a Parquet file or an archive.")
    ] = 1000,
    overwrite: opt.Overwrite = False,
    quiet: opt.Quiet = False,
    json_path: opt.Json = None,
) -> None:
    """A dataset as trainers load it in one line: depth in metres, labels, numbers.

    \b
    parquet     datasets.load_dataset(DIR) of Hugging Face
    webdataset  train-00000.tar, ... of .npy images and one .json a frame
    zarr        xarray.open_zarr(DIR / "frames.zarr", group="train")

    With a card (README.md) and Croissant metadata (croissant.json). Needs spadwarp[datasets], but webdataset.

    \b
    Examples:
      spadwarp dataset export data/small/ --format parquet --out data/small-parquet/
      spadwarp dataset export data/small/ --format webdataset --field noisy --field clean --out data/small-tar/
    """
    outputs = opt.check_outputs(json=json_path, inputs=(folder,), overwrite=overwrite)
    if out.resolve() == folder.resolve() or out.resolve() in folder.resolve().parents:
        raise typer.BadParameter(f"{out} holds the dataset", param_hint="--out")
    if out.exists() and not overwrite and not (out.is_dir() and not any(out.iterdir())):
        raise typer.BadParameter(f"{out} exists; --overwrite replaces it", param_hint="--out")
    with progress(quiet=quiet, unit="frames") as report:
        spadwarp.dataset.export_dataset(
            folder,
            out,
            format.value,
            fields=fields,
            frames_per_file=frames_per_file,
            overwrite=overwrite,
            progress=report,
        )
    size = sum(path.stat().st_size for path in out.rglob("*") if path.is_file())
    if not quiet:
        say(opt.rows({"written": f"{out}, {opt.in_bytes(size)}"}))
    outputs.write_json({"folder": out, "bytes": size})


class Split(enum.StrEnum):
    """What `spadwarp.dataset.FrameReader` takes as split."""

    train = "train"
    validation = "validation"
    test = "test"
    all = "all"


@group.command()
def preview(
    folder: Folder,
    out: Annotated[Path | None, typer.Option(metavar="PNG", help="The picture; by default preview.png in DIR.")] = None,
    split: Annotated[Split, typer.Option(help="Split of the frames.")] = Split.all,
    frames: Annotated[
        int, typer.Option(parser=opt.whole_number, metavar="N", help="Number of frames, spread evenly over the split.")
    ] = 20,
    overwrite: opt.Overwrite = False,
) -> None:
    """Draws frames of a dataset on one sheet.

    True depth, measured depth, recorded photons.

    \b
    Example:
      spadwarp dataset preview data/small/ --out sheet.png
    """
    from spadwarp.dataset import read_manifest
    from spadwarp.viz import draw_dataset

    read_manifest(folder)  # before a folder is made for the picture
    picture = out or folder / "preview.png"
    opt.check_outputs(files={"--out": picture}, inputs=(folder,), overwrite=overwrite)
    path = draw_dataset(folder, picture, split=split.value, frames=frames)
    say(f"written: {path}")


__all__ = ["export_command", "group", "info", "make", "preview", "verify"]
