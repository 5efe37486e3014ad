"""The water: its coefficients, phase function and cells, and what ends a photon's history in it."""

from __future__ import annotations

import math
from typing import Any

import numpy as np

from spadwarp.checks.survey import Survey
from spadwarp.scene import Layer, Medium, Scene, phase_function
from spadwarp.scene.camera import to_camera
from spadwarp.scene.grid import GridCells
from spadwarp.scene.medium import grid_cells
from spadwarp.scene.sight import beam_planes, view_planes
from spadwarp.water import molecular_density, pure_water_absorption, water_optics


def check_medium(survey: Survey) -> None:
    """The medium, its layers, and the collisions that transport allows in it."""
    medium, laser = survey.scene.medium, survey.scene.laser
    pure = pure_water_absorption(laser.wavelength_nm) if laser.is_visible else 0.0
    for name, water in _waters(medium).items():
        if water.absorption < 0.95 * pure:
            text = f"absorption = {water.absorption:.3g} 1/m is below pure water's {pure:.3g} 1/m"
            survey.note(f"{name}.absorption", text, absorption=water.absorption, pure_water=pure)
    for name, water in _waters(medium).items():
        if water.preset is None or abs(laser.wavelength_nm - 532.0) <= 10.0:
            continue
        text = f"the coefficients of {water.preset} are for about 532 nm, the laser has {laser.wavelength_nm:g} nm"
        values = {"wavelength_nm": laser.wavelength_nm}
        if laser.is_visible:
            green = pure_water_absorption(532.0)
            values |= {"pure_water": pure, "pure_water_532": green}
            text += f", where pure water absorbs {pure:.3g} 1/m and not {green:.3g}"
        survey.warn(f"{name}.preset", text, **values)
    if medium.layers and medium.phase_function == "henyey_greenstein":
        _check_molecular_scattering(survey)
    if medium.has_phase_table:
        _check_phase_table(survey)
    _check_collisions(survey)


def _waters(medium: Medium) -> dict[str, Medium | Layer]:
    layers = {f"medium.layers[{i}]": layer for i, layer in enumerate(medium.layers)}
    return {"medium": medium, **layers}


def _check_phase_table(survey: Survey) -> None:
    """A forward peak narrower than the near-axis rule; a table that leaves most of the light to its power law."""
    scene, law = survey.scene, phase_function(survey.scene.medium)
    snapped = math.acos(scene.transport.axis_threshold)
    within = law.fraction_below(snapped) if snapped > 0.0 else 0.0
    if within > 0.1:
        text = (
            f"axis_threshold = {scene.transport.axis_threshold:g} takes light within {math.degrees(snapped):.3g}° of "
            f"the optical axis for axial, and {100.0 * within:.2g} % of the scattered light turns by less than that; "
            "guided follows the forward peak with axis_threshold = 1 only, else single photons stand out"
        )
        survey.warn("transport.axis_threshold", text, within=within)
    continued = law.fraction_below(law.first_angle) if law.first_angle > 0.0 else 0.0
    if continued > 0.1:
        text = (
            f"begins at {math.degrees(law.first_angle):.3g}°: {100.0 * continued:.2g} % of the scattered light is "
            "below that, where the law between the first two points is continued"
        )
        survey.note("medium.phase_table", text, continued=continued)


def _check_molecular_scattering(survey: Survey) -> None:
    """Water molecules scatter little, but nearly evenly: the phase function of particles misses it straight back."""
    medium = survey.scene.medium
    for name, water in _waters(medium).items():
        if water.chlorophyll is None:
            continue
        optics = water_optics(survey.scene.laser.wavelength_nm, chlorophyll=water.chlorophyll, **medium.state)
        molecules = optics.water_scattering * float(molecular_density(np.array(2.0)))
        g = medium.anisotropy if water.anisotropy is None else water.anisotropy
        particles = (optics.scattering - optics.water_scattering) * (1.0 - g) / (4.0 * math.pi * (1.0 + g) ** 2)
        missing = molecules / (molecules + particles)
        if missing > 0.1:
            text = (
                f"layers have the phase function of particles alone: {100.0 * missing:.2g} % of what would be "
                "scattered straight back is the water's own and is missing"
            )
            survey.note(f"{name}.chlorophyll", text, missing=missing)


