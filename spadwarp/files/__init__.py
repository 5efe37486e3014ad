"""Any of our files opened: results, frames of a camera or of the analytic simulator, datasets, records."""

from spadwarp.files.depth import gate_of, stored_depth
from spadwarp.files.describe import summary
from spadwarp.files.loader import Held, holds_own_file, is_own_file, load, locate
from spadwarp.files.sequences import open_source, sequence

__all__ = ["Held", "gate_of", "holds_own_file", "is_own_file", "load", "locate", "open_source", "sequence"]
__all__ += ["stored_depth", "summary"]
