"""Single-scattering and single-bounce lidar returns by quadrature, in float64.

Everything is in the camera frame: pinhole at the origin, looking along +z. A laser at `laser_position` sends a uniform
cone of half-angle `half_angle` [rad] along `laser_direction`. What a pixel's bin holds is the fraction of the emitted
photons that arrives through the aperture into the pixel within the bin of optical path (index 1: laser to scatterer to
lens). The aperture counts as a point of area A, which is what 1e-4 m² is at ranges of a metre and more (its finite
size changes the sums by (radius/range)²).

    dF = 1/Ω · e^{−cs}/s² · b·p(cosΘ) · e^{−cr} · A·cosψ/r² dV,   s: laser to point, r: point to lens
"""

import itertools
import math
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import ArrayLike, NDArray


@dataclass(frozen=True)
class Lidar:
    """A laser, a camera and water. Lengths in metres, angles in radians, coefficients in 1/m."""

    laser_position: tuple[float, float, float] = (-0.1, 0.0, 0.0)
    laser_direction: tuple[float, float, float] = (0.0, 0.0, 1.0)
    half_angle: float = math.radians(2.5)
    field_of_view: float = math.radians(10.0)  # horizontal, full angle
    pixels: int = 32  # width and height
    aperture_area: float = 1e-4
    extinction: float = 0.3
    albedo: float = 0.8
    anisotropy: float = 0.924
    edges: NDArray[np.float64] = field(default_factory=lambda: np.arange(2.0, 8.0))  # of the bins of optical path [m]
    # (z where it begins, extinction, albedo, anisotropy) of further waters; laser and camera are then at z = 0. The
    # quadrature converges with narrow bins only.
    layers: tuple[tuple[float, float, float, float], ...] = ()
    phase_function: Callable[[NDArray[np.float64]], NDArray[np.float64]] | None = None  # of cosΘ [1/sr]; None: HG

    @property
    def solid_angle(self) -> float:
        """Of the laser's cone [sr]."""
        return 2 * math.pi * (1 - math.cos(self.half_angle))

    def scattered(self, z: NDArray, path: NDArray, cos_scatter: NDArray) -> NDArray:
        """b·p(cosΘ)·exp(−∫c) at depth z, with `path` the way from the laser and on to the lens [1/m/sr]."""
        waters = ((-np.inf, self.extinction, self.albedo, self.anisotropy), *self.layers)
        ends = (*(start for start, *_ in self.layers), np.inf)
        value, depth = np.zeros_like(z), np.zeros_like(z)
        for (start, extinction, albedo, g), end in zip(waters, ends, strict=True):
            depth += extinction * (np.clip(z, None, end) - max(start, 0.0)).clip(0.0)
            here = (z >= start) & (z < end)
            p = henyey_greenstein(cos_scatter, g) if self.phase_function is None else self.phase_function(cos_scatter)
            value += here * albedo * extinction * p
        return value * np.exp(-depth / z * path)

    @property
    def pixel_edges(self) -> NDArray[np.float64]:
        """Tangents x/z of the pixel columns' edges, [pixels + 1]; the rows' are the same."""
        half = math.tan(self.field_of_view / 2)
        return np.linspace(-half, half, self.pixels + 1)


Factor = Callable[[NDArray[np.float64], NDArray[np.float64]], NDArray[np.float64]]
"""[..., k] over the unit directions [..., 3] before and after the scattering: Stokes vectors, of which I is 1."""


def henyey_greenstein(cos_theta: ArrayLike, g: float) -> NDArray[np.float64]:
    """The phase function [1/sr]."""
    return (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * np.asarray(cos_theta)) ** 1.5)


def single_scatter(
    lidar: Lidar,
    *,
    columns: ArrayLike | None = None,
    rows: ArrayLike | None = None,
    order: int = 8,
    factor: Factor | None = None,
) -> NDArray:
    """Collected fraction of light scattered once, [rows, columns, bins], with a last axis of the factor's.

    Integrates over each pixel (order² Gauss points) and, along each of the camera's rays, over the part that lies in
    the laser's cone and in the bin (Gauss points again: the integrand is smooth there). Default: all pixels.
    """
    edges = lidar.pixel_edges
    columns, rows = (np.arange(lidar.pixels) if i is None else np.atleast_1d(np.asarray(i)) for i in (columns, rows))
    node, gauss = (v / 2 for v in np.polynomial.legendre.leggauss(order))
    pitch = edges[1] - edges[0]
    u = edges[columns][:, None] + pitch * (node + 0.5)  # [columns, order]
    v = edges[rows][:, None] + pitch * (node + 0.5)
    result = []
    for i in range(rows.size):  # a row of pixels at a time keeps the arrays small
        shape = (columns.size, order, order)
        tangent = np.stack(np.broadcast_arrays(u[:, :, None], v[i], 1.0), -1).reshape(*shape, 3)
        length = np.linalg.norm(tangent, axis=-1)
        ray = tangent / length[..., None]
        solid = pitch**2 * gauss[:, None] * gauss / length**3  # du dv cos³ψ
        result.append(np.einsum("cxy,cxyt...->ct...", solid, _along_ray(lidar, ray, factor)))
    return np.stack(result)


