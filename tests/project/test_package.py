"""The house: which way its arrows point, what it says about itself, and what it does not say."""

import importlib.resources
import importlib.util
import inspect
import pkgutil
import re
import subprocess
import sys
import tomllib

import pytest
import yaml

import spadwarp
import spadwarp_kernels
from helpers.cli import ENVIRONMENT, ROOT
from helpers.source_code import KERNELS, names_imported

BINARY = {".png", ".h5", ".exr", ".npz", ".safetensors", ".woff2"}


def test_kernels_import_warp_numpy_and_the_standard_library_only():
    allowed = {"warp", "numpy", "spadwarp_kernels"} | sys.stdlib_module_names
    for path in KERNELS.rglob("*.py"):
        foreign = {name.split(".")[0] for name in names_imported(path)} - allowed
        assert not foreign, f"{path.name} imports {foreign}"


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
        assert importlib.resources.files(package).joinpath("py.typed").is_file()
        for module in pkgutil.walk_packages(package.__path__, f"{package.__name__}."):
            if module.name.split(".")[-1] != "__main__":
                importlib.import_module(module.name)
        for name in package.__all__:
            assert getattr(package, name) is not None and not inspect.ismodule(getattr(package, name)), name
    for name in spadwarp.__all__:
        assert importlib.util.find_spec(f"spadwarp.{name}") is None, f"{name} is the name of a module"
    with pytest.raises(AttributeError, match="nothing"):
        _ = spadwarp.nothing


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
item = spadwarp.dataset.FrameReader("data")[0]
depth, label = item["noisy"] + item["distance"], item["lable"]  # wrong
target: str = item["target"]  # wrong
"""


@pytest.mark.slow
def test_a_type_checker_finds_planted_errors(tmp_path):
    """In a program of a user, outside the checkout: each wrong line, and no other."""
    pytest.importorskip("mypy")
    program = tmp_path / "program.py"
    program.write_text(_PLANTED)
    # NumPy's types take a minute
    options = ["--strict", "--follow-imports=silent", "--no-site-packages", "--ignore-missing-imports"]
    command = [sys.executable, "-m", "mypy", "--cache-dir", "cache", *options, program]
    environment = {**ENVIRONMENT, "MYPYPATH": ENVIRONMENT["PYTHONPATH"]}
    found = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True).stdout
    wrong = {int(line.split(":")[1]) for line in found.splitlines() if ": error:" in line}
    planted = {number for number, line in enumerate(_PLANTED.splitlines(), 1) if "# wrong" in line}
    assert wrong == planted, found


def test_readme_links_become_absolute_where_there_is_no_checkout():
    for folder in ("", "kernels/"):
        project = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())
        text = (ROOT / folder / "README.md").read_text()
        for change in project["tool"]["hatch"]["metadata"]["hooks"]["fancy-pypi-readme"]["substitutions"]:
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
    matrix = yaml.safe_load((ROOT / ".github/workflows/ci.yml").read_text())["jobs"]["tests"]["strategy"]["matrix"]
    assert set(matrix["os"]) == {"ubuntu-latest", "windows-latest", "macos-latest"}
    for folder in ("", "kernels"):
        classifiers = tomllib.loads((ROOT / folder / "pyproject.toml").read_text())["project"]["classifiers"]
        assert matrix["python"] == re.findall(r"Python :: (3\.\d+)$", "\n".join(classifiers), re.MULTILINE)


def test_no_file_names_a_place_on_somebodys_machine():
    listed = subprocess.run(["git", "ls-files", "-z"], cwd=ROOT, capture_output=True)
    if listed.returncode != 0:
        pytest.skip("not a git checkout")
    place = re.compile(r"(?<![\w./~-])/(?:home|Users|root|tmp|work|mnt|scratch)/\w+")
    paths = [ROOT / name for name in listed.stdout.decode().split("\0")[:-1]]
    texts = [path for path in paths if path.is_file() and path.suffix not in BINARY]
    assert not [f"{path}: {hit}" for path in texts for hit in place.findall(path.read_text())]
