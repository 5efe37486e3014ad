"""Files that appear whole or not at all: HDF5, EXR, PLY, JSON, CSV."""

from spadwarp.io.atomic import atomic_path, file_within
from spadwarp.io.exr import read_exr, write_exr
from spadwarp.io.lock import lock
from spadwarp.io.parsing import parse_toml, read_toml
from spadwarp.io.text import json_text, write_csv, write_json, write_text

__all__ = [
    "atomic_path",
    "file_within",
    "json_text",
    "lock",
    "parse_toml",
    "read_exr",
    "read_toml",
    "write_csv",
    "write_exr",
    "write_json",
    "write_text",
]