def single_scatter_total(lidar: Lidar, *, order: int = 300, factor: Factor | None = None) -> NDArray:
    """The same summed over the field, [bins, ...], integrated the other way round: over the laser's rays."""
    node, gauss = np.polynomial.legendre.leggauss(order)
    cosine = 1 - (1 - math.cos(lidar.half_angle)) * (node + 1) / 2
    phi = (np.arange(order) + 0.5) * 2 * math.pi / order
    sine = np.sqrt(1 - cosine**2)[:, None]
    local = np.stack(np.broadcast_arrays(sine * np.cos(phi), sine * np.sin(phi), cosine[:, None]), -1)
    ray = local @ _basis(np.array(lidar.laser_direction, float))
    start = np.array(lidar.laser_position, float)
    # Inside the field: -T z <= x <= T z and the same in y, each linear in the distance along the ray.
    tan = math.tan(lidar.field_of_view / 2)
    low, high = np.zeros(ray.shape[:2]), np.full(ray.shape[:2], np.inf)
    for normal in np.array([[1, 0, tan], [-1, 0, tan], [0, 1, tan], [0, -1, tan], [0, 0, 1.0]]):
        offset, slope = start @ normal, ray @ normal
        with np.errstate(divide="ignore", invalid="ignore"):
            crossing = -offset / slope
        low = np.where(slope > 0, np.maximum(low, crossing), low)
        high = np.where(slope < 0, np.minimum(high, crossing), high)
        high = np.where((slope == 0) & (offset < 0), -np.inf, high)
    distance, weight = _gauss_in_bins(low, high, _distance_at_path(lidar.edges, -start, ray))
    point = start + distance[..., None] * ray[:, :, None, None, :]
    r = np.linalg.norm(point, axis=-1)
    cos_scatter = -(point * ray[:, :, None, None, :]).sum(-1) / r
    value = lidar.scattered(point[..., 2], distance + r, cos_scatter) * lidar.aperture_area * (point[..., 2] / r) / r**2
    value = value * weight
    if factor is None:
        return np.einsum("a,aptn->t", gauss / 2, value) / order
    directions = np.broadcast_to(ray[:, :, None, None, :], point.shape)
    return np.einsum("a,aptn,aptns->ts", gauss / 2, value, factor(directions, -point / r[..., None])) / order


def lambertian_plane(lidar: Lidar, *, depth: float, reflectance: float, order: int = 8) -> NDArray:
    """Light reflected once by the plane z = depth and never scattered, all times together: [pixels, pixels].

    Exact for the pixels that the cone covers and for those that it misses; a few per cent where its rim passes.
    """
    node, gauss = (v / 2 for v in np.polynomial.legendre.leggauss(order))
    edges = lidar.pixel_edges
    pitch = edges[1] - edges[0]
    tangent = edges[:-1, None] + pitch * (node + 0.5)  # [pixels, order]
    v, u = tangent[:, :, None, None], tangent
    point = depth * np.stack(np.broadcast_arrays(u, v, 1.0), -1)
    beam = point - np.array(lidar.laser_position)
    s, r = np.linalg.norm(beam, axis=-1), np.linalg.norm(point, axis=-1)
    axis = np.array(lidar.laser_direction) / np.linalg.norm(lidar.laser_direction)
    lit = beam @ axis >= s * math.cos(lidar.half_angle)
    # per unit of plane: 1/Ω · e^{−cs} · cosθ_in/s²; the plane's element is depth² du dv; cosθ_out = cosψ = depth/r
    arriving = lit / lidar.solid_angle * np.exp(-lidar.extinction * (s + r)) * np.abs(beam[..., 2]) / s**3
    collected = arriving * reflectance / math.pi * lidar.aperture_area * (depth / r) ** 2 / r**2 * depth**2
    return np.einsum("iajb,a,b->ij", collected, gauss, gauss) * pitch**2


