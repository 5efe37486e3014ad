"""What polarised light of a scene depends on, as the kernels take it."""

from __future__ import annotations

import dataclasses
import math
from typing import TYPE_CHECKING, Any

import numpy as np

import spadwarp_kernels as sk
from spadwarp.scene import Camera, Laser, Scene, scattering_matrix

if TYPE_CHECKING:
    from spadwarp.mesh import TriangleMesh

__all__ = ["channel_rows", "emitted_stokes", "polarised_model"]


def polarised_model(model: sk.Model, scene: Scene, mesh: TriangleMesh | None) -> sk.Model:
    """The model with its polarised light, and tallies of the camera's channels in the unit of its histogram."""
    rows = channel_rows(scene.camera)
    facets: Any = ()
    if mesh is not None and mesh.specular is not None:
        index = np.array([target.specular_index for target in scene.targets]) / scene.medium.phase_index
        facets = index[mesh.target]
    polarisation = sk.make_polarisation(
        laser=emitted_stokes(scene.laser),
        matrix=scattering_matrix(scene.medium),
        channels=rows,
        facet_index=facets,
        device=model.device,
    )
    model = dataclasses.replace(model, polarisation=polarisation)
    if not rows:
        return model
    scales = [model.scale] * len(rows)
    tallies = sk.make_derivatives([], [], scales, channels=len(rows), device=model.device)
    return dataclasses.replace(model, derivatives=tallies)


def emitted_stokes(laser: Laser) -> tuple[float, float, float, float]:
    """Stokes vector (1, Q, U, V) of a laser's light with respect to its beam's right.

    U counts towards the second direction, right × axis, which is the beam's up, so that an angle towards its down is
    negative there.
    """
    if laser.polarisation == "linear":
        double = math.radians(2.0 * laser.polarisation_angle_deg)
        return 1.0, math.cos(double), -math.sin(double), 0.0
    return 1.0, 0.0, 0.0, {"none": 0.0, "right_circular": 1.0, "left_circular": -1.0}[laser.polarisation]


def channel_rows(camera: Camera) -> list[list[float]]:
    """Of each channel but "I", the row whose product with the Stokes vector at the lens it gets."""
    if camera.polarisation == "none":
        return []
    if camera.polarisation == "stokes":
        return np.eye(4)[1:].tolist()
    leak, double = 1.0 / camera.analyser_extinction_ratio, math.radians(2.0 * camera.analyser_angle_deg)
    part = 0.5 * (1.0 - leak)
    along = [0.5 * (1.0 + leak), part * math.cos(double), part * math.sin(double), 0.0]
    return [along, [along[0], -along[1], -along[2], 0.0]]
