"""Our files: opened, whatever they hold, and written in other formats."""

from spadwarp.run.analytic_file import save_analytic
from spadwarp.run.depth import write_depth
from spadwarp.run.formats import FORMATS, export
from spadwarp.run.sources import open_source

__all__ = ["FORMATS", "export", "open_source", "save_analytic", "write_depth"]
