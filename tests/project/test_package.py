"""The house: which way its arrows point, what it says about itself, and what it does not say."""

import ast
import importlib.resources
import importlib.util
import inspect
import os
import pkgutil
import re
import subprocess
import sys
import tomllib
from pathlib import Path

import pytest

import spadwarp
import spadwarp_kernels

ROOT = Path(__file__).parents[2]

# Heavy, so that nothing that `import spadwarp` or `spadwarp --help` loads may import them at its top.
HEAVY = {"warp", "spadwarp_kernels", "torch", "matplotlib", "h5py", "rich", "trimesh", "OpenEXR", "scipy", "ray"}


def imports(path, top_only=False):
    """Full names of the modules that a file imports, relative ones resolved."""
    tree = ast.parse(path.read_text())
    relative_to = path.relative_to(ROOT).parts[:-1]
    for node in tree.body if top_only else ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            base = ".".join(relative_to[: len(relative_to) - node.level + 1]) if node.level else ""
            module = ".".join(part for part in (base, node.module) if part)
            yield module
            yield from (f"{module}.{alias.name}" for alias in node.names)


def sources(place):
    path = ROOT / place
    found = [path] if path.suffix == ".py" else sorted(path.rglob("*.py"))
    assert found, place
    return found


def test_kernels_import_warp_numpy_and_the_standard_library_only():
    allowed = {"warp", "numpy", "kernels", "spadwarp_kernels"} | sys.stdlib_module_names  # "kernels": relative ones
    for path in sources("kernels/spadwarp_kernels"):
        foreign = {name.split(".")[0] for name in imports(path)} - allowed
        assert not foreign, f"{path.name} imports {foreign}"


# Themselves loaded when there are photons to trace, pictures to draw, or a network to run.
LOADED_LATE = {
    "denoise/belief_propagation.py",
    "denoise/context.py",
    "denoise/guide.py",
    "denoise/histogram_features.py",
    "denoise/losses.py",
    "denoise/marginals.py",
    "denoise/networks.py",
    "denoise/pyramid.py",
    "denoise/repeatable.py",
    "denoise/samples.py",
    "denoise/scattered_light.py",
    "denoise/selection.py",
    "denoise/semi_global.py",
    "denoise/shapes.py",
    "denoise/sides.py",
    "denoise/symmetric.py",
    "denoise/synthetic_noise.py",
    "denoise/total_variation.py",
    "denoise/training.py",
    "denoise/training_steps.py",
    "denoise/two_surfaces.py",
    "denoise/volumes.py",
    "denoise/votes.py",
}


def test_heavy_packages_are_imported_where_they_are_used():
    for path in sources("spadwarp"):
        name = path.relative_to(ROOT / "spadwarp").as_posix()
        if name not in LOADED_LATE and not name.startswith(("transport/", "viz/")):
            top = {name.split(".")[0] for name in imports(path, top_only=True)}
            assert top.isdisjoint(HEAVY), f"{path.name} imports {top & HEAVY}"


def test_one_version():
    """Of both distributions, of the citation and of the list of changes."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["version"] == spadwarp.__version__ == spadwarp_kernels.__version__
    assert f"spadwarp-kernels=={spadwarp.__version__}" in project["dependencies"]
    assert f'version: "{spadwarp.__version__}"' in (ROOT / "CITATION.cff").read_text()
    assert f"## {spadwarp.__version__}" in (ROOT / "CHANGELOG.md").read_text()


def test_every_public_name_is_there_whatever_was_imported():
    """Importing a submodule must not hide a function behind it, so that no public name is that of a module."""
    for package in (spadwarp, spadwarp_kernels):
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if module.name.split(".")[-1] != "__main__":
                importlib.import_module(module.name)
    assert set(spadwarp.__all__) == {"__version__", *spadwarp._HOMES}
    for name in spadwarp.__all__:
        assert getattr(spadwarp, name) is not None
        assert not inspect.ismodule(getattr(spadwarp, name)), name
        assert importlib.util.find_spec(f"spadwarp.{name}") is None, f"{name} is the name of a module"
    for name in spadwarp_kernels.__all__:
        assert not inspect.ismodule(getattr(spadwarp_kernels, name)), name
    with pytest.raises(AttributeError, match="nothing"):
        _ = spadwarp.nothing


@pytest.mark.parametrize("package", [spadwarp, spadwarp_kernels], ids=lambda package: package.__name__)
def test_type_hints_are_for_those_who_import_it(package):
    assert importlib.resources.files(package).joinpath("py.typed").is_file()


_PLANTED = """
import spadwarp
from spadwarp import load_scene
from spadwarp_kernels.detection import nothing  # wrong

