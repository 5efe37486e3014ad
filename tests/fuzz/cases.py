"""What is run on damaged files: a case is a folder of files, one of them damaged, and a command on it."""

import random
import shutil
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

from fuzz import command_lines, mutations
from fuzz.corpus import Corpus

CPU = ("--device", "cpu")
QUIETLY = ("--out", "out", "--quiet", *CPU)
_MEDIAN = ("--model", "median", "--out", "out", *CPU)
CALIBRATED = ("phase.csv", "beam.npy", "camera.yaml", "irf.csv", "target.obj", "target.mtl", "target.png")


@dataclass(frozen=True)
class Case:
    """A command in a folder."""

    arguments: tuple[str, ...]  # of `spadwarp`, or the name of a check in `executed` and a file
    files: dict[str, bytes | None]  # content by name; what has none is a folder or file of the corpus
    outputs: tuple[str, ...] = ()  # what the command may create or change, folders with all that is in them
    injected: bool = False  # a number of a text became NaN or infinite, so that success has to be looked into


def _scene(r: random.Random, corpus: Corpus) -> Case:
    name = r.choice(("scene.toml", "scene.toml", "calibrated.toml"))
    injected = r.random() < 0.25
    damaged = (mutations.non_finite if injected else mutations.in_text)(r, corpus[name])
    others = {} if name == "scene.toml" else dict.fromkeys(CALIBRATED)
    command = r.choice((
        ("check", name),
        ("check", name, "--json", "out.json"),
        ("simulate", name, "--photons", "200", *QUIETLY),
        ("sweep", name, "--vary", "range=1,2", "--out", "out", *CPU),
        ("load_scene", name),
    ))  # fmt: skip
    return Case(command, {name: damaged, **others}, ("out", "out.json"), injected)


def _beside_a_scene(*names: str) -> Callable[[random.Random, Corpus], Case]:
    """Files that a scene names: calibrations, tables, responses, profiles, meshes with colours."""

    def case(r: random.Random, corpus: Corpus) -> Case:
        name = r.choice(names)
        damage = mutations.in_bytes if name.rpartition(".")[2] in ("npy", "png") else mutations.in_text
        scene = corpus["calibrated.toml"]
        if name.startswith("camera"):
            scene = scene.replace(b"camera.yaml", name.encode())
        files = {**dict.fromkeys(CALIBRATED), "calibrated.toml": scene, name: damage(r, corpus[name])}
        return Case(_check_or_run(r, "calibrated.toml"), files, ("out",))

    return case


def _check_or_run(r: random.Random, *words: str) -> tuple[str, ...]:
    return r.choice((("check", *words), ("simulate", *words, "--photons", "100", *QUIETLY)))


def _grid(r: random.Random, corpus: Corpus) -> Case:
    name = r.choice(("cells.npz", "cells.h5"))
    files = {"grid.toml": corpus["grid.toml"].replace(b"cells.npz", name.encode())}
    files[name] = mutations.in_bytes(r, corpus[name])
    return Case(_check_or_run(r, "grid.toml"), files, ("out",))


def _recipe(r: random.Random, corpus: Corpus) -> Case:
    name = r.choice(("recipe.toml", "recipe.toml", "training.toml"))
    injected = r.random() < 0.3
    damaged = (mutations.non_finite if injected else mutations.in_text)(r, corpus[name])
    return Case(("load_" + name.partition(".")[0], name), {name: damaged}, (), injected)


def _mesh(r: random.Random, corpus: Corpus) -> Case:
    name = r.choice(("box.stl", "box.ascii.stl", "box.ply", "box.off", "box.glb", "target.obj"))
    is_text = name in ("box.ascii.stl", "box.off", "target.obj")
    damaged = (mutations.in_text if is_text or r.random() < 0.3 else mutations.in_bytes)(r, corpus[name])
    command = ("info", name) if r.random() < 0.3 else _check_or_run(r, "scene.toml", "--mesh", name)
    return Case(command, {name: damaged, **dict.fromkeys(("scene.toml", "target.mtl", "target.png"))}, ("out",))


def _exr(r: random.Random, corpus: Corpus) -> Case:
    rendered = "depth=depth.exr,depth_channel=Z,depth_scale=1,albedo=" + r.choice(("0.5", "depth.exr"))
    command = r.choice(
        (("analytic", "scene.toml", "--rendered", rendered, *QUIETLY), ("denoise", "depth.exr", *_MEDIAN))
    )
    return Case(command, {"depth.exr": mutations.in_bytes(r, corpus["depth.exr"]), "scene.toml": None}, ("out",))


