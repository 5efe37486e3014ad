"""Files opened and written: runs, frames, datasets, formats of other programs, JSON Schema of our TOML files."""

from spadwarp.files.formats import *
from spadwarp.files.loader import *
from spadwarp.files.run import *
from spadwarp.files.schema import *
from spadwarp.values import guarded

guarded(__name__)
