"""Writes the pages in docs/reference that come from the code: `python docs/reference.py`.

scene.md, recipe.md and training.md: every field of a scene, a dataset recipe and a training recipe, from their
models. dataset.md: what the files of a dataset hold. cli.md: the help of every command. python.md and kernels.md: the
public names, whose docstrings mkdocstrings shows.
"""

from __future__ import annotations

import dataclasses
import inspect
import math
import pkgutil
import types
from collections.abc import Iterable, Iterator, Mapping
from importlib import import_module
from pathlib import Path
from typing import Annotated, Any, Literal, Union, get_args, get_origin

import numpy as np
import typer
from pydantic import AfterValidator, BaseModel, BeforeValidator
from pydantic.fields import FieldInfo
from pydantic_core import PydanticUndefined

import spadwarp
from spadwarp.cli import app
from spadwarp.dataset import Distribution, Recipe
from spadwarp.denoise.recipe import TrainingRecipe
from spadwarp.scene import Scene
from spadwarp.scene.grid import COEFFICIENTS
from spadwarp.scene.sections import interval_of, parts_of
from spadwarp.values import Interval

FOLDER = Path(__file__).parent / "reference"
MADE = "<!-- Made by docs/reference.py from the code. -->\n\n"


def pages() -> dict[str, str]:
    """Every page by its file name."""
    return {
        "scene.md": scene(),
        "recipe.md": recipe(),
        "training.md": training(),
        "dataset.md": dataset(),
        "cli.md": commands(),
        "python.md": python(),
        "kernels.md": kernels(),
    }


# Scene


def scene() -> str:
    """Sections and fields with kinds, ranges, defaults and units, and the presets."""
    parts = [
        MADE + "# Scene file\n\n"
        "A scene is a TOML file of sections. Units are SI where the name carries none; a text with a unit is "
        'converted, such as `pulse_energy = "150 nJ"` ([units](../commands.md#units)). The camera looks along +z, with '
        "+x right and +y down, from the origin unless it has a pose ([frames](../optics.md#frames)). A field that a "
        "file leaves out has its default, or the value of the section's `preset`; `--set SECTION.FIELD=VALUE` lies "
        "over both. What is not valid is refused with the field, its value and its range; `spadwarp check FILE` does "
        "so without running anything.\n\n"
        "```toml\n" + _EXAMPLE + "```\n"
    ]
    for name, field in Scene.model_fields.items():
        parts.append(_section(name, _model(field), repeated=_is_repeated(field)))
    return "\n".join(parts)


_EXAMPLE = """\
[medium]
preset = "uwoc-coastal"

[laser]
half_angle_deg = 10.0
position = [0.1, 0.0, 0.0]

[camera]
width = 64
height = 48
horizontal_fov_deg = 20.0
aperture_diameter = 0.02

[gate]
start_ns = 40.0
bin_width_ps = 55.0
bins = 256

[[targets]]
builtin = "staircase"
translation = [0.0, 0.0, 5.0]
"""


def recipe() -> str:
    """Tables and fields of a dataset recipe."""
    return (
        MADE
        + (
            "# Dataset recipe\n\n"
            "What `spadwarp dataset RECIPE` draws from. A *distribution* is a number (always that), a list (one of "
            "these) or a table `{low = …, high = …}`, with `log = true` even in the logarithm. Recipes that run as "
            "they are: [configs/datasets](../../configs/datasets).\n\n"
        )
        + _document(Recipe)
    )


def training() -> str:
    """Tables and fields of a training recipe."""
    return (
        MADE
        + (
            "# Training recipe\n\n"
            "What `spadwarp train RECIPE` learns from ([how](../denoising.md#training)). Recipes that run as they are: "
            "[configs/training](../../configs/training). `--set optimiser.steps=2000` overrides a field.\n\n"
        )
        + _document(TrainingRecipe)
    )


def _document(document: type[BaseModel]) -> str:
    """The fields at the top level, then each table."""
    fields = document.model_fields
    top = {name: field for name, field in fields.items() if _model(field) in (None, Distribution)}
    parts = ["## Top level\n\n" + _table(top)]
    models = {name: model for name, field in fields.items() if name not in top and (model := _model(field))}
    for name, model in models.items():
        base = model.__base__ if model.__base__ in models.values() else None  # has a table of its own
        elsewhere = () if base is None else base.model_fields
        parts.append(_section(name, model, repeated=_is_repeated(fields[name]), elsewhere=elsewhere))
    return "\n".join(parts)


def _model(field: FieldInfo) -> type[BaseModel] | None:
    models = (one for one in _flat(field.annotation) if inspect.isclass(one) and issubclass(one, BaseModel))
    return next(models, None)


def _table(fields: Mapping[str, FieldInfo]) -> str:
    lines = ["| field | kind | range | default | what it is |", "|---|---|---|---|---|"]
    for field, info in fields.items():
        about = " ".join((info.description or "").split()).replace("|", "\\|")
        # Of the coefficients of water two are given, and the others follow.
        default = "" if field in (*COEFFICIENTS, "average_power", "peak_power") else _default(info)
        lines.append(f"| {' | '.join((f'`{field}`', _kind(info), _range(info), default, about))} |")
    return "\n".join(lines) + "\n"


