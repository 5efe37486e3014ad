"""Denoisers of depth frames: networks with trained weights, baselines and training.

torch and the other packages of the extra are loaded when a function needs them: `pip install "spadwarp[denoise]"`.
"""

from spadwarp.denoise.files import *
from spadwarp.denoise.inference import *
from spadwarp.denoise.network_files import *
from spadwarp.denoise.recipe import *
from spadwarp.values import guarded

guarded(__name__)
