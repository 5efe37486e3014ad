"""spadwarp: Monte Carlo photon transport for single-photon (SPAD) imaging in scattering water, on NVIDIA Warp.

scene = spadwarp.load_scene("configs/scenes/staircase_15m.toml")
result = spadwarp.simulate(scene, photons=2_000_000, seed=7)
result.histogram, result.depth(), result.save("result.h5")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

__version__ = "0.1.0"

# The rooms, and which of their public names stand here too. Loaded when first used, so that `import spadwarp` and
# `spadwarp --help` need neither Warp nor h5py.
_ROOMS = {
    "scene": ("Scene", "load_scene"),
    "water": (),
    "mesh": (),
    "checks": ("check",),
    "transport": ("RunOptions", "simulate", "truth_maps"),
    "parallel": ("Ray",),
    "result": ("Result", "load_result", "merge"),
    "frames": ("Frames", "arrival_time", "crlb", "detect"),
    "analytic": ("budget", "plan", "simulate_analytic", "sweep"),
    "inverse": ("fit",),
    "dataset": (),
    "denoise": (),
    "files": ("load",),
    "viz": (),
    "run": ("export",),
    "validate": (),
    "benchmark": (),
    "doctor": (),
    "device": (),
    "interop": ("data_frame",),
    "io": (),
    "errors": ("ArgumentError", "ConfigError", "DeviceError", "FileError", "MeshError", "SpadwarpError"),
}
_HOMES = {name: room for room, names in _ROOMS.items() for name in names}

__all__ = [  # written out for type checkers
    "ArgumentError",
    "ConfigError",
    "DeviceError",
    "FileError",
    "Frames",
    "MeshError",
    "Ray",
    "Result",
    "RunOptions",
    "Scene",
    "SpadwarpError",
    "__version__",
    "arrival_time",
    "budget",
    "check",
    "crlb",
    "data_frame",
    "detect",
    "export",
    "fit",
    "load",
    "load_result",
    "load_scene",
    "merge",
    "plan",
    "simulate",
    "simulate_analytic",
    "sweep",
    "truth_maps",
]

# Type checkers take "as" for public, and without `__getattr__` they find misspelled names.
if TYPE_CHECKING:
    from spadwarp import (
        analytic as analytic,
        benchmark as benchmark,
        checks as checks,
        dataset as dataset,
        denoise as denoise,
        device as device,
        doctor as doctor,
        errors as errors,
        files as files,
        frames as frames,
        interop as interop,
        inverse as inverse,
        io as io,
        mesh as mesh,
        parallel as parallel,
        result as result,
        run as run,
        scene as scene,
        transport as transport,
        validate as validate,
        viz as viz,
        water as water,
    )
    from spadwarp.analytic import budget, plan, simulate_analytic, sweep
    from spadwarp.checks import check
    from spadwarp.errors import ArgumentError, ConfigError, DeviceError, FileError, MeshError, SpadwarpError
    from spadwarp.files import load
    from spadwarp.frames import Frames, arrival_time, crlb, detect
    from spadwarp.interop import data_frame
    from spadwarp.inverse import fit
    from spadwarp.parallel import Ray
    from spadwarp.result import Result, load_result, merge
    from spadwarp.run import export
    from spadwarp.scene import Scene, load_scene
    from spadwarp.transport import RunOptions, simulate, truth_maps
else:

    def __getattr__(name: str) -> Any:
        if name in _HOMES:
            return getattr(import_module(f"spadwarp.{_HOMES[name]}"), name)
        if name in _ROOMS:
            return import_module(f"spadwarp.{name}")
        raise AttributeError(f"module 'spadwarp' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted(__all__)
