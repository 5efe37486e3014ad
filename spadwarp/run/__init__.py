"""The directory of a run; results and frames in the formats of other programs; JSON Schema of our TOML files."""

from spadwarp.run.depth import write_depth
from spadwarp.run.directory import (
    CHECKPOINT,
    RUN_FILES,
    RunFiles,
    bytes_needed,
    load_resumable,
    remove_checkpoint,
    write_run,
)
from spadwarp.run.fit import fit_files, write_fit
from spadwarp.run.formats import FORMATS, export, export_sensor_fusion
from spadwarp.run.schema import SCHEMAS, json_schema
from spadwarp.run.sequence import simulate_sequence

__all__ = [
    "CHECKPOINT",
    "FORMATS",
    "RUN_FILES",
    "SCHEMAS",
    "RunFiles",
    "bytes_needed",
    "export",
    "export_sensor_fusion",
    "fit_files",
    "json_schema",
    "load_resumable",
    "remove_checkpoint",
    "simulate_sequence",
    "write_depth",
    "write_fit",
    "write_run",
]
