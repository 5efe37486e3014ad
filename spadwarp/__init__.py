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
    "load_scene": "scene",
    "Scene": "scene",
    "presets": "scene",
    "water_optics": "water",
    "WaterOptics": "water",
    "refractive_index": "water",
    "group_index": "water",
    "pure_water_absorption": "water",
    "pure_water_scattering": "water",
    "phase_function": "scene",
    "PhaseFunction": "scene",
    "check": "checks",
    "bench": "benchmark.cases",
    "simulate": "transport",
    "Ray": "parallel",
    "run_jobs": "parallel",
    "interruptible": "parallel",
    "trace": "transport",
    "PhotonRecords": "transport",
    "look_at": "scene",
    "opencv_pose": "scene",
    "truth_maps": "transport",
    "devices": "device",
    "Diagnosis": "doctor.diagnosis",
    "SelfTest": "doctor.diagnosis",
    "Result": "result",
    "merge": "result",
    "Truth": "result",
    "load_result": "result",
    "save_result": "result",
    "depth_frame": "frames",
    "detect": "frames",
    "Frames": "frames",
    "coates": "frames",
    "InstrumentResponse": "frames",
    "instrument_response": "frames",
    "arrival_time": "frames",
    "crlb": "frames",
    "simulate_analytic": "analytic",
    "AnalyticResult": "analytic",
    "load_truth_exr": "result",
    "budget": "analytic",
    "sweep": "analytic",
    "export": "run",
    "save_analytic": "run",
    "view": "viz.viewer",
    "video": "viz.transient_video",
    "to_torch": "result",
    "TorchResult": "result",
    "load_recipe": "dataset",
    "Recipe": "dataset",
    "make_dataset": "dataset",
    "verify_dataset": "dataset",
    "FrameReader": "dataset",
    "SpadDataset": "dataset",
    "iterate_dataset": "dataset",
    "SpadwarpError": "errors",
    "ArgumentError": "errors",
    "ConfigError": "errors",
    "DeviceError": "errors",
    "FileError": "errors",
    "MeshError": "errors",
}

_ROOMS = {"analytic", "benchmark", "checks", "dataset", "denoise", "doctor", "frames", "mesh", "parallel"}
_ROOMS |= {"result", "run", "scene", "transport", "validate", "viz", "water"}

__all__ = ["__version__", *_HOMES]

if TYPE_CHECKING:
    from spadwarp.analytic import AnalyticResult, simulate_analytic, sweep
    from spadwarp.analytic.photon_budget import budget
    from spadwarp.benchmark.cases import bench
    from spadwarp.checks import check
    from spadwarp.dataset import (
        FrameReader,
        Recipe,
        SpadDataset,
        iterate_dataset,
        load_recipe,
        make_dataset,
        verify_dataset,
    )
    from spadwarp.device import devices
    from spadwarp.doctor.diagnosis import Diagnosis, SelfTest
    from spadwarp.errors import ArgumentError, ConfigError, DeviceError, FileError, MeshError, SpadwarpError
    from spadwarp.frames import (
        Frames,
        InstrumentResponse,
        coates,
        crlb,
        depth_frame,
        detect,
        instrument_response,
    )
    from spadwarp.frames.estimators import arrival_time
    from spadwarp.parallel import Ray, interruptible, run_jobs
    from spadwarp.result import Result, TorchResult, Truth, load_result, load_truth_exr, save_result, to_torch
    from spadwarp.result.merge import merge
    from spadwarp.run import save_analytic
    from spadwarp.run.formats import export
    from spadwarp.scene import PhaseFunction, Scene, load_scene, look_at, opencv_pose, phase_function, presets
    from spadwarp.transport import PhotonRecords, trace, truth_maps
    from spadwarp.transport.simulate import simulate
    from spadwarp.viz.transient_video import video
    from spadwarp.viz.viewer import view
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
    if name in _ROOMS:
        return import_module(f"spadwarp.{name}")
    raise AttributeError(f"module 'spadwarp' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
