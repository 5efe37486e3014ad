"""The packages of the kernel library: arrows point one way, and each package names what it offers."""

import ast
import importlib
import pkgutil
import types

import pytest
import warp as wp

import spadwarp_kernels
import spadwarp_kernels as sk
from helpers.source_code import KERNELS, names_imported, nodes_of

# A package imports those before it.
PACKAGES = (
    "base",
    "water",
    "optics",
    "surface",
    "tally",
    "photon",
    "riders",
    "estimators",
    "transport",
    "detection",
    "analytic",
    "worlds",
)


@pytest.mark.parametrize("package", PACKAGES)
def test_arrows_point_one_way(package):
    before = PACKAGES[: PACKAGES.index(package) + 1]
    for path in (KERNELS / package).rglob("*.py"):
        ours = [name.split(".")[1:] for name in names_imported(path) if name.startswith("spadwarp_kernels")]
        # Neither from the top, nor from later packages.
        assert all(len(parts) > 1 and parts[0] in before for parts in ours), f"{path.name} imports {ours}"


def test_every_package_is_listed():
    found = {path.stem for path in KERNELS.iterdir() if path.stem[0] not in "_." and path.is_dir()}
    assert found == set(PACKAGES)


# Fields of a `TransportSpec` by the packages that own them. Those that know the spec read their own alone, but where
# RESOLVING makes of them what is asked of the packages below it, says what a request holds and checks a launch.
OWNED = {
    "water": "phase random_albedo bounded layered rotated_domain reflecting grid",
    "optics": "lens measured_beam confocal port laser_port sun sea",
    "surface": "mesh brute_force pattern specular use_warp_bvh",
    "photon": "stepped merged",
    "riders": "derivatives blocks polarised lines channels flux",
    "estimators": "estimator points",
    "transport": "records roulette",
}
RESOLVING = {"photon/spec.py", "photon/queue.py", "transport/compose.py", "transport/launch.py"}


def test_fields_of_a_spec_have_one_owner():
    assert sorted(" ".join(OWNED.values()).split()) == sorted(sk.TransportSpec._fields)


@pytest.mark.parametrize("package", PACKAGES)
def test_fields_of_a_spec_are_read_by_their_owner(package):
    read = {
        node.attr
        for path in (KERNELS / package).rglob("*.py")
        if path.relative_to(KERNELS).as_posix() not in RESOLVING
        for node in nodes_of(path)
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "spec"
    }
    assert read & set(sk.TransportSpec._fields) <= set(OWNED.get(package, "").split())


def test_public_names():
    assert not set(sk.__all__) & set(PACKAGES)
    for package in PACKAGES:
        module = importlib.import_module(f"spadwarp_kernels.{package}")
        assert module.__doc__
        for name in getattr(module, "__all__", ()):
            assert getattr(module, name) is not None


# Modules of kernels


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
