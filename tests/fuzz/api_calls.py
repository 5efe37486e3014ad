"""Every public function, class and method of spadwarp, called with arguments that fit and with some that do not."""

import contextlib
import importlib
import inspect
import io
import itertools
import math
import os
import random
import shutil
import tempfile
import types
import warnings
from pathlib import Path
from typing import Any

import numpy as np
import pydantic
import warp as wp

import spadwarp
from fuzz.corpus import COUNTS
from fuzz.isolation import run_isolated
from spadwarp.values import SpadwarpError, _fits, in_words

# Those that run for minutes whatever they are given, end the process, or are no calls with one answer.
LEFT_OUT = {
    "benchmark.run", "benchmark.TransportRun", "evaluation.evaluate", "evaluation.evaluate_fresh", "doctor.diagnose",
    "evaluation.evaluate_scenes", "evaluation.photon_sweep", "denoise.train", "device.devices", "device.start_warp",
    "io.parse_json", "parallel.Forked", "parallel.Ray", "viz.draw_targets",
    "viz.describe_targets",
}  # fmt: skip
PACKAGES = [name for name in spadwarp._PACKAGES if name != "values"]
ALWAYS = ("device", "frames", "photons", "pictures", "pulses", "progress", "cases", "initial")
NUMBERS = (0, -1, 2**31, 2**63, 2**64, 10**400, 1.5, -0.5, math.nan, math.inf, -math.inf, 1e300, -1e300, 1e-300, True)
ODD: tuple[Any, ...] = (
    *NUMBERS, None, "", "a", "nan", "\0", "é\udcff", "x" * 5000, b"x", [], {}, (), [None], {"a": None}, {1: 2},
    object(), 1j, "out", Path("missing.h5"), Path(), int, len, np.float32(1), np.array(1.0), np.array([]),
    np.array(["a"]),
    np.full(3, np.nan), np.zeros((2, 0)), np.full((8, 10, 30), np.inf), np.full((8, 10, 30), 2**62), [[1.0], [2, 3]],
    np.zeros((8, 10, 30)), np.full(3, 1e300), np.array([object()]), np.zeros(3, "M8[s]"), slice(None), range(3),
)  # fmt: skip
CALLS = 5  # of a case
_POOL: list[Any] = []
_NAMED: dict[str, tuple[Any, ...]] = {}
_CALLS: dict[str, Any] = {}
TRAJECTORY = "time,medium.extinction\n0,0.3\n1,0.5\n"


def warm_up(corpus: Path) -> None:
    """The values that calls are made of: one of every kind, and those that parameters of a name take."""
    (corpus / "path.csv").write_text(TRAJECTORY)
    load = {name: spadwarp.load(corpus / name) for name in ("result.h5", "frames.h5", "analytic.h5", "data")}
    scene, result, tagged = spadwarp.load_scene(corpus / "scene.toml"), load["result.h5"], load["frames.h5"]
    s = spadwarp
    frames = s.detect(result, pulses=20, seed=1, device="cpu")
    analytic = s.simulate_analytic(scene, frames=1, seed=1, device="cpu")
    fitted = s.fit(COUNTS, scene, unknown="medium.absorption", pulses=300, photons=1000, device="cpu")
    optics = s.water.kopelevich_particles(532.0, small=0.1, large=0.1)
    recipe = s.dataset.load_recipe(corpus / "recipe.toml")
    truth = s.truth_maps(scene, device="cpu")
    irf = s.frames.detector_response(scene.detector, scene.laser)
    _POOL[:] = [
        scene, result, tagged, frames, analytic, optics, recipe, truth, irf, load["analytic.h5"], load["data"],
        s.mesh.build_mesh(scene), s.mesh.describe_mesh(corpus / "box.stl"), s.water.single_size(1e-6),
        result.depth(device="cpu"), fitted, fitted.goodness,
        s.scene.load_trajectory(corpus / "path.csv"), s.scene.phase_function(scene.medium), scene.targets[0],
        s.transport.load_records(corpus / "records.h5"), s.denoise.load_training_recipe(corpus / "training.toml"),
        scene.medium, scene.laser, scene.camera, scene.detector, s.RunOptions(), s.parallel.Worker("cpu"),
        0.5, 1.0, 2, 3, True, "a", "I", "depth", "peak", np.ones(3), np.ones((8, 10)), np.ones((8, 10, 30), np.int32),
        wp.ones((8, 10, 30), dtype=int, device="cpu"), wp.get_device("cpu"), (1.0, 2.0), (1, 2), ["a"], [1.0, 2.0],
        {"a": 1.0}, {"a": np.ones(3)}, None, np.ones((3, 3)), [{"a": 1.0}], np.linspace(0.0, 6e-9, 31), (1.0, 0.0, 0.0),
        np.ones((8, 10), np.float32), len,
    ]  # fmt: skip
    names = sorted(place.name for place in corpus.iterdir())
    files = (*names, *(f"data/{one}" for one in ("manifest.json", "scenes.h5")), "out.h5", "out.png", "out.csv", "out")
    pairs = dict(
        path=files, source=(*files, result, tagged, frames), folder=("data", "out"), out=("out",), device=("cpu",),
        photons=(100,), frames=(2, 1), pictures=(3,), pulses=(20, 300), progress=(None,), cases=(["slab"], ["none"]),
        counts=(np.ones((8, 10, 30), np.int32),), directory=("out",), method=("peak", "centroid", "likelihood"),
        wavelength_nm=(532.0,), view=(np.array([[0.0, 0.0, 1.0]]),), group_index=(1.34,), overrides=(None, {}),
        recipe=(recipe, "recipe.toml"), vary=("range=1,2", "medium.extinction=0.1,0.3"), kind=("depth", "scenes"),
        derivatives=((), ("medium.extinction",)), unknown=("medium.absorption", "depth,targets[0].reflectance"),
        name=("target", "plane"), histogram=(np.ones((8, 10, 30), np.int32),), shown=(result, frames, scene),
        format=("npy", "numpy", "webdataset"), held=(result, tagged, load["data"]),
        depth=(np.ones((8, 10), np.float32),), array=(np.ones((2, 3)),), gate=((1.0, 8.0), None),
        split=("all", "train"), bin_width=(2e-10,), gate_start=(1.6e-8,), edges=(np.arange(31) * 2e-10,),
        model=("median", "usdn"), text=("medium.extinction=0.3", "0.1:1:2"), period=(1e-7, None), engine=(None,),
        tables=({"medium": {"extinction": 0.3}},), names=(["medium.extinction"],), processes=(1,), index=(0, 1),
        response=(np.array([1.0, 4.0, 2.0]),), background=(1.0, None), seed=(1,), threads=(1,),
        work=(lambda job, worker: job,), jobs=([1, 2],), columns=({"a": np.ones(3)}, {"angle_deg": "[0, 180]"}),
        channels=({"Z": np.ones((2, 3))},),
    )  # fmt: skip
    _NAMED.update(pairs)
    _CALLS.update(_public())


