"""Where a fit starts: absorption and scattering from slope and level of the backscatter, as a lidar has them."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from spadwarp.scene import phase_function
from spadwarp.transport import truth_maps

if TYPE_CHECKING:
    from spadwarp.inverse.exposure import Exposure
    from spadwarp.scene import Scene

__all__ = ["lidar_start"]

_LEAST_COUNTS, _LEAST_BINS = 200, 12
_LEAST_SPAN = 1.3  # last over first range, for a slope that says something of the water
_NEARER = 0.95  # of the range of the nearest target
_SHARE = 0.2  # of the scattering that the slope contains: most of it goes on forward


def lidar_start(scene: Scene, exposure: Exposure, *, device: str | None = None) -> dict[str, float]:
    """Absorption and scattering [1/m] from the single-scatter lidar equation; empty where no backscatter is recorded.

    Counts of the whole image before the nearest target, without pile-up (Coates) and noise, times R², fall as
    exp(−2KR), R half the path. Their level is N η (Ω_view/Ω_beam) A b p(π) v Δt/2, from which b follows with the
    scene's phase function. Light that is scattered forward is not lost, so that K is a + 0.2 b rather than a + b.
    It is right within a factor of about 3, which is what a start needs.
    """
    assert exposure.counts is not None
    start, bins = exposure.window
    dt, speed = scene.gate.bin_width, scene.medium.pulse_speed
    distance = 0.5 * speed * (start + dt * (np.arange(bins) + 0.5))
    seen = truth_maps(scene, device=device).range
    nearest = float(np.nanmin(seen)) if np.isfinite(seen).any() else math.inf
    # From where on the beam fills the view.
    baseline = float(np.linalg.norm(scene.beam.position))
    overlap = 2.0 * baseline / math.tan(min(scene.laser.half_angle, 1.5)) if scene.laser.half_angle > 0 else 0.0
    inside = (distance > max(overlap, 5.0 * scene.camera.aperture_radius)) & (distance < _NEARER * nearest)
    counts, left = exposure.counts.sum(axis=0), np.maximum(exposure.left().sum(axis=0), 1.0)
    inside &= left > 0.05 * exposure.pulses * len(exposure.counts)
    rate = -np.log1p(-np.minimum(counts / left, 0.99)) - scene.detector.noise_rate * dt
    inside &= (rate > 0) & (counts > 0)
    if inside.sum() < _LEAST_BINS or counts[inside].sum() < _LEAST_COUNTS:
        return {}
    if distance[inside][-1] < _LEAST_SPAN * distance[inside][0]:
        return {}
    x, y = distance[inside], np.log(rate[inside] * distance[inside] ** 2)
    slope, level = np.polyfit(x, y, 1, w=np.sqrt(counts[inside]))
    camera = scene.camera
    view = camera.pixel_tangent**2  # of a pixel [sr]
    beam = 2.0 * math.pi * (1.0 - math.cos(scene.laser.half_angle))
    backward = float(phase_function(scene.medium).density(np.array([math.pi]))[0])
    caught = scene.laser.photons_per_pulse * scene.detections_per_photon * min(view / max(beam, 1e-12), 1.0)
    scattering = math.exp(level) / (caught * camera.aperture_area * backward * 0.5 * speed * dt)
    decay = max(-0.5 * slope, 0.02)
    scattering = min(max(scattering, 0.05 * decay), 10.0 * decay)
    return {
        "medium.absorption": max(decay - _SHARE * scattering, 0.2 * decay),
        "medium.scattering": scattering,
    }
