"""Warp functions and kernels for photon transport, SPAD detection and depth; needs warp and numpy only.

Functions marked `wp.func` go into the caller's own kernels; `launch_transport` walks photons against the caller's own
`wp.Mesh`. A folder for each topic, whose public names are those of its modules.
"""

from importlib import import_module
from types import ModuleType
from typing import TYPE_CHECKING, Any

# In the order in which they build on each other. Loaded when a name is first asked for: a kernel that only traces
# photons needs no camera and no estimator of depth.
_PACKAGES = (
    "base", "tally", "water", "optics", "surface", "photon", "estimators", "transport",
    "detection", "analytic", "worlds",
)  # fmt: skip

if TYPE_CHECKING:  # type checkers follow the stars
    from .analytic import *
    from .base import *
    from .detection import *
    from .estimators import *
    from .optics import *
    from .photon import *
    from .surface import *
    from .tally import *
    from .transport import *
    from .water import *
    from .worlds import *
else:

    def __getattr__(name: str) -> Any:
        if name in _PACKAGES:
            package = import_module(f"{__name__}.{name}")
            modules = [vars(one) for one in vars(package).values() if isinstance(one, ModuleType)]
            own = [one.get("__all__", ()) for one in modules if one["__package__"] == package.__name__]
            package.__all__ = sorted(public for names in own for public in names)
            return package
        if name == "__all__":
            return [public for package in _PACKAGES for public in __getattr__(package).__all__]
        for package in () if name.startswith("_") else map(__getattr__, _PACKAGES):
            if name in package.__all__:
                return globals().setdefault(name, getattr(package, name))  # asked for once
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")

    def __dir__() -> list[str]:
        return sorted({*globals(), *__getattr__("__all__")})


__version__ = "0.1.0"
