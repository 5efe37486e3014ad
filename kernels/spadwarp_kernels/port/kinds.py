"""Kinds of ports, as the transport kernels take them, and their parameters from lengths and indices."""

import math
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
import warp as wp

from spadwarp_kernels.arguments import ArgumentError, check_number, check_vector

from .dome import apparent_centre_dome, apparent_dome, connect_dome, cosines_dome, enter_dome, leave_dome
from .flat import apparent_centre_flat, apparent_flat, connect_flat, cosines_flat, enter_flat, leave_flat
from .port import Port

# Stands for no bound.
_FAR = 1.0e6


class PortKind(NamedTuple):
    """A kind of port; its name identifies it in the kernel cache.

    Attributes:
        name: "flat" or "dome".
        connect: Warp function (port, x, o) -> Connection from x in the water to o inside.
        apparent: Warp function (port, x, o, connection) -> the point from where the light of o seems to come at x [m].
        apparent_centre: Warp function (port) -> about that point for the lens's centre, at once [m].
        leave: Warp function (port, x, u) -> Passage of a ray from the water to the plane z = 0 inside.
        enter: Warp function (port, x, u) -> Passage of a ray from inside into the water.
        cosines: Warp function (port, x, u) -> vec4: index times cosine to the normal before and behind both interfaces,
            in the order of `transmission`, of the ray through x in the water along u, on its way in or out.
    """

    name: str
    connect: wp.Function
    apparent: wp.Function
    apparent_centre: wp.Function
    leave: wp.Function
    enter: wp.Function
    cosines: wp.Function


FLAT_PORT = PortKind("flat", connect_flat, apparent_flat, apparent_centre_flat, leave_flat, enter_flat, cosines_flat)
"""A plane window, or a calm surface without one."""

DOME_PORT = PortKind("dome", connect_dome, apparent_dome, apparent_centre_dome, leave_dome, enter_dome, cosines_dome)
"""A spherical window."""


def make_flat_port(
    *,
    distance: float,
    thickness: float = 0.0,
    normal: Sequence[float] = (0.0, 0.0, 1.0),
    index: Sequence[float],
    group_index: Sequence[float],
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    aperture_radius: float = 0.0,
    largest_angle: float = 1.5,
) -> Port:
    """The parameters of a plane window.

    Args:
        distance: From the camera's lens centre along the normal to the inner face [m].
        thickness: Of the window [m], >= 0.
        normal: Unit vector into the water.
        index, group_index: Of what is inside, of the window, of the water; >= 1.
        origin: The lens centre, or the position of a laser, which must be inside [m].
        aperture_radius: Of the camera [m]: all of the lens must be inside.
        largest_angle: Between the normal and any ray of the view, inside, in [0, pi/2) [rad].

    Raises:
        ArgumentError: A number out of its range.
    """
    check_number("distance", distance, "(-inf, inf)")
    check_vector("normal", normal, unit=True)
    _check_layers(thickness, index, group_index, origin, aperture_radius)
    check_number("largest_angle", largest_angle, "[0, 1.5707963]")
    tilt = aperture_radius * math.hypot(normal[0], normal[1])
    inside = distance - sum(x * n for x, n in zip(origin, normal, strict=True))
    if tilt >= inside:
        raise ArgumentError(
            f"distance = {distance} m: a lens or laser at {tuple(origin)} m of radius {aperture_radius} m reaches "
            "through the port"
        )
    port = _port(thickness, index, group_index)
    port.normal, port.distance = wp.vec3(*normal), distance
    n = tuple(port.index)
    slopes = [_slopes(n[0], n[k], largest_angle) for k in (1, 2)]
    port.glass_slope, port.water_slope = (wp.vec2(*bounds) for bounds in slopes)
    steepest = max(math.tan(largest_angle), slopes[0][1] * math.tan(largest_angle))
    longest = min(math.hypot(1.0, steepest), _FAR)
    _set_times(port, ((inside - tilt, (inside + tilt) * longest), (thickness, thickness * longest)))
    return port


