"""A lidar for the analytic kernels."""

import math

import warp as wp

from spadwarp_kernels import analytic

C0 = 299_792_458.0
AXIS = [0.0, 0.0, 1.0]


def lidar(**changes):
    """A coaxial lidar in clear air of index 1, one photon a pulse; `changes` are fields of the struct."""
    half_angle = changes.pop("half_angle", math.radians(5.0))
    fields = {
        "lu2024": 0,
        "photons": 1.0,
        "pde": 1.0,
        "extinction": 0.0,
        "scattering": 0.0,
        "speed": C0,
        "laser": (0.0, 0.0, 0.0),
        "axis": AXIS,
        "profile": 0,
        "spread": 2 * math.sin(half_angle / 2) ** 2,
        "tan2": math.tan(half_angle) ** 2,
        "radius": 0.0,
        "pixel_tangent": 1e-3,
        "aperture_area": 1e-4,
        "start": 0.0,
        "stop": 1e-7,
        "sigma": 1e-10,
        "dark": 0.0,
        "source": 0,
        "constant": 0.0,
        "nearest": 0.05,
        "bin_width": 1e-10,
    }
    struct = analytic.Lidar()
    for name, value in {**fields, **changes}.items():
        setattr(struct, name, wp.vec3d(*value) if name in ("laser", "axis") else value)
    return struct
