"""The card of a dataset or an export, README.md with the YAML front matter that hubs of datasets read, and its
croissant.json: JSON-LD that hubs, search engines and `mlcroissant` read (version 1.0)."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Any

import numpy as np

from spadwarp.dataset.shards import FRAME_COLUMNS, HISTOGRAM_COLUMNS, Column, scene_columns

Files = Mapping[str, Mapping[str, Any]]
"""Name → `bytes` and `sha256`."""

_TAGS = ("spad", "single-photon", "underwater", "lidar", "depth", "denoising", "simulation")
_SIZES = {"n<1K": 1e3, "1K<n<10K": 1e4, "10K<n<100K": 1e5, "100K<n<1M": 1e6, "1M<n<10M": 1e7, "10M<n<100M": 1e99}
_READING = {
    "parquet": """import datasets

frames = datasets.load_dataset("<this folder>", split="{split}").with_format("numpy")
frames[0]["noisy"], frames[0]["clean"], frames[0]["label"]     # [H, W]""",
    "webdataset": """import webdataset

for frame in webdataset.WebDataset("<this folder>/{split}-00000.tar").decode():
    frame["noisy.npy"], frame["clean.npy"], frame["label.npy"], frame["json"]""",
    "zarr": """import xarray

frames = xarray.open_zarr("<this folder>/frames.zarr", group="{split}")
frames.noisy, frames.clean, frames.label     # [frame, y, x]""",
    "hdf5": """import spadwarp.dataset

for item in spadwarp.dataset.iterate_dataset("<this folder>", split="{split}"):
    item["noisy"], item["clean"], item["label"]     # float32 [1, H, W]; NaN: no return, nothing hit""",
}
_UNLICENSED = "The recipe names no licence (`license`): ask whoever made the dataset."
_MEDIA = {
    "hdf5": "application/x-hdf5",
    "parquet": "application/x-parquet",
    "webdataset": "application/x-tar",
    "zarr": "application/json",
}


def card(manifest: Mapping[str, Any], format: str, files: Files, columns: Mapping[str, Column] | None = None) -> str:
    """The text of README.md of a dataset ("hdf5") or of an export, whose frames have these columns."""
    import yaml

    splits = {name: split for name, split in manifest["splits"].items() if split["frames"]}
    license, rows = manifest["license"], manifest["frames"]
    front = {
        "pretty_name": manifest["name"],
        **({"license": license.lower()} if license else {}),
        "task_categories": ["depth-estimation", "image-to-image"],
        "tags": list(_TAGS),
        "size_categories": [next(limit for limit, most in _SIZES.items() if rows < most)],
    }
    size = source = more = ""
    if columns is None:
        size = sum(record["bytes"] for record in files.values())
        size = f"; {size / 1e9:.3g} GB" if size >= 1e9 else f"; {size / 1e6:.3g} MB"
        source = " from `recipe.toml`"
        places = [{"split": name, "path": split["shards"]} for name, split in splits.items()]
        front["configs"] = [{"config_name": "frames", "data_files": places}]
        parts = _files_of_dataset(manifest)
    else:
        more = " `croissant.json` describes the files for programs."
        if format == "parquet":
            front |= _parquet_facts(splits, files, columns)
        text = "Of a frame. Camera frame: +x right, +y down, +z away from the camera; depth is z."
        described = ((name, item.unit or "mixed", f"`{item.type}` {item.meaning}") for name, item in columns.items())
        parts = _table("Fields", text, described)
    described_splits = "\n".join(
        f"| {name} | {', '.join(split['targets'])} | {split['frames']} | {split['seed']} |"
        for name, split in splits.items()
    )
    licence = f"Licence: {license}." if license else _UNLICENSED
    description = f"{manifest['description']}\n\n" if manifest["description"] else ""
    return f"""---
{yaml.safe_dump(front, sort_keys=False, allow_unicode=True, width=1000)}---

# {manifest["name"]}

{description}{rows} simulated single-photon depth frames of {manifest["width"]} × {manifest["height"]} pixels, of \
{manifest["scenes"]} underwater scenes with {len(manifest["targets"])} targets{size}. Made by spadwarp \
{manifest["version"]}{source}, seed {manifest["seed"]}. Splits share neither targets nor seeds.{more}

| split | targets | frames | seed |
|---|---|---|---|
{described_splits}

{licence}

## Reading

```python
{_READING[format].replace("{split}", next(iter(splits)))}
```

{parts}"""


