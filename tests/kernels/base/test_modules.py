"""Where kernels stand: a thread that makes functions of a transport kernel disturbs no other that loads a kernel."""

import importlib
import pkgutil
import types

import pytest
import warp as wp

import spadwarp_kernels

MODULES = [one.name for one in pkgutil.walk_packages(spadwarp_kernels.__path__, "spadwarp_kernels.")]
OF_TRANSPORT = ("estimators", "optics", "photon", "riders", "surface", "tally", "transport", "water")


@pytest.mark.parametrize("package", OF_TRANSPORT)
def test_a_file_that_makes_functions_has_no_kernel_in_its_own_module(package):
    """Each function that is made changes the module of its file, which Warp cannot load meanwhile."""
    for name in (one for one in MODULES if one.startswith(f"spadwarp_kernels.{package}.")):
        items = [one for one in vars(importlib.import_module(name)).values() if getattr(one, "__module__", "") == name]
        makes = any(isinstance(one, types.FunctionType) and hasattr(one, "__wrapped__") for one in items)
        kernels = [one.key for one in vars(importlib.import_module(name)).values() if isinstance(one, wp.Kernel)
                   and one.module.name == name]  # fmt: skip
        assert not (makes and kernels), (name, kernels)
