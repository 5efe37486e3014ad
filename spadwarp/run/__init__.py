"""The directory of a run; our files opened, whatever they hold, and written in other formats."""

from spadwarp.run.analytic_file import save_analytic
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
from spadwarp.run.formats import FORMATS, export
from spadwarp.run.schema import SCHEMAS, json_schema
from spadwarp.run.sources import open_source

__all__ = [
    "CHECKPOINT",
    "FORMATS",
    "RUN_FILES",
    "SCHEMAS",
    "RunFiles",
    "bytes_needed",
    "export",
    "json_schema",
    "load_resumable",
    "open_source",
    "remove_checkpoint",
    "save_analytic",
    "write_depth",
    "write_run",
]
