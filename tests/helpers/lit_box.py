"""The structs of a transport model: a small camera that looks at a lit box in water."""

import math

import warp as wp

import spadwarp_kernels as sk


def lit_box():
    """Fresh structs by name."""
    medium, laser, camera, gate = sk.Medium(), sk.Laser(), sk.Camera(), sk.Gate()
    limits, guiding = sk.Limits(), sk.Guiding()
    medium.extinction, medium.albedo, medium.anisotropy, medium.axis_threshold = 0.3, 0.8, 0.9, 1.0
    laser.axis, laser.spread = wp.vec3(0.0, 0.0, 1.0), 0.01
    camera.width, camera.height, camera.pixel_tangent = 4, 3, 0.05
    camera.aperture_radius, camera.aperture_area = 0.01, math.pi * 0.01**2
    gate.start, gate.stop, gate.bins, gate.bins_per_metre = 8.0, 12.0, 8, 2.0
    limits.max_path, limits.max_collisions = 20.0, 8
    guiding.probability, guiding.surface_probability, guiding.anisotropy = 0.3, 0.3, 0.9
    return dict(medium=medium, laser=laser, camera=camera, gate=gate, limits=limits, guiding=guiding)
