"""Denoisers of depth frames: networks with trained weights, baselines, training and evaluation.

torch and the other packages of the extra are loaded when a function needs them: `pip install "spadwarp[denoise]"`.
"""

from spadwarp.denoise.evaluation import Evaluation, evaluate
from spadwarp.denoise.files import denoise_file, depth_files, read_depth
from spadwarp.denoise.inference import METHODS, apply, weights_metadata
from spadwarp.denoise.photon_counts import PhotonSweep, draw_photon_sweep, photon_sweep
from spadwarp.denoise.recipe import TrainingRecipe, load_training_recipe
from spadwarp.denoise.report import TITLES, write_report
from spadwarp.denoise.training_run import train

__all__ = ["METHODS", "TITLES", "Evaluation", "PhotonSweep", "TrainingRecipe", "apply", "denoise_file", "depth_files"]
__all__ += ["draw_photon_sweep", "evaluate", "load_training_recipe", "photon_sweep", "read_depth", "train"]
__all__ += ["weights_metadata", "write_report"]
