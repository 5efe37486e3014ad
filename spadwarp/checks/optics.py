"""The thin lens and the confocal scan."""

from __future__ import annotations

import math
from collections.abc import Iterator

import numpy as np

from spadwarp.checks.message import CheckMessage, note, warning
from spadwarp.checks.survey import Survey
from spadwarp.scene import Laser
from spadwarp.scene.camera import to_world
from spadwarp.scene.port import Port


def check_focus(survey: Survey) -> Iterator[CheckMessage]:
    """How far the lens is out of focus on what it sees."""
    camera = survey.scene.camera
    focus = survey.focus_distance
    if focus is None or survey.target_range is None or survey.distance is None:
        return
    seen = {distance: _apparent(survey, distance) for distance in survey.target_range}
    blur = {
        distance: 2.0 * camera.aperture_radius * abs(1.0 / seen_at - 1.0 / focus) / camera.pixel_tangent
        for distance, seen_at in seen.items()
    }
    worst = max(blur, key=blur.__getitem__)
    if blur[worst] > 1.0:
        text = (
            f"a point at {worst:.4g} m is blurred over {blur[worst]:.3g} pixels by a lens focused at "
            f"{focus:.4g} m; truth maps and the analytic simulator are sharp"
        )
        yield note("camera.focus_distance", text, distance=worst, pixels=blur[worst])


def _apparent(survey: Survey, distance: float) -> float:
    """Distance at which the lens sees a point on its axis at a range [m]."""
    port = survey.camera_port
    if port is None:
        return distance
    start, axis, lead, _ = port.enter((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    return port.apparent_distance(start + (distance - float(lead)) * axis)


def check_ports(survey: Survey) -> Iterator[CheckMessage]:
    """What a port makes of the view, and whether a surface is where the water ends."""
    scene, port = survey.scene, survey.camera_port
    if port is not None:
        left, top, right, bottom = scene.camera.view_box
        edges = np.array([[left, 0.0, 1.0], [right, 0.0, 1.0], [0.0, top, 1.0], [0.0, bottom, 1.0]])
        _, water, _, _ = port.enter((0.0, 0.0, 0.0), edges / np.linalg.norm(edges, axis=1, keepdims=True))
        angles = np.degrees(np.arctan2(water[[0, 1, 2, 3], [0, 0, 1, 1]], water[:, 2]))
        wide, tall = angles[1] - angles[0], angles[3] - angles[2]
        if not np.isfinite(wide + tall):
            yield warning("camera.port", "some of the view does not get through the port: it shows nothing there")
        else:
            text = f"through it the camera sees {wide:.3g} x {tall:.3g}° of the water; intrinsics are those in air"
            yield note("camera.port", text, wide_deg=float(wide), tall_deg=float(tall))
    low, high = np.array(scene.domain.bounds)
    for name, surface, place in (
        ("camera", scene.camera.port, np.array(scene.camera.position)),
        ("laser", scene.laser.port, to_world(scene.camera, scene.beam.position)),
    ):
        is_surface = isinstance(surface, Port) and surface.shape == "flat" and surface.thickness == 0.0
        if is_surface and (low <= place).all() and (place <= high).all():
            text = "without a window it is a calm surface, but no face of the domain ends the water there: domain"
            yield warning(f"{name}.port", text)


def check_scan(survey: Survey) -> Iterator[CheckMessage]:
    """Whether the beam of a confocal scan is where its pixel looks, and what of the detector is then one pixel's."""
    scene = survey.scene
    if scene.scan_positions == 1:
        return
    detector, laser = scene.detector, scene.beam
    if scene.laser.direction != Laser().direction:
        yield note("laser.direction", f"direction = {list(scene.laser.direction)} is not used: a scan aims the laser")
    snapped = math.degrees(math.acos(scene.transport.axis_threshold))
    pixel_deg = math.degrees(math.atan(scene.camera.pixel_tangent))
    if snapped > pixel_deg:
        text = (
            f"axis_threshold = {scene.transport.axis_threshold:g} scatters light within {snapped:.3g}° of the optical "
            f"axis as if it went along it, and a pixel sees {pixel_deg:.3g}°: 1 is exact"
        )
        yield warning("transport.axis_threshold", text, degrees=snapped, pixel_deg=pixel_deg)
    for name in ("crosstalk_probability", "dark_count_spread", "hot_pixel_fraction"):
        if value := getattr(detector, name):
            text = f"{name} = {value:g} is drawn between positions of the scan, where one pixel looks at all of them"
            yield note(f"detector.{name}", text, **{name: value})
    if survey.distance is None:
        return
    distance = survey.distance
    aside = math.hypot(*laser.position[:2]) * abs(1.0 - distance / scene.scan.distance)
    spot = laser.beam_radius if laser.profile == "collimated" else math.tan(min(laser.half_angle, 1.5)) * distance
    pixel = scene.camera.pixel_tangent * distance
    if aside > spot + pixel:
        text = (
            f"at {distance:.4g} m the beam is {aside:.3g} m beside what its pixel sees ({pixel:.3g} m wide, the spot's "
            f"radius is {spot:.3g} m): scan.distance makes them cross"
        )
        yield warning("scan.distance", text, aside=aside, spot=spot, pixel=pixel)
