"""Files that appear whole or not at all, and files read with care: HDF5, EXR, NumPy, PLY, TOML, JSON, CSV."""

from spadwarp.io.atomic import atomic_path
from spadwarp.io.examples import example_or_path, examples
from spadwarp.io.exr import read_exr, write_exr
from spadwarp.io.lock import lock
from spadwarp.io.npy import read_npy
from spadwarp.io.parsing import parse_toml, read_toml
from spadwarp.io.paths import existing_file, file_within, is_stream
from spadwarp.io.text import json_text, write_csv, write_json, write_text

__all__ = ["atomic_path", "example_or_path", "examples", "existing_file", "file_within", "is_stream", "json_text"]
__all__ += ["lock", "parse_toml", "read_exr", "read_npy", "read_toml", "write_csv", "write_exr", "write_json"]
__all__ += ["write_text"]
