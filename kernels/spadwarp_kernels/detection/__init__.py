"""SPAD and TCSPC: counts from expected detections, and arrival times of what is significant in histograms."""

from .arrival_time import *
from .counts import *
from .messages import *
from .significance import *
