"""The water's coefficients and phase function, and what ends a photon's history in it."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from spadwarp.checks.message import CheckMessage, note, warning
from spadwarp.checks.survey import Survey
from spadwarp.scene import Laser, Layer, Medium, Scene, phase_function
from spadwarp.water import molecular_density, pure_water_absorption, water_optics


def check_medium(survey: Survey) -> Iterator[CheckMessage]:
    """Findings about the medium, its layers, and the collisions that transport allows in it."""
    scene = survey.scene
    medium, laser = scene.medium, scene.laser
    if laser.is_visible:
        pure = pure_water_absorption(laser.wavelength_nm)
        for name, water in _named_waters(medium):
            if water.absorption < 0.95 * pure:
                text = f"absorption = {water.absorption:.3g} 1/m is below pure water's {pure:.3g} 1/m"
                yield note(f"{name}.absorption", text, absorption=water.absorption, pure_water=pure)
    if abs(laser.wavelength_nm - 532.0) > 10.0:
        for name, water in _named_waters(medium):
            if water.preset is not None:
                yield _preset_at_another_wavelength(name, water.preset, laser)
    if medium.layers:
        yield from _check_molecular_scattering(scene)
    if medium.has_phase_table:
        yield from _check_phase_table(scene)
    yield from _check_collisions(scene)


def _named_waters(medium: Medium) -> Iterator[tuple[str, Medium | Layer]]:
    yield "medium", medium
    for i, layer in enumerate(medium.layers):
        yield f"medium.layers[{i}]", layer


def _preset_at_another_wavelength(name: str, preset: str, laser: Laser) -> CheckMessage:
    text = f"the coefficients of {preset} are for about 532 nm, the laser has {laser.wavelength_nm:g} nm"
    values = {"wavelength_nm": laser.wavelength_nm}
    if laser.is_visible:
        here, green = pure_water_absorption(laser.wavelength_nm), pure_water_absorption(532.0)
        values |= {"pure_water": here, "pure_water_532": green}
        text += f", where pure water absorbs {here:.3g} 1/m and not {green:.3g}"
    return warning(f"{name}.preset", text, **values)


def _check_phase_table(scene: Scene) -> Iterator[CheckMessage]:
    """A forward peak narrower than the near-axis rule; a table that leaves most of the light to its power law."""
    law = phase_function(scene.medium)
    snapped = math.acos(scene.transport.axis_threshold)
    within = law.fraction_below(snapped) if snapped > 0.0 else 0.0
    if within > 0.1:
        text = (
            f"axis_threshold = {scene.transport.axis_threshold:g} takes light within {math.degrees(snapped):.3g}° of "
            f"the optical axis for axial, and {100.0 * within:.2g} % of the scattered light turns by less than that; "
            "guided follows the forward peak with axis_threshold = 1 only, else single photons stand out"
        )
        yield warning("transport.axis_threshold", text, within=within)
    continued = law.fraction_below(law.first_angle) if law.first_angle > 0.0 else 0.0
    if continued > 0.1:
        text = (
            f"begins at {math.degrees(law.first_angle):.3g}°: {100.0 * continued:.2g} % of the scattered light is "
            "below that, where the law between the first two points is continued"
        )
        yield note("medium.phase_table", text, continued=continued)


def _check_molecular_scattering(scene: Scene) -> Iterator[CheckMessage]:
    """Water molecules scatter little, but nearly evenly: the phase function of particles misses it straight back."""
    medium = scene.medium
    if medium.phase_function != "henyey_greenstein":
        return
    for name, water in _named_waters(medium):
        if water.chlorophyll is None:
            continue
        optics = water_optics(scene.laser.wavelength_nm, chlorophyll=water.chlorophyll, **medium.state)
        molecules = optics.water_scattering * float(molecular_density(np.array(2.0)))
        g = medium.anisotropy if water.anisotropy is None else water.anisotropy
        particles = (optics.scattering - optics.water_scattering) * (1.0 - g) / (4.0 * math.pi * (1.0 + g) ** 2)
        missing = molecules / (molecules + particles)
        if missing > 0.1:
            text = (
                f"layers have the phase function of particles alone: {100.0 * missing:.2g} % of what would be "
                "scattered straight back is the water's own and is missing"
            )
            yield note(f"{name}.chlorophyll", text, missing=missing)


def _check_collisions(scene: Scene) -> Iterator[CheckMessage]:
    """Whether `max_collisions` or `weight_cutoff` ends histories that the longest path would let go on."""
    transport = scene.transport
    mean = scene.medium.range.extinction * scene.path_limit  # along the longest path
    if scene.medium.grid is not None:  # most of which is not in the densest cell
        beam = scene.beam
        far = [p + 0.5 * scene.path_limit * u for p, u in zip(beam.position, beam.axis, strict=True)]
        mean = 2.0 * scene.optical_depth(beam.position, far)
    most, cutoff = mean + 3.0 * math.sqrt(mean), _cutoff_collisions(scene)
    values = {"path_collisions": mean, "cutoff_collisions": cutoff}
    if transport.max_collisions < min(most, cutoff):
        text = (
            f"max_collisions = {transport.max_collisions} ends histories that the longest path would let collide "
            f"{mean:.3g} times on average, {most:.3g} at most"
        )
        yield warning("transport.max_collisions", text, **values)
    elif cutoff < min(most, transport.max_collisions):
        text = (
            f"weight_cutoff = {transport.weight_cutoff:g} ends histories after about {cutoff:.0f} collisions, before "
            f"max_collisions = {transport.max_collisions} matters; the longest path allows {mean:.3g} on average "
            f'(termination = "roulette" is without this bias)'
        )
        yield note("transport.weight_cutoff", text, **values)


def _cutoff_collisions(scene: Scene) -> float:
    """Collisions after which the analog weight is below the cut-off, on average; inf where it never is."""
    transport = scene.transport
    if transport.termination != "cutoff" or transport.weight_cutoff == 0.0:
        return math.inf
    if scene.medium.albedo == "lu2024":
        step = math.log(0.97) - 1.0  # the mean of ln ω for ω uniform in (0, 0.97)
    else:
        albedo = scene.medium.range.albedo
        if albedo in (0.0, 1.0):
            return 1.0 if albedo == 0.0 else math.inf
        step = math.log(albedo)
    return max(1.0, math.ceil(math.log(transport.weight_cutoff) / step))
