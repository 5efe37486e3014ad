"""The card of a dataset or an export, README.md with the YAML front matter that hubs of datasets read, and its
croissant.json: JSON-LD that hubs, search engines and `mlcroissant` read (version 1.0)."""

from __future__ import annotations

import importlib.resources
import json
import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from spadwarp.dataset.shards import FRAME_COLUMNS, HISTOGRAM_COLUMNS, Column, scene_columns

Files = Mapping[str, Mapping[str, Any]]
"""Name → `bytes` and `sha256`."""

_TAGS = ("spad", "single-photon", "underwater", "lidar", "depth", "denoising", "simulation")
_SIZES = {"n<1K": 1e3, "1K<n<10K": 1e4, "10K<n<100K": 1e5, "100K<n<1M": 1e6, "1M<n<10M": 1e7, "10M<n<100M": 1e99}
_MEDIA = {
    "hdf5": "application/x-hdf5",
    "parquet": "application/x-parquet",
    "webdataset": "application/x-tar",
    "zarr": "application/json",
}


def card(manifest: Mapping[str, Any], format: str, files: Files, columns: Mapping[str, Column] | None = None) -> str:
    """The text of README.md of a dataset ("hdf5") or of an export, whose frames have these columns."""
    import yaml
    from jinja2 import Template

    splits = {name: split for name, split in manifest["splits"].items() if split["frames"]}
    front: dict[str, Any] = {
        "pretty_name": manifest["name"],
        **({"license": manifest["license"].lower()} if manifest["license"] else {}),
        "task_categories": ["depth-estimation", "image-to-image"],
        "tags": list(_TAGS),
        "size_categories": [next(limit for limit, most in _SIZES.items() if manifest["frames"] < most)],
    }
    size = ""
    if columns is None:
        bytes = sum(record["bytes"] for record in files.values())
        size = f"{bytes / 1e9:.3g} GB" if bytes >= 1e9 else f"{bytes / 1e6:.3g} MB"
        places = [{"split": name, "path": split["shards"]} for name, split in splits.items()]
        front["configs"] = [{"config_name": "frames", "data_files": places}]
        scenes = scene_columns((manifest["height"], manifest["width"]))
        text = "One row for each scene. It refers to the files in `scenes/` beside it."
        tables = [("`frames-*.h5`", "One row for each frame.", FRAME_COLUMNS), ("`scenes.h5`", text, scenes)]
        if any(name.startswith("histograms-") for name in manifest["files"]):
            text = "Of the scenes that were traced photon by photon."
            tables.append(("`histograms-*.h5`", text, HISTOGRAM_COLUMNS))
    else:
        front |= _parquet_facts(splits, files, columns) if format == "parquet" else {}
        text = "Of a frame. Camera frame: +x right, +y down, +z away from the camera; depth is z."
        tables = [("Fields", text, dict(columns))]
    template = Template(_read("card.jinja"), trim_blocks=True, keep_trailing_newline=True)
    return template.render(
        it=manifest,
        format=format,
        front=yaml.safe_dump(front, sort_keys=False, allow_unicode=True, width=1000),
        splits=splits,
        first=next(iter(splits)),
        size=size,
        tables=tables,
    )


def _read(name: str) -> str:
    return (importlib.resources.files("spadwarp.dataset") / name).read_text(encoding="utf-8")


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


def croissant(
    manifest: Mapping[str, Any], format: str, files: Files, columns: Mapping[str, Column] | None = None
) -> dict[str, Any]:
    """The content of croissant.json of a dataset ("hdf5") or of an export; each Parquet file is a record set."""
    described: dict[str, Any] = {
        "@context": json.loads(_read("croissant.json")),
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