def _public() -> dict[str, Any]:
    """Functions, constructors and methods by name; the methods are those of values of the pool."""
    found = {}
    for package in PACKAGES:
        module = importlib.import_module(f"spadwarp.{package}")
        for name in module.__all__:
            one = getattr(module, name)
            model = isinstance(one, type) and issubclass(one, pydantic.BaseModel | tuple | Exception)
            if isinstance(one, types.FunctionType | type) and not model and f"{package}.{name}" not in LEFT_OUT:
                found[f"{package}.{name}"] = one
    for value in _POOL:
        if type(value).__module__.startswith("spadwarp."):
            for name in dir(type(value)):
                if not name.startswith("_") and not hasattr(pydantic.BaseModel, name):
                    member = inspect.getattr_static(type(value), name)
                    if isinstance(member, types.FunctionType | classmethod | staticmethod):
                        found[f"{type(value).__name__}.{name}"] = getattr(value, name)
    return found


def run(number: int, corpus: Path) -> tuple[str, str, str]:
    """Verdict, text and name of one function or method, called some times with one or two arguments that are odd."""
    r = random.Random(f"api {number}")
    names = sorted(_CALLS)
    name = names[number % len(names)]
    with tempfile.TemporaryDirectory(prefix="fuzz-") as folder:
        shutil.copytree(corpus, folder, dirs_exist_ok=True)
        outcome = run_isolated(lambda: _some(_CALLS[name], r, folder))
    if outcome.kind != "done":
        return outcome.kind, f"{outcome.value}\n{outcome.text}", name
    return "done" if outcome.value else "refused", "", name


def _some(call: Any, r: random.Random, folder: str) -> int:
    """The number of calls that were not refused."""
    os.chdir(folder)
    os.environ["TMPDIR"] = tempfile.tempdir = folder
    warnings.simplefilter("ignore")
    return sum(_accepts(call, _arguments(call, r)) for _ in range(CALLS))


def _accepts(call: Any, given: dict[str, Any]) -> bool:
    try:
        with contextlib.redirect_stdout(io.StringIO()):
            value = call(**given)
            if isinstance(value, types.GeneratorType):
                list(itertools.islice(value, 2))
    except SpadwarpError:
        return False
    except Exception as error:
        if (in_words(error) or "").startswith("not enough memory") or "Failed to allocate" in str(error):
            return False
        error.add_note(", ".join(f"{key}={value!r:.80}" for key, value in given.items()))
        raise
    return True


def _arguments(call: Any, r: random.Random) -> dict[str, Any]:
    given, space = {}, getattr(inspect.unwrap(call), "__globals__", {})
    parameters = inspect.signature(call).parameters.values()
    named = [one for one in parameters if one.kind in (one.POSITIONAL_OR_KEYWORD, one.KEYWORD_ONLY)]
    for one in named:
        if one.default is one.empty or one.name in ALWAYS or r.random() < 0.15:
            kind: Any = one.annotation
            with contextlib.suppress(Exception):
                kind = eval(kind, space) if isinstance(kind, str) else kind
            fits = [value for value in _POOL if isinstance(kind, str) or _fits(value, kind)]
            given[one.name] = r.choice(_NAMED.get(one.name) or fits or ODD)
    for one in r.sample(named, min(len(named), r.choice((1, 1, 2)))):
        given[one.name] = r.choice(ODD if r.random() < 0.7 else _POOL)
    return given
