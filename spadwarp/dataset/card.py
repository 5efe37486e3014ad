"""The card of a dataset or an export, README.md with the YAML front matter that hubs of datasets read, and its
croissant.json: JSON-LD that hubs, search engines and `mlcroissant` read (version 1.0)."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np

from spadwarp.dataset.recipe import SPLITS
from spadwarp.dataset.shards import FRAME_COLUMNS, HISTOGRAM_COLUMNS, Column, scene_columns

_TAGS = ("spad", "single-photon", "underwater", "lidar", "depth", "denoising", "simulation")
_SIZES = {"n<1K": 1e3, "1K<n<10K": 1e4, "10K<n<100K": 1e5, "100K<n<1M": 1e6, "1M<n<10M": 1e7}
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
    "hdf5": [
        "import spadwarp.dataset",
        "",
        'for item in spadwarp.dataset.iterate_dataset("<this folder>", split="{split}"):',
        '    item["noisy"], item["clean"], item["label"]     # float32 [1, H, W]; NaN: no return, nothing hit',
    ],
}
_MEDIA = {
    "hdf5": "application/x-hdf5",
    "parquet": "application/x-parquet",
    "webdataset": "application/x-tar",
    "zarr": "application/json",
}


def card(manifest: Mapping[str, Any]) -> str:
    """The text of README.md of a dataset."""
    used = {split: manifest["splits"][split] for split in SPLITS if manifest["splits"][split]["shards"]}
    front = ["configs:", "- config_name: frames", "  data_files:"]
    for name, split in used.items():
        front += [f"  - split: {name}", "    path:", *(f"    - {shard}" for shard in split["shards"])]
    scenes = scene_columns((manifest["height"], manifest["width"]))
    tables = [
        *_table("`frames-*.h5`", "One row for each frame.", _rows(FRAME_COLUMNS)),
        *_table("`scenes.h5`", "One row for each scene. It refers to the files in `scenes/` beside it.", _rows(scenes)),
    ]
    if any(name.startswith("histograms-") for name in manifest["files"]):
        text = "Of the scenes that were traced photon by photon."
        tables += _table("`histograms-*.h5`", text, _rows(HISTOGRAM_COLUMNS))
    notes = [
        "Without spadwarp: depth [m] = offset + step · code, both attributes of `depth`"
        f" (here {manifest['depth_offset']:.6g} m and {manifest['depth_step']:.6g} m); code 0 is no return; "
        "`np.unpackbits(label, axis=-1)[..., :width]` are the labels.",
        "",
        "`spadwarp export <this folder> --format parquet --out <folder>` writes float depth, clean depth, "
        "labels and numbers for `datasets.load_dataset(<folder>)`; `webdataset` and `zarr` likewise.",
        "",
    ]
    sizes = {name: split["frames"] for name, split in used.items()}
    size = sum(record["bytes"] for record in manifest["files"].values())
    size_text = f"; {size / 1e9:.3g} GB" if size >= 1e9 else f"; {size / 1e6:.3g} MB"
    made = size_text, " from `recipe.toml`", ""
    return _page(manifest, "hdf5", front, sizes, made, [*notes, *tables])


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
    rows = [(name, column.unit or "mixed", f"`{_kind(column)}` {column.meaning}") for name, column in columns.items()]
    text = "Of a frame. Camera frame: +x right, +y down, +z away from the camera; depth is z."
    front = _parquet_lines(files, columns, sizes) if format == "parquet" else []
    made = "", "", " `croissant.json` describes the files for programs."
    return _page(manifest, format, front, sizes, made, _table("Fields", text, rows))


def _page(
    manifest: Mapping[str, Any],
    format: str,
    front: Sequence[str],
    sizes: Mapping[str, int],
    made: tuple[str, str, str],
    parts: Sequence[str],
) -> str:
    """A card: front matter, what the dataset is, its splits, its licence, how it is read, and further `parts`.

    `made`: of the second sentence, of the size, the source and what follows.
    """
    size, source, more = made
    categories = (limit for limit, most in _SIZES.items() if manifest["frames"] < most)
    license = manifest.get("license", "")
    licence = f"Licence: {license}." if license else None
    splits = manifest["splits"]
    lines = [
        "---",
        f"pretty_name: {json.dumps(manifest['name'])}",
        *([f"license: {json.dumps(license.lower())}"] if license else []),
        "task_categories:",
        "- depth-estimation",
        "- image-to-image",
        "tags:",
        *(f"- {tag}" for tag in _TAGS),
        "size_categories:",
        f"- {next(categories, '10M<n<100M')}",
        *front,
        "---",
        "",
        f"# {manifest['name']}",
        "",
        *([manifest["description"], ""] if manifest.get("description") else []),
        f"{manifest['frames']} simulated single-photon depth frames of {manifest['width']} × {manifest['height']} "
        f"pixels, of {manifest['scenes']} underwater scenes with {len(manifest['targets'])} targets{size}. Made by "
        f"spadwarp {manifest['version']}{source}, seed {manifest['seed']}. Splits share neither targets nor "
        f"seeds.{more}",
        "",
        "| split | targets | frames | seed |",
        "|---|---|---|---|",
        *(
            f"| {name} | {', '.join(splits[name]['targets'])} | {count} | {splits[name]['seed']} |"
            for name, count in sizes.items()
        ),
        "",
        licence or "The recipe names no licence (`license`): ask whoever made the dataset.",
        "",
        "## Reading",
        "",
        "```python",
        *(line.replace("{split}", next(iter(sizes))) for line in _READING[format]),
        "```",
        "",
        *parts,
    ]
    return "\n".join(lines)


def _rows(columns: Mapping[str, Column]) -> list[tuple[str, str, str]]:
    return [(name, column.unit, column.meaning) for name, column in columns.items()]


def _table(title: str, text: str, rows: Iterable[tuple[str, str, str]]) -> list[str]:
    lines = [f"| `{name}` | {unit} | {meaning} |" for name, unit, meaning in rows]
    return [f"## {title}", "", text, "", "| dataset | unit | meaning |", "|---|---|---|", *lines, ""]


def _kind(column: Column) -> str:
    name = "text" if column.is_text else str(np.dtype(column.kind))
    return f"{name} {list(column.shape)}" if column.shape else name


def _parquet_lines(files: Mapping[str, Any], columns: Mapping[str, Column], sizes: Mapping[str, int]) -> list[str]:
    """Where each split lies, how large it is, and what its columns are, as Hugging Face reads it."""
    lines = ["configs:", "- config_name: default", "  data_files:"]
    lines += [line for name in sizes for line in (f"  - split: {name}", f"    path: data/{name}-*.parquet")]
    lines += ["dataset_info:", "  config_name: default", "  features:"]
    for name, column in columns.items():
        kind = "string" if column.is_text else str(np.dtype(column.kind))
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


# Croissant

_TERMS = ["citeAs", "column", "containedIn", "dataBiases", "dataCollection", "equivalentProperty"]
_TERMS += ["extract", "field", "fileObject", "fileProperty", "fileSet", "format", "includes"]
_TERMS += ["isLiveDataset", "jsonPath", "key", "md5", "parentField", "path"]
_TERMS += ["personalSensitiveInformation", "recordSet", "references", "regex", "repeated", "replace"]
_TERMS += ["samplingRate", "separator", "source", "subField", "transform"]
_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "cr": "http://mlcommons.org/croissant/",
    "dct": "http://purl.org/dc/terms/",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "sc": "https://schema.org/",
    "conformsTo": "dct:conformsTo",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "examples": {"@id": "cr:examples", "@type": "@json"},
    **{term: f"cr:{term}" for term in _TERMS},
}


def croissant(
    manifest: Mapping[str, Any],
    format: str,
    files: Mapping[str, Mapping[str, Any]],
    columns: Mapping[str, Column] | None = None,
) -> dict[str, Any]:
    """The content of croissant.json.

    Args:
        manifest: Of the dataset.
        format: "hdf5" for the dataset itself, or that of an export.
        files: Name → `bytes` and `sha256`.
        columns: Of Parquet files, which become a record set for each split.
    """
    described: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": re.sub(r"[^\w-]+", "_", manifest["name"]),
        "description": manifest.get("description") or f"Simulated single-photon depth frames: {manifest['name']}",
        "version": "1.0.0",
        "keywords": ["SPAD", "single-photon", "underwater", "lidar", "depth"],
        "citeAs": f"{manifest['name']}: simulated by spadwarp {manifest['version']}, seed {manifest['seed']}",
        "distribution": [
            {
                "@type": "cr:FileObject",
                "@id": name,
                "name": name,
                "contentUrl": name,
                "contentSize": f"{record['bytes']} B",
                "encodingFormat": _MEDIA[format],
                "sha256": record["sha256"],
            }
            for name, record in files.items()
        ],
    }
    if manifest.get("license"):
        described["license"] = f"https://spdx.org/licenses/{manifest['license']}.html"
    if format == "parquet" and columns:
        described["recordSet"] = [
            _record_set(file, columns) for file in files if file.endswith(".parquet") and file.startswith("data/")
        ]
    return described


def _record_set(file: str, columns: Mapping[str, Column]) -> dict[str, Any]:
    """The rows of one Parquet file."""
    name = file.removeprefix("data/").removesuffix(".parquet")
    fields = []
    for field, column in columns.items():
        described: dict[str, Any] = {
            "@type": "cr:Field",
            "@id": f"{name}/{field}",
            "name": field,
            "description": f"{column.meaning} [{column.unit}]" if column.unit not in ("", "1") else column.meaning,
            "dataType": "sc:Text" if column.is_text else _number_type(column.kind),
            "source": {"fileObject": {"@id": file}, "extract": {"column": field}},
        }
        fields.append(described | ({"repeated": True} if column.shape else {}))
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "field": fields}


def _number_type(kind: Any) -> str:
    return "sc:Integer" if np.issubdtype(kind, np.integer) else "sc:Float"
