"""Commands to begin with: `init`, `list`, `doctor`."""

from __future__ import annotations

import dataclasses
import itertools
from pathlib import Path
from typing import Any, Literal

import spadwarp
from spadwarp.cli import options as opt
from spadwarp.cli.app import fail, note, say, wrong
from spadwarp.cli.options import command
from spadwarp.cli.outputs import check_outputs, rows, write_json
from spadwarp.values import count, suggestion


@command()
def init(
    name: str | None = None,
    *,
    example: str | None = None,
    schema: Literal["scene", "dataset", "training"] | None = None,
) -> None:
    """Write a commented scene to start from, or a JSON Schema with which editors complete and check TOML.

    VS Code reads a schema with the extension Even Better TOML, other editors with taplo.

    Args:
        name ([NAME]): The file to write, by default scene.toml, or KIND.schema.json; .toml may be left out.
        example (EXAMPLE): A scene of `spadwarp list scenes` instead of the template.
        schema (KIND): Write the schema of this kind of TOML file instead: scene, dataset or training.

    \b
    Examples:
      spadwarp init my_harbour --example harbour_5m
      spadwarp init --schema scene
    """
    if name is not None and (not Path(name).name or Path(name).name.startswith("-")):
        why = "begins as an option does" if Path(name).name else "is no name of a file"
        wrong(f"{name!r} {why}", "NAME")
    if schema is not None:
        opt.refuse("cannot be combined with --schema", "--example")
        path = Path(name or f"{schema}.schema.json")
        check_outputs(files={"NAME": path})
        if schema == "scene":
            model: Any = spadwarp.Scene
        else:
            model = spadwarp.dataset.Recipe if schema == "dataset" else spadwarp.denoise.TrainingRecipe
        spadwarp.io.write_json(spadwarp.files.json_schema(model), path)
        place = path if path.is_absolute() or path.parent.parts else f"./{path}"
        say(f"written: {path}\nVS Code, once:\n  code --install-extension tamasfe.even-better-toml")
        say(f"first line of a TOML file beside it, for VS Code and taplo:\n  #:schema {place}")
        write_json({"file": path})
        return
    name = "scene" if name is None else name
    path = Path(name if name.lower().endswith(".toml") else f"{name}.toml")
    check_outputs(files={"NAME": path})
    out = f"{path.with_suffix('')}/"
    if example is None:
        text = spadwarp.scene.template().replace("out/", out).replace(" scene.toml", f" {path}")
    else:
        copied = spadwarp.io.example_or_path(example, "scenes")
        spadwarp.load_scene(copied)
        text = spadwarp.io.read_text(copied)
    spadwarp.io.write_text(text, path)
    say(f"written: {path}\nnext: spadwarp check {path}; spadwarp plan {path}; spadwarp simulate {path} --out {out}")
    write_json({"file": path})


@command(name="list", prints_result=True)
def listed(
    kind: Literal["scenes", "datasets", "training", "presets", "targets", "validation", "benchmarks"] | None = None,
    name: str | None = None,
    *,
    out: Path | None = None,
    device: str | None = None,
) -> None:
    """Scenes, recipes, presets, targets and cases that come with spadwarp.

    \b
    scenes, datasets, training  scenes and recipes, which commands take by name; with NAME this one
    presets     waters, lasers, cameras, ports, detectors and gates with their sources; a scene
                selects one by preset = "NAME" in the section of that name; with NAME one section.
                The waters are for about 532 nm; `spadwarp water` computes other wavelengths
    targets     the built-in targets, which a scene selects by builtin = "NAME" in [[targets]]
    validation, benchmarks  cases of `spadwarp validate` and `spadwarp bench`

    Args:
        kind (KIND): One of these; without it, scenes and recipes.
        name ([NAME]): A scene or a recipe to print; a section of presets.
        out (DIR): Directory for targets.png, a picture of the built-in targets.

    \b
    Examples:
      spadwarp list
      spadwarp list presets medium
      spadwarp list targets --out pictures/
    """
    if kind != "targets":
        opt.refuse("is for `spadwarp list targets`", "--out", "--device")
    if kind in ("targets", "validation", "benchmarks"):
        opt.refuse(f"{name!r}: `spadwarp list {kind}` has no parts", "NAME")
    check_outputs(out, ["targets.png"])
    if kind == "presets":
        _list_presets(name)
    elif kind == "targets":
        _list_targets(out, device)
    elif kind in ("validation", "benchmarks"):
        cases = spadwarp.validate.CASES if kind == "validation" else spadwarp.benchmark.CASES
        found = {case.name: case.summary for case in cases.values()}
        if kind == "benchmarks":
            found["scaling"] = "how cost and memory grow with photons, faces and bins"
        say(rows(found))
        write_json({kind: found})
    else:
        _list_examples(kind, name)


