"""Truth maps: what the camera sees through clear water, by rays against the scene's meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.result import Truth
from spadwarp.scene import Scene, SceneLike, as_scene
from spadwarp.scene.sight import lines_of_sight, pixel_directions

if TYPE_CHECKING:
    from spadwarp_kernels import Model

__all__ = ["trace_truth", "truth_maps"]


def truth_maps(scene: SceneLike, *, device: str | None = None) -> Truth:
    """Depth, range, normal and reflectance at the pixel centres, by rays against the scene's meshes.

    Behind a port rays bend: depth is z of the point that is hit, range the length of the bent ray from the lens.
    """
    from spadwarp.transport.model import build_model

    scene = as_scene(scene)
    return trace_truth(scene, build_model(scene, pick_device(device), build_mesh(scene), camera=False))


def trace_truth(scene: Scene, model: Model) -> Truth:
    """`truth_maps` for a model that is already on its device."""
    import warp as wp

    import spadwarp_kernels as sk

    shape = (scene.camera.height, scene.camera.width)
    if model.mesh is None:
        nothing = np.full(shape, np.nan, np.float32)
        return Truth(depth=nothing, range=nothing, normal=np.full((*shape, 3), np.nan, np.float32), reflectance=nothing)
    origins = directions = wp.zeros((0, 0), dtype=wp.vec3, device=model.device)
    if not scene.camera.is_plain:
        directions = wp.array(pixel_directions(scene.camera).astype(np.float32), dtype=wp.vec3, device=model.device)
    lines = lines_of_sight(scene)
    depth, distance, reflectance = (wp.empty(shape, dtype=float, device=model.device) for _ in range(3))
    normal = wp.empty(shape, dtype=wp.vec3, device=model.device)
    if scene.camera.port is not None:
        # A ray that does not get through goes where nothing is.
        passes = np.isfinite(lines.direction).all(axis=-1, keepdims=True)
        rays = [np.where(passes, lines.start, 1e9), np.where(passes, lines.direction, [0.0, 0.0, 1.0])]
        origins, directions = (wp.array(part.astype(np.float32), dtype=wp.vec3, device=model.device) for part in rays)
    wp.launch(
        sk.truth_kernel,
        dim=shape,
        inputs=[model.camera, model.surfaces, origins, directions],
        outputs=[depth, distance, normal, reflectance],
        device=model.device,
    )
    ranges = distance.numpy()
    if scene.camera.port is not None:
        ranges = (ranges + lines.lead).astype(np.float32)
    return Truth(depth=depth.numpy(), range=ranges, normal=normal.numpy(), reflectance=reflectance.numpy())
