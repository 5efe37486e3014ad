"""The transport kernel, what it takes and writes, and its launch."""

from .launch import *
from .loops import *
