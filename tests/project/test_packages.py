"""The packages, which way their imports point, and how many lines each may have."""

import ast
import graphlib
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
from helpers.source_code import KERNELS, SPADWARP, imported, names_imported, nodes_of

# A package imports those further down this table only.
LEVELS = (
    ("cli",),
    ("doctor",),
    ("benchmark", "validate", "evaluation"),
    ("denoise",),
    ("viz",),
    ("files",),
    ("dataset",),
    ("checks",),
    ("inverse",),
    ("analytic",),
    ("frames",),
    ("transport",),
    ("mesh", "result"),
    ("scene",),
    ("water",),
    ("parallel", "arrays"),
    ("io", "device"),
    ("values",),
)
LEVEL = {package: level for level, packages in enumerate(LEVELS) for package in packages}

# One-line methods of data classes, which call a public name of `spadwarp`: the one exception.
ONE_LINE_METHODS = {"depth", "save", "plot", "_repr_html_", "to_xarray"}

MODULES = sorted(path for path in SPADWARP.rglob("*.py") if path.parent != SPADWARP or path.stem in LEVEL)


def excepted(path):
    """Nodes of imports in the one-line methods."""
    methods = [node for node in nodes_of(path) if getattr(node, "name", None) in ONE_LINE_METHODS]
    return {inner for method in methods for inner in ast.walk(method) if imported(inner) == ["spadwarp"]}


def statements(function):
    """Statements of a body without its docstring."""
    return [item for item in function.body if not (isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant))]


def test_every_package_is_in_the_table():
    packages = {path.stem for path in SPADWARP.iterdir() if path.is_dir() and (path / "__init__.py").exists()}
    files = {path.stem for path in SPADWARP.glob("*.py")} - {"__init__", "__main__"}
    assert packages | files == set(LEVEL)


def test_arrows_point_down():
    for path in MODULES:
        here = path.relative_to(SPADWARP).parts[0].removesuffix(".py")
        for name in names_imported(path, excepted(path)):
            top, *parts = name.split(".")
            if top == "spadwarp_kernels":
                assert len(parts) <= 2, f"{path.name}: {name} is not a public name of a package of the kernels"
            elif top == "spadwarp" and here == "cli":
                module = SPADWARP.joinpath(*parts).with_suffix(".py")
                public = len(parts) <= 2 and not module.exists()
                assert parts[:1] == ["cli"] or public, f"{path.name}: {name} is not of the public API"
            elif top == "spadwarp":
                # `import spadwarp` is for one-line methods of data classes, and for the commands.
                assert parts and parts[0] in LEVEL, f"{path.name}: {name} goes by way of the top"
                assert parts[0] == here or LEVEL[here] < LEVEL[parts[0]], f"{path.name}: {here} imports {name}"


@pytest.mark.parametrize("folder", [SPADWARP, KERNELS], ids=lambda folder: folder.name)
def test_no_file_imports_itself_by_way_of_others(folder):
    """At import time or inside functions, type hints left out."""
    names = {
        ".".join(path.relative_to(folder.parent).with_suffix("").parts).removesuffix(".__init__"): path
        for path in folder.rglob("*.py")
    }
    arrows = {}
    for name, path in names.items():
        conditions = [node for node in nodes_of(path) if isinstance(node, ast.If)]
        hints = {x for node in conditions if ast.unparse(node.test) == "TYPE_CHECKING" for x in ast.walk(node)}
        found = names_imported(path, hints)
        found = {one if one in names else one.rpartition(".")[0] for one in found}
        arrows[name] = (found & set(names)) - {name, folder.name}
    list(graphlib.TopologicalSorter(arrows).static_order())  # or a CycleError that names the files


def test_one_line_methods_have_one_line():
    for path in MODULES:
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef) and node.name in ONE_LINE_METHODS:
                calls = [item for item in ast.walk(node) if imported(item) == ["spadwarp"]]
                assert not calls or len(statements(node)) == 2, f"{path.name}: {node.name}"


