"""Voxels of a NanoVDB grid."""

import warp as wp


@wp.kernel(enable_backward=False)
def voxel_values_kernel(volume: wp.uint64, voxels: wp.array(dtype=wp.vec3i), values: wp.array(dtype=float)):
    """Values of a `wp.Volume` of float32 at the indices of `Volume.get_voxels`. Launch: voxels."""
    i = wp.tid()
    v = voxels[i]
    values[i] = wp.volume_lookup_f(volume, v[0], v[1], v[2])
