"""spadwarp: Monte Carlo photon transport for single-photon (SPAD) imaging in scattering water, on NVIDIA Warp.

scene = spadwarp.load_scene("configs/scenes/staircase_15m.toml")
result = spadwarp.simulate(scene, photons=2_000_000, seed=7)
result.histogram, result.depth(), result.save("result.h5")
"""

from importlib import import_module
from typing import TYPE_CHECKING, Any

from spadwarp.values import __version__

# The packages, and which of their public names stand here too. Loaded when first used, so that `import spadwarp` and
# `spadwarp --help` need neither Warp nor h5py.
_PACKAGES = {
    "scene": ("Scene", "load_scene"),
    "water": (),
    "mesh": (),
    "checks": ("check",),
    "transport": ("RunOptions", "reconstruct", "simulate", "truth_maps"),
    "parallel": ("Ray",),
    "result": ("Result", "merge"),
    "frames": ("Frames", "arrival_time", "crlb", "detect"),
    "analytic": ("budget", "plan", "simulate_analytic", "sweep"),
    "inverse": ("fit",),
    "dataset": (),
    **dict.fromkeys(("denoise", "evaluation"), ()),
    "files": ("export", "load"),
    "viz": (),
    "validate": (),
    "benchmark": (),
    "doctor": (),
    "device": (),
    "arrays": ("to_pandas",),
    "io": (),
    "values": ("ArgumentError", "ConfigError", "DeviceError", "FileError", "MeshError", "SpadwarpError"),
}
_PACKAGES["values"] += ("SpadwarpWarning",)
_HOMES = {name: package for package, names in _PACKAGES.items() for name in names}

# Type checkers take "as" for public, and without `__getattr__` they find misspelled names.
if TYPE_CHECKING:
    from spadwarp import analytic as analytic, arrays as arrays, benchmark as benchmark, checks as checks
    from spadwarp import dataset as dataset, denoise as denoise, device as device, doctor as doctor, files as files
    from spadwarp import evaluation as evaluation, frames as frames, inverse as inverse, io as io, mesh as mesh
    from spadwarp import parallel as parallel, result as result, scene as scene, transport as transport
    from spadwarp import validate as validate, values as values, viz as viz, water as water
    from spadwarp.analytic import budget as budget, plan as plan, simulate_analytic as simulate_analytic, sweep as sweep
    from spadwarp.checks import check as check
    from spadwarp.values import ArgumentError as ArgumentError, ConfigError as ConfigError, DeviceError as DeviceError
    from spadwarp.values import FileError as FileError, MeshError as MeshError, SpadwarpError as SpadwarpError
    from spadwarp.values import SpadwarpWarning as SpadwarpWarning
    from spadwarp.files import export as export, load as load
    from spadwarp.frames import Frames as Frames, arrival_time as arrival_time, crlb as crlb, detect as detect
    from spadwarp.arrays import to_pandas as to_pandas
    from spadwarp.inverse import fit as fit
    from spadwarp.parallel import Ray as Ray
    from spadwarp.result import Result as Result, merge as merge
    from spadwarp.scene import Scene as Scene, load_scene as load_scene
    from spadwarp.transport import RunOptions as RunOptions, reconstruct as reconstruct, simulate as simulate
    from spadwarp.transport import truth_maps as truth_maps
else:
    __all__ = ["__version__", *_HOMES]

    def __getattr__(name: str) -> Any:
        if name in _HOMES:
            return getattr(import_module(f"spadwarp.{_HOMES[name]}"), name)
        if name in _PACKAGES:
            return import_module(f"spadwarp.{name}")
        raise AttributeError(f"module 'spadwarp' has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted({*__all__, *_PACKAGES})