def _hdf5(r: random.Random, corpus: Corpus) -> Case:
    name = r.choice(("result.h5", "frames.h5", "analytic.h5", "records.h5"))
    commands = [
        ("info", name),
        ("info", name, "--json", "out.json"),
        ("depth", name, "--out", "out", *CPU),
        ("view", name, "--out", "out.html", *CPU),
        ("export", name, "--format", r.choice(("npy", "mat", "ptu", "exr")), "--out", "out"),
        ("load", name),
    ]
    if name == "result.h5":
        commands += [
            ("detect", name, "--pulses", "50", "--method", "peak", "--out", "out", *CPU),
            ("merge", name, "other.h5", "--out", "out", *CPU),
            ("simulate", "scene.toml", "--photons", "2000", "--resume", "result.h5", "--out", "out", *CPU),
            ("view", name, "--out", "out.gif", "--pictures", "3"),
        ]
    files = {name: mutations.in_hdf5(r, corpus[name]), "scene.toml": None}
    if name == "result.h5":
        files["other.h5"] = corpus["result.h5"]
    return Case(r.choice(commands), files, ("out", "out.json", "out.html", "out.gif"))


def _dataset(r: random.Random, corpus: Corpus) -> Case:
    name = r.choice(("manifest.json", "frames-00000.h5", "scenes.h5", "scenes/scenes-00001.h5", "recipe.toml"))
    damage = mutations.in_hdf5 if name.endswith(".h5") else mutations.in_text
    command = r.choice((
        ("info", "data"),
        ("info", "data", "--verify"),
        ("view", "data", "--out", "out.png"),
        ("export", "data", "--format", "npy", "--out", "out"),
        ("load", "data"),
    ))  # fmt: skip
    return Case(command, {"data": None, f"data/{name}": damage(r, corpus[f"data/{name}"])}, ("out", "out.png"))


_KNOWN = ("--input", "bin_width=200ps,gate_start=10ns,group_index=1.3")


def _measured(*names: str) -> Callable[[random.Random, Corpus], Case]:
    def case(r: random.Random, corpus: Corpus) -> Case:
        name = r.choice(names)
        tags = ("--input", "tag_unit=200ps") if name == "tags.mat" else ()
        method = ("--input", "irf=300ps", "--method", r.choice(("peak", "centroid", "likelihood")))
        depth = ("depth", name, "--out", "out", *_KNOWN, *tags, *method, *CPU)
        command = r.choice((depth, ("denoise", name, *_MEDIAN, *_KNOWN, *tags)))
        if name == "depth.npy":
            command = ("denoise", name, *_MEDIAN)
        if name in ("response.npy", "irf.csv"):
            method = ("--input", f"irf={name}", "--method", "matched")
            command = ("depth", "counts.npy", "--out", "out", *_KNOWN, *method, *CPU)
        damage = mutations.in_text if name.endswith(".csv") else mutations.in_bytes
        return Case(command, {"counts.npy": None, name: damage(r, corpus[name])}, ("out",))

    return case


def _weights(r: random.Random, corpus: Corpus) -> Case:
    damaged = mutations.in_bytes(r, corpus["usdn.safetensors"])
    command = ("denoise", "depth.npy", "--model", "usdn", "--weights", "own.safetensors", "--out", "out", *CPU)
    return Case(command, {"own.safetensors": damaged, "depth.npy": None}, ("out",))


def _command_line(r: random.Random, corpus: Corpus) -> Case:
    files = dict.fromkeys(("scene.toml", "result.h5", "frames.h5", "counts.npy", "depth.npy", "box.stl", "recipe.toml"))
    arguments, outputs = command_lines.draw(r)
    return Case(arguments, files, outputs)


CATEGORIES: dict[str, Callable[[random.Random, Corpus], Case]] = {
    "scene": _scene,
    "recipe": _recipe,
    "grid": _grid,
    "calibration": _beside_a_scene("camera.yaml", "camera.json", "camera.xml"),
    "table": _beside_a_scene("phase.csv", "irf.csv", "beam.npy"),
    "mesh": _mesh,
    "picture": _beside_a_scene("target.png", "target.mtl", "target.obj"),
    "exr": _exr,
    "hdf5": _hdf5,
    "dataset": _dataset,
    "npy": _measured("counts.npy", "depth.npy", "response.npy"),
    "csv": _measured("irf.csv"),
    "mat": _measured("counts.mat", "packed.mat", "tags.mat", "sparse.mat"),
    "ptu": _measured("counts.ptu"),
    "weights": _weights,
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
