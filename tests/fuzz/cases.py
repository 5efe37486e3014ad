"""What is run on damaged files: a case is a folder of files, one of them damaged, and a command on it."""

import itertools
import random
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from fuzz import command_lines, mutations
from fuzz.corpus import SPECIAL, Corpus

CALIBRATED = ("phase.csv", "beam.npy", "camera.yaml", "irf.csv", "target.obj", "target.mtl", "target.png")

# Commands on a file {0}, of which one is chosen.
RUN = "simulate {0} --photons 100 --out out --quiet --device cpu"
CHECK_OR_RUN = ("check {0}", RUN)
ON_A_SCENE = (*CHECK_OR_RUN, "check {0} --json out.json", "load_scene {0}")
ON_A_SCENE += ("sweep {0} --vary range=1,2 --out out --device cpu", "plan {0} --photons 2000 --no-range --device cpu")
ON_A_SCENE += ("fit counts.npy {0} --unknown medium.absorption --pulses 300 --photons 500 --out out --device cpu",)
ON_A_SCENE += ("analytic {0} --out out --frames 1 --quiet --device cpu",)
ON_A_MESH = ("info {0}", "check scene.toml --mesh {0}", RUN.replace("{0}", "scene.toml --mesh {0}"))
MEDIAN = "denoise {0} --model median --out out --device cpu"
RENDERED = (
    "analytic scene.toml --out out --quiet --device cpu --rendered depth={0},depth_channel=Z,depth_scale=1,albedo="
)
ON_AN_EXR = (MEDIAN, MEDIAN, RENDERED + "0.5", RENDERED + "{0}")
ON_HDF5 = ("info {0}", "info {0} --json out.json", "load {0}", "depth {0} --out out --device cpu")
ON_HDF5 += ("view {0} --out out.html --device cpu",)
ON_HDF5 += tuple(f"export {{0}} --out out --format {name}" for name in ("npy", "mat", "ptu", "exr"))
ON_A_RESULT = (
    "detect {0} --pulses 50 --method peak --out out --device cpu",
    "merge {0} other.h5 --out out --device cpu",
    "simulate --photons 2500 --resume {0} --device cpu",
    "view {0} --out out.gif --pictures 3",
)
ON_A_DATASET = ("info data", "info data --verify", "view data --out out.png", "export data --format npy --out out")
ON_A_DATASET += ("load data",)
TAGS, KNOWN = "tag_unit=200ps,", " --input bin_width=200ps,gate_start=10ns,group_index=1.3"
DEPTH = "depth {0} --out out --device cpu" + KNOWN
ON_COUNTS = (MEDIAN + KNOWN, *(f"{DEPTH},irf=300ps --method {name}" for name in ("peak", "centroid", "likelihood")))
WITH_A_RESPONSE = (DEPTH.format("counts.npy") + ",irf={0} --method matched",)
WITH_WEIGHTS = ("denoise depth.npy --model usdn --weights {0} --out out --device cpu",)


@dataclass(frozen=True)
class Case:
    """A command in a folder."""

    arguments: tuple[str, ...]  # of `spadwarp`, or the name of a check in `executed` and a file
    files: dict[str, bytes | None]  # content by name; what has none is a folder or file of the corpus
    outputs: tuple[str, ...] = ()  # what the command may create or change, folders with all that is in them
    injected: bool = False  # a number of a text became NaN or infinite, so that success has to be looked into


def _case(r: random.Random, commands: Sequence[str], name: str, damaged: bytes, *others: str, **options: Any) -> Case:
    outputs = ("out", "out.json", "out.html", "out.gif", "out.png")
    words = tuple(r.choice(commands).format(name).split())
    outputs += (".",) * ("--resume" in words)  # a run that is resumed is written where it is
    return Case(words, {**dict.fromkeys(others), name: damaged}, outputs, **options)


def _scene(r: random.Random, corpus: Corpus) -> Case:
    name, injected = r.choice(("scene.toml", "scene.toml", "calibrated.toml", *SPECIAL)), r.random() < 0.25
    damaged = (mutations.non_finite if injected else mutations.in_text)(r, corpus[name])
    others = CALIBRATED if name == "calibrated.toml" else ("cells.npz",)
    return _case(r, ON_A_SCENE, name, damaged, "counts.npy", *others, injected=injected)


def _changed(r: random.Random, corpus: Corpus) -> Case:
    """A file that a scene names, or one that its mesh names, changes after the scene was run."""
    name = r.choice((*CALIBRATED, "cells.npz"))
    damage = mutations.in_bytes if name.endswith((".npy", ".png", ".npz")) else mutations.in_text
    scene = "grid.toml" if name == "cells.npz" else "calibrated.toml"
    new, other = damage(r, corpus[name]), {"calibrated.toml": CALIBRATED, "grid.toml": ("cells.npz",)}[scene]
    files = {**dict.fromkeys((scene, *other)), f"new/{name}": new}
    return Case(("changed", scene, name, r.choice(("simulate", "merge"))), files, ("out", "new", name))


