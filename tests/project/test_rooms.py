"""The rooms of the house and which way its arrows point: a room imports rooms further down this table only."""

import ast
from pathlib import Path

import pytest

SPADWARP = Path(__file__).parents[2] / "spadwarp"
KERNELS = Path(__file__).parents[2] / "kernels" / "spadwarp_kernels"

LEVELS = (
    ("cli",),
    ("benchmark", "doctor", "validate"),
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
    ("parallel", "interop", "arrays"),
    ("io", "device"),
    ("limits",),
    ("units", "errors"),
)
LEVEL = {room: level for level, rooms in enumerate(LEVELS) for room in rooms}

# One-line methods of data classes, which call a public name of `spadwarp`: the one exception.
ONE_LINE_METHODS = {"depth", "save", "plot", "_repr_html_", "to_xarray"}

MODULES = sorted(path for path in SPADWARP.rglob("*.py") if path.parent != SPADWARP or path.stem in LEVEL)


def room_of(path):
    return path.relative_to(SPADWARP).parts[0].removesuffix(".py")


def imported(node):
    """Full names that an import statement names; relative imports are not used."""
    if isinstance(node, ast.Import):
        return [alias.name for alias in node.names]
    if isinstance(node, ast.ImportFrom):
        assert node.level == 0, "imports are absolute"
        return [f"{node.module}.{alias.name}" for alias in node.names]
    return []


def imports(tree):
    """Names that a file imports, inside functions too, but not in the one-line methods."""
    methods = [
        item
        for node in ast.walk(tree)
        if isinstance(node, ast.ClassDef)
        for item in node.body
        if isinstance(item, ast.FunctionDef) and item.name in ONE_LINE_METHODS
    ]
    excepted = {inner for method in methods for inner in ast.walk(method) if imported(inner) == ["spadwarp"]}
    for node in ast.walk(tree):
        if node not in excepted:
            yield from imported(node)


def statements(function):
    """Statements of a body without its docstring."""
    return [item for item in function.body if not (isinstance(item, ast.Expr) and isinstance(item.value, ast.Constant))]


def test_every_room_is_in_the_table():
    rooms = {path.stem for path in SPADWARP.iterdir() if path.is_dir() and (path / "__init__.py").exists()}
    files = {path.stem for path in SPADWARP.glob("*.py")} - {"__init__", "__main__"}
    assert rooms | files == set(LEVEL)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: path.relative_to(SPADWARP).as_posix())
def test_arrows_point_down(path):
    here = room_of(path)
    for name in imports(ast.parse(path.read_text())):
        parts = name.split(".")
        if parts[0] == "spadwarp":
            there = parts[1] if len(parts) > 1 else "spadwarp"
            if here == "cli":
                module = SPADWARP.joinpath(*parts[1:]).with_suffix(".py")
                assert there == "cli" or (len(parts) <= 3 and not module.exists()), f"{name} is not of the public API"
                continue
            assert there != "spadwarp", (
                "`import spadwarp` is for one-line methods of data classes, and for the commands"
            )
            assert there in LEVEL or there == "__version__", f"{name} goes by way of the top"
            if there != here and there in LEVEL:
                assert LEVEL[here] < LEVEL[there], f"{here} imports {name}"
        if parts[0] == "spadwarp_kernels":
            assert len(parts) <= 3, f"{name} is not a public name of a room of the kernels"


def cycles(folder, package):
    """Circles of files that import each other at import time or inside functions, type hints left out."""
    names = {
        ".".join([package, *path.relative_to(folder).with_suffix("").parts]).removesuffix(".__init__"): path
        for path in folder.rglob("*.py")
    }
    arrows = {}
    for name, path in names.items():
        found = set()
        tree = ast.parse(path.read_text())
        hints = {
            inner
            for node in ast.walk(tree)
            if isinstance(node, ast.If) and ast.unparse(node.test) == "TYPE_CHECKING"
            for inner in ast.walk(node)
        }
        for node in ast.walk(tree):
            if node in hints:
                continue
            base = node.module if isinstance(node, ast.ImportFrom) and node.level == 0 else None
            if isinstance(node, ast.ImportFrom) and node.level:
                here = name if path.name == "__init__.py" else name.rpartition(".")[0]
                for _ in range(node.level - 1):
                    here = here.rpartition(".")[0]
                base = f"{here}.{node.module}" if node.module else here
            if base is not None:
                for alias in node.names:
                    full = f"{base}.{alias.name}"
                    found.add(full if full in names else base)
            elif isinstance(node, ast.Import):
                found.update(alias.name for alias in node.names)
        arrows[name] = {other for other in found if other in names and other not in {name, package}}
    done, circles = set(), []

    def visit(name, trail):
        if name in trail:
            circles.append([*trail[trail.index(name) :], name])
        elif name not in done:
            for other in sorted(arrows[name]):
                visit(other, [*trail, name])
            done.add(name)

    for name in sorted(arrows):
        visit(name, [])
    return circles


@pytest.mark.parametrize(("folder", "package"), [(SPADWARP, "spadwarp"), (KERNELS, "spadwarp_kernels")])
def test_no_file_imports_itself_by_way_of_others(folder, package):
    assert cycles(folder, package) == []


def test_one_line_methods_have_one_line():
    for path in MODULES:
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.FunctionDef) and node.name in ONE_LINE_METHODS:
                calls = [item for item in ast.walk(node) if imported(item) == ["spadwarp"]]
                assert not calls or len(statements(node)) == 2, f"{path.name}: {node.name}"


# The kernel's loop over the stages, all of which it calls.
LONG = {"transport"}


def body_lines(function):
    """Lines of a body without signature, docstring and nested functions."""
    body = statements(function)
    if not body:
        return 0
    lines = set(range(body[0].lineno, function.end_lineno + 1))
    for node in ast.walk(function):
        if node is not function and isinstance(node, ast.FunctionDef | ast.ClassDef):
            first = min([node.lineno, *(item.lineno for item in node.decorator_list)])
            lines -= set(range(first, node.end_lineno + 1))
    return len(lines)


SOURCES = [*sorted(SPADWARP.rglob("*.py")), *sorted(KERNELS.rglob("*.py"))]


def test_files_and_functions_can_be_read_in_a_sitting():
    long = []
    for path in SOURCES:
        text = path.read_text()
        if len(text.splitlines()) > 400:
            long.append(f"{path.name}: {len(text.splitlines())} lines")
        for node in ast.walk(ast.parse(text)):
            if isinstance(node, ast.FunctionDef):
                limit = 225 if node.name in LONG and path.parts[-2:] == ("transport", "kernel.py") else 60
                if body_lines(node) > limit:
                    long.append(f"{path.parent.name}/{path.name}: {node.name} has {body_lines(node)} lines")
    assert not long, "\n".join(long)
