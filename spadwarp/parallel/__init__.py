"""Jobs on the devices of this host, or on Ray's workers on one machine or many."""

from typing import TYPE_CHECKING

from spadwarp.parallel import jobs, worker
from spadwarp.parallel.jobs import *
from spadwarp.parallel.worker import *
from spadwarp.values import guarded

if not TYPE_CHECKING:  # type checkers follow the stars
    __all__ = guarded(__name__, jobs.__all__ + worker.__all__)
