"""The cards of datasets and of their exports: README.md with the YAML front matter that hubs of datasets read."""

from __future__ import annotations

import json
from collections.abc import Mapping
from typing import Any

from spadwarp.dataset.recipe import SPLITS
from spadwarp.dataset.sampling import Plan
from spadwarp.dataset.schema import FRAME_COLUMNS, HISTOGRAM_COLUMNS, Column, scene_columns

__all__ = ["card", "export_card"]

_TAGS = ("spad", "single-photon", "underwater", "lidar", "depth", "denoising", "simulation")
_SIZES = {"n<1K": 1e3, "1K<n<10K": 1e4, "10K<n<100K": 1e5, "100K<n<1M": 1e6, "1M<n<10M": 1e7}


def card(plan: Plan, manifest: dict[str, Any]) -> str:
    """The text of README.md."""
    recipe = plan.recipe
    used = {split: manifest["splits"][split] for split in SPLITS if manifest["splits"][split]["shards"]}
    size_text = _size(manifest["files"])
    splits = [
        f"| {name} | {', '.join(split['targets'])} | {split['frames']} | {split['seed']} |"
        for name, split in used.items()
    ]
    columns = {name: (unit, text) for name, (_, _, unit, text) in scene_columns(plan.shape).items()}
    tables = [
        *_table("`frames-*.h5`", "One row for each frame.", FRAME_COLUMNS),
        *_table("`scenes.h5`", "One row for each scene. It refers to the files in `scenes/` beside it.", columns),
    ]
    if any(name.startswith("histograms-") for name in manifest["files"]):
        tables += _table("`histograms-*.h5`", "Of the scenes that were traced photon by photon.", HISTOGRAM_COLUMNS)
    return "\n".join(
        [
            *_front_matter(plan, used),
            "",
            f"# {recipe.name}",
            "",
            *([recipe.description, ""] if recipe.description else []),
            f"{plan.sample_count} simulated single-photon depth frames of {plan.shape[1]} × {plan.shape[0]} pixels, of "
            f"{plan.scene_count} underwater scenes with {len(plan.targets)} targets; {size_text}. Made by "
            f"spadwarp {manifest['version']} from `recipe.toml`, seed {recipe.seed}. Splits share neither targets nor "
            "seeds.",
            "",
            "| split | targets | frames | seed |",
            "|---|---|---|---|",
            *splits,
            "",
            *_license_lines(manifest),
            "## Reading",
            "",
            "```python",
            "import spadwarp.dataset",
            "",
            f'for item in spadwarp.dataset.iterate_dataset("<this folder>", split="{next(iter(used))}"):',
            '    item["noisy"], item["clean"], item["label"]     # float32 [1, H, W]; NaN: no return, nothing hit',
            "```",
            "",
            "Without spadwarp: depth [m] = offset + step · code, both attributes of `depth`"
            f" (here {plan.depth_offset:.6g} m and {plan.depth_step:.6g} m); code 0 is no return; "
            "`np.unpackbits(label, axis=-1)[..., :width]` are the labels.",
            "",
            "`spadwarp export <this folder> --format parquet --out <folder>` writes float depth, clean depth, "
            "labels and numbers for `datasets.load_dataset(<folder>)`; `webdataset` and `zarr` likewise.",
            "",
            *tables,
        ]
    )


_READING = {
    "parquet": [
        "import datasets",
        "",
        'frames = datasets.load_dataset("<this folder>", split="{split}").with_format("numpy")',
        'frames[0]["noisy"], frames[0]["clean"], frames[0]["label"]     # [H, W]',
    ],
    "webdataset": [
        "import webdataset",
        "",
        'for frame in webdataset.WebDataset("<this folder>/{split}-00000.tar").decode():',
        '    frame["noisy.npy"], frame["clean.npy"], frame["label.npy"], frame["json"]',
    ],
    "zarr": [
        "import xarray",
        "",
        'frames = xarray.open_zarr("<this folder>/frames.zarr", group="{split}")',
        "frames.noisy, frames.clean, frames.label     # [frame, y, x]",
    ],
}


