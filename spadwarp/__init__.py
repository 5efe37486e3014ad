"""spadwarp: Monte Carlo photon transport for single-photon (SPAD) imaging in scattering water, on NVIDIA Warp.

scene = spadwarp.load_scene("configs/scenes/staircase_15m.toml")
result = spadwarp.simulate(scene, photons=2_000_000, seed=7)
result.histogram, result.depth(), result.save("result.h5")
"""

import ast
from importlib import import_module
from pathlib import Path
from typing import Any

from spadwarp.values import __version__

# Loaded when first used, so that `import spadwarp` and `spadwarp --help` need neither Warp nor h5py. The one list of
# public names is that for type checkers, which with `__getattr__` alone would not find misspelled names.
_PUBLIC = [
    (str(node.module).partition(".")[2], one.name)
    for node in ast.parse(Path(__file__).with_suffix(".pyi").read_text(encoding="utf-8")).body
    if isinstance(node, ast.ImportFrom)
    for one in node.names
    if one.name != "__version__"
]
_PACKAGES = tuple(name for home, name in _PUBLIC if not home)
_HOMES = {name: home for home, name in _PUBLIC if home}

__all__ = ["__version__", *_HOMES]


def __getattr__(name: str) -> Any:
    if name in _HOMES:
        return getattr(import_module(f"spadwarp.{_HOMES[name]}"), name)
    if name in _PACKAGES:
        return import_module(f"spadwarp.{name}")
    raise AttributeError(f"module 'spadwarp' has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted({*__all__, *_PACKAGES})