def make_dome_port(
    *,
    radius: float,
    thickness: float,
    centre: Sequence[float] = (0.0, 0.0, 0.0),
    index: Sequence[float],
    group_index: Sequence[float],
    origin: Sequence[float] = (0.0, 0.0, 0.0),
    aperture_radius: float = 0.0,
    largest_angle: float = 1.5,
) -> Port:
    """The parameters of a spherical window.

    Args:
        radius: Of the inner sphere [m], > 0.
        thickness: Of the window [m], >= 0.
        centre: Of the spheres, from the camera's lens centre [m].
        index, group_index: Of what is inside, of the window, of the water; >= 1.
        origin: The lens centre, or the position of a laser, which must be inside [m].
        aperture_radius: Of the camera [m].
        largest_angle: Between the optical axis and any ray of the view, inside, in [0, pi/2) [rad].

    Raises:
        ArgumentError: A number out of its range, or a lens so far from the centre that some of its light could not get
            through.
    """
    check_number("radius", radius, "(0, 1e9]")
    check_vector("centre", centre)
    _check_layers(thickness, index, group_index, origin, aperture_radius)
    check_number("largest_angle", largest_angle, "[0, 1.5707963]")
    port = _port(thickness, index, group_index)
    port.radius, port.centre = radius, wp.vec3(*centre)
    n = tuple(port.index)
    furthest = math.dist(centre, origin) + aperture_radius
    if not furthest < min(1.0, n[1] / n[0], n[2] / n[0] * (1.0 + thickness / radius)) * radius:
        raise ArgumentError(
            f"centre = {tuple(centre)} m: a lens or laser reaches {furthest:g} m from it, too far for a dome of radius "
            f"{radius} m"
        )
    p, outer = np.linspace(0.0, n[0] * furthest, 257), radius + thickness
    angle = [np.arcsin(p / x) for x in (n[0] * radius, n[1] * radius, n[1] * outer, n[2] * outer)]
    turn = float(np.abs(angle[1] - angle[0] + angle[3] - angle[2]).max())
    widest = largest_angle + turn
    port.turn = math.sin(turn) / math.cos(widest) if widest < 1.57 else _FAR
    port.aside = max(1.0, n[0] / n[2]) * furthest
    b = n[0] * furthest / n[1]
    oblique = math.sqrt(outer**2 - b**2) - math.sqrt(radius**2 - b**2)
    _set_times(port, ((radius - furthest, radius + furthest), (thickness, oblique)))
    return port


def check_port(name: str, port: Port, kind: PortKind) -> None:
    """Parameters of a port of that kind; raises `ArgumentError`."""
    for k, value in enumerate(port.index):
        check_number(f"{name}.index[{k}]", value, "[1, inf)")
    if kind.name == FLAT_PORT.name:
        check_number(f"{name}.distance", port.distance, "(-inf, inf)")
        check_vector(f"{name}.normal", port.normal, unit=True)
    else:
        check_number(f"{name}.radius", port.radius, "(0, inf)")
        check_vector(f"{name}.centre", port.centre)


def _check_layers(
    thickness: float,
    index: Sequence[float],
    group_index: Sequence[float],
    origin: Sequence[float],
    aperture_radius: float,
) -> None:
    check_vector("origin", origin)
    check_number("thickness", thickness, "[0, 1e9]")
    check_number("aperture_radius", aperture_radius, "[0, 1e9]")
    for name, values in (("index", index), ("group_index", group_index)):
        check_vector(name, values)
        for k, value in enumerate(values):
            check_number(f"{name}[{k}]", value, "[1, inf)")


def _port(thickness: float, index: Sequence[float], group_index: Sequence[float]) -> Port:
    port = Port()
    port.thickness = thickness
    # A window without thickness has no faces, and must not be the layer of the least index.
    port.index = wp.vec3(index[0], index[1] if thickness > 0.0 else index[0], index[2])
    port.delay = wp.vec2(group_index[0] / group_index[2], group_index[1] / group_index[2])
    return port


def _slopes(inside: float, layer: float, angle: float) -> tuple[float, float]:
    """Least and largest tan(theta_layer)/tan(theta_inside) of rays within an angle of the normal; rising or falling."""
    rest = layer**2 - (inside * math.sin(angle)) ** 2
    oblique = inside * math.cos(angle) / math.sqrt(rest) if rest > 0.0 else _FAR
    return min(inside / layer, oblique), max(inside / layer, oblique)


def _set_times(port: Port, lengths: Sequence[tuple[float, float]]) -> None:
    """Bounds of a way's time, from the least and largest lengths in the layers.

    The ray is no shorter than the straight line, and by Fermat's principle its optical length is not longer.
    """
    early, late = 0.0, 0.0
    for k, (least, largest) in enumerate(lengths):
        delay, ratio = port.delay[k], port.index[k] / port.index[2]
        early += max(1.0 - delay, 0.0) * largest
        late += (ratio - 1.0) * (least if ratio < 1.0 else largest)
        late += (delay - ratio) * (least if delay < ratio else largest)
    port.early, port.late = early, late
