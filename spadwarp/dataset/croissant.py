"""Croissant metadata of datasets: JSON-LD that hubs, search engines and `mlcroissant` read (version 1.0)."""

from __future__ import annotations

import re
from collections.abc import Mapping
from typing import Any

import numpy as np

from spadwarp.dataset.schema import Column

__all__ = ["croissant"]

_CONTEXT: dict[str, Any] = {
    "@language": "en",
    "@vocab": "https://schema.org/",
    "citeAs": "cr:citeAs",
    "column": "cr:column",
    "conformsTo": "dct:conformsTo",
    "containedIn": "cr:containedIn",
    "cr": "http://mlcommons.org/croissant/",
    "data": {"@id": "cr:data", "@type": "@json"},
    "dataBiases": "cr:dataBiases",
    "dataCollection": "cr:dataCollection",
    "dataType": {"@id": "cr:dataType", "@type": "@vocab"},
    "dct": "http://purl.org/dc/terms/",
    "equivalentProperty": "cr:equivalentProperty",
    "examples": {"@id": "cr:examples", "@type": "@json"},
    "extract": "cr:extract",
    "field": "cr:field",
    "fileObject": "cr:fileObject",
    "fileProperty": "cr:fileProperty",
    "fileSet": "cr:fileSet",
    "format": "cr:format",
    "includes": "cr:includes",
    "isLiveDataset": "cr:isLiveDataset",
    "jsonPath": "cr:jsonPath",
    "key": "cr:key",
    "md5": "cr:md5",
    "parentField": "cr:parentField",
    "path": "cr:path",
    "personalSensitiveInformation": "cr:personalSensitiveInformation",
    "rai": "http://mlcommons.org/croissant/RAI/",
    "recordSet": "cr:recordSet",
    "references": "cr:references",
    "regex": "cr:regex",
    "repeated": "cr:repeated",
    "replace": "cr:replace",
    "samplingRate": "cr:samplingRate",
    "sc": "https://schema.org/",
    "separator": "cr:separator",
    "source": "cr:source",
    "subField": "cr:subField",
    "transform": "cr:transform",
}
_MEDIA = {
    "hdf5": "application/x-hdf5",
    "parquet": "application/x-parquet",
    "webdataset": "application/x-tar",
    "zarr": "application/json",
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
            _record_set(name, columns) for name in files if name.endswith(".parquet") and name.startswith("data/")
        ]
    return described


def _record_set(file: str, columns: Mapping[str, Column]) -> dict[str, Any]:
    """The rows of one Parquet file."""
    name = file.removeprefix("data/").removesuffix(".parquet")
    return {
        "@type": "cr:RecordSet",
        "@id": name,
        "name": name,
        "field": [_field(name, file, field, column) for field, column in columns.items()],
    }


def _field(record_set: str, file: str, name: str, column: Column) -> dict[str, Any]:
    kind = "sc:Text" if column.is_text else "sc:Integer" if np.issubdtype(column.kind, np.integer) else "sc:Float"
    described: dict[str, Any] = {
        "@type": "cr:Field",
        "@id": f"{record_set}/{name}",
        "name": name,
        "description": f"{column.meaning} [{column.unit}]" if column.unit not in ("", "1") else column.meaning,
        "dataType": kind,
        "source": {"fileObject": {"@id": file}, "extract": {"column": name}},
    }
    if column.shape:
        described["repeated"] = True
    return described
