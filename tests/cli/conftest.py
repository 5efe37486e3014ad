"""A scene and a finished run that the commands' tests share."""

import pytest

from helpers.cli import end_started, run
from helpers.coarse_pictures import coarse_pictures
from helpers.scenes import scene as make_scene

# A laser beside a wide lens, a gate that begins at 1.8 m of path and a response of some bins.
SECTIONS = {
    "medium": {"phase_index": 1.0},
    "laser": {"half_angle_deg": 20.0, "position": [-0.05, 0.0, 0.0], "pulse_energy": 1e-14, "repetition_rate": 1e7},
    "camera": {"width": 5, "height": 4, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.4},
    "gate": {"start_ns": 6.0, "bin_width_ps": 100.0, "bins": 150},
    "detector": {"dark_count_rate": 1e3, "pulses_per_frame": 5000},
    "transport": {"photons": 20_000, "seed": 1, "max_collisions": 12},
    "output": {"png": False},
}


@pytest.fixture(autouse=True)
def small_and_ended(monkeypatch):
    """Pictures are small, and no process outlives its test."""
    coarse_pictures(monkeypatch.setattr)
    yield
    end_started()


@pytest.fixture(scope="session")
def scene(tmp_path_factory):
    """A plate in water; runs draw no pictures unless they are asked to."""
    path = tmp_path_factory.mktemp("scene") / "scene.toml"
    path.write_text(make_scene(**SECTIONS).to_toml())
    return path


@pytest.fixture(scope="session")
def done(scene):
    """The directory of a finished run."""
    out = scene.parent / "run"
    run("simulate", scene, "--out", out, "--quiet", "--device", "cpu")
    return out