def _files_of_dataset(manifest: Mapping[str, Any]) -> str:
    def table(title: str, text: str, columns: Mapping[str, Column]) -> str:
        return _table(title, text, ((name, column.unit, column.meaning) for name, column in columns.items()))

    scenes = scene_columns((manifest["height"], manifest["width"]))
    text = f"""Without spadwarp: depth [m] = offset + step · code, both attributes of `depth` (here \
{manifest["depth_offset"]:.6g} m and {manifest["depth_step"]:.6g} m); code 0 is no return; `np.unpackbits(label, \
axis=-1)[..., :width]` are the labels.

`spadwarp export <this folder> --format parquet --out <folder>` writes float depth, clean depth, labels and numbers \
for `datasets.load_dataset(<folder>)`; `webdataset` and `zarr` likewise.

"""
    text += table("`frames-*.h5`", "One row for each frame.", FRAME_COLUMNS)
    text += table("`scenes.h5`", "One row for each scene. It refers to the files in `scenes/` beside it.", scenes)
    if any(name.startswith("histograms-") for name in manifest["files"]):
        text += table("`histograms-*.h5`", "Of the scenes that were traced photon by photon.", HISTOGRAM_COLUMNS)
    return text


def _table(title: str, text: str, rows: Iterable[tuple[str, str, str]]) -> str:
    lines = "\n".join(f"| `{name}` | {unit} | {meaning} |" for name, unit, meaning in rows)
    return f"## {title}\n\n{text}\n\n| dataset | unit | meaning |\n|---|---|---|\n{lines}\n\n"


def _parquet_facts(splits: Mapping[str, Any], files: Files, columns: Mapping[str, Column]) -> dict[str, Any]:
    """Where each split lies, how large it is, and what its columns are, as Hugging Face reads it."""

    def feature(column: Column) -> Any:
        kind = "string" if column.is_text else str(np.dtype(column.kind))
        return {f"array{len(column.shape)}_d": {"shape": list(column.shape), "dtype": kind}} if column.shape else kind

    def size(split: str) -> int:
        return sum(file["bytes"] for path, file in files.items() if path.startswith(f"data/{split}-"))

    sizes = {name: size(name) for name in splits}
    return {
        "configs": [
            {
                "config_name": "default",
                "data_files": [{"split": name, "path": f"data/{name}-*.parquet"} for name in splits],
            }
        ],
        "dataset_info": {
            "config_name": "default",
            "features": [{"name": name, "dtype": feature(column)} for name, column in columns.items()],
            "splits": [
                {"name": name, "num_bytes": sizes[name], "num_examples": split["frames"]}
                for name, split in splits.items()
            ],
            "download_size": sum(sizes.values()),
            "dataset_size": sum(sizes.values()),
        },
    }


# Croissant

_TERMS = """citeAs column containedIn dataBiases dataCollection equivalentProperty extract field fileObject
fileProperty fileSet format includes isLiveDataset jsonPath key md5 parentField path personalSensitiveInformation
recordSet references regex repeated replace samplingRate separator source subField transform"""
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
    **{term: f"cr:{term}" for term in _TERMS.split()},
}


def croissant(
    manifest: Mapping[str, Any], format: str, files: Files, columns: Mapping[str, Column] | None = None
) -> dict[str, Any]:
    """The content of croissant.json of a dataset ("hdf5") or of an export; each Parquet file is a record set."""
    described: dict[str, Any] = {
        "@context": _CONTEXT,
        "@type": "sc:Dataset",
        "conformsTo": "http://mlcommons.org/croissant/1.0",
        "name": re.sub(r"[^\w-]+", "_", manifest["name"]),
        "description": manifest["description"] or f"Simulated single-photon depth frames: {manifest['name']}",
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
    if manifest["license"]:
        described["license"] = f"https://spdx.org/licenses/{manifest['license']}.html"
    if format == "parquet" and columns:
        described["recordSet"] = [_record_set(file, columns) for file in files if file.endswith(".parquet")]
    return described


def _record_set(file: str, columns: Mapping[str, Column]) -> dict[str, Any]:
    """The rows of one Parquet file."""
    name = file.removeprefix("data/").removesuffix(".parquet")
    fields = []
    for field, column in columns.items():
        number = "sc:Integer" if not column.is_text and np.issubdtype(column.kind, np.integer) else "sc:Float"
        described: dict[str, Any] = {
            "@type": "cr:Field",
            "@id": f"{name}/{field}",
            "name": field,
            "description": f"{column.meaning} [{column.unit}]" if column.unit not in ("", "1") else column.meaning,
            "dataType": "sc:Text" if column.is_text else number,
            "source": {"fileObject": {"@id": file}, "extract": {"column": field}},
        }
        fields.append(described | ({"repeated": True} if column.shape else {}))
    return {"@type": "cr:RecordSet", "@id": name, "name": name, "field": fields}
