"""Valid calls of the cameras in many worlds, to be changed by `kernel_calls`."""

import numpy as np
import warp as wp

import spadwarp_kernels as sk
from spadwarp_kernels.worlds.shapes import move_shapes

_STILL = (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0)


def valid_calls(mesh: wp.Mesh) -> dict:
    config = dict(
        width=6, height=4, horizontal_fov=1.0, bins=8, gate_distance=(0.5, 8.0), pulses=20, pulse_energy=2e-9,
        wavelength=532e-9,
        pde=0.2, dark_rate=1e3, timing_sigma=2e-10, aperture_radius=0.01, laser_position=(0.05, 0.0, 0.0), nearest=0.05,
        laser_half_angle=0.5, absorption=0.1, scattering=0.2, anisotropy=0.9, group_index=1.3, method="peak", seed=1,
    )  # fmt: skip
    shapes = dict(
        kind=["plane", "sphere", "mesh"], size=[(0.0, 0.0, 0.0), (0.4, 0.0, 0.0), (1.0, 1.0, 1.0)], body=[-1, 0, 1],
        local=[(0.0, 0.0, 4.0, 0.0, 0.0, 0.0, 1.0), _STILL, _STILL], mesh=[None, None, mesh],
        reflectance=[0.5, 0.3, 0.8], world=[-1, 0, 1], worlds=2, visible=[True, True, True], device="cpu",
    )  # fmt: skip
    made = sk.make_shapes(**shapes)
    poses = wp.array(np.tile(np.array(_STILL, np.float32), (2, 1)), dtype=wp.transform, device="cpu")
    image, normal = wp.full((2, 4, 6), 2.0, dtype=float), wp.full((2, 4, 6), wp.vec3(0.0, 0.0, -1.0), dtype=wp.vec3)
    camera = dict(config=sk.SpadConfig(**config), cameras=2, world=[0, 1], frame="optical", device="cpu")
    looked = dict(shapes=made, camera_q=poses, body_q=poses)
    images = dict(depth=image, normal=normal, reflectance=image, along_ray=False, camera_q=poses)
    matrix = wp.full(2, wp.mat33(1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0), dtype=wp.mat33, device="cpu")
    written = dict(position=wp.zeros(2, dtype=wp.vec3), rotation=matrix, out=wp.zeros(2, dtype=wp.transform))
    points = wp.array(mesh.points.numpy(), dtype=wp.vec3, device="cpu")
    moving = wp.Mesh(points, wp.array(mesh.indices.numpy(), dtype=int, device="cpu"))
    surfaces = sk.make_surfaces(moving, 0.5, extent=9.0)
    return {
        "SpadConfig": (sk.SpadConfig, config),
        "make_shapes": (sk.make_shapes, shapes),
        "SpadCamera": (sk.SpadCamera, camera),
        "SpadCamera.update": (lambda **changed: sk.SpadCamera(**camera).update(**changed), looked),
        "SpadCamera.images": (lambda **changed: sk.SpadCamera(**camera).update_from_images(**changed), images),
        "SpadTracer": (sk.SpadTracer, {"shapes": made, "photons": 100, "oversampling": 2, **camera}),
        "move_shapes": (move_shapes, {"shapes": made, "body_q": poses}),
        "write_poses": (sk.write_poses, written),
        # Not the numbers in the tree's arrays, which a call that a CUDA graph can hold does not read.
        "update_surfaces": (
            lambda **changed: sk.update_surfaces(**{"surfaces": surfaces, **changed}),
            {"mesh": moving},
        ),
    }