def _section(name: str, model: type[BaseModel], *, repeated: bool = False, elsewhere: Iterable[str] = ()) -> str:
    lines = [f"## {name}", "", inspect.cleandoc(model.__doc__ or ""), ""]
    if repeated:
        lines += [f"Written as `[[{name}]]`, once for each.", ""]
    lines.append(_table({field: info for field, info in model.model_fields.items() if field not in elsewhere}))
    presets = [one for one in spadwarp.scene.presets().values() if one.section == name.rpartition(".")[2]]
    if presets:
        lines += ['Presets (`preset = "…"`), with their sources:']
        source = None
        for one in presets:
            if one.source != source:
                source = one.source
                lines += ["", f"- {source}:"]
            values = ", ".join(f"{key} {_short(value)}" for key, value in one.values.items())
            lines.append(f"    - `{one.name}`: {values}")
    for field, info in model.model_fields.items():
        inner = _model(info)
        if inner is not None and inner is not Distribution:
            lines += ["", _section(f"{name}.{field}", inner, repeated=_is_repeated(info))]
    return "\n".join(lines) + "\n"


def _is_repeated(field: FieldInfo) -> bool:
    return get_origin(field.annotation) is tuple


def _flat(annotation: Any) -> Iterator[Any]:
    """The parts of a union, through `Annotated` and tuples."""
    if get_origin(annotation) in (Union, types.UnionType, Annotated, tuple):
        for one in get_args(annotation):
            yield from _flat(one)
    else:
        yield annotation


def _kind(info: FieldInfo) -> str:
    options = [one for one in _union(info.annotation) if one is not type(None)]
    return " or ".join(dict.fromkeys(_one_kind(one, info.metadata) for one in options))


def _union(annotation: Any) -> tuple[Any, ...]:
    return get_args(annotation) if get_origin(annotation) in (Union, types.UnionType) else (annotation,)


def _one_kind(annotation: Any, metadata: Iterable[Any] = ()) -> str:
    if get_origin(annotation) is Annotated:
        return _one_kind(get_args(annotation)[0], get_args(annotation)[1:])
    if get_origin(annotation) is Literal:
        return ", ".join(f'`"{value}"`' for value in get_args(annotation))
    if get_origin(annotation) is tuple:
        parts = get_args(annotation)
        what = "texts" if parts[0] is str or get_origin(parts[0]) is Literal else "numbers"
        what = "tables" if inspect.isclass(parts[0]) and issubclass(parts[0], BaseModel) else what
        alone = any(isinstance(one, BeforeValidator) and isinstance(one.func(1.0), tuple) for one in metadata)
        return ("number or " * alone) + (f"list of {what}" if parts[-1] is Ellipsis else f"{len(parts)} {what}")
    if get_origin(annotation) is dict:
        return "table"
    names = {Distribution: "distribution", float: "number", int: "integer", bool: "true or false", str: "text"}
    return names.get(annotation, getattr(annotation, "__name__", str(annotation)))


def _range(info: FieldInfo) -> str:
    for part in parts_of(info):
        if isinstance(part, AfterValidator):  # of a distribution's values
            limits = inspect.getclosurevars(part.func).nonlocals
            if "interval" in limits:
                return str(limits["interval"])
    interval = interval_of(info)._replace(unit="")
    return "" if interval == Interval(-math.inf, math.inf, False, False) else str(interval)


def _default(info: FieldInfo) -> str:
    value = info.default_factory() if callable(info.default_factory) else info.default  # type: ignore[call-arg]
    if isinstance(value, Distribution):
        value = value.to_dict()
    if value == {} or value == ():
        return ""
    if value is PydanticUndefined:
        return "needed"
    if value is None:
        return ""
    if isinstance(value, tuple) and len(set(map(repr, value))) == 1 and math.isinf(value[0]):
        value = value[0]
    if isinstance(value, tuple):
        return f"`[{', '.join(map(_short, value))}]`"
    return f"`{_short(value)}`"


def _short(value: Any) -> str:
    if isinstance(value, str):
        return f'"{value}"'
    if isinstance(value, bool):
        return str(value).lower()
    if isinstance(value, int):
        power = value.bit_length()
        for exponent, offset in ((power, 0), (power, 1)):
            if value > 10**12 and value == 2**exponent - offset:
                return f"2^{exponent}" + (" - 1" if offset else "")
        return f"{value:_}" if value < 10**9 else f"{value:g}"
    if isinstance(value, float):
        return f"{value:g}" if math.isfinite(value) else ("inf" if value > 0 else "-inf")
    return str(value)