def export_card(
    manifest: Mapping[str, Any],
    format: str,
    files: Mapping[str, Any],
    columns: Mapping[str, Column],
    sizes: Mapping[str, int],
) -> str:
    """The text of README.md of an export.

    Args:
        manifest: Of the dataset.
        format: Of the export.
        files: Name → `bytes`.
        columns: Fields of a frame.
        sizes: Frames of each split.
    """
    reading = [line.replace("{split}", next(iter(sizes))) for line in _READING[format]]
    rows = {name: (column.unit or "mixed", f"`{_kind(column)}` {column.meaning}") for name, column in columns.items()}
    seeds = manifest["splits"]
    lines = [
        *_front_lines(manifest["name"], manifest["frames"], manifest.get("license", "")),
        *(_parquet_lines(files, columns, sizes) if format == "parquet" else []),
        "---",
        "",
        f"# {manifest['name']}",
        "",
        *([manifest["description"], ""] if manifest.get("description") else []),
        f"{manifest['frames']} simulated single-photon depth frames of {manifest['width']} × {manifest['height']} "
        f"pixels, of {manifest['scenes']} underwater scenes with {len(manifest['targets'])} targets. Made by spadwarp "
        f"{manifest['version']}, seed {manifest['seed']}. Splits share neither targets nor seeds. `croissant.json` "
        "describes the files for programs.",
        "",
        "| split | targets | frames | seed |",
        "|---|---|---|---|",
        *(
            f"| {name} | {', '.join(seeds[name]['targets'])} | {count} | {seeds[name]['seed']} |"
            for name, count in sizes.items()
        ),
        "",
        *_license_lines(manifest),
        "## Reading",
        "",
        "```python",
        *reading,
        "```",
        "",
        *_table("Fields", "Of a frame. Camera frame: +x right, +y down, +z away from the camera; depth is z.", rows),
    ]
    return "\n".join(lines)


def _kind(column: Column) -> str:
    name = "text" if column.is_text else str(column.kind)
    return f"{name} {list(column.shape)}" if column.shape else name


def _parquet_lines(files: Mapping[str, Any], columns: Mapping[str, Column], sizes: Mapping[str, int]) -> list[str]:
    """Where each split lies, how large it is, and what its columns are, as Hugging Face reads it."""
    lines = ["configs:", "- config_name: default", "  data_files:"]
    lines += [line for name in sizes for line in (f"  - split: {name}", f"    path: data/{name}-*.parquet")]
    lines += ["dataset_info:", "  config_name: default", "  features:"]
    for name, column in columns.items():
        kind = "string" if column.is_text else str(column.kind)
        if column.shape:
            shape = ", ".join(map(str, column.shape))
            lines += [f"  - name: {name}", "    dtype:", f"      array{len(column.shape)}_d:"]
            lines += [f"        shape: [{shape}]", f"        dtype: {kind}"]
        else:
            lines += [f"  - name: {name}", f"    dtype: {kind}"]
    lines += ["  splits:"]
    total = 0
    for name, count in sizes.items():
        size = sum(record["bytes"] for file, record in files.items() if file.startswith(f"data/{name}-"))
        lines += [f"  - name: {name}", f"    num_bytes: {size}", f"    num_examples: {count}"]
        total += size
    return [*lines, f"  download_size: {total}", f"  dataset_size: {total}"]


def _size(files: Mapping[str, Any]) -> str:
    size = sum(record["bytes"] for record in files.values())
    return f"{size / 1e9:.3g} GB" if size >= 1e9 else f"{size / 1e6:.3g} MB"


def _license_lines(manifest: Mapping[str, Any]) -> list[str]:
    if not manifest.get("license"):
        return ["The recipe names no licence (`license`): ask whoever made the dataset.", ""]
    return [f"Licence: {manifest['license']}.", ""]


def _front_lines(name: str, frames: int, license: str) -> list[str]:
    """The front matter's first lines."""
    sizes = (limit for limit, most in _SIZES.items() if frames < most)
    return [
        "---",
        f"pretty_name: {json.dumps(name)}",
        *([f"license: {json.dumps(license.lower())}"] if license else []),
        "task_categories:",
        "- depth-estimation",
        "- image-to-image",
        "tags:",
        *(f"- {tag}" for tag in _TAGS),
        "size_categories:",
        f"- {next(sizes, '10M<n<100M')}",
    ]


def _front_matter(plan: Plan, splits: Mapping[str, Any]) -> list[str]:
    lines = [
        *_front_lines(plan.recipe.name, plan.sample_count, plan.recipe.license),
        "configs:",
        "- config_name: frames",
        "  data_files:",
    ]
    for name, split in splits.items():
        lines += [f"  - split: {name}", "    path:", *(f"    - {shard}" for shard in split["shards"])]
    return [*lines, "---"]


def _table(title: str, text: str, columns: Mapping[str, tuple[str, str]]) -> list[str]:
    rows = [f"| `{name}` | {unit} | {meaning} |" for name, (unit, meaning) in columns.items()]
    return [f"## {title}", "", text, "", "| dataset | unit | meaning |", "|---|---|---|", *rows, ""]
