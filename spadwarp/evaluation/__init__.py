"""Comparison of denoisers: on datasets, on drawn scenes by scene type, and on histograms of few photons.

torch is loaded when a function needs it: `pip install "spadwarp[denoise]"`.
"""

from typing import TYPE_CHECKING

from spadwarp.evaluation.datasets import *
from spadwarp.evaluation.drawn_scenes import *
from spadwarp.evaluation.photon_counts import *
from spadwarp.evaluation.report import *
from spadwarp.values import guarded

if not TYPE_CHECKING:  # type checkers follow the stars
    _modules = (datasets, drawn_scenes, photon_counts, report)
    __all__ = guarded(__name__, sorted(name for module in _modules for name in module.__all__))