def dataset() -> str:
    """Datasets in the files of a dataset."""
    from spadwarp.dataset import Plan
    from spadwarp.dataset.shards import FRAME_COLUMNS, HISTOGRAM_COLUMNS, Column, scene_columns

    def table(columns: Mapping[str, Column]) -> str:
        lines = [f"| `{name}` | {column.unit} | {column.meaning} |" for name, column in columns.items()]
        return "\n".join(["| dataset | unit | what |", "|---|---|---|", *lines])

    plan = Plan(spadwarp.dataset.load_recipe(FOLDER.parents[1] / "configs" / "datasets" / "small.toml"))
    scenes = {
        name: dataclasses.replace(
            column,
            meaning=f"{column.meaning}; {np.dtype(column.kind)}"
            + (f" `{list(column.shape)}` a scene" if column.shape else ""),
        )
        for name, column in scene_columns(plan.shape).items()
    }
    parts = [
        MADE
        + "# Files of a dataset\n\nHow they lie together: [file formats](../formats.md#datasets). Shapes are those of "
        "[configs/datasets/small.toml](../../configs/datasets/small.toml), 64 × 48 pixels.",
        "## frames-NNNNN.h5\n\nOne row a frame.\n\n" + table(FRAME_COLUMNS),
        "## scenes-NNNNN.h5 and scenes.h5\n\nOne row a scene.\n\n" + table(scenes),
        "## histograms-NNNNN.h5\n\nOf traced scenes: `scene`, `expected`, `polarisation`, `gate_start` and `bin_width` "
        "have a row a scene, `sample` and the counts a row a frame. Counts are stored as cubes "
        "(`counts`), or event by event.\n\n" + table(HISTOGRAM_COLUMNS),
    ]
    return "\n\n".join(parts) + "\n"


# Command line


def commands() -> str:
    """The help of every command, 100 columns wide."""
    group: Any = typer.main.get_command(app)
    parts = [
        MADE + "# Command line\n\n"
        "Every command has a twin in [Python](python.md). stdout is for the answer, stderr for progress, warnings and "
        "errors. Exit codes: 0 done, 1 failed, 2 wrong use or a scene that is not valid, 130 interrupted, "
        "70 a bug of spadwarp."
    ]
    parts += _help(group, "spadwarp")
    return "\n\n".join(parts) + "\n"


def _help(command: Any, path: str) -> Iterator[str]:
    context = command.make_context(path, [], resilient_parsing=True, terminal_width=100, max_content_width=100)
    text = "\n".join(line.rstrip() for line in command.get_help(context).splitlines())
    yield f"## {path}\n\n```text\n{text}\n```"
    for name, one in sorted(getattr(command, "commands", {}).items()):
        yield from _help(one, f"{path} {name}")


# Python


def python() -> str:
    """The names of `spadwarp.__all__` by module, and the other public names of each package."""
    homes: dict[str, list[str]] = {}
    for name, home in spadwarp._HOMES.items():
        homes.setdefault(home, []).append(name)
    for package in sorted(spadwarp._PACKAGES):
        module = import_module(f"spadwarp.{package}")
        inner = package in ("arrays", "values")  # of which users need what `spadwarp` itself names
        names = [name for name in ([] if inner else getattr(module, "__all__", ())) if name not in spadwarp._HOMES]
        homes.setdefault(package, []).extend(name for name in names if callable(getattr(module, name)))
    homes = {home: names for home, names in homes.items() if names}
    parts = [
        MADE + "# Python\n\n`import spadwarp` loads a name when it is used. Names of `spadwarp.__all__` are "
        "`spadwarp.NAME`; the others are found in their package, as `spadwarp.PACKAGE.NAME`."
    ]
    for home, names in homes.items():
        about = inspect.cleandoc(import_module(f"spadwarp.{home}").__doc__ or "").splitlines()[0]
        parts.append(f"## {home.split('.')[-1].replace('_', ' ').capitalize()}\n\n{about}")
        parts += [f"::: spadwarp.{home}.{name}" for name in names]
    return "\n\n".join(parts) + "\n"


def kernels() -> str:
    """The public names of `spadwarp_kernels`, by package."""
    import spadwarp_kernels

    parts = [
        MADE
        + "# Kernel library\n\n`import spadwarp_kernels as sk`; what it is for: [README](../../kernels/README.md). "
        "Warp functions (`wp.func`) go into kernels of your own; structs and the other functions are for Python. "
        "All names stand at the top, as `sk.NAME`, too."
    ]
    assert spadwarp_kernels.__all__  # which lists those of each package
    for folder in pkgutil.iter_modules(spadwarp_kernels.__path__):
        package = import_module(f"spadwarp_kernels.{folder.name}")
        if names := getattr(package, "__all__", ()):
            parts.append(f"## {folder.name.capitalize()}\n\n{package.__doc__}")
            parts += [f"::: spadwarp_kernels.{folder.name}.{name}" for name in names]
    return "\n\n".join(parts) + "\n"


if __name__ == "__main__":
    FOLDER.mkdir(exist_ok=True)
    for file, text in pages().items():
        (FOLDER / file).write_text(text, encoding="utf-8")
