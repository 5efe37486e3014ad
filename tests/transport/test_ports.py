"""Cameras and lasers behind ports: the estimators agree, and light arrives as quadrature and reciprocity say."""

import pytest

from helpers.estimators import agreeing_cells
from helpers.scenes import WATER, scene

pytestmark = pytest.mark.physics

SEAWATER = WATER | {"phase_index": "seawater", "group_index": "seawater"}
WINDOW = {"distance": 0.05, "thickness": 0.02, "material": "BK7"}
DOME = {"shape": "dome", "radius": 0.15, "thickness": 0.02, "material": "acrylic"}
GATE = {"start_ns": 0.0, "bin_width_ps": 4549.1, "bins": 8}  # 1 m of path a bin


def ported(camera_port, *, laser_port=None, aperture=0.2, **sections):
    camera = {"port": camera_port, "aperture_diameter": aperture}
    laser = {} if laser_port is None else {"port": laser_port}
    return scene(**{"medium": SEAWATER, "camera": camera, "laser": laser, "gate": GATE} | sections)


CASES = {
    "flat": lambda: ported(WINDOW),
    "flat, and the laser behind it": lambda: ported(WINDOW, laser_port="camera"),
    "tilted": lambda: ported(WINDOW | {"normal": [0.3, -0.15, 1.0]}, laser_port=WINDOW | {"distance": 0.01}),
    "dome": lambda: ported(DOME, laser_port="camera"),
    "lens in front of the dome's centre": lambda: ported(DOME | {"offset": [0.01, 0.0, -0.03]}, aperture=0.1),
    "from the air": lambda: ported(
        {"distance": 0.7},
        laser_port="camera",
        domain={"shape": "slab", "lower": 0.7, "upper": 3.0},
        gate=GATE | {"start_ns": 3.0},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("name", CASES)
def test_estimators_share_one_mean_behind_a_port(name, device):
    """Analog photons are refracted and must hit the lens themselves: they know nothing of solid angles."""
    agreeing_cells(CASES[name](), device, pixels=True)
