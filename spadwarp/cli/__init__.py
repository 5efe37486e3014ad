"""The command line: a file for each kind of commands. Importing it registers its functions with `app`.

Commands use the public API only, and load what is heavy when they run: `spadwarp --help` answers at once.
"""

from spadwarp.cli import counts, learning, planning, results, simulate, start, trust  # noqa: F401
from spadwarp.cli.app import app

__all__ = ["app"]
