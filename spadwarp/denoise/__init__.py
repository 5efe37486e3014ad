"""Denoisers of depth frames: networks with trained weights, baselines, training and evaluation.

torch and the other packages of the extra are loaded when a function needs them: `pip install "spadwarp[denoise]"`.
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

_HOMES = {
    "METHODS": "inference",
    "apply": "inference",
    "weights_metadata": "inference",
    "denoise_file": "files",
    "depth_files": "files",
    "read_depth": "files",
    "Evaluation": "evaluation",
    "evaluate": "evaluation",
    "TITLES": "report",
    "write_report": "report",
    "PhotonSweep": "photon_counts",
    "photon_sweep": "photon_counts",
    "draw_photon_sweep": "photon_counts",
    "TrainingRecipe": "recipe",
    "load_training_recipe": "recipe",
    "train": "training_run",
}

__all__ = [*_HOMES]

if TYPE_CHECKING:
    from spadwarp.denoise.evaluation import Evaluation, evaluate
    from spadwarp.denoise.files import denoise_file, depth_files, read_depth
    from spadwarp.denoise.inference import METHODS, apply, weights_metadata
    from spadwarp.denoise.photon_counts import PhotonSweep, draw_photon_sweep, photon_sweep
    from spadwarp.denoise.recipe import TrainingRecipe, load_training_recipe
    from spadwarp.denoise.report import TITLES, write_report
    from spadwarp.denoise.training_run import train


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"spadwarp.denoise.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'spadwarp.denoise' has no attribute {name!r}")
