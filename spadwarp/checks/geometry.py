"""Where things are: targets in the view, the beam, the gate and the water; focus, ports and the confocal scan."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.checks.survey import Survey
from spadwarp.scene import Laser
from spadwarp.scene.camera import image_points, to_world
from spadwarp.scene.laser import profile_extent
from spadwarp.scene.port import Port
from spadwarp.scene.sight import points_inside
from spadwarp.units import path_from_time

Points = NDArray[np.float64]

_AROUND = 2.0  # [ns] of a gate before and after a target


def check_targets(survey: Survey) -> None:
    """The targets, and where camera and laser stand."""
    scene = survey.scene
    if not scene.targets:
        survey.note("targets", "the scene has none: only the water scatters light back")
    for index in range(len(scene.targets)):
        triangles = survey.triangles[survey.target == index]
        if len(triangles):
            _check_target(survey, f"targets[{index}]", triangles)
    for index, target in enumerate(scene.targets):
        if target.specular > 0.0:
            text = (
                f"specular = {target.specular:g} acts in `simulate` alone: the analytic simulator, budgets and the "
                "signal named here take the target as Lambertian"
            )
            survey.note(f"targets[{index}].specular", text, specular=target.specular)
    (low, high), laser = scene.domain.bounds, to_world(scene.camera, scene.beam.position)
    for name, point in (("the lens", scene.camera.position), ("the laser", laser)):
        if any(not (a <= x <= b) for a, x, b in zip(low, point, high, strict=True)):
            text = f"{name} at {_vector(point)} m is outside the water, {_vector(low)} to {_vector(high)} m"
            survey.warn("domain", text)


def _vector(values: Any) -> str:
    """`(0, 1, 2.5)`"""
    return "(" + ", ".join(f"{value:.4g}" for value in np.asarray(values)) + ")"


def _check_target(survey: Survey, name: str, triangles: Points) -> None:
    """One target; where light cannot come back from it, the first reason alone."""
    scene, in_view = survey.scene, points_inside(triangles, survey.view)
    illuminated = survey.illuminated_part(triangles) if len(in_view) else in_view
    if _is_dark(survey, name, triangles, in_view, illuminated):
        return
    laser = scene.beam
    if laser.profile in ("uniform_cone", "gaussian") and scene.scan_positions == 1 and laser.half_angle_deg < 90.0:
        widest = math.degrees(float(_angles(in_view, laser).max()))
        if math.tan(math.radians(min(widest, 89.9))) > 2.0 * math.tan(laser.half_angle):
            text = (
                f"the beam misses most of what the camera sees of it: that reaches {widest:.3g}° off the axis, "
                f"{_beam_text(scene.laser)}"
            )
            survey.note("laser.half_angle_deg", text, widest_angle_deg=widest)
    _check_gate(survey, name, survey.paths(illuminated))
    side = float(np.abs(illuminated[:, :2]).max())
    if side > scene.transport.lateral_limit:
        text = f"lateral_limit = {scene.transport.lateral_limit:.4g} m cuts {name}, which is seen out to {side:.4g} m"
        survey.warn("transport.lateral_limit", text, side=side)
    corners, bounds = to_world(scene.camera, triangles.reshape(-1, 3)), scene.domain.bounds
    low, high = corners.min(axis=0), corners.max(axis=0)
    if (low < bounds[0]).any() or (high > bounds[1]).any():
        text = (
            f"spans {_vector(low)} to {_vector(high)} m in the world; the water reaches from {_vector(bounds[0])} to "
            f"{_vector(bounds[1])} m: nothing outside is hit"
        )
        survey.warn(name, text)
    extent = np.ptp(image_points(scene.camera, in_view[:, :2] / in_view[:, 2:]), axis=0)
    if extent.max() < 1.0:
        text = (
            f"smaller than a pixel, {extent[0]:.2g} x {extent[1]:.2g} of one: the truth maps may miss it, and what is "
            "beside it shares its pixel"
        )
        survey.warn(name, text, columns=float(extent[0]), rows=float(extent[1]))


def _is_dark(survey: Survey, name: str, triangles: Points, in_view: Points, illuminated: Points) -> bool:
    """Whether no light comes back from a target; says why."""
    scene, corners = survey.scene, triangles.reshape(-1, 3)
    ends = zip("xyz", corners.min(0), corners.max(0), strict=True)
    where = f"spans {', '.join(f'{axis} {low:.4g} to {high:.4g}' for axis, low, high in ends)} m"
    where += " in the camera frame" if scene.camera.is_posed else ""
    if not len(in_view):
        depth = float(triangles[..., 2].max())
        if depth <= 0:
            survey.warn(name, f"behind the camera: {where}", depth=depth)
            return True
        left, top, right, bottom = (depth * tangent for tangent in scene.camera.view_box)
        wide, tall = max(-left, right), max(-top, bottom)
        text = f"outside the view: {where}, the view at its far end is |x| < {wide:.3g}, |y| < {tall:.3g} m"
        survey.warn(name, text, half_width=wide, half_height=tall, depth=depth)
        return True
    nearest = float(np.linalg.norm(in_view, axis=1).min())
    if nearest <= scene.camera.aperture_radius:
        survey.warn(name, f"reaches the lens ({where}): translation moves it away", nearest=nearest)
    elif not len(illuminated):
        angles = np.degrees(_angles(in_view, scene.beam))
        text = (
            f"the beam misses what the camera sees of it: {where}, that is {angles.min():.3g} to {angles.max():.3g}° "
            f"off the axis, {_beam_text(scene.laser)}"
        )
        survey.warn(name, text, nearest_angle_deg=float(angles.min()))
    return nearest <= scene.camera.aperture_radius or not len(illuminated)


def _check_gate(survey: Survey, name: str, paths: Points) -> None:
    scene = survey.scene
    first, last = survey.arrival_ns(float(paths.min())), survey.arrival_ns(float(paths.max()))
    start, stop = scene.gate.start * 1e9, scene.gate.stop * 1e9
    if first < start or last > stop or first >= stop:
        partly = "" if first >= stop or last < start else "partly "
        begin = max(0.0, math.floor(first - _AROUND))
        bins = math.ceil(1e3 * (last + _AROUND - begin) / scene.gate.bin_width_ps)
        advice = "`spadwarp plan` proposes one"
        if bins <= 1_000_000:
            advice = f"start_ns = {begin:g} and bins = {bins} hold it, and `spadwarp plan` proposes a gate"
        text = (
            f"{partly}outside the gate: its light comes back from {first:.5g} to {last:.5g} ns, the gate is open from "
            f"{start:.5g} to {stop:.5g} ns; {advice}"
        )
        survey.warn(name, text, first_ns=first, last_ns=last, start_ns=start, stop_ns=stop)
    limit = scene.path_limit
    if paths.max() > limit < path_from_time(scene.gate.stop, scene.medium.group_index):
        text = f"max_path = {limit:.4g} m ends photons before they return from {name}, up to {paths.max():.4g} m"
        survey.warn("transport.max_path", text, max_path=limit, path=float(paths.max()))


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


def check_focus(survey: Survey) -> None:
    """How far the lens is out of focus on what it sees."""
    camera, focus, port = survey.scene.camera, survey.focus_distance, survey.camera_port
    if focus is None or survey.target_range is None or survey.on_axis is None:
        return

    def blur(distance: float) -> float:
        """Of a point at a range on the axis [pixels]."""
        apparent = distance
        if port is not None:
            start, axis, lead, _ = port.enter((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
            apparent = port.apparent_distance(start + (distance - float(lead)) * axis)
        return 2.0 * camera.aperture_radius * abs(1.0 / apparent - 1.0 / focus) / camera.pixel_tangent

    worst = max(survey.target_range, key=blur)
    if (pixels := blur(worst)) > 1.0:
        text = (
            f"a point at {worst:.4g} m is blurred over {pixels:.3g} pixels by a lens focused at "
            f"{focus:.4g} m; truth maps and the analytic simulator are sharp"
        )
        survey.note("camera.focus_distance", text, distance=worst, pixels=pixels)


def check_ports(survey: Survey) -> None:
    """The view through a port, and whether a surface is where the water ends."""
    scene, port = survey.scene, survey.camera_port
    if port is not None:
        left, top, right, bottom = scene.camera.view_box
        edges = np.array([[left, 0.0, 1.0], [right, 0.0, 1.0], [0.0, top, 1.0], [0.0, bottom, 1.0]])
        _, water, _, _ = port.enter((0.0, 0.0, 0.0), edges / np.linalg.norm(edges, axis=1, keepdims=True))
        angles = np.degrees(np.arctan2(water[[0, 1, 2, 3], [0, 0, 1, 1]], water[:, 2]))
        wide, tall = angles[1] - angles[0], angles[3] - angles[2]
        if not np.isfinite(wide + tall):
            survey.warn("camera.port", "some of the view does not get through the port: it shows nothing there")
        else:
            text = f"through it the camera sees {wide:.3g} x {tall:.3g}° of the water; intrinsics are those in air"
            survey.note("camera.port", text, wide_deg=float(wide), tall_deg=float(tall))
    low, high = np.array(scene.domain.bounds)
    for name, surface, place in (
        ("camera", scene.camera.port, np.array(scene.camera.position)),
        ("laser", scene.laser.port, to_world(scene.camera, scene.beam.position)),
    ):
        is_surface = isinstance(surface, Port) and surface.shape == "flat" and surface.thickness == 0.0
        if is_surface and (low <= place).all() and (place <= high).all():
            text = "without a window it is a calm surface, but no face of the domain ends the water there: domain"
            survey.warn(f"{name}.port", text)


def check_scan(survey: Survey) -> None:
    """Whether the beam of a confocal scan is where its pixel looks, and what of the detector is then one pixel's."""
    scene = survey.scene
    if scene.scan_positions == 1:
        return
    laser = scene.beam
    if scene.laser.direction != Laser().direction:
        survey.note("laser.direction", f"direction = {list(scene.laser.direction)} is not used: a scan aims the laser")
    snapped = math.degrees(math.acos(scene.transport.axis_threshold))
    pixel_deg = math.degrees(math.atan(scene.camera.pixel_tangent))
    if snapped > pixel_deg:
        text = (
            f"axis_threshold = {scene.transport.axis_threshold:g} scatters light within {snapped:.3g}° of the optical "
            f"axis as if it went along it, and a pixel sees {pixel_deg:.3g}°: 1 is exact"
        )
        survey.warn("transport.axis_threshold", text, degrees=snapped, pixel_deg=pixel_deg)
    for name in ("crosstalk_probability", "dark_count_spread", "hot_pixel_fraction"):
        if value := getattr(scene.detector, name):
            text = f"{name} = {value:g} is drawn between positions of the scan, where one pixel looks at all of them"
            survey.note(f"detector.{name}", text, **{name: value})
    if survey.on_axis is None:
        return
    distance = survey.on_axis.distance
    aside = math.hypot(*laser.position[:2]) * abs(1.0 - distance / scene.scan.distance)
    spot = laser.beam_radius if laser.profile == "collimated" else math.tan(min(laser.half_angle, 1.5)) * distance
    pixel = scene.camera.pixel_tangent * distance
    if aside > spot + pixel:
        text = (
            f"at {distance:.4g} m the beam is {aside:.3g} m beside what its pixel sees ({pixel:.3g} m wide, the spot's "
            f"radius is {spot:.3g} m): scan.distance makes them cross"
        )
        survey.warn("scan.distance", text, aside=aside, spot=spot, pixel=pixel)