scene = spadwarp.load_scene("plane_5m")
result = spadwarp.simulate(scene, photons="many")  # wrong
result.depht()  # wrong
spadwarp.simulat(scene)  # wrong
seed: str = result.seed  # wrong
frames = spadwarp.detect(result, pulses=1000, frames=[1], seed=1)  # wrong
counts = spadwarp.detect(result, pulses=1000, frames=2, seed=1).counts
reader = spadwarp.dataset.FrameReader("data", split=3)  # wrong
plan: int = spadwarp.plan(scene)  # wrong
"""


@pytest.mark.slow
def test_a_type_checker_finds_planted_errors(tmp_path):
    """In a program of a user, outside the checkout: each wrong line, and no other."""
    pytest.importorskip("mypy")
    program = tmp_path / "program.py"
    program.write_text(_PLANTED)
    options = [
        "--strict",
        "--follow-imports=silent",
        "--no-site-packages",
        "--ignore-missing-imports",
    ]  # NumPy's types take a minute
    found = subprocess.run(
        [sys.executable, "-m", "mypy", "--cache-dir", tmp_path / "cache", *options, program],
        cwd=tmp_path,
        env={**os.environ, "MYPYPATH": os.pathsep.join(map(str, (ROOT, ROOT / "kernels")))},
        capture_output=True,
        text=True,
    ).stdout
    wrong = {int(line.split(":")[1]) for line in found.splitlines() if ": error:" in line}
    planted = {number for number, line in enumerate(_PLANTED.splitlines(), 1) if "# wrong" in line}
    assert wrong == planted, found


def test_readme_links_become_absolute_where_there_is_no_checkout():
    for folder in ("", "kernels/"):
        project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())
        text = (ROOT / folder / "README.md").read_text()
        hook = project["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]
        for change in hook["substitutions"]:
            text = re.sub(change["pattern"], change["replacement"], text)
        links = re.findall(r"\]\(([^)\s]+)[^)]*\)", text)
        assert links and all(re.match("https?:|#", link) for link in links)
        shown = {link for link in links if "raw.githubusercontent" in link}
        assert all((ROOT / folder / link.split(f"/main/{folder}")[1]).is_file() for link in shown)
        assert project["project"]["urls"]["Repository"] in text


def test_every_table_of_others_has_its_terms():
    notice = (ROOT / "NOTICE").read_text()
    for path in (ROOT / "spadwarp" / "water" / "tables").iterdir():
        assert f"spadwarp/water/tables/{path.name}\n" in notice


def test_ci_covers_the_pythons_of_the_classifiers():
    import yaml

    matrix = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]["tests"]["strategy"]["matrix"]
    assert set(matrix["os"]) == {"ubuntu-latest", "windows-latest", "macos-latest"}
    for folder in ("", "kernels"):
        project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]
        named = [text.removeprefix("Programming Language :: Python :: ") for text in project["classifiers"]]
        assert matrix["python"] == [text for text in named if re.fullmatch(r"3\.\d+", text)]


def tracked_texts():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    for name in listed.stdout.decode().split("\0")[:-1]:
        path = ROOT / name
        if path.is_file() and path.suffix not in {".png", ".h5", ".exr", ".npz", ".safetensors", ".woff2"}:
            yield name, path.read_text()


def test_no_file_names_a_place_on_somebodys_machine():
    place = re.compile(r"(?<![\w./~-])/(?:home|Users|root|tmp|work|mnt|scratch)/\w+")
    found = [f"{name}: {hit}" for name, text in tracked_texts() for hit in place.findall(text)]
    assert not found


def test_relative_links_in_the_documents_lead_somewhere():
    for name, text in tracked_texts():
        if name.endswith(".md"):
            for link in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text) + re.findall(r'src="([^"]+)"', text):
                assert "://" in link or (ROOT / name).parent.joinpath(link).exists(), f"{name}: {link}"
