"""The packages, which way their imports point, and how many lines each may have."""

import ast
import graphlib

import pytest

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
    classes = [node for node in nodes_of(path) if isinstance(node, ast.ClassDef)]
    methods = [item for node in classes for item in node.body if getattr(item, "name", None) in ONE_LINE_METHODS]
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
    "spadwarp": (750, 1499),
    "analytic": (2000, 2492),
    "benchmark": (500, 505),
    "checks": (800, 900),
    "cli": (2900, 3048),
    "dataset": (2600, 2675),
    "denoise": (4300, 5370),
    "evaluation": (1600, 1598),
    "files": (1150, 1425),
    "frames": (2500, 2685),
    "inverse": (1900, 2341),
    "io": (1200, 1483),
    "mesh": (1800, 1820),
    "parallel": (600, 566),
    "result": (1500, 2145),
    "scene": (3700, 5224),
    "transport": (2300, 3205),
    "validate": (750, 869),
    "viz": (2200, 2426),
    "water": (800, 853),
    "kernels/spadwarp_kernels": (50, 45),
    "kernels/analytic": (1650, 1617),
    "kernels/base": (950, 1214),
    "kernels/detection": (1000, 1349),
    "kernels/estimators": (1300, 1101),
    "kernels/optics": (1350, 2880),
    "kernels/photon": (850, 1245),
    "kernels/riders": (750, 677),
    "kernels/surface": (1700, 1886),
    "kernels/tally": (450, 934),
    "kernels/transport": (1450, 1759),
    "kernels/water": (1350, 1661),
    "kernels/worlds": (1600, 2173),
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
