"""Pictures, pages and videos: arrays in, images out."""

from spadwarp.values import guarded
from spadwarp.viz import style  # noqa: F401 (first: it says what is wrong with Matplotlib)
from spadwarp.viz.curves import *
from spadwarp.viz.result import *
from spadwarp.viz.scenes import *
from spadwarp.viz.viewer import *

guarded(__name__)
