"""Photons that pass a round lens, counted one by one: a random walk in float64 NumPy with a plate.

It shares nothing with the kernels but the definition: a photon counts when its flight passes through the disc in the
plane z = 0, coming from z > 0, in a direction that the thin lens images into the field.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from .walk import Medium, cosine_law, scatter


@dataclass(frozen=True)
class Rig:
    """A laser that sends a uniform cone along +z from (x, y, 0), a lens at the origin, a plate at a depth.

    Lengths in metres, angles in radians; `field` are half the tangents of the field's width and height.
    """

    medium: Medium
    laser: tuple[float, float]
    half_angle: float
    aperture_radius: float
    field: tuple[float, float]
    focus: float
    plate_depth: float
    plate_size: tuple[float, float]
    reflectance: float


def count(rig: Rig, photons: int, edges: NDArray[np.float64], rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Fractions of the emitted photons by component and bin of path `[3, bins]`, and their standard errors.

    Components: ballistic (one surface, nothing else), forward-scattered (other light with a surface), backscatter.
    """
    x = np.tile([rig.laser[0], rig.laser[1], 0.0], (photons, 1))
    cosine = 1.0 - (1.0 - math.cos(rig.half_angle)) * rng.random(photons)
    phi = 2.0 * math.pi * rng.random(photons)
    sine = np.sqrt(1.0 - cosine**2)
    u = np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=1)
    weight, path = np.ones(photons), np.zeros(photons)
    events, surfaces = np.zeros(photons, int), np.zeros(photons, int)
    total, square = np.zeros((2, 3, len(edges) - 1))
    while len(x):
        flight = -np.log1p(-rng.random(len(x))) / rig.medium.extinction
        with np.errstate(divide="ignore", invalid="ignore"):
            to_plate = (rig.plate_depth - x[:, 2]) / u[:, 2]
            to_lens = -x[:, 2] / u[:, 2]
        to_plate[~(to_plate > 1e-9)] = math.inf
        with np.errstate(invalid="ignore"):
            met = (np.abs(x + to_plate[:, None] * u)[:, :2] < 0.5 * np.array(rig.plate_size)).all(axis=1)
        to_plate[~met] = math.inf
        step = np.minimum(flight, to_plate)

        passes = (u[:, 2] < 0.0) & (to_lens > 0.0) & (to_lens < step) & (events > 0)
        o = x[passes, :2] + to_lens[passes, None] * u[passes, :2]
        seen = u[passes, :2] / u[passes, 2:] + o / rig.focus
        hit = ((o**2).sum(axis=1) < rig.aperture_radius**2) & (np.abs(seen) < rig.field).all(axis=1)
        counted = np.flatnonzero(passes)[hit]
        ballistic = (surfaces[counted] == 1) & (events[counted] == 1)
        component = np.where(ballistic, 0, np.where(surfaces[counted] > 0, 1, 2))
        for total_part, values in ((total, weight[counted]), (square, weight[counted] ** 2)):
            arrival = (path + to_lens)[counted]
            total_part += np.histogram2d(component, arrival, bins=[np.arange(4), edges], weights=values)[0]

        x, path = x + step[:, None] * u, path + step
        on_plate = to_plate <= flight
        weight = weight * np.where(on_plate, rig.reflectance, float(rig.medium.albedo))
        events, surfaces = events + 1, surfaces + on_plate
        turned = scatter(u, rig.medium.anisotropy, rng)
        normal = np.stack([np.zeros(len(u)), np.zeros(len(u)), -np.sign(u[:, 2])], axis=1)
        u = np.where(on_plate[:, None], cosine_law(normal, rng), turned)
        kept = (path < edges[-1]) & (weight > 0.0)
        x, u, weight, path = x[kept], u[kept], weight[kept], path[kept]
        events, surfaces = events[kept], surfaces[kept]
    return total / photons, np.sqrt(square) / photons
