"""The checks in order, and the numbers that follow from a scene."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

from spadwarp.checks.geometry import check_focus, check_ports, check_scan, check_targets
from spadwarp.checks.light import check_daylight, check_polarisation, check_spectrum, check_statistics, check_timing
from spadwarp.checks.plausible import check_plausible
from spadwarp.checks.survey import CheckMessage, OnAxis, Survey
from spadwarp.checks.water import check_grid, check_medium, grid_summary
from spadwarp.errors import ArgumentError, ConfigError
from spadwarp.frames import detector_response
from spadwarp.mesh import TriangleMesh
from spadwarp.scene import SceneLike, as_scene
from spadwarp.transport import points_per_flight

__all__ = ["check", "summary"]

_CHECKS = (
    *(check_plausible, check_targets, check_focus, check_ports, check_scan, check_timing, check_spectrum),
    *(check_daylight, check_medium, check_grid, check_polarisation, check_statistics),
)


def check(scene: SceneLike, mesh: TriangleMesh | None = None) -> list[CheckMessage]:
    """Everything worth knowing about a scene, warnings first; occlusion is not considered.

    `mesh` is the scene's mesh if the caller has it; else it is built. Raises `MeshError`; `FileError` or `ConfigError`
    for the tables of a phase function and a scattering matrix and the instrument response of the detector;
    `ConfigError` for several points per flight with what they do not go with.
    """
    survey = Survey(as_scene(scene), mesh)
    points_per_flight(survey.scene)
    try:  # read here, since only depth and counts need it: at the end of a run it would be too late
        detector_response(survey.scene.detector, survey.scene.laser)
    except ArgumentError as error:
        raise ConfigError(f"detector.irf: {error}", source=survey.scene.source) from None
    for find in _CHECKS:
        find(survey)
    return sorted(survey.messages, key=lambda message: message.level != "warning")


def summary(scene: SceneLike, mesh: TriangleMesh | None = None) -> dict[str, Any]:
    """Numbers that follow from a scene; lengths in m, None where there is no target in the view and the beam.

    `attenuation_length` and `albedo` are those of the water before the first layer; `layers` has those of each layer,
    with its start; `grid` counts, edges, least and largest extinction and memory of the cells, and the optical depth
    along the axis through their box, None without a grid. `focus_distance` is the depth that the lens images sharply,
    None for a pinhole. `optical_depth` is one-way to the nearest visible point. `signal_per_pulse` is the expected
    number of unscattered target photons that one pixel on the beam's axis detects from a pulse, `photons_per_pixel` how
    many it receives; `samples_per_pixel` how many of the traced photons reach a pixel's part of the target unscattered.
    `irradiance` is that of unscattered light at the nearest visible point's range on the beam's axis, mean over time
    [W/m²]. `histogram_bytes` is one set of tallies.
    Raises `MeshError`.
    """
    scene = as_scene(scene)
    survey = Survey(scene, mesh)
    camera, gate, laser, medium = scene.camera, scene.gate, scene.laser, scene.medium

    def water(part: Any) -> dict[str, float]:
        return {"attenuation_length": part.attenuation_length, "albedo": part.scattering / part.extinction}

    axis = dict.fromkeys(field.name for field in dataclasses.fields(OnAxis))
    axis |= {} if survey.on_axis is None else vars(survey.on_axis)
    del axis["distance"]
    return {
        **water(medium),
        "layers": [{"start": layer.start, **water(layer)} for layer in medium.layers],
        "grid": grid_summary(scene),
        "target_range": survey.target_range,
        "target_arrival_ns": survey.target_arrival_ns,
        **axis,
        "optical_depth": survey.optical_depth,
        "gate_range": (survey.range_of(gate.start), survey.range_of(gate.stop)),
        "bin_range": survey.bin_range,
        "path_limit": scene.path_limit,
        "unambiguous_range": survey.range_of(1.0 / laser.repetition_rate),
        "irf_fwhm_ps": survey.irf_fwhm_ps,
        "horizontal_fov_deg": math.degrees(camera.horizontal_fov),
        "vertical_fov_deg": math.degrees(camera.vertical_fov),
        "aperture_area": camera.aperture_area,
        "focus_distance": survey.focus_distance,
        "photons_per_pulse": laser.photons_per_pulse,
        "average_power": laser.average_power,
        "peak_power": laser.peak_power,
        "pde": scene.detections_per_photon,
        "histogram_bytes": survey.histogram_bytes,
    }
