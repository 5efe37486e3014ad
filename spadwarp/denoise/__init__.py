"""Denoisers of depth frames: networks with trained weights, baselines, training and evaluation.

torch and the other packages of the extra are loaded when a function needs them: `pip install "spadwarp[denoise]"`.
"""

from spadwarp.denoise.evaluation import Evaluation, evaluate
from spadwarp.denoise.files import denoise_file, depth_files
from spadwarp.denoise.histogram_scores import HistogramScores, evaluate_histograms
from spadwarp.denoise.inference import METHODS, Estimate, apply, estimate
from spadwarp.denoise.network_files import weights_metadata
from spadwarp.denoise.photon_counts import PhotonSweep, draw_photon_sweep, photon_sweep
from spadwarp.denoise.reading import read_depth
from spadwarp.denoise.recipe import TrainingRecipe, load_training_recipe
from spadwarp.denoise.report import TITLES, scene_table, write_report, write_scene_report
from spadwarp.denoise.scene_scores import SceneScores, evaluate_scenes
from spadwarp.denoise.second_return import second_return
from spadwarp.denoise.training_run import train

__all__ = ["METHODS", "TITLES", "Estimate", "Evaluation", "HistogramScores", "PhotonSweep", "SceneScores"]
__all__ += ["TrainingRecipe", "apply", "denoise_file", "depth_files", "draw_photon_sweep", "estimate", "evaluate"]
__all__ += ["evaluate_histograms", "evaluate_scenes", "load_training_recipe", "photon_sweep", "read_depth", "train"]
__all__ += ["scene_table", "second_return", "weights_metadata", "write_report", "write_scene_report"]
