"""The rooms of the kernel library: arrows point one way, and each room names what it offers."""

import ast
import importlib
from pathlib import Path

import pytest

import spadwarp_kernels as sk

ROOT = Path(sk.__file__).parent

# A room imports those before it.
ROOMS = (
    "arguments",
    "compiled",
    "pixels",
    "math",
    "random",
    "medium",
    "phase",
    "intersect",
    "port",
    "sensor",
    "surface",
    "source",
    "tally",
    "photon",
    "derivatives",
    "polarisation",
    "estimators",
    "transport",
    "detection",
    "analytic",
    "ray_cast",
    "worlds",
)


def rooms_imported(path):
    """Rooms from which a file imports, its own aside."""
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("spadwarp_kernels"):
            assert node.module != "spadwarp_kernels", f"{path.name} imports from the top"
            yield node.module.split(".")[1]


@pytest.mark.parametrize("room", ROOMS)
def test_arrows_point_one_way(room):
    place = ROOT / room
    for path in sorted(place.rglob("*.py")) if place.is_dir() else [place.with_suffix(".py")]:
        later = {name for name in rooms_imported(path) if ROOMS.index(name) >= ROOMS.index(room)}
        assert not later, f"{path.name} imports {later}"


def test_every_room_is_listed():
    found = {path.stem for path in ROOT.iterdir() if path.stem[0] not in "_." and path.suffix in ("", ".py")}
    assert found == set(ROOMS)


def test_public_names():
    for room in ROOMS:
        module = importlib.import_module(f"spadwarp_kernels.{room}")
        assert module.__doc__
        for name in getattr(module, "__all__", ()):
            assert getattr(module, name) is not None
    assert not set(sk.__all__) & set(ROOMS)
