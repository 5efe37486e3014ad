"""The unit of a scene's tallies, from an upper bound of its brightest bin."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import TYPE_CHECKING

import numpy as np

from spadwarp.scene import Laser, Scene
from spadwarp.scene.beam_profile import load_profile, profile_extent
from spadwarp.scene.frustum import view_planes

if TYPE_CHECKING:
    from spadwarp.mesh import TriangleMesh

__all__ = ["PHOTON_CAPACITY", "tally_scale"]

# Photons that a tally can hold: the unit is chosen so that the brightest bin stays below 2^62 after this many.
PHOTON_CAPACITY = 2**40


def tally_scale(scene: Scene, mesh: TriangleMesh | None) -> float:
    """Tally units per emitted photon, a power of two: `PHOTON_CAPACITY` photons keep the brightest bin below 2^62.

    The brightest bin is bounded from above by the lidar equation at the near end of the gate, for light scattered
    evenly in all directions, or off the nearest point of a target, all of it within one bin, shared by the pixels that
    the beam spans; for a laser away from the lens also where its beam, narrow near its exit, crosses the view. Times 16
    for multiple scattering.
    """
    camera, laser, gate, medium = scene.camera, scene.beam, scene.gate, scene.medium
    speed = medium.pulse_speed
    pixels = camera.width * camera.height
    half_field = 0.5 * camera.width * camera.pixel_tangent
    spread = _spread(laser)
    # Each position of a scan has its own part of the photons.
    share = scene.scan_positions

    def illuminated_pixels(spot_scale: float) -> float:
        """Pixels that share the beam, for a spot of `spot_scale` times its size as seen from the lens's distance."""
        spot = max(math.pi * (spread * spot_scale / camera.pixel_tangent) ** 2, 1.0)
        return share * spot if share > 1 else min(spot, pixels)

    baseline = math.hypot(laser.position[0], laser.position[1])
    nearest = max(0.5 * gate.start * speed, baseline / (half_field + spread), camera.aperture_radius, 0.01)
    scattering = max(water.scattering for water in medium.waters)
    extinction = min(water.extinction for water in medium.waters)
    water = scattering * 0.5 * gate.bin_width * speed / (4.0 * math.pi * nearest**2)
    surface, bistatic = 0.0, _crossing(scene, illuminated_pixels)
    if mesh is not None:
        lower, upper = mesh.bounds.astype(float)
        gap = float(np.linalg.norm(np.maximum(np.maximum(lower, -upper), 0.0)))
        white = 1.0
        if mesh.specular is not None and mesh.roughness is not None:
            # A lobe is brighter than white by the density of its facets, 1/(4 alpha^2) times their reflectance.
            white = max(1.0, float((mesh.reflectance + 0.25 * mesh.specular / mesh.roughness**2).max()))
        surface = white / (math.pi * max(gap, nearest) ** 2)
        if math.hypot(*laser.position) > 0.25 * gap:
            exit_point = np.array(laser.position)
            reach = float(np.linalg.norm(np.maximum(np.maximum(lower - exit_point, exit_point - upper), 0.0)))
            spot = illuminated_pixels(min(1.0, reach / max(gap, 1e-3)))
            through = math.exp(-extinction * (gap + reach))
            bistatic = max(bistatic, white * through / (math.pi * max(gap, camera.aperture_radius, 0.01) ** 2 * spot))
    coaxial = max(water, surface) * math.exp(-extinction * 2.0 * nearest) / illuminated_pixels(1.0)
    brightest = 16.0 * camera.aperture_area * max(coaxial, bistatic)
    brightest = min(max(brightest, 1e-30), 1.0)
    exponent = math.floor(62 - math.log2(PHOTON_CAPACITY) - math.log2(brightest))
    # Beyond 2^52 an analog photon of weight 1 would not fit into one contribution.
    return 2.0 ** min(exponent, 52)


def _spread(laser: Laser) -> float:
    """Tangent of the half angle of an even cone that is as bright as the beam; 0 for a parallel one."""
    if laser.profile == "collimated":
        return 0.0
    if laser.profile == "measured":
        image = load_profile(laser)
        wide, tall = profile_extent(laser)
        return math.sqrt(4.0 * wide * tall * float(image.mean() / image.max()) / math.pi)
    return math.tan(min(laser.half_angle, 1.5))


def _crossing(scene: Scene, illuminated_pixels: Callable[[float], float]) -> float:
    """Largest share of the light per area of the lens [1/m^2] that one bin of one pixel gets where the beam's axis is
    in view, by single scattering; 0 if it never is, or starts at the lens."""
    camera, laser, gate = scene.camera, scene.beam, scene.gate
    exit_point = np.array(laser.position)
    if np.linalg.norm(exit_point) < camera.aperture_radius or scene.scan_positions > 1:
        return 0.0
    speed = scene.medium.pulse_speed
    along = np.geomspace(1e-3, max(scene.path_limit, 2e-3), 400)
    points = exit_point + along[:, None] * np.array(laser.axis)
    away = np.linalg.norm(points, axis=1)
    planes = view_planes(camera)
    seen = (points @ planes[:, :3].T + planes[:, 3] >= 0.0).all(axis=1)
    seen &= (along + away >= gate.start * speed) & (along + away <= gate.stop * speed)
    brightest = 0.0
    g, scattering = scene.medium.anisotropy, max(water.scattering for water in scene.medium.waters)
    extinction = min(water.extinction for water in scene.medium.waters)
    for distance, point, r in zip(along[seen], points[seen], away[seen], strict=True):
        one_minus_cosine = 1.0 + float(point @ laser.axis) / r
        phase = (1.0 - g * g) / (4.0 * math.pi * ((1.0 - g) ** 2 + 2.0 * g * one_minus_cosine) ** 1.5)
        # The part of the beam that arrives within a bin; light that comes straight at the lens arrives all at once.
        part = min(gate.bin_width * speed / max(one_minus_cosine, 1e-6), distance + r)
        r = max(r, camera.aperture_radius, 0.01)
        value = scattering * part * phase * math.exp(-extinction * (distance + r)) / r**2
        value /= illuminated_pixels(distance / r)
        brightest = max(brightest, value)
    return brightest
