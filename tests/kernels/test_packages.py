"""The packages of the kernel library: arrows point one way, and each package names what it offers."""

import ast
import importlib
from pathlib import Path

import pytest

import spadwarp_kernels as sk

ROOT = Path(sk.__file__).parent

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


def packages_imported(path):
    """Packages from which a file imports, its own aside."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and node.level == 0 and (node.module or "").startswith("spadwarp_kernels"):
            assert node.module != "spadwarp_kernels", f"{path.name} imports from the top"
            yield node.module.split(".")[1]


@pytest.mark.parametrize("package", PACKAGES)
def test_arrows_point_one_way(package):
    place = ROOT / package
    for path in sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]:
        later = {name for name in packages_imported(path) if PACKAGES.index(name) >= PACKAGES.index(package)}
        assert not later, f"{path.name} imports {later}"


def test_every_package_is_listed():
    found = {path.stem for path in ROOT.iterdir() if path.stem[0] not in "_." and path.is_dir()}
    assert found == set(PACKAGES)


# Fields of a `TransportSpec` by the packages that resolve them, where they make Warp functions; others ask for what
# `photon/spec.py` and `transport/compose.py` make of them. `transport/launch.py` checks a launch field by field.
RESOLVED = {
    "photon": "confocal derivatives grid mesh points polarised",
    "riders": "blocks channels confocal derivatives laser_port layered mesh polarised port specular",
    "estimators": "bounded confocal derivatives estimator grid lens merged mesh phase points polarised port reflecting "
    "rotated_domain specular",
    "transport": "blocks bounded confocal derivatives laser_port measured_beam mesh phase port random_albedo records "
    "reflecting rotated_domain roulette specular stepped",
}
RESOLVING = {"photon/spec.py", "transport/compose.py", "transport/launch.py"}


@pytest.mark.parametrize("package", PACKAGES)
def test_fields_of_a_spec_are_read_where_they_are_resolved(package):
    read = {
        node.attr
        for path in (ROOT / package).rglob("*.py")
        if path.relative_to(ROOT).as_posix() not in RESOLVING
        for node in ast.walk(ast.parse(path.read_text()))
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name) and node.value.id == "spec"
    }
    assert read & set(sk.TransportSpec._fields) == set(RESOLVED.get(package, "").split())


def test_public_names():
    for package in PACKAGES:
        module = importlib.import_module(f"spadwarp_kernels.{package}")
        assert module.__doc__
        for name in getattr(module, "__all__", ()):
            assert getattr(module, name) is not None
    assert not set(sk.__all__) & set(PACKAGES)
