"""Small scenes that the tests share."""

import math

import numpy as np

from reference.single_scatter import Lidar
from spadwarp.scene import Scene

WATER = {"extinction": 0.5, "albedo": 0.8, "anisotropy": 0.8, "group_index": 1.0}
PLATE = {"builtin": "plane", "size": [3.0, 3.0], "translation": [0.0, 0.0, 2.2], "reflectance": 0.7}

# Of so many faces that a GPU walks down a tree to them.
TREE = {"builtin": "staircase", "translation": [0.0, 0.0, 2.2], "reflectance": 0.7}


def scene(**sections):
    """A 4 x 4 pixel scene in which even `analog` converges: a wide lens and a near plate; sections change it."""
    tables = {
        "medium": dict(WATER),
        "laser": {"half_angle_deg": 20.0, "position": [-0.1, 0.0, 0.0]},
        "camera": {"width": 4, "height": 4, "horizontal_fov_deg": 50.0, "aperture_diameter": 0.4},
        "gate": {"start_ns": 0.0, "bin_width_ps": 3335.64095, "bins": 8},  # 1 m of path a bin
        "targets": [PLATE],
        "transport": {"photons": 100_000, "seed": 1, "max_collisions": 12, "axis_threshold": 1.0},
    }
    for name, fields in sections.items():
        tables[name] = {**tables.get(name, {}), **fields} if isinstance(fields, dict) else fields
    return Scene.from_dict(tables)


def single_scatter_case(field_of_view, half_angle):
    """Sections of a scene without targets where light is scattered once, and the lidar of its quadrature [degree]."""
    lidar = Lidar(
        pixels=4,
        field_of_view=math.radians(field_of_view),
        half_angle=math.radians(half_angle),
        anisotropy=0.6,
        edges=np.linspace(3.0, 7.0, 5),
    )
    aperture = 2 * math.sqrt(1e-4 / math.pi)
    sections = {
        "medium": {"extinction": 0.3, "albedo": 0.8, "anisotropy": 0.6, "group_index": 1.0},
        "laser": {"half_angle_deg": half_angle, "position": [-0.1, 0.0, 0.0]},
        "camera": {"width": 4, "height": 4, "horizontal_fov_deg": field_of_view, "aperture_diameter": aperture},
        "gate": {"start_ns": 3.0 / 0.299792458, "bin_width_ps": 1e3 / 0.299792458, "bins": 4},
        "targets": [],
        "transport": {"estimator": "guided", "max_collisions": 1, "axis_threshold": 1.0},
    }
    return lidar, sections
