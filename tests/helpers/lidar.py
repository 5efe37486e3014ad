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
        **dict.fromkeys(("lu2024", "profile", "source"), 0),
        **dict.fromkeys(("extinction", "scattering", "radius", "start", "dark", "constant"), 0.0),
        **{"photons": 1.0, "pde": 1.0, "speed": C0, "laser": (0.0, 0.0, 0.0), "axis": AXIS},
        **{"spread": 2 * math.sin(half_angle / 2) ** 2, "tan2": math.tan(half_angle) ** 2},
        **{"pixel_tangent": 1e-3, "aperture_area": 1e-4, "nearest": 0.05},
        **{"stop": 1e-7, "sigma": 1e-10, "bin_width": 1e-10},
    }
    struct = analytic.Lidar()
    for name, value in {**fields, **changes}.items():
        setattr(struct, name, wp.vec3d(*value) if name in ("laser", "axis") else value)
    return struct
