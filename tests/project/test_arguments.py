"""What the functions of `spadwarp.__all__` take: scenes and results or their paths, whole numbers as 1e5, and nothing
that is not finite, out of range or of another kind."""

import math
import pickle

import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene
from helpers.synthetic_result import make_result, make_scene
from spadwarp.scene import Medium, Scene
from spadwarp.values import ArgumentError, ConfigError

ROOM = {"targets": [{"builtin": "plane", "size": [4.0, 4.0], "translation": [0.0, 0.0, 3.0]}]}
OF_SCENES = {
    "simulate": lambda one: spadwarp.simulate(one, photons=1000, device="cpu").tallies,
    "truth_maps": lambda one: spadwarp.truth_maps(one, device="cpu").depth,
    "check": lambda one: [str(message) for message in spadwarp.check(one)],
    "budget": lambda one: [row.signal for row in spadwarp.budget(one, [2.0], device="cpu")],
    "sweep": lambda one: spadwarp.sweep(one, vary="medium.extinction=0.2", device="cpu").column("signal"),
    "simulate_analytic": lambda one: spadwarp.simulate_analytic(one, device="cpu").signal,
}
OF_RESULTS = {
    "detect": lambda one: spadwarp.detect(one, pulses=10, seed=1, device="cpu").counts,
    "crlb": lambda one: spadwarp.crlb(one, device="cpu"),
    "merge": lambda one: spadwarp.merge([one]).tallies,
    "resume": lambda one: (
        spadwarp.simulate(scene(**ROOM), photons=1500, device="cpu", run=spadwarp.RunOptions(resume=one)).tallies
    ),
}
NO_SCENE, NO_RESULT = (None, 5, {}, [1.0], object), (5, {}, np.zeros((2, 2, 3)))


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Of a run and its scene."""
    place = tmp_path_factory.mktemp("run")
    (place / "scene.toml").write_text(scene(**ROOM).to_toml())
    spadwarp.simulate(scene(**ROOM), photons=1000, device="cpu").save(place / "result.h5")
    return place


@pytest.mark.filterwarnings("ignore::spadwarp.values.SpadwarpWarning")
@pytest.mark.parametrize("name", [*OF_SCENES, *OF_RESULTS])
def test_a_scene_or_a_result_may_be_its_path(name, folder):
    function, file = (OF_SCENES | OF_RESULTS)[name], folder / ("scene.toml" if name in OF_SCENES else "result.h5")
    expected = function((spadwarp.load_scene if name in OF_SCENES else spadwarp.load)(file))
    for one in (file, str(file), *([] if name in OF_SCENES else [folder])):
        np.testing.assert_array_equal(function(one), expected)
    words = "a Scene nor the path of a scene file" if name in OF_SCENES else "a Result nor the path of one"
    for wrong in NO_SCENE if name in OF_SCENES else () if name == "detect" else NO_RESULT:
        with pytest.raises(spadwarp.ArgumentError, match=f" is neither {words}"):
            function(wrong)
    for wrong in ("a.h5", None, 5) if name == "merge" else ():
        with pytest.raises(spadwarp.ArgumentError, match="is not a list of results"):
            spadwarp.merge(wrong)


def test_integral_floats_are_integers():
    options = spadwarp.RunOptions(threads=1.0, launch_size=2.0**9)
    one = spadwarp.simulate(scene(), photons=1e3, seed=3.0, device="cpu", run=options)
    other = spadwarp.simulate(scene(), photons=1000, seed=np.uint64(3), device="cpu")
    assert one.photons == 1000 and one.tallies.tobytes() == other.tallies.tobytes()
    numbers = {"pulses": 1e2, "frames": 2.0, "seed": np.float64(7), "detector": FREE["detector"]}
    assert spadwarp.detect(0.1 * CUBE, **AXIS, **numbers, device="cpu").counts.shape[0] == 2


CUBE = np.ones((2, 2, 8))
AXIS = {"gate_start": 0.0, "bin_width": 1e-10}
FREE = {"seed": 0, "detector": spadwarp.scene.Detector(wrap=False)}
NUMBERS = {
    "simulate": (lambda **one: spadwarp.simulate(scene(), device="cpu", **one), {
        "photons": [0, 1.5, 1e13, math.nan, "1e5", True, [5]],
        "seed": [-1, 2**64, 0.5, math.inf],
        "relative_error": [0, 1, math.nan, "2 %"],
        "run": [{"threads": 2}, 5],
    }),
    "RunOptions": (spadwarp.RunOptions, {
        "first_photon": [-1, 1e300, None],
        "threads": [0, 1e9, "all"],
        "launch_size": [0, 2**40, 1.5],
        "checkpoint_every": [-1, math.nan, None],
    }),
    "detect": (lambda **one: spadwarp.detect(CUBE, device="cpu", **{**AXIS, **FREE, **one}), {
        "pulses": [0, 1.5, 1e10, math.nan],
        "frames": [0, 2.5],
        "seed": [-1, None],
        "gate_start": [math.nan, math.inf, "0"],
        "bin_width": [0, -1e-9, math.nan, 1e300, 1e-300],
        "window": [5, (0.0,), (math.nan, 5), (0.0, 0), (0.0, 1.5)],
        "camera_seed": [-1],
    }),
    "arrival_time": (lambda **one: spadwarp.arrival_time(CUBE, device="cpu", **{**AXIS, **one}), {
        "gate_start": [math.nan, math.inf],
        "bin_width": [0, math.nan, 1e300],
        "gate": [5, (0.0,), (math.nan, 1.0)],
        "method": ["centre", None, 3],
    }),
    "crlb": (lambda **one: spadwarp.crlb(make_result(make_scene()), device="cpu", **one), {
        "pulses": [0, math.nan, "many"],
        "law": ["Poisson", None],
    }),
    "budget": (lambda **one: spadwarp.budget(scene(), device="cpu", **one), {
        "ranges": [5.0, "1:5", [0], [math.nan], [1e300], [], ["1"]],
        "reflectance": [-0.1, 1.1, math.nan, "white"],
    }),
    "sweep": (lambda **one: spadwarp.sweep(scene(), device="cpu", **{"vary": "medium.extinction=1", **one}), {
        "vary": [5, None, "x", ("medium.extinction",), ("medium.extinction", 5), ("medium.extinction", [])],
        "of": ["depth", None],
    }),
    "simulate_analytic": (lambda **one: spadwarp.simulate_analytic(scene(**ROOM), device="cpu", **one), {
        "frames": [-1, 0.5, math.nan, 1e300],
        "seed": [-1, 2**64, "x"],
        "backscatter_profile": [5],
    }),
    "Ray": (spadwarp.Ray, {"workers": [0, 1.5, "two"], "address": [6379]}),
}  # fmt: skip
CASES = [
    pytest.param(name, argument, value, id=f"{name} {argument} {value!r:.20}")
    for name, (_, arguments) in NUMBERS.items()
    for argument, values in arguments.items()
    for value in values
]


@pytest.mark.parametrize(("name", "argument", "value"), CASES)
def test_what_is_out_of_range_or_of_another_kind_is_refused_by_name(name, argument, value):
    with pytest.raises(spadwarp.ArgumentError) as caught:
        NUMBERS[name][0](**{argument: value})
    assert argument in str(caught.value) and len(str(caught.value)) < 300


@pytest.mark.parametrize("name", [5, "", "cpu,", "CPU", "cuda:99", "all"])
def test_a_device_that_does_not_exist_is_refused(name):
    for function in (
        lambda: spadwarp.simulate(scene(), photons=10, device=name),
        lambda: spadwarp.detect(CUBE, **AXIS, **FREE, device=name),
        lambda: spadwarp.arrival_time(CUBE, **AXIS, device=name),
        lambda: spadwarp.truth_maps(scene(), device=name),
    ):
        with pytest.raises(spadwarp.DeviceError, match=r"device = .* is not one of cpu"):
            function()


# Types


ONE = np.ones((4, 4))
CALLS = {
    "path = 2147483648": lambda: spadwarp.load(2**31),
    "path =": lambda: spadwarp.load_scene(3),
    "recipe": lambda: spadwarp.dataset.make_dataset(3, "out"),
    "tables": lambda: Scene.from_dict(3),
    "result": lambda: spadwarp.files.write_run(None, 3),
    "medium": lambda: Scene(medium=None),
    "extinction": lambda: Medium(extinction=-1.0),
    "begin": lambda: Medium(extinction=1.0, albedo=0.5).optical_depth([1.0, 2.0], (0.0, 0.0, 1.0)),
    "side = 0": lambda: spadwarp.denoise.second_return([[0.5]], [[[1]]], background=1.0, response=[1.0], side=0),
    "quantity = 'peak'": lambda: spadwarp.viz.draw_depth(ONE, ONE, "a.png", quantity="peak", title=""),
}


@pytest.mark.parametrize("name", CALLS)
def test_arguments_of_the_wrong_type_are_named(name):
    with pytest.raises((ArgumentError, ConfigError)) as caught:
        CALLS[name]()
    assert name in str(caught.value)


def test_an_error_of_right_arguments_is_not_hidden(monkeypatch):
    def broken(*_, **__):
        raise ZeroDivisionError("a fault of ours")

    monkeypatch.setattr("spadwarp.transport.simulation.make_plan", broken)
    with pytest.raises(ZeroDivisionError):
        spadwarp.simulate(scene(), photons=10, device="cpu")


def test_public_functions_are_found_where_they_say():
    """Pools of processes send them by their name."""
    for function in (spadwarp.simulate, spadwarp.load_scene, spadwarp.frames.crlb, spadwarp.check):
        assert pickle.loads(pickle.dumps(function)) is function