# Commands that take scenes and recipes by name.
_USES = {"scenes": "spadwarp simulate NAME", "datasets": "spadwarp dataset NAME", "training": "spadwarp train NAME"}


def _list_examples(kind: str | None, name: str | None) -> None:
    known = {one: spadwarp.io.examples(one) for one in _USES if kind in (None, one)}
    if name is None:
        for one, paths in known.items():
            headings = {path.stem: _heading(path.read_text(encoding="utf-8")) for path in paths.values()}
            say(f"{one}: {_USES[one]}\n{rows(headings, indent='  ')}")
        write_json(known)
        return
    found = {one: {name: paths[name]} for one, paths in known.items() if name in paths}
    if not found:
        hint = suggestion(name, [one for paths in known.values() for one in paths])
        wrong(f"{name!r} is not one of `spadwarp list {kind}`{hint}", "NAME")
    say("\n".join(paths[name].read_text(encoding="utf-8").rstrip() for paths in found.values()))
    write_json(found)


def _heading(text: str) -> str:
    """The first sentence of a file's comment."""
    lines = text.splitlines()
    first = itertools.takewhile(lambda line: line.startswith("# ") and not line.startswith("#   "), lines)
    return " ".join(line[2:] for line in first)


def _list_presets(section: str | None) -> None:
    chosen = list(spadwarp.scene.presets(section).values())
    groups = itertools.groupby(chosen, lambda preset: f"[{preset.section}] {preset.source}")
    before: list[str] = []
    for number, (source, presets) in enumerate(groups):
        parts = source.split("; ")
        own = [part for k, part in enumerate(parts) if parts[: k + 1] != before[: k + 1]]  # not said above
        say("\n" * (number > 0 and own == parts) + "; ".join(own))
        before = parts
        for preset in presets:
            values = {name: f"{x:.5g}" if isinstance(x, float) else x for name, x in preset.values.items()}
            say(f"  {preset.name:<30}  " + ", ".join(f"{name} {value}" for name, value in values.items()))
    write_json({"presets": [dataclasses.asdict(preset) for preset in chosen]})


def _list_targets(out: Path | None, device: str | None) -> None:
    found = spadwarp.viz.describe_targets()
    files = [] if out is None else [spadwarp.viz.draw_targets(out / "targets.png", device=device)]
    for one in found:
        extent = " x ".join(f"{side:.2f}" for side in one["extent"])
        say(f"{one['name']:<14}  {extent} m  {count(one['faces']):>7} faces")
    for path in files:
        say(f"written: {path}")
    write_json({"targets": found, "files": files})


@command()
def doctor(*, device: str | None = None, self_test: bool = True) -> None:
    """Check the installation, show the devices that can trace photons, and run a self-test.

    Shows versions, devices, driver, kernel cache, and what is missing for a GPU. The self-test takes some seconds, and
    compares ballistic light from a plate with the lidar equation, and a slab with published values. Exit code 1 for a
    problem or a failed test.

    Args:
        self_test: Trace two small scenes.

    \b
    Examples:
      spadwarp doctor
      spadwarp doctor --device cpu --json report.json
    """
    check_outputs()
    found = spadwarp.doctor.diagnose(device=device, self_test=self_test, progress=note)
    for title, facts in found.facts.items():
        say(f"{title}\n{rows(facts, indent='  ')}")
    if found.gpu:
        say("No GPU is used\n" + "\n".join(f"  {reason}" for reason in found.gpu))
    if found.tests:
        took = ", ".join(f"{name} {seconds:.1f} s" for name, seconds in found.seconds.items())
        say(f"Self-test ({took})\n" + rows({test.name: str(test) for test in found.tests}, indent="  "))
    devices = spadwarp.device.devices()
    write_json({**dataclasses.asdict(found), "devices": devices, "healthy": found.healthy})
    if not found.healthy:
        failed = [f"self-test: {test.name}: {test}" for test in found.tests if not test.passed]
        fail("\n".join([*found.problems, *failed]))