def _check_collisions(survey: Survey) -> None:
    """Whether `max_collisions` or `weight_cutoff` ends histories that the longest path would let go on."""
    scene, transport = survey.scene, survey.scene.transport
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
        survey.warn("transport.max_collisions", text, **values)
    elif cutoff < min(most, transport.max_collisions):
        text = (
            f"weight_cutoff = {transport.weight_cutoff:g} ends histories after about {cutoff:.0f} collisions, before "
            f"max_collisions = {transport.max_collisions} matters; the longest path allows {mean:.3g} on average "
            f'(termination = "roulette" is without this bias)'
        )
        survey.note("transport.weight_cutoff", text, **values)


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


def check_grid(survey: Survey) -> None:
    """The cells of `medium.grid`: where their box lies, and what light loses in it."""
    scene = survey.scene
    if scene.medium.grid is None:
        return
    cells, axis = grid_cells(scene.medium), survey.on_axis
    if _misses(scene, cells):
        survey.warn("medium.grid", "lies beside the view and the beam: single scattering does not show it")
    else:
        begin, end = (0.0, 0.0, 0.0), (0.0, 0.0, 0.5 * scene.path_limit if axis is None else axis.distance)
        depth, without = scene.optical_depth(begin, end), scene.medium.extinction * end[2]
        where = "to the end of the gate" if axis is None else "to the target's range"
        text = f"optical depth along the axis {where} ({end[2]:.4g} m): {depth:.3g} one way, {without:.3g} without it"
        survey.note("medium.grid", text, optical_depth=depth, without_grid=without)
    longest = max(edge / count for edge, count in zip(cells.size, cells.extinction.shape, strict=True))
    thickest = float(cells.extinction.max()) * longest
    if thickest > 1.0:
        text = f"a cell has an optical depth of up to {thickest:.3g} and does not resolve what varies in it; take more"
        survey.warn("medium.grid.cells", text, cell_optical_depth=thickest)


def _misses(scene: Scene, cells: GridCells) -> bool:
    """Whether one plane of the view, and one of the beam, has the whole box behind it."""
    half = 0.5 * np.array(cells.size)
    signs = np.array([[i, j, k] for i in (-1, 1) for j in (-1, 1) for k in (-1, 1)])
    corners = to_camera(scene.camera, (signs * half) @ cells.rotation.T + cells.centre)

    def behind(planes: Any) -> bool:
        return bool(((corners @ planes[:, :3].T + planes[:, 3]) < 0.0).all(axis=0).any())

    beam = beam_planes(scene.beam) if scene.scan_positions == 1 else view_planes(scene.camera)
    return behind(view_planes(scene.camera)) and behind(beam)


def grid_summary(scene: Scene) -> dict[str, Any] | None:
    """Numbers of the cells: counts, edges [m], least and largest extinction [1/m], memory on a device [bytes], and the
    optical depth on the axis through the whole box, one way; None without a grid."""
    if scene.medium.grid is None:
        return None
    cells = grid_cells(scene.medium)
    centre = to_camera(scene.camera, cells.centre)
    reach = float(centre[2]) + math.hypot(*cells.size)
    return {
        "cells": list(cells.extinction.shape),
        "size": list(cells.size),
        "extinction": [float(cells.extinction.min()), float(cells.extinction.max())],
        "optical_depth": scene.optical_depth((0.0, 0.0, 0.0), (0.0, 0.0, max(reach, 0.0))),
        "bytes": cells.extinction.size * (8 if cells.anisotropy is None else 12),
    }
