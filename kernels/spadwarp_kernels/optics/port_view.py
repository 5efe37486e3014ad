"""What a camera sees of the water behind a port: parts of flights that hold all of it, and a little more.

What they hold beside it is rejected by its pixel: densities may be too wide, not too narrow.
"""

from typing import NamedTuple

import warp as wp

from .camera import Camera, clip_half_space, clip_to_view, in_view
from .gate import Gate, clip_to_gate
from .port import DOME_PORT, FLAT_PORT, Port, PortKind


class PortView(NamedTuple):
    """Warp functions for one kind of port, or none.

    Attributes:
        clip: As `clip_to_view`, holding the part that lies in the view.
        shows: As `in_view`.
        clip_gate: (camera, gate, x, u, path, lens, interval) -> the part whose light arrives within the gate.
    """

    clip: wp.Function
    shows: wp.Function
    clip_gate: wp.Function


@wp.func
def _clip_gate_bare(
    camera: Camera, gate: Gate, x: wp.vec3, u: wp.vec3, path: float, lens: wp.vec3, interval: wp.vec2
) -> wp.vec2:
    return clip_to_gate(gate, x, u, path, lens, interval)


@wp.func
def clip_gate_behind_port(
    camera: Camera, gate: Gate, x: wp.vec3, u: wp.vec3, path: float, lens: wp.vec3, interval: wp.vec2
) -> wp.vec2:
    """As `clip_to_gate`, for the least and the largest time that the port may save against the straight line."""
    wide = Gate()
    wide.start = gate.start - camera.port.late
    wide.stop = gate.stop + camera.port.early
    return clip_to_gate(wide, x, u, path, lens, interval)


@wp.func
def _side(view: wp.vec4, k: int) -> wp.vec3:
    """Side plane k of a view (left, top, right, bottom): a normal outwards, for planes through the origin."""
    if k == 0:
        return wp.vec3(-1.0, 0.0, view[0])
    if k == 1:
        return wp.vec3(0.0, -1.0, view[1])
    if k == 2:
        return wp.vec3(1.0, 0.0, -view[2])
    return wp.vec3(0.0, 1.0, -view[3])


@wp.func
def _view_from(camera: Camera, view: wp.vec4, o: wp.vec3) -> wp.vec4:
    """Tangents of the directions in which the lens point o sees the view."""
    x = camera.inverse_focus * o[0]
    y = camera.inverse_focus * o[1]
    return wp.vec4(view[0] - x, view[1] - y, view[2] - x, view[3] - y)


@wp.func
def _rise(port: Port, beyond: float, outward: float, largest: bool) -> float:
    """By how much a side plane lies further out for a point that is seen nearer than it is, along the normal.

    Rays go as if straight to a point whose depths in glass and water are shorter by the ratio of the tangents; ratios
    are taken at that end of their range which widens the view.
    """
    take = wp.where(largest, 1, 0)
    return -outward * (port.thickness * (port.glass_slope[take] - 1.0) + beyond * (port.water_slope[take] - 1.0))


@wp.func
def clip_to_flat_view(camera: Camera, view: wp.vec4, x: wp.vec3, u: wp.vec3, o: wp.vec3, limit: float) -> wp.vec2:
    """As `clip_to_view` behind a flat port: holds all that the lens point o sees."""
    port = camera.port
    beyond = wp.dot(x, port.normal) - port.distance - port.thickness
    climb = wp.dot(u, port.normal)
    seen = _view_from(camera, view, o)
    interval = clip_half_space(beyond, climb, wp.vec2(0.0, limit))
    for k in range(4):
        side = _side(seen, k)
        outward = wp.dot(side, port.normal)
        slope = port.water_slope[wp.where(outward < 0.0, 1, 0)] - 1.0
        value = _rise(port, beyond, outward, outward < 0.0) - wp.dot(side, x - o)
        interval = clip_half_space(value, -wp.dot(side, u) - outward * climb * slope, interval)
    return interval


@wp.func
def flat_view_shows(camera: Camera, view: wp.vec4, x: wp.vec3) -> bool:
    """As `in_view` behind a flat port; False is certain."""
    port = camera.port
    beyond = wp.dot(x, port.normal) - port.distance - port.thickness
    shown = beyond > 0.0
    for k in range(4):
        side = _side(view, k)
        outward = wp.dot(side, port.normal)
        value = float(-1.0e30)
        for end in range(2):
            near = port.thickness * (port.glass_slope[end] - 1.0) + beyond * (port.water_slope[end] - 1.0)
            blur = camera.aperture_radius * wp.abs((x[2] + near * port.normal[2]) * camera.inverse_focus - 1.0)
            value = wp.max(value, blur - outward * near)
        shown = shown and value > wp.dot(side, x)
    return shown


@wp.func
def _dome_side(port: Port, side: wp.vec3) -> wp.vec3:
    """A side plane through the dome's centre that holds all rays, which are bent and pass the centre aside."""
    return wp.normalize(side) - wp.vec3(0.0, 0.0, port.turn)


@wp.func
def clip_to_dome_view(camera: Camera, view: wp.vec4, x: wp.vec3, u: wp.vec3, o: wp.vec3, limit: float) -> wp.vec2:
    """As `clip_to_view` behind a dome: holds all that the lens point o sees."""
    port = camera.port
    seen = _view_from(camera, view, o)
    interval = wp.vec2(0.0, limit)
    for k in range(4):
        side = _dome_side(port, _side(seen, k))
        value = port.aside * (1.0 + port.turn) - wp.dot(side, x - port.centre)
        interval = clip_half_space(value, -wp.dot(side, u), interval)
    return interval


@wp.func
def dome_view_shows(camera: Camera, view: wp.vec4, x: wp.vec3) -> bool:
    """As `in_view` behind a dome; False is certain."""
    port = camera.port
    blur = camera.aperture_radius * camera.inverse_focus
    wide = wp.vec4(view[0] - blur, view[1] - blur, view[2] + blur, view[3] + blur)
    y = x - port.centre
    shown = wp.length(y) > port.radius + port.thickness
    for k in range(4):
        shown = shown and wp.dot(_dome_side(port, _side(wide, k)), y) < port.aside * (1.0 + port.turn)
    return shown


_BARE = PortView(clip_to_view, in_view, _clip_gate_bare)
_VIEWS = {
    FLAT_PORT.name: PortView(clip_to_flat_view, flat_view_shows, clip_gate_behind_port),
    DOME_PORT.name: PortView(clip_to_dome_view, dome_view_shows, clip_gate_behind_port),
}


def port_view(port: PortKind | None) -> PortView:
    """What a camera sees behind a kind of port; None: without one."""
    return _BARE if port is None else _VIEWS[port.name]
