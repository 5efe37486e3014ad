"""Polarised light: the table of its matrix, and fields that nothing uses."""

from __future__ import annotations

from collections.abc import Iterator

from spadwarp.checks.message import CheckMessage, note
from spadwarp.checks.survey import Survey
from spadwarp.scene import Camera, Laser, Medium, scattering_matrix


def check_polarisation(survey: Survey) -> Iterator[CheckMessage]:
    """Polarised light that no channel records, and fields without their choice; reads the matrix's table."""
    scene = survey.scene
    scattering_matrix(scene.medium)
    if scene.polarised and scene.camera.polarisation == "none":
        text = "light is polarised, but the result will have no channels: 'analyser' or 'stokes' records them"
        yield note("camera.polarisation", text)
    if scene.camera.polarisation != "none" and scene.laser.polarisation == "none":
        yield note("laser.polarisation", "the camera measures polarisation, but the laser's light is not polarised")
    medium, camera, laser = scene.medium, scene.camera, scene.laser
    rayleigh = "rayleigh" in (medium.scattering_matrix, medium.phase_function)
    measured, cameras = camera.polarisation != "none", "polarisation = 'analyser' or 'stokes'"
    scaled = medium.scattering_matrix == "scaled_rayleigh"
    for section, model, field, used, needed in (
        ("laser", Laser, "polarisation_angle_deg", laser.polarisation == "linear", "polarisation = 'linear'"),
        ("medium", Medium, "depolarisation_ratio", rayleigh, "scattering_matrix or phase_function = 'rayleigh'"),
        ("medium", Medium, "largest_polarisation", scaled, "scattering_matrix = 'scaled_rayleigh'"),
        ("camera", Camera, "analyser_angle_deg", measured, cameras),
        ("camera", Camera, "analyser_extinction_ratio", measured, cameras),
    ):
        value = getattr(getattr(scene, section), field)
        if not used and value != model.model_fields[field].default:
            yield note(f"{section}.{field}", f"{field} = {value:g} is not used: it goes with {section}.{needed}")