# Lines of `*.py`: what a package is to come to, and what it has. What it has may only fall; a feature that needs more
# lines deletes as many, or brings its own with a reason.
LINES = {
    "spadwarp": (750, 1445),
    "analytic": (2000, 2563),
    "benchmark": (500, 503),
    "checks": (800, 891),
    "cli": (2900, 3122),
    "dataset": (2600, 2673),
    "denoise": (4300, 4299),
    "evaluation": (1600, 1568),
    "files": (1150, 1420),
    "frames": (2500, 2996),
    "inverse": (1900, 2326),
    "io": (1200, 1501),
    "mesh": (1800, 1820),
    "parallel": (600, 566),
    "result": (1500, 2145),
    "scene": (3700, 5058),
    "transport": (2300, 3331),
    "validate": (750, 794),
    "viz": (2200, 2553),
    "water": (800, 852),
    "kernels/spadwarp_kernels": (50, 50),
    "kernels/analytic": (1650, 1676),
    "kernels/base": (950, 1241),
    "kernels/detection": (1000, 1434),
    "kernels/estimators": (1300, 1090),
    "kernels/optics": (1350, 2573),
    "kernels/photon": (850, 1122),
    "kernels/riders": (750, 713),
    "kernels/surface": (1700, 1844),
    "kernels/tally": (450, 1032),
    "kernels/transport": (1450, 1657),
    "kernels/water": (1350, 1518),
    "kernels/worlds": (1600, 2154),
}


def lines_of(place):
    """Of a package, which may be one file, or of the files beside packages."""
    if place.suffix == ".py":
        paths = [place]
    elif place.name in ("spadwarp", "spadwarp_kernels"):
        paths = [path for path in place.glob("*.py") if path.stem not in LINES]
    else:
        paths = place.rglob("*.py")
    return sum(len(path.read_text().splitlines()) for path in paths)


def test_packages_keep_to_their_lines():
    """Prints each package's count beside its budget: `pytest -s tests/project/test_packages.py -k lines`."""
    folders = {place.name: place for place in (SPADWARP, *SPADWARP.iterdir()) if place.is_dir()}
    folders |= {place.stem: place for place in SPADWARP.glob("*.py") if place.stem in LINES}
    folders |= {f"kernels/{place.name}": place for place in (KERNELS, *KERNELS.iterdir()) if place.is_dir()}
    counts = {name: lines_of(place) for name, place in folders.items() if lines_of(place)}
    print("\n" + "\n".join(f"{name:26}{counts[name]:7}  budget {LINES[name][0]:6}" for name in sorted(counts)))
    print(f"{'sum':26}{sum(counts.values()):7}  budget {sum(budget for budget, _ in LINES.values()):6}")
    assert {name: count for name, count in counts.items() if count > LINES[name][1]} == {}
    assert set(counts) == set(LINES)


MOST_LINES, MOST_BODY_LINES = 900, 80
LONGER = {"loops.py": 150, "cramer_rao.py": 100}  # of kernels


def body_lines(function):
    """Lines of a body with nested functions, without signature and docstring."""
    body = statements(function)
    return function.end_lineno - body[0].lineno + 1 if body else 0


def test_files_and_functions_can_be_read_in_a_sitting():
    long = []
    for path in [*sorted(SPADWARP.rglob("*.py")), *sorted(KERNELS.rglob("*.py"))]:
        if lines_of(path) > MOST_LINES:
            long.append(f"{path.name}: {lines_of(path)} lines")
        limit = LONGER.get(path.name, MOST_BODY_LINES) if KERNELS in path.parents else MOST_BODY_LINES
        for node in nodes_of(path):
            if isinstance(node, ast.FunctionDef) and body_lines(node) > limit:
                long.append(f"{path.parent.name}/{path.name}: {node.name} has {body_lines(node)} lines")
    assert not long, "\n".join(long)


# What the house says about itself, and what it does not say


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
