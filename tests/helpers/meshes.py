"""Meshes on a device."""

import numpy as np
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import on_device


def mesh_and_surfaces(shape, device, *, builder=None, leaf_size=1):
    """The mesh, which has to outlive its surfaces, and these."""
    arrays = on_device(shape.vertices, device), on_device(np.ravel(shape.faces), device, int)
    mesh = wp.Mesh(*arrays, bvh_constructor=builder, bvh_leaf_size=leaf_size)
    return mesh, sk.make_surfaces(mesh)
