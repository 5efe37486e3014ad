"""Values that are valid but far from what a SPAD camera, its laser, water and targets have: mostly a wrong unit."""

from __future__ import annotations

from typing import Any

import numpy as np

from spadwarp.checks.survey import Survey
from spadwarp.mesh import guess_unit
from spadwarp.scene.port import Port
from spadwarp.scene.sections import field_unit
from spadwarp.units import quantity, with_prefix

# Section → field → lowest and highest plausible value in the field's own unit, and units that people take it for.
# 0 is always allowed: it leaves something out. Lasers from picosecond diodes to Q-switched ones of 1 kHz, cameras from
# endoscopes to telescopes, water from pure to milk.
_PLAUSIBLE: dict[str, dict[str, tuple[float, float, tuple[str, ...]]]] = {
    "laser": {
        "pulse_energy": (1e-14, 0.1, ("nJ", "µJ")),
        "repetition_rate": (1e3, 1e10, ("kHz", "MHz")),
        "pulse_fwhm_ps": (1.0, 1e5, ("s", "ns")),
        "wavelength_nm": (200.0, 2000.0, ("m", "µm")),
        "linewidth_nm": (1e-7, 300.0, ("m", "µm")),
        "half_angle_deg": (1e-3, 180.0, ()),
        "beam_radius": (1e-5, 2.0, ("mm",)),
    },
    "camera": {
        "focal_length": (1e-4, 5.0, ("mm",)),
        "pixel_pitch_um": (0.5, 2000.0, ("m", "mm")),
        "aperture_diameter": (1e-5, 5.0, ("mm",)),
        "f_number": (0.3, 200.0, ()),
    },
    "detector": {
        "jitter_fwhm_ps": (0.5, 1e5, ("s", "ns")),
        "irf_tail_ps": (0.1, 1e6, ("s", "ns")),
        "dark_count_rate": (1e-4, 1e9, ()),
        "filter_centre_nm": (200.0, 2000.0, ("m", "µm")),
        "filter_fwhm_nm": (0.01, 500.0, ("m", "µm")),
        "dead_time_ns": (0.1, 1e6, ("s", "µs")),
        "afterpulsing_time_constant_ns": (0.1, 1e6, ("s", "µs")),
    },
    "gate": {
        "start_ns": (1e-3, 1e5, ("s", "µs", "ps")),
        "bin_width_ps": (0.1, 1e5, ("s", "ns", "fs")),
    },
    "medium": {
        "absorption": (1e-6, 1e3, ()),
        "scattering": (1e-6, 1e4, ()),
        "extinction": (1e-5, 1e4, ()),
    },
}
# Of a port with a window; that of a calm surface may be far.
_PORT: dict[str, tuple[float, float, tuple[str, ...]]] = {
    "distance": (1e-4, 2.0, ("mm",)),
    "radius": (1e-3, 2.0, ("mm",)),
    "thickness": (1e-4, 0.5, ("mm",)),
}
_MOST_POWER = 100.0  # [W]
_FARTHEST = 1000.0  # [m] of a laser, a camera or a target
_MESH_SIDES = (0.01, 100.0)  # longest side of a mesh file's target [m]


def check_plausible(survey: Survey) -> None:
    """Values of the scene outside what is plausible, with the unit that was probably meant."""
    scene, laser = survey.scene, survey.scene.laser
    tables = [(section, getattr(scene, section), fields) for section, fields in _PLAUSIBLE.items()]
    ports = {"camera.port": scene.camera.port, "laser.port": laser.port}
    tables += [(name, port, _PORT) for name, port in ports.items() if isinstance(port, Port) and port.thickness > 0.0]
    for section, model, fields in tables:
        for name, plausible in fields.items():
            _check_value(survey, f"{section}.{name}", getattr(model, name), type(model).model_fields[name], plausible)
    if laser.average_power > _MOST_POWER and not any(item.field.startswith("laser.") for item in survey.messages):
        text = (
            f"{with_prefix(laser.pulse_energy, 'J')} at {with_prefix(laser.repetition_rate, 'Hz')} are "
            f"{with_prefix(laser.average_power, 'W')} on average"
        )
        survey.warn("laser.pulse_energy", text, average_power=laser.average_power)
    places = {"laser.position": laser.position, "camera.position": scene.camera.position}
    places |= {f"targets[{i}].translation": target.translation for i, target in enumerate(scene.targets)}
    for field, place in places.items():
        if (farthest := max(map(abs, place))) > _FARTHEST:
            text = f"{list(place)} m is {farthest:.4g} m away; in mm it would be {[1e-3 * x for x in place]} m"
            survey.warn(field, text, farthest=farthest)
    _check_meshes(survey)


def _check_value(survey: Survey, field: str, value: Any, info: Any, plausible: tuple[float, float, Any]) -> None:
    low, high, units = plausible
    if not isinstance(value, float) or value == 0.0 or low <= value <= high:
        return
    unit_of_field = field_unit(info) or "1"
    unit = "" if unit_of_field == "1" else f" {unit_of_field}"
    text = f"{value:g}{unit} is not plausible ({low:g} to {high:g}{unit} is)"
    meant = {other: quantity(f"{value!r} {other}", unit_of_field) for other in units}
    meant = {other: number for other, number in meant.items() if low <= number <= high}
    if meant:
        words = [f'"{value:g} {other}" ({number:g}{unit})' for other, number in meant.items()]
        text += f"; did you mean {' or '.join(words)}?"
    survey.warn(field, text, value=value, **{f"in_{other}": number for other, number in meant.items()})


def _check_meshes(survey: Survey) -> None:
    """The size of targets from files, whose unit most formats do not state."""
    for index, target in enumerate(survey.scene.targets):
        corners = survey.triangles[survey.target == index].reshape(-1, 3)
        if target.mesh is None or not len(corners):
            continue
        extent = np.ptp(corners, axis=0)
        longest = float(extent.max())
        if _MESH_SIDES[0] <= longest <= _MESH_SIDES[1]:
            continue
        sides = " x ".join(f"{side:.4g}" for side in extent)
        text = f"the mesh is {sides} m"
        guess = guess_unit(longest)
        if guess is not None and guess[0] != "m":
            scale = [guess[1] * factor for factor in target.scale]
            shown = f"{scale[0]:g}" if len(set(scale)) == 1 else f"{[float(f'{factor:g}') for factor in scale]}"
            smaller = " x ".join(f"{side * guess[1]:.4g}" for side in extent)
            text += f"; if its unit is {guess[0]}, scale = {shown} makes it {smaller} m"
        survey.warn(f"targets[{index}].scale", text, longest=longest)
