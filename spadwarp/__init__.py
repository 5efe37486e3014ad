"""spadwarp: Monte Carlo photon transport for single-photon (SPAD) imaging in scattering water, on NVIDIA Warp.

scene = spadwarp.load_scene("configs/scenes/staircase_15m.toml")
result = spadwarp.simulate(scene, photons=2_000_000, seed=7)
result.histogram, result.depth(), result.save("result.h5")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# Loaded when first used, so that `import spadwarp` and `spadwarp --help` need neither Warp nor h5py.
_HOMES = {
    "load_scene": "config",
    "Scene": "config",
    "presets": "catalog",
    "water_optics": "water",
    "WaterOptics": "water",
    "refractive_index": "water",
    "group_index": "water",
    "pure_water_absorption": "water",
    "pure_water_scattering": "water",
    "phase_function": "phase_functions",
    "PhaseFunction": "phase_functions",
    "check": "checks",
    "bench": "benchmark",
    "simulate": "simulation",
    "Ray": "engines",
    "run_jobs": "engines",
    "interruptible": "engines",
    "trace": "records",
    "PhotonRecords": "records",
    "look_at": "pose",
    "opencv_pose": "pose",
    "truth_maps": "model",
    "devices": "hardware",
    "doctor": "health",
    "Diagnosis": "health",
    "SelfTest": "health",
    "Result": "result",
    "merge": "sums",
    "Truth": "result",
    "load_result": "files",
    "detect": "detector",
    "Detection": "detector",
    "coates": "detector",
    "InstrumentResponse": "response",
    "instrument_response": "response",
    "arrival_time": "depth",
    "crlb_map": "crlb",
    "analytic": "analytic_model",
    "AnalyticResult": "analytic_model",
    "load_truth_exr": "truth_exr",
    "budget": "budgets",
    "sweep": "budgets",
    "export": "exports",
    "view": "viewer",
    "video": "film",
    "to_torch": "tensors",
    "TorchResult": "tensors",
    "validate": "validation",
    "denoise": "denoising.inference",
    "evaluate": "denoising.evaluation",
    "train": "denoising.run",
    "load_recipe": "dataset.recipe",
    "Recipe": "dataset.recipe",
    "make_dataset": "dataset.making",
    "verify_dataset": "dataset.making",
    "FrameReader": "dataset.reading",
    "SpadDataset": "dataset.reading",
    "iterate_dataset": "dataset.reading",
    "SpadwarpError": "errors",
    "ConfigError": "errors",
    "DeviceError": "errors",
    "FileError": "errors",
    "MeshError": "errors",
}

__all__ = ["__version__", *_HOMES]

if TYPE_CHECKING:
    from spadwarp.analytic_model import AnalyticResult, analytic
    from spadwarp.benchmark import bench
    from spadwarp.budgets import budget, sweep
    from spadwarp.catalog import presets
    from spadwarp.checks import check
    from spadwarp.config import Scene, load_scene
    from spadwarp.crlb import crlb_map
    from spadwarp.dataset.making import make_dataset, verify_dataset
    from spadwarp.dataset.reading import FrameReader, SpadDataset, iterate_dataset
    from spadwarp.dataset.recipe import Recipe, load_recipe
    from spadwarp.denoising.evaluation import evaluate
    from spadwarp.denoising.inference import denoise
    from spadwarp.denoising.run import train
    from spadwarp.depth import arrival_time
    from spadwarp.detector import Detection, coates, detect
    from spadwarp.engines import Ray, interruptible, run_jobs
    from spadwarp.errors import ConfigError, DeviceError, FileError, MeshError, SpadwarpError
    from spadwarp.exports import export
    from spadwarp.files import load_result
    from spadwarp.film import video
    from spadwarp.hardware import devices
    from spadwarp.health import Diagnosis, SelfTest, doctor
    from spadwarp.model import truth_maps
    from spadwarp.phase_functions import PhaseFunction, phase_function
    from spadwarp.pose import look_at, opencv_pose
    from spadwarp.records import PhotonRecords, trace
    from spadwarp.response import InstrumentResponse, instrument_response
    from spadwarp.result import Result, Truth
    from spadwarp.simulation import simulate
    from spadwarp.sums import merge
    from spadwarp.tensors import TorchResult, to_torch
    from spadwarp.truth_exr import load_truth_exr
    from spadwarp.validation import validate
    from spadwarp.viewer import view
    from spadwarp.water import (
        WaterOptics,
        group_index,
        pure_water_absorption,
        pure_water_scattering,
        refractive_index,
        water_optics,
    )


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"spadwarp.{_HOMES[name]}"), name)
    raise AttributeError(f"module 'spadwarp' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
