"""Jobs on the devices of this host, or on Ray's workers on one machine or many."""

from spadwarp.parallel.jobs import *
from spadwarp.parallel.workers import *
from spadwarp.values import guarded

guarded(__name__)
