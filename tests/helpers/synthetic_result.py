"""Results made from closed forms, without transport, for tests of what comes after it."""

import numpy as np

from spadwarp.mesh import build_mesh
from spadwarp.result.result import Result, Truth
from spadwarp.scene import Scene
from spadwarp.scene.camera import pixel_directions

UNIT = 2.0**-60


def make_scene(*, width=16, height=12, bins=48, distance=14.89, **sections):
    """The staircase with its plate at `distance` [m], the gate on it, the laser 10 cm beside the lens."""
    nanoseconds = 1.3638 / 0.299792458  # of a metre
    gate = {"start_ns": 2 * (distance - 1.0) * nanoseconds, "bin_width_ps": 2.6e3 / bins * nanoseconds, "bins": bins}
    tables = {
        "medium": {"extinction": 0.3, "albedo": 0.8},
        "laser": {"position": [0.1, 0.0, 0.0]},
        "camera": {"width": width, "height": height, "horizontal_fov_deg": 20.0, "aperture_diameter": 0.02},
        "gate": gate,
        "targets": [{"builtin": "staircase", "translation": [0.0, 0.0, distance]}],
    }
    return Scene.from_dict(tables | sections)


def make_result(scene, *, photons=10**9, seed=7, empty=False):
    """Ballistic returns by the lidar equation with shot noise, a tail behind them, single backscatter before them."""
    lost = {"absorbed_water": 3 * photons << 20, "weight_cutoff": 2 * photons << 20, "roulette": -(photons << 20)}
    result = Result(
        scene=scene,
        tallies=np.zeros((3, scene.camera.height, scene.camera.width, scene.gate.bins), dtype=np.int64),
        unit=UNIT,
        photons=photons,
        seed=seed,
        energy_balance=lost,
        energy_balance_unit=2.0**-22,
        counters={"water_collisions": 13 * photons, "after_gate": 5},
        truth=cast_truth(scene, build_mesh(scene)),
        timing={"transport": 1.25},
        provenance={"device": "cpu", "versions": {"spadwarp": "0.1.0"}},
    )
    rng = np.random.default_rng(seed)
    for index, expected in enumerate([] if empty else _components(result)):
        samples = rng.poisson(expected * photons * 1e8)  # stands for an estimator's noise
        result.tallies[index] = np.round(samples / 1e8 / UNIT)
    return result


def _components(result):
    scene = result.scene
    c, area = scene.medium.extinction, scene.camera.aperture_area
    edges, path = result.path_edges, result.true_path()
    centres = 0.5 * (edges[1:] + edges[:-1])
    cosine = np.abs((result.truth.normal * pixel_directions(scene.camera)).sum(-1))
    weight = 0.05 * result.truth.reflectance * cosine * np.exp(-c * path) * area / (path / 2) ** 2
    weight = np.nan_to_num(weight) / path.size * 25
    first = np.searchsorted(edges, np.nan_to_num(path), side="right") - 1
    ballistic = weight[..., None] * (np.arange(len(centres)) == first[..., None])
    delay = centres - path[..., None]
    tail = np.where(delay > 0, np.exp(-np.clip(delay, 0, None) / 0.3), 0.0)
    back = 0.01 * area * np.exp(-c * centres) / centres**2 / path.size
    return [ballistic, 0.05 * np.nan_to_num(tail) * weight[..., None], np.where(delay > 0, 0.1 * back, back)]


def cast_truth(scene, mesh=None):
    """Truth maps by trying every triangle (Möller and Trumbore 1997), float64."""
    rays = pixel_directions(scene.camera)
    shape = rays.shape[:2]
    nearest, face = np.full(shape, np.inf), np.full(shape, -1)
    normal, reflectance = np.full((*shape, 3), np.nan), np.full(shape, np.nan)
    if mesh is not None:
        corners = mesh.vertices[mesh.faces].astype(np.float64)
        for index, (a, b, c) in enumerate(corners):
            p = np.cross(rays, c - a)
            det = p @ (b - a)
            with np.errstate(divide="ignore", invalid="ignore"):
                u = -(p @ a) / det
                q = np.cross(-a, b - a)
                v, t = (rays @ q) / det, (q @ (c - a)) / det
                inside = (u >= -1e-9) & (v >= -1e-9) & (u + v <= 1 + 1e-9)
            hit = inside & (np.abs(det) > 1e-12) & (t > 0) & (t < nearest)
            nearest[hit], face[hit] = t[hit], index
        seen = face >= 0
        towards = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])[face[seen]]
        towards /= np.linalg.norm(towards, axis=1, keepdims=True)
        facing = (towards * rays[seen]).sum(-1, keepdims=True) > 0
        normal[seen] = np.where(facing, -towards, towards)
        reflectance[seen] = mesh.reflectance[face[seen]]
    distance = np.where(face >= 0, nearest, np.nan)
    maps = {"depth": distance * rays[..., 2], "range": distance, "normal": normal, "reflectance": reflectance}
    return Truth(**{name: array.astype(np.float32) for name, array in maps.items()})
