"""Comparison of denoisers: on datasets, on drawn scenes by scene type, and on histograms of few photons.

torch is loaded when a function needs it: `pip install "spadwarp[denoise]"`.
"""

from spadwarp.evaluation.datasets import *
from spadwarp.evaluation.drawn_scenes import *
from spadwarp.evaluation.photon_counts import *
from spadwarp.evaluation.report import *
from spadwarp.values import guarded

guarded(__name__)
