"""Truth maps: what the camera sees through clear water, by rays against the scene's meshes."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.result import Truth
from spadwarp.scene import Scene, SceneLike, as_scene
from spadwarp.scene.geometry import pixel_directions

if TYPE_CHECKING:
    from spadwarp_kernels import Model

__all__ = ["trace_truth", "truth_maps"]


def truth_maps(scene: SceneLike, *, device: str | None = None) -> Truth:
    """Depth, range, normal and reflectance at the pixel centres, by rays against the scene's meshes."""
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
    directions = wp.zeros((0, 0), dtype=wp.vec3, device=model.device)
    if not scene.camera.is_plain:
        directions = wp.array(pixel_directions(scene.camera).astype(np.float32), dtype=wp.vec3, device=model.device)
    depth, distance, reflectance = (wp.empty(shape, dtype=float, device=model.device) for _ in range(3))
    normal = wp.empty(shape, dtype=wp.vec3, device=model.device)
    wp.launch(
        sk.truth_kernel,
        dim=shape,
        inputs=[model.camera, model.surfaces, directions],
        outputs=[depth, distance, normal, reflectance],
        device=model.device,
    )
    return Truth(depth=depth.numpy(), range=distance.numpy(), normal=normal.numpy(), reflectance=reflectance.numpy())
