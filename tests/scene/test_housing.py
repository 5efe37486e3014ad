"""What is in the camera's housing or its window, and not meant for it, is refused: it would be traced in water."""

from contextlib import nullcontext

import pytest

import spadwarp
from helpers.scenes import scene
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.transport.model import build_model
from spadwarp.values import ConfigError

INDICES = {"index": 1.5, "thickness": 0.01}
FLAT = {"shape": "flat", "distance": 0.05, **INDICES}
DOME = {"shape": "dome", "radius": 0.05, **INDICES}


def box(distance):
    return [{"builtin": "sphere", "size": [0.002, 0.002, 0.002], "translation": [0.0, 0.0, distance]}]


@pytest.mark.parametrize(
    ("port", "position", "distance", "problem"),
    [
        (FLAT, [0.0, 0.0, 0.0], 2.0, "laser.position"),
        (FLAT, [0.0, 0.01, 0.055], 2.0, "laser.position"),  # within the glass
        (FLAT, [0.2, 0.0, 0.0], 2.0, ""),  # beside the housing
        (FLAT, [0.0, 0.0, 0.07], 2.0, ""),
        (DOME, [0.0, 0.03, 0.0], 2.0, "laser.position"),
        (DOME, [0.0, 0.055, 0.0], 2.0, "laser.position"),
        (DOME, [0.0, 0.07, 0.0], 2.0, ""),
        (FLAT, [0.2, 0.0, 0.0], 0.055, "camera.port"),
        (FLAT, [0.2, 0.0, 0.0], 0.0612, ""),
        (DOME, [0.0, 0.07, 0.0], 0.055, "camera.port"),
        (DOME, [0.0, 0.07, 0.0], 0.0612, ""),
    ],
)
def test_what_is_within_the_housing_is_refused(port, position, distance, problem):
    one = scene(
        camera={"port": port, "aperture_diameter": 0.002, "horizontal_fov_deg": 20.0},
        laser={"position": position},
        targets=box(distance),
    )
    found = [message.field for message in spadwarp.check(one) if message.level == "warning"]
    assert [name for name in found if name in ("laser.position", "camera.port")] == [problem] * bool(problem)
    made = pytest.raises(ConfigError, match=problem) if problem else nullcontext()
    with made:
        build_model(one, pick_device("cpu"), build_mesh(one))
