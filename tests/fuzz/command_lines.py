"""Command lines that a beginner, a typo or an attacker writes: options of every command with odd values."""

import functools
import itertools
import random

import typer

ODD = (
    "", " ", "-1", "0", "1e5", "1.5", "nan", "inf", "-inf", "1e308", "1e-320", "9" * 5000, "99999999999999999999",
    "0x10", "--", "-", "--help", "-h", "~nosuchuser", "~", "/dev/null", "nowhere/a", ".", "a" * 300, "a/" * 200,
    "x\ty", "é𝕏", "²", "٣", "\udcff", "%s", "{}", "$(ls)", "scene.toml", "result.h5", "frames.h5", "counts.npy",
    "depth.npy", "box.stl", "recipe.toml", "missing.h5", "out", "out/", "out/x.html", "out.json", "cpu", "cpu,cpu",
    "cuda:99", "cuda:all", "ray", "local", "1:2", "1:5:3", "1:5:999999999", "1:5", "a,b,c", "3/2", "1/0", "2/3",
    "0:1", "5:1", "16x12", "medium.extinction=1", "medium.extinction=-1", "medium.extinction=nan", "targets.².x=1",
    "targets[0].scale=2", "targets[9].scale=2", "=", "a=", "=1", "medium=1", "transport.seed=1e3",
    "camera.width=1e9", "gate.bins=0", "transport.photons=07:32:00", "[" * 500, "{" * 500, "json", "html", "mat",
    "npy", "exr", "peak", "likelihood", "test", "nosuch", "pyramid", "median", "uwoc-clear", "staircase_15m", "1 m",
    "zero.npy", "many.npy", "gate.npy", "port.toml", "polarised.toml", "depth=5,1e-300", "medium.absorption=nan,1",
    "medium.absorption", "depth:pixel", "targets[0].reflectance,background", "training.toml", "data", "slab", "water",
    "all", "histograms", "medium.absorption=1e300", "bin_width=200ps,gate_start=3ns", "optimiser.steps=2", "0 m",
    "5 mm", "3km", "1e3ps", "20 ns", "1e300", "True", "null",
)  # fmt: skip

# What would run for minutes, reach for a network or a browser, or write where it should not.
_LEFT_OUT = {("doctor",)}
_SETTINGS = {"--install-completion", "--show-completion", "--ray", "--repeats"}
_LONG = {("bench",), ("validate",)}  # with the cases and photons of their bases alone

BASES = {
    ("check",): ("scene.toml",),
    ("simulate",): ("scene.toml", "--photons", "200", "--out", "out", "--device", "cpu"),
    ("analytic",): ("scene.toml", "--out", "out", "--frames", "2", "--device", "cpu"),
    ("sweep",): ("scene.toml", "--vary", "medium.extinction=0.1:1:2", "--out", "out", "--device", "cpu"),
    ("detect",): ("result.h5", "--pulses", "20", "--method", "peak", "--out", "out", "--device", "cpu"),
    ("depth",): ("result.h5", "--out", "out", "--device", "cpu"),
    ("denoise",): ("depth.npy", "--model", "median", "--out", "out", "--device", "cpu"),
    ("info",): ("result.h5",),
    ("view",): ("result.h5", "--out", "out.html", "--device", "cpu"),
    ("export",): ("frames.h5", "--format", "npy", "--out", "out"),
    ("merge",): ("result.h5", "result.h5", "--out", "out"),
    ("water",): ("532",),
    ("list",): ("presets", "medium"),
    ("init",): ("mine",),
    ("plan",): ("scene.toml", "--photons", "2000", "--no-range", "--device", "cpu"),
    ("fit",): ("counts.npy", "scene.toml", "--unknown", "medium.absorption,depth", "--pulses", "300", "--photons",
               "1000", "--out", "out", "--device", "cpu"),
    ("train",): ("training.toml", "--out", "out", "--device", "cpu"),
    ("evaluate",): ("data", "--models", "median", "--frames", "1", "--device", "cpu"),
    ("validate",): ("slab", "--photons", "2000", "--device", "cpu"),
    ("bench",): ("water", "--photons", "2000", "--repeats", "1", "--device", "cpu"),
    ("dataset",): ("recipe.toml", "--out", "out", "--device", "cpu"),
}  # fmt: skip
# In the place of a base's scene or counts: other features, and counts of nothing, of too much, of another gate.
ALIKE = {
    "scene.toml": ("scene.toml", "grid.toml", "port.toml", "walls.toml", "polarised.toml"),
    "counts.npy": ("counts.npy", "frames.h5", "result.h5", "zero.npy", "many.npy", "gate.npy"),
}
OUTPUTS = ("out", "out.json", "out.html", "out.gif", "mine.toml", "view.html", "light.gif", "scene.toml.new")


@functools.cache
def program():
    """`spadwarp`, built once: typer reads the annotations of all commands for it."""
    from spadwarp.cli import app

    return typer.main.get_command(app)


@functools.cache
def options() -> dict[tuple[str, ...], list[tuple[str, bool]]]:
    """Of each command its options, and whether they take a value."""
    found: dict[tuple[str, ...], list[tuple[str, bool]]] = {}

    def walk(command, path):
        for name, one in getattr(command, "commands", {}).items():
            walk(one, (*path, name))
        if not hasattr(command, "commands") and path not in _LEFT_OUT:
            named = [one for one in command.params if one.param_type_name == "option" and one.opts[-1] not in _SETTINGS]
            found[path] = [(one.opts[-1], not getattr(one, "is_flag", False)) for one in named]

    walk(program(), ())
    return found


def draw(r: random.Random) -> tuple[tuple[str, ...], tuple[str, ...]]:
    """Arguments, and the names that they name for output."""
    path = r.choice(sorted(options()))
    words = [r.choice(ALIKE.get(word, (word,))) for word in BASES.get(path, ())]
    for _ in range(r.choice((1, 1, 2, 3))):
        action = r.random() * (0.45 if path in _LONG else 1.0)
        if action < 0.45 and options()[path]:
            name, takes_value = r.choice(options()[path])
            words += [name, r.choice(ODD)] if takes_value else [name]
        elif action < 0.75 and words:
            words[r.randrange(len(words))] = r.choice(ODD)
        elif action < 0.85 and words:
            del words[r.randrange(len(words))]
        elif action < 0.93:
            words.insert(r.randrange(len(words) + 1), r.choice(ODD))
        else:
            r.shuffle(words)
    named = [value for option, value in itertools.pairwise(words) if option in _NAMING]
    written = [word for word in words if not word.startswith("-")] or ["scene"]
    initial = [f"{word.removesuffix('.toml')}.toml" for word in written] if path == ("init",) else []
    in_place = ["."] * (path == ("reconstruct",) and "--out" not in words)
    return (*path, *words), (*OUTPUTS, *named, *initial, *in_place)


_NAMING = {"--out", "--json", "--ply", "--write", "--report", "--traceback", "--plots", "--picture", "--matrix"}
