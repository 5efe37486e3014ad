"""Whether each target is in the view, the beam, the gate and the water."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from spadwarp.checks.message import CheckMessage, note, span, vector, warning
from spadwarp.checks.survey import Survey
from spadwarp.scene import Laser
from spadwarp.scene.camera import image_points, to_world
from spadwarp.scene.laser import profile_extent
from spadwarp.scene.sight import points_inside
from spadwarp.units import path_from_time

Points = NDArray[np.float64]

_AROUND = 2.0  # [ns] of a gate before and after a target


def check_targets(survey: Survey) -> Iterator[CheckMessage]:
    """Findings about the targets and about where camera and laser stand."""
    scene = survey.scene
    if not scene.targets:
        yield note("targets", "the scene has none: only the water scatters light back")
    for index in range(len(scene.targets)):
        triangles = survey.triangles[survey.target == index]
        if len(triangles):
            yield from _check_target(survey, f"targets[{index}]", triangles)
    for index, target in enumerate(scene.targets):
        if target.specular > 0.0:
            text = (
                f"specular = {target.specular:g} acts in `simulate` alone: the analytic simulator, budgets and the "
                "signal named here take the target as Lambertian"
            )
            yield note(f"targets[{index}].specular", text, specular=target.specular)
    (low, high), laser = scene.domain.bounds, to_world(scene.camera, scene.beam.position)
    for name, point in (("the lens", scene.camera.position), ("the laser", laser)):
        if any(not (a <= x <= b) for a, x, b in zip(low, point, high, strict=True)):
            text = f"{name} at {vector(point)} m is outside the water, {vector(low)} to {vector(high)} m"
            yield warning("domain", text)


def _check_target(survey: Survey, name: str, triangles: Points) -> Iterator[CheckMessage]:
    """Findings about one target; where light cannot come back from it, the first of them alone."""
    in_view = points_inside(triangles, survey.view)
    illuminated = survey.illuminated_part(triangles) if len(in_view) else in_view
    if (hidden := _why_dark(survey, name, triangles, in_view, illuminated)) is not None:
        yield hidden
        return
    yield from _check_beam(survey, name, in_view)
    yield from _check_gate(survey, name, survey.paths(illuminated))
    yield from _check_limits(survey, name, triangles, illuminated)
    extent = np.ptp(image_points(survey.scene.camera, in_view[:, :2] / in_view[:, 2:]), axis=0)
    if extent.max() < 1.0:
        text = (
            f"smaller than a pixel, {extent[0]:.2g} x {extent[1]:.2g} of one: the truth maps may miss it, and what is "
            "beside it shares its pixel"
        )
        yield warning(name, text, columns=float(extent[0]), rows=float(extent[1]))


def _why_dark(
    survey: Survey, name: str, triangles: Points, in_view: Points, illuminated: Points
) -> CheckMessage | None:
    """Why no light comes back from a target, if none does."""
    scene, where = survey.scene, _extent(survey, triangles)
    if not len(in_view):
        depth = float(triangles[..., 2].max())
        if depth <= 0:
            return warning(name, f"behind the camera: {where}", depth=depth)
        left, top, right, bottom = (depth * tangent for tangent in scene.camera.view_box)
        wide, tall = max(-left, right), max(-top, bottom)
        text = f"outside the view: {where}, the view at its far end is |x| < {wide:.3g}, |y| < {tall:.3g} m"
        return warning(name, text, half_width=wide, half_height=tall, depth=depth)
    nearest = float(np.linalg.norm(in_view, axis=1).min())
    if nearest <= scene.camera.aperture_radius:
        return warning(name, f"reaches the lens ({where}): translation moves it away", nearest=nearest)
    if not len(illuminated):
        angles = np.degrees(_angles(in_view, scene.beam))
        text = (
            f"the beam misses what the camera sees of it: {where}, that is {angles.min():.3g} to {angles.max():.3g}° "
            f"off the axis, {_beam_text(scene.laser)}"
        )
        return warning(name, text, nearest_angle_deg=float(angles.min()))
    return None


def _check_gate(survey: Survey, name: str, paths: Points) -> Iterator[CheckMessage]:
    scene = survey.scene
    first, last = survey.arrival_ns(float(paths.min())), survey.arrival_ns(float(paths.max()))
    start, stop = scene.gate.start * 1e9, scene.gate.stop * 1e9
    if first < start or last > stop or first >= stop:
        partly = "" if first >= stop or last < start else "partly "
        text = (
            f"{partly}outside the gate: its light comes back from {first:.5g} to {last:.5g} ns, the gate is open from "
            f"{start:.5g} to {stop:.5g} ns; {_gate_that_holds(first, last, scene.gate.bin_width_ps)}"
        )
        yield warning(name, text, first_ns=first, last_ns=last, start_ns=start, stop_ns=stop)
    limit = scene.path_limit
    if paths.max() > limit < path_from_time(scene.gate.stop, scene.medium.group_index):
        text = f"max_path = {limit:.4g} m ends photons before they return from {name}, up to {paths.max():.4g} m"
        yield warning("transport.max_path", text, max_path=limit, path=float(paths.max()))


def _gate_that_holds(first: float, last: float, width_ps: float) -> str:
    """What to do about light from `first` to `last` [ns] outside the gate."""
    start = max(0.0, math.floor(first - _AROUND))
    bins = math.ceil(1e3 * (last + _AROUND - start) / width_ps)
    if bins > 1_000_000:
        return "`spadwarp plan` proposes one"
    return f"start_ns = {start:g} and bins = {bins} hold it, and `spadwarp plan` proposes a gate"


def _check_beam(survey: Survey, name: str, in_view: Points) -> Iterator[CheckMessage]:
    """Whether the beam leaves most of what is seen of a target dark."""
    scene, laser = survey.scene, survey.scene.beam
    if laser.profile not in ("uniform_cone", "gaussian") or scene.scan_positions > 1 or laser.half_angle_deg >= 90.0:
        return
    widest = math.degrees(float(_angles(in_view, laser).max()))
    if math.tan(math.radians(min(widest, 89.9))) > 2.0 * math.tan(laser.half_angle):
        text = (
            f"the beam misses most of what the camera sees of it: that reaches {widest:.3g}° off the axis, "
            f"{_beam_text(scene.laser)}"
        )
        yield note("laser.half_angle_deg", text, widest_angle_deg=widest)


def _check_limits(survey: Survey, name: str, triangles: Points, illuminated: Points) -> Iterator[CheckMessage]:
    scene = survey.scene
    side = float(np.abs(illuminated[:, :2]).max())
    if side > scene.transport.lateral_limit:
        text = f"lateral_limit = {scene.transport.lateral_limit:.4g} m cuts {name}, which is seen out to {side:.4g} m"
        yield warning("transport.lateral_limit", text, side=side)
    corners, bounds = to_world(scene.camera, triangles.reshape(-1, 3)), scene.domain.bounds
    low, high = corners.min(axis=0), corners.max(axis=0)
    if (low < bounds[0]).any() or (high > bounds[1]).any():
        text = (
            f"spans {vector(low)} to {vector(high)} m in the world; the water reaches from {vector(bounds[0])} to "
            f"{vector(bounds[1])} m: nothing outside is hit"
        )
        yield warning(name, text)


def _extent(survey: Survey, triangles: Points) -> str:
    corners = triangles.reshape(-1, 3)
    spans = ", ".join(
        f"{axis} {span(*ends)}" for axis, *ends in zip("xyz", corners.min(0), corners.max(0), strict=True)
    )
    return f"spans {spans} m" + (" in the camera frame" if survey.scene.camera.is_posed else "")


def _angles(points: Points, laser: Laser) -> Points:
    """Angles [rad] of the points against the beam's axis, seen from the laser."""
    away = points - np.array(laser.position)
    along = away @ np.array(laser.axis)
    return np.arctan2(np.linalg.norm(away - along[:, None] * np.array(laser.axis), axis=1), along)


def _beam_text(laser: Laser) -> str:
    if laser.profile == "collimated":
        return f"the beam is parallel with a radius of {laser.beam_radius:.3g} m"
    if laser.profile == "measured":
        wide, tall = (math.degrees(math.atan(tangent)) for tangent in profile_extent(laser))
        return f"the beam's image spans ±{wide:.3g}° and ±{tall:.3g}°"
    return f"the beam's half angle is {laser.half_angle_deg:.3g}°"
