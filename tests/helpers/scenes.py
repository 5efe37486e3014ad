"""Small scenes that the tests share."""

import math

import numpy as np

from reference.single_scatter import Lidar
from spadwarp.scene import Scene

WATER = {"extinction": 0.5, "albedo": 0.8, "anisotropy": 0.8, "group_index": 1.0}
PLATE = {"builtin": "plane", "size": [3.0, 3.0], "translation": [0.0, 0.0, 2.2], "reflectance": 0.7}

# A target and a layer of water that no light of the gate meets: they give a scene the kernel of those that need one.
BEYOND = [{**PLATE, "translation": [0.0, 0.0, 40.0]}]
ELSEWHERE = [{"start": 50.0, "extinction": 0.5, "albedo": 0.8}]

# Of so many faces that a GPU walks down a tree to them.
TREE = {"builtin": "staircase", "translation": [0.0, 0.0, 2.2], "reflectance": 0.7}

# Water that differs from place to place: in layers, and in cells.
LAYERS = [
    {"start": 1.2, "extinction": 1.5, "albedo": 0.6, "anisotropy": 0.5},
    {"start": 1.7, "extinction": 0.2, "albedo": 0.9},
]
PLUME = {"shape": "plume", "size": [1.4, 1.4, 1.2], "cells": 24, "extinction": 6.0, "albedo": 0.7, "anisotropy": 0.6}
PLUME |= {"turbulence": 0.5, "seed": 5, "translation": [0.0, 0.0, 1.2]}
PENCIL = {"profile": "collimated", "position": [0.0, 0.0, 0.0]}


def scattered_once(medium, edges):
    """Light of a pencil beam at x = -0.1 m that scatters once, by bins of path [m]."""
    gate = {"start_ns": edges[0] / 0.299792458, "bin_width_ps": 1e3 * (edges[1] - edges[0]) / 0.299792458}
    return scene(
        medium=medium,
        laser={**PENCIL, "position": [-0.1, 0.0, 0.0]},
        camera={"aperture_diameter": 0.01},
        gate={**gate, "bins": len(edges) - 1},
        targets=BEYOND,
        transport={"max_collisions": 1},
    )


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
        "targets": BEYOND,
        "transport": {"estimator": "guided", "max_collisions": 1, "axis_threshold": 1.0},
    }
    return lidar, sections