def _along_ray(lidar: Lidar, ray: NDArray, factor: Factor | None = None) -> NDArray:
    """∫dr of the scattered light per steradian of the camera's unit rays [..., 3], by bin: [..., bins, ...]."""
    laser = np.array(lidar.laser_position)
    axis = np.array(lidar.laser_direction) / np.linalg.norm(lidar.laser_direction)
    low, high = _ray_in_cone(ray, laser, axis, math.cos(lidar.half_angle))
    r, weight = _gauss_in_bins(low, high, _distance_at_path(lidar.edges, laser, ray))
    beam = r[..., None] * ray[..., None, None, :] - laser
    s = np.linalg.norm(beam, axis=-1)
    cos_scatter = -(beam * ray[..., None, None, :]).sum(-1) / s
    depth = r * ray[..., None, None, 2]
    value = lidar.scattered(depth, s + r, cos_scatter) / (
        lidar.solid_angle * s**2
    )  # r² of the volume element and 1/r² of the aperture's solid angle cancel
    value = value * weight * (lidar.aperture_area * ray[..., 2, None, None])
    if factor is None:
        return value.sum(-1)
    directions = np.broadcast_to(-ray[..., None, None, :], beam.shape)
    return np.einsum("...n,...ns->...s", value, factor(beam / s[..., None], directions))


def _ray_in_cone(ray: NDArray, apex: NDArray, axis: NDArray, cos_half: float) -> tuple[NDArray, NDArray]:
    """The part (low, high) of each ray from the origin that lies in a cone of half-angle < 90°.

    One interval: a cone of one nappe is convex. Empty when high <= low.
    """
    along, offset = ray @ axis, -apex @ axis
    # (q·a)² >= cos² q·q with q = r·ray − apex
    a = along**2 - cos_half**2
    b = 2 * (along * offset + cos_half**2 * (ray @ apex))
    c = offset**2 - cos_half**2 * (apex @ apex)
    disc = b * b - 4 * a * c
    root = np.sqrt(np.maximum(disc, 0))
    with np.errstate(divide="ignore", invalid="ignore"):
        roots = np.sort(np.stack([(-b - root) / (2 * a), (-b + root) / (2 * a)]), axis=0)
    cuts = np.concatenate([np.zeros((1, *along.shape)), np.maximum(roots, 0), np.full((1, *along.shape), 1e9)])
    low, high = np.full(along.shape, np.inf), np.full(along.shape, -np.inf)
    for start, stop in itertools.pairwise(cuts):
        middle = (start + stop) / 2
        q = middle[..., None] * ray - apex
        inside = (stop > start) & (q @ axis >= cos_half * np.linalg.norm(q, axis=-1))
        low, high = np.where(inside, np.minimum(low, start), low), np.where(inside, np.maximum(high, stop), high)
    return low, high


def _distance_at_path(path: NDArray, focus: NDArray, ray: NDArray) -> NDArray:
    """Where on a ray the way along it and on to `focus` (seen from its start) has the lengths `path`: [..., paths]."""
    return (path**2 - focus @ focus) / (2 * (path - (ray @ focus)[..., None]))


def _gauss_in_bins(low: NDArray, high: NDArray, cuts: NDArray, order: int = 8) -> tuple[NDArray, NDArray]:
    """Gauss points and weights on [low, high] cut into bins: [..., bins, order]; weight 0 where a bin is missed."""
    node, gauss = (v / 2 for v in np.polynomial.legendre.leggauss(order))
    start = np.maximum(cuts[..., :-1], low[..., None])
    width = np.minimum(cuts[..., 1:], high[..., None]) - start
    missed = ~(width > 0)
    start, width = np.where(missed, 1.0, start), np.where(missed, 0.0, width)
    return start[..., None] + width[..., None] * (node + 0.5), width[..., None] * gauss


def _basis(axis: NDArray) -> NDArray:
    """Rows: two unit vectors normal to the axis, and the axis."""
    axis = axis / np.linalg.norm(axis)
    first = np.cross(axis, [0.0, 1.0, 0.0] if abs(axis[0]) > 0.5 else [1.0, 0.0, 0.0])
    first /= np.linalg.norm(first)
    return np.stack([first, np.cross(axis, first), axis])
