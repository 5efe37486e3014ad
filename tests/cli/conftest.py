"""Scenes and a finished run that the commands' tests share."""

import pytest

from helpers.cli import run
from helpers.scenes import scene as make_scene
from spadwarp.scene import Scene

SCENE = {
    "medium": {"extinction": 0.3, "albedo": 0.8, "group_index": "seawater"},
    "laser": {"position": [-0.05, 0.0, 0.0]},
    "camera": {"width": 8, "height": 6, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.02},
    "gate": {"start_ns": 16.0, "bin_width_ps": 200.0, "bins": 30},
    "targets": [{"builtin": "plane", "size": [1.5, 1.5], "translation": [0.0, 0.0, 2.0]}],
    "transport": {"photons": 20_000, "seed": 3},
    "output": {"png": False},
}

# A laser in the lens, a gate that begins at 2 m of path and a response of some bins.
SECTIONS = {
    "laser": {"half_angle_deg": 20.0, "position": [-0.05, 0.0, 0.0], "pulse_energy": 1e-14, "repetition_rate": 1e7},
    "camera": {"width": 5, "height": 4, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.4},
    "gate": {"start_ns": 6.0, "bin_width_ps": 100.0, "bins": 150},
    "detector": {"dark_count_rate": 1e3, "pulses_per_frame": 5000},
    "transport": {"photons": 20_000, "seed": 1, "max_collisions": 12},
    "output": {"png": False},
}


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """A plate in water; runs draw no pictures unless they are asked to."""
    path = tmp_path_factory.mktemp("scene") / "scene.toml"
    path.write_text(Scene.from_dict(SCENE).to_toml())
    return path


@pytest.fixture(scope="session")
def spad_scene(tmp_path_factory):
    path = tmp_path_factory.mktemp("spad") / "scene.toml"
    path.write_text(make_scene(**SECTIONS).to_toml())
    return path


@pytest.fixture(scope="session")
def done(spad_scene):
    """The directory of a finished run."""
    out = spad_scene.parent / "run"
    run("simulate", spad_scene, "--out", out, "--quiet", "--uncertainty", "--device", "cpu")
    return out
