"""A plain random walk in float64 NumPy, photon by photon as the transport is defined, without meshes or detectors.

Independent of the Warp kernels in everything but the definition: other random numbers, other direction update (the
textbook's rotation, eq 15 of the paper), other data layout.
"""

import math
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Medium:
    """extinction [1/m]; albedo 0–1; Henyey–Greenstein anisotropy g."""

    extinction: float
    albedo: float
    anisotropy: float


@dataclass
class Walk:
    """How every photon ended. N photons.

    position, direction [N, 3]; weight, path [m], collisions [N]; reason [N]: "max_collisions", "max_path" or the
    face, "x_low" … "z_high".
    """

    position: NDArray[np.float64]
    direction: NDArray[np.float64]
    weight: NDArray[np.float64]
    path: NDArray[np.float64]
    collisions: NDArray[np.int64]
    reason: NDArray[np.str_]


_FACES = np.array(["x_low", "y_low", "z_low", "x_high", "y_high", "z_high"])


def pencil(count: int) -> tuple[NDArray, NDArray]:
    """Positions and directions of a pencil beam along +z."""
    return np.zeros((count, 3)), np.tile([0.0, 0.0, 1.0], (count, 1))


def isotropic(count: int, rng: np.random.Generator) -> tuple[NDArray, NDArray]:
    """Positions and directions of an isotropic point source."""
    cosine, phi = 2 * rng.random(count) - 1, 2 * math.pi * rng.random(count)
    sine = np.sqrt(1 - cosine**2)
    return np.zeros((count, 3)), np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], 1)


def walk(
    medium: Medium,
    source: tuple[NDArray, NDArray],
    rng: np.random.Generator,
    *,
    lower: ArrayLike = (-math.inf,) * 3,
    upper: ArrayLike = (math.inf,) * 3,
    max_collisions: int | None = None,
    max_path: float = math.inf,
    axis_threshold: float = 1.0,
) -> Walk:
    """Follow every photon until it leaves [lower, upper] or reaches a limit.

    At a collision: weight, then the collision limit, then the new direction. A flight is cut where it
    leaves the domain or reaches max_path. axis_threshold < 1 snaps a direction with |u_z| >= threshold to the axis
    before scattering.
    """
    position, direction = (np.array(a, float) for a in source)
    count = len(position)
    lower, upper = np.asarray(lower, float), np.asarray(upper, float)
    weight, path, collisions = np.ones(count), np.zeros(count), np.zeros(count, int)
    reason = np.full(count, "", dtype="U16")
    alive = np.arange(count)
    while alive.size:
        x, u = position[alive], direction[alive]
        flight = -np.log1p(-rng.random(alive.size)) / medium.extinction
        with np.errstate(divide="ignore", invalid="ignore"):
            exits = np.where(u > 0, (upper - x) / u, np.where(u < 0, (lower - x) / u, math.inf))
        axis = exits.argmin(1)
        wall = exits[np.arange(alive.size), axis]
        left = max_path - path[alive]
        step = np.minimum(np.minimum(flight, wall), left)
        position[alive] = x + step[:, None] * u
        path[alive] += step
        face = axis + 3 * (u[np.arange(alive.size), axis] > 0)
        collided = (flight < wall) & (flight < left)
        ended = alive[~collided]
        reason[ended] = np.where(wall <= left, _FACES[face], "max_path")[~collided]
        alive = alive[collided]

        weight[alive] *= medium.albedo
        collisions[alive] += 1
        many = collisions[alive] >= (math.inf if max_collisions is None else max_collisions)
        reason[alive[many]] = "max_collisions"
        # The direction after the last collision is part of its record.
        direction[alive] = scatter(direction[alive], medium.anisotropy, rng, axis_threshold)
        alive = alive[~many]
    return Walk(position, direction, weight, path, collisions, reason)


def scatter(u: NDArray, g: float, rng: np.random.Generator, axis_threshold: float = 1.0) -> NDArray:
    """New directions [N, 3] from Henyey–Greenstein (eq 14), turned as in eq 15; exact unless axis_threshold < 1."""
    return turned(u, scattering_cosine(g, rng, len(u)), rng, axis_threshold)


def scattering_cosine(g: float, rng: np.random.Generator, count: int) -> NDArray:
    """Of Henyey and Greenstein's law (eq 14)."""
    xi = rng.random(count)
    return 1 - 2 * xi if abs(g) < 1e-3 else (1 + g * g - ((1 - g * g) / (1 - g + 2 * g * xi)) ** 2) / (2 * g)


def turned(u: NDArray, cosine: NDArray, rng: np.random.Generator, axis_threshold: float = 1.0) -> NDArray:
    """Directions [N, 3] at these cosines to u (eq 15)."""
    sine = np.sqrt(np.maximum(0, 1 - cosine**2))
    phi = 2 * math.pi * rng.random(len(u))
    a, b = sine * np.cos(phi), sine * np.sin(phi)
    z = u[:, 2]
    root = np.hypot(u[:, 0], u[:, 1])
    vertical = root < 1e-12
    if axis_threshold < 1:
        vertical |= np.abs(z) >= axis_threshold
    safe = np.where(vertical, 1.0, root)
    x = (a * u[:, 0] * z - b * u[:, 1]) / safe + u[:, 0] * cosine
    y = (a * u[:, 1] * z + b * u[:, 0]) / safe + u[:, 1] * cosine
    rotated = np.stack([x, y, -a * safe + z * cosine], 1)
    sign = np.where(z < 0, -1.0, 1.0)
    rotated = np.where(vertical[:, None], np.stack([a, sign * b, sign * cosine], 1), rotated)
    return rotated / np.linalg.norm(rotated, axis=1, keepdims=True)


def cosine_law(normal: NDArray, rng: np.random.Generator) -> NDArray:
    """Directions [N, 3] by the cosine law about unit normals: a point on the unit sphere added to each."""
    cosine, phi = 2.0 * rng.random(len(normal)) - 1.0, 2.0 * math.pi * rng.random(len(normal))
    sine = np.sqrt(1.0 - cosine**2)
    direction = normal + np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], 1)
    return direction / np.linalg.norm(direction, axis=1, keepdims=True)
