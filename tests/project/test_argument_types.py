"""Arguments that are not of their type end in a sentence that names them, not in a library's error."""

import pickle

import pytest

import spadwarp
from helpers.scenes import scene
from spadwarp.scene import Medium, Scene
from spadwarp.values import ArgumentError, ConfigError

CALLS = {
    "path = 2147483648": lambda: spadwarp.load(2**31),
    "path =": lambda: spadwarp.load_scene(3),
    "recipe": lambda: spadwarp.dataset.make_dataset(3, "out"),
    "tables": lambda: Scene.from_dict(3),
    "result": lambda: spadwarp.files.write_run(None, 3),
    "medium": lambda: Scene(medium=None),
    "extinction": lambda: Medium(extinction=-1.0),
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
