"""Reflectance, gloss and textures of a mesh."""

import numpy as np
import pytest
import trimesh
import warp as wp

import spadwarp_kernels as sk
from helpers.meshes import mesh_and_surfaces


def test_surfaces_check_their_arrays_and_the_spec_that_goes_with_them():
    mesh, _ = mesh_and_surfaces(trimesh.creation.box(), "cpu")
    with pytest.raises(ValueError, match="specular has 5 entries; the mesh has 12 faces"):
        sk.make_surfaces(mesh, 0.5, specular=wp.zeros(5, dtype=float, device="cpu"))
    image = np.linspace(0, 1, 6).reshape(2, 3)
    textures = sk.make_textures(np.full(12, -1), np.zeros((12, 3, 2)), [image], device="cpu")
    surfaces = sk.make_surfaces(mesh, 0.25, specular=0.5, roughness=0.1, textures=textures)
    assert sk.surface_choices(surfaces) == {"pattern": True, "specular": True, "use_warp_bvh": False}
    assert (surfaces.corner_reflectance.numpy() == 0.25).all()
    np.testing.assert_allclose(surfaces.roughness.numpy(), 0.1)
    plain = sk.make_surfaces(mesh, 0.25)
    assert sk.surface_choices(plain) == {"pattern": False, "specular": False, "use_warp_bvh": False}
    limits = sk.Limits()
    model = sk.Model(
        mesh.device, sk.Medium(), sk.Laser(), sk.Camera(), sk.Gate(), limits, sk.Guiding(), mesh, surfaces, 1.0
    )
    data = sk.make_data(model, histogram=False)
    with pytest.raises(ValueError, match=r"spec.pattern = False does not go with the model's surfaces"):
        sk.launch_transport(sk.TransportSpec("none"), model, data, seed=1, first_id=0, photon_count=1)