def _recipe(r: random.Random, corpus: Corpus) -> Case:
    name, injected = r.choice(("recipe.toml", "recipe.toml", "training.toml")), r.random() < 0.3
    damaged = (mutations.non_finite if injected else mutations.in_text)(r, corpus[name])
    return _case(r, (f"load_{name.partition('.')[0]} {{0}}",), name, damaged, injected=injected)


def _beside_a_scene(*names: str) -> Callable[[random.Random, Corpus], Case]:
    """Files that a scene names: calibrations, tables, responses, profiles, meshes with colours, cells."""

    def case(r: random.Random, corpus: Corpus) -> Case:
        name = r.choice(names)
        damage = mutations.in_bytes if name.endswith((".npy", ".png", ".npz", ".h5")) else mutations.in_text
        scene = "grid.toml" if name.startswith("cells") else "calibrated.toml"
        made = _case(r, CHECK_OR_RUN, scene, corpus[scene], *CALIBRATED)
        text = made.files[scene].replace(b"cells.npz", name.encode())
        text = text.replace(b"camera.yaml", name.encode()) if name.startswith("camera") else text
        return replace(made, files={**made.files, scene: text, name: damage(r, corpus[name])})

    return case


def _mesh(r: random.Random, corpus: Corpus) -> Case:
    name = r.choice(("box.stl", "box.ascii.stl", "box.ply", "box.off", "box.glb", "target.obj"))
    is_text = name in ("box.ascii.stl", "box.off", "target.obj")
    damaged = (mutations.in_text if is_text or r.random() < 0.3 else mutations.in_bytes)(r, corpus[name])
    return _case(r, ON_A_MESH, name, damaged, "scene.toml", "target.mtl", "target.png")


def _hdf5(r: random.Random, corpus: Corpus) -> Case:
    name = r.choice(("result.h5", "frames.h5", "analytic.h5", "records.h5"))
    commands = ON_HDF5 + (ON_A_RESULT if name == "result.h5" else ())
    made = _case(r, commands, name, mutations.in_hdf5(r, corpus[name]), "scene.toml")
    return replace(made, files={**made.files, "other.h5": corpus["result.h5"]})


def _dataset(r: random.Random, corpus: Corpus) -> Case:
    name = r.choice(("manifest.json", "frames-00000.h5", "scenes.h5", "scenes/scenes-00001.h5", "recipe.toml"))
    damage = mutations.in_hdf5 if name.endswith(".h5") else mutations.in_text
    return _case(r, ON_A_DATASET, f"data/{name}", damage(r, corpus[f"data/{name}"]), "data")


def _damaged(commands: Sequence[str], *names: str, others: tuple[str, ...] = ()) -> Callable:
    def case(r: random.Random, corpus: Corpus) -> Case:
        name = r.choice(names)
        damage = mutations.in_text if name.endswith(".csv") else mutations.in_bytes
        command = [one.replace("gate_start", f"{TAGS * (name == 'tags.mat')}gate_start") for one in commands]
        return _case(r, command, name, damage(r, corpus[name]), *others)

    return case


def _command_line(r: random.Random, corpus: Corpus) -> Case:
    names = ("result.h5", "frames.h5", "depth.npy", "box.stl", "recipe.toml", "training.toml", "cells.npz", "data")
    files = dict.fromkeys((*names, *itertools.chain(*command_lines.ALIKE.values())))
    arguments, outputs = command_lines.draw(r)
    return Case(arguments, files, outputs)


CATEGORIES: dict[str, Callable[[random.Random, Corpus], Case]] = {
    "scene": _scene,
    "changed": _changed,
    "recipe": _recipe,
    "grid": _beside_a_scene("cells.npz", "cells.h5"),
    "calibration": _beside_a_scene("camera.yaml", "camera.json", "camera.xml"),
    "table": _beside_a_scene("phase.csv", "irf.csv", "beam.npy"),
    "mesh": _mesh,
    "picture": _beside_a_scene("target.png", "target.mtl", "target.obj"),
    "exr": _damaged(ON_AN_EXR, "depth.exr", others=("scene.toml",)),
    "hdf5": _hdf5,
    "dataset": _dataset,
    "counts": _damaged(ON_COUNTS, "counts.npy", "counts.npz"),
    "depth": _damaged((MEDIAN,), "depth.npy"),
    "response": _damaged(WITH_A_RESPONSE, "irf.csv", "response.npy", others=("counts.npy",)),
    "mat": _damaged(ON_COUNTS, "counts.mat", "packed.mat", "tags.mat", "sparse.mat"),
    "ptu": _damaged(ON_COUNTS, "counts.ptu"),
    "weights": _damaged(WITH_WEIGHTS, "usdn.safetensors", others=("depth.npy",)),
    "command": _command_line,
}


def draw(number: int, corpus: Corpus, category: str) -> Case:
    """The case of a number, the same every time."""
    return CATEGORIES[category](random.Random(f"{category} {number}"), corpus)


def write(case: Case, folder: Path, corpus: Path) -> None:
    """The files of a case."""
    for name, content in case.files.items():
        place, source = folder / name, corpus / name
        place.parent.mkdir(parents=True, exist_ok=True)
        if content is not None:
            place.write_bytes(content)
        elif source.is_dir():
            shutil.copytree(source, place)
        else:
            shutil.copyfile(source, place)
