"""The camera, its lens and its gate: origin at the lens centre, +z along the optical axis, +x right, +y down.

Image coordinates are in pixels, (0.5, 0.5) is the first pixel's centre. Tangents are x/z and y/z of a direction.
"""

import math
from typing import Any, NamedTuple

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.native import fill
from spadwarp_kernels.base.rotations import cos_sin_turn

from .port import Port

__all__ = ["C0", "CALIBRATED", "PLAIN", "SCANNED", "Camera", "Gate", "Lens", "make_camera", "make_gate"]


@wp.struct
class Camera:
    """A camera with a thin lens: a disc in the plane z = 0 that images one depth sharply."""

    width: int  # of the image [pixels]
    height: int  # of the image [pixels]
    pixel_tangent: float  # pixel pitch over image distance
    aperture_radius: float
    """Radius of the entrance pupil [m]; 0 makes the lens a point, which images all depths sharply."""
    aperture_area: float  # the area that collects light [m^2], also where the lens is a point
    inverse_focus: float  # 1 over the depth that is imaged sharply [1/m]; 0 is infinity
    focal: wp.vec2
    """Focal length in pixels along rows and columns. This and what follows is for `CALIBRATED` alone; for `PLAIN`,
    `launch_transport` computes what it needs of it."""
    principal: wp.vec2  # image coordinates of the optical axis
    radial: wp.vec3  # k1, k2, k3 of Brown's model
    tangential: wp.vec2  # p1, p2 of Brown's model
    view: wp.vec4  # least and largest tangents (left, top, right, bottom) of what the image shows: a box that holds it
    columns: int  # pixels of the receiver, which stand in one row, of `SCANNED` alone
    port: Port
    """What is between the lens and the water, see `make_flat_port`; read by specs with a port alone. View and focus are
    those in the air behind it."""


@wp.func
def image_tangents(camera: Camera, x: wp.vec3, o: wp.vec3) -> wp.vec2:
    """Tangents of the direction in which light from x through the lens point o is seen, for x[2] > 0: that in which the
    lens centre sees the point where their line meets the focus plane, x/z + o (1/focus - 1/z)."""
    inverse = 1.0 / x[2]
    return wp.vec2(
        (x[0] - o[0]) * inverse + camera.inverse_focus * o[0], (x[1] - o[1]) * inverse + camera.inverse_focus * o[1]
    )


@wp.func
def project(camera: Camera, view: wp.vec4, target: int, x: wp.vec3, o: wp.vec3) -> int:
    """Row-major index of the pixel that images the point x by way of the lens point o, or -1 outside the view; of a
    camera from `ready_camera`."""
    t = image_tangents(camera, x, o)
    column = t[0] * camera.focal[0] + camera.principal[0]
    row = t[1] * camera.focal[1] + camera.principal[1]
    # Compared as floats: a float beyond the int range has no defined int value. Also false for what is not a number.
    inside = column >= 0.0 and row >= 0.0 and column < float(camera.width) and row < float(camera.height)
    if not (inside and x[2] > 0.0):
        return -1
    return int(row) * camera.width + int(column)


@wp.func
def distort(camera: Camera, t: wp.vec2) -> wp.vec2:
    """Image coordinates at which the direction of tangents t through the lens centre is seen (Brown 1966)."""
    x = t[0]
    y = t[1]
    r2 = x * x + y * y
    radial = 1.0 + r2 * (camera.radial[0] + r2 * (camera.radial[1] + r2 * camera.radial[2]))
    p1 = camera.tangential[0]
    p2 = camera.tangential[1]
    column = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x)
    row = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y
    return wp.vec2(column * camera.focal[0] + camera.principal[0], row * camera.focal[1] + camera.principal[1])


@wp.func
def project_calibrated(camera: Camera, view: wp.vec4, target: int, x: wp.vec3, o: wp.vec3) -> int:
    """Row-major index of the pixel that images x by way of the lens point o, or -1 outside the view or the image, and
    for any pixel but the target where that is not negative."""
    if x[2] <= 0.0:
        return -1
    t = image_tangents(camera, x, o)
    # Beyond the view the polynomial may turn over and lead back into the image. Also false for what is not a number.
    if not (t[0] >= view[0] and t[1] >= view[1] and t[0] <= view[2] and t[1] <= view[3]):
        return -1
    place = distort(camera, t)
    column = wp.floor(place[0])
    row = wp.floor(place[1])
    if column < 0.0 or row < 0.0 or column >= float(camera.width) or row >= float(camera.height):
        return -1
    pixel = int(row) * camera.width + int(column)
    return wp.where(target >= 0 and pixel != target, -1, pixel)


@wp.func
def project_shot(camera: Camera, view: wp.vec4, target: int, x: wp.vec3, o: wp.vec3) -> int:
    """As `project` of the row of pixels with which a shot, `target`, sees."""
    t = image_tangents(camera, x, o)
    column = t[0] * camera.focal[0] + camera.principal[0]
    row = t[1] * camera.focal[1] + camera.principal[1]
    inside = column >= 0.0 and row >= 0.0 and column < float(camera.columns) and row < 1.0
    if not (inside and x[2] > 0.0):
        return -1
    return target * camera.columns + int(column)


@wp.func
def pixel_direction(camera: Camera, column: float, row: float) -> wp.vec3:
    """Unit direction from the lens centre through image coordinates in pixels; (0.5, 0.5) is the first pixel's
    centre."""
    return wp.normalize(
        wp.vec3(
            (column - 0.5 * float(camera.width)) * camera.pixel_tangent,
            (row - 0.5 * float(camera.height)) * camera.pixel_tangent,
            1.0,
        )
    )


@wp.func
def lens_point(camera: Camera, xi1: float, xi2: float) -> wp.vec3:
    """A uniform point on the aperture disc [m], for uniform xi1, xi2 in [0, 1)."""
    r = camera.aperture_radius * wp.sqrt(xi1)
    turn = cos_sin_turn(xi2)
    return wp.vec3(r * turn[0], r * turn[1], 0.0)


@wp.func
def clip_half_space(value: float, slope: float, interval: wp.vec2) -> wp.vec2:
    """The part of the interval of s in which value + slope s > 0."""
    # Selected rather than branched to: half the lanes of a warp go either way. For a flight along the plane the
    # crossing is infinite.
    crossing = -1.0 * value / slope
    rising = slope >= 0.0
    lower = wp.where(rising, wp.max(interval[0], crossing), interval[0])
    upper = wp.where(rising, interval[1], wp.min(interval[1], crossing))
    return wp.vec2(lower, upper)


def field(camera: Any) -> wp.vec4:
    """Tangents (left, top, right, bottom) of what the image shows, for square pixels about the optical axis."""
    tangent = np.float32(camera.pixel_tangent)
    half_width, half_height = (np.float32(0.5) * np.float32(size) * tangent for size in (camera.width, camera.height))
    return wp.vec4(-half_width, -half_height, half_width, half_height)


def ready_camera(copy: Any, camera: Any) -> None:
    """Readies a copy for a kernel with view, focal lengths and principal point of square pixels about the axis."""
    tangent = np.float32(camera.pixel_tangent)
    focal = float(1.0 / tangent) if tangent > 0.0 else 0.0  # 0 where nothing asks for an image
    middle = (0.5 * int(camera.width), 0.5 * int(camera.height))
    fill(copy, view=field(camera), focal=(focal, focal), principal=middle)


@wp.func
def clip_to_view(camera: Camera, view: wp.vec4, x: wp.vec3, u: wp.vec3, o: wp.vec3, limit: float) -> wp.vec2:
    """The part [s0, s1] of the flight x + s u, 0 <= s <= limit, that lies in the view as the lens point o sees it;
    empty where s0 >= s1."""
    # Sheared so that the side planes, which go through o and the view on the focus plane, go through the origin.
    slope_x = camera.inverse_focus * o[0]
    slope_y = camera.inverse_focus * o[1]
    y = wp.vec3(x[0] - o[0] + slope_x * x[2], x[1] - o[1] + slope_y * x[2], x[2])
    v = wp.vec3(u[0] + slope_x * u[2], u[1] + slope_y * u[2], u[2])
    # The planes meet at the origin: all of what is between them has z > 0.
    part = clip_half_space(view[2] * y[2] - y[0], view[2] * v[2] - v[0], wp.vec2(0.0, limit))
    part = clip_half_space(y[0] - view[0] * y[2], v[0] - view[0] * v[2], part)
    part = clip_half_space(view[3] * y[2] - y[1], view[3] * v[2] - v[1], part)
    return clip_half_space(y[1] - view[1] * y[2], v[1] - view[1] * v[2], part)


@wp.func
def in_view(camera: Camera, view: wp.vec4, x: wp.vec3) -> bool:
    """Whether any point of the lens may image x into the view; False is certain, up to rounding at its edge."""
    z = x[2]
    # Radius of the circle of confusion, at the distance of x.
    blur = camera.aperture_radius * wp.abs(z * camera.inverse_focus - 1.0)
    inside = wp.min(wp.min(x[0] - view[0] * z, view[2] * z - x[0]), wp.min(x[1] - view[1] * z, view[3] * z - x[1]))
    return z > 0.0 and inside > -blur


@wp.func
def in_field(camera: Camera, view: wp.vec4, x: wp.vec3) -> bool:
    """`in_view` of a view about the optical axis."""
    z = x[2]
    blur = camera.aperture_radius * wp.abs(z * camera.inverse_focus - 1.0)
    return wp.abs(x[0]) < view[2] * z + blur and wp.abs(x[1]) < view[3] * z + blur and z > 0.0


@wp.func
def toward_middle(view: wp.vec4, x: wp.vec3) -> wp.vec2:
    """Vector across the optical axis from x towards the middle of the view [m]."""
    depth = 0.5 * wp.max(x[2], 0.0)
    return wp.vec2(depth * (view[0] + view[2]) - x[0], depth * (view[1] + view[3]) - x[1])


@wp.func
def toward_axis(view: wp.vec4, x: wp.vec3) -> wp.vec2:
    """`toward_middle` of a view about the optical axis."""
    return wp.vec2(-1.0 * x[0], -1.0 * x[1])


def check_camera(name: str, camera: Any, *, calibrated: bool) -> None:
    """A camera that images something; raises `ArgumentError`."""
    check.kind(name, camera, Camera)
    check.fields(name, camera, dict.fromkeys(("width", "height"), "[1, inf)"))
    check.fields(name, camera, dict.fromkeys(("pixel_tangent", "aperture_area"), "(0, inf)"))
    check.fields(name, camera, dict.fromkeys(("aperture_radius", "inverse_focus"), "[0, inf)"))
    if not calibrated:
        return
    finite = dict.fromkeys(("principal", "radial", "tangential", "view"), "(-inf, inf)")
    check.fields(name, camera, {"focal": "(0, inf)", **finite})
    left, top, right, bottom = camera.view
    check.number(f"{name}.view, its right,", right, f"({float(left)}, inf)")
    check.number(f"{name}.view, its bottom,", bottom, f"({float(top)}, inf)")


# ---- The time gate: arrival times are kept as optical path lengths, path = time * c0 / n_g.


C0 = 299_792_458.0


@wp.struct
class Gate:
    """Equal bins of geometric path."""

    start: float  # path of the gate's begin [m]; bin k covers [start + k w, start + (k + 1) w)
    stop: float  # path at which it ends [m], before the last bin does if histories may not be as long
    bins_per_metre: float  # 1/w [1/m]
    bins: int  # number of bins


def make_camera(
    width: int,
    height: int,
    pixel_tangent: float,
    *,
    aperture_radius: float = 0.0,
    aperture_area: float | None = None,
    focus: float = math.inf,
) -> Camera:
    """A camera whose numbers fit each other, see `Camera`.

    Args:
        width, height: Of the image [pixels].
        pixel_tangent: Pixel pitch over focal length, such as 2 tan(fov / 2) / width.
        aperture_radius: Of the lens [m]; 0 images all depths sharply, and needs `aperture_area`.
        aperture_area: That collects light [m^2]; by default, and within 1 % of it, that of the radius.
        focus: Depth that is imaged sharply [m].

    Raises:
        ArgumentError: A number out of range, or an area that is not that of the radius.
    """
    width, height = check.integer("width", width, 1), check.integer("height", height, 1)
    pixel_tangent = check.number("pixel_tangent", pixel_tangent, "(0, inf)")
    radius = check.number("aperture_radius", aperture_radius, "[0, inf)")
    area = check.number("aperture_area", math.pi * radius**2 if aperture_area is None else aperture_area, "[0, inf)")
    if radius > 0.0 and abs(area - math.pi * radius**2) > 0.01 * math.pi * radius**2:
        disc = f"that of aperture_radius = {radius} m is {math.pi * radius**2:.4g} m^2"
        raise ArgumentError(f"aperture_area = {area} m^2, and {disc}; a lens of another area has aperture_radius = 0")
    if area == 0.0:
        raise ArgumentError("aperture_radius = 0 needs aperture_area [m^2]: a camera of no area sees nothing")
    inverse = 0.0 if focus == math.inf else 1.0 / check.number("focus", focus, "(0, inf)")
    made = fill(Camera(), width=width, height=height, pixel_tangent=pixel_tangent, aperture_radius=radius)
    return fill(made, aperture_area=area, inverse_focus=inverse)


def make_gate(bins: int, *, one_way_metres: tuple[float, float]) -> Gate:
    """A gate of equal bins, so many, between two distances from the camera [m].

    Raises:
        ArgumentError: A number out of range.
    """
    check.vector("one_way_metres", one_way_metres, size=2)
    start = check.number("one_way_metres[0]", one_way_metres[0], "[0, inf)")
    stop = check.number("one_way_metres[1]", one_way_metres[1], f"({start}, inf)")
    bins = check.integer("bins", bins, 1)
    return fill(Gate(), start=2.0 * start, stop=2.0 * stop, bins=bins, bins_per_metre=bins / (2.0 * (stop - start)))


BEFORE = wp.constant(-1)
AFTER = wp.constant(-2)


@wp.func
def gate_bin(gate: Gate, path: float) -> int:
    """Bin of a path length [m], or BEFORE or AFTER the gate."""
    # Selected rather than branched to: the lanes of a warp go either way.
    k = (path - gate.start) * gate.bins_per_metre
    inside = wp.where(k >= float(gate.bins) or path >= gate.stop, AFTER, int(k))
    return wp.where(path < gate.start, BEFORE, inside)


@wp.func
def clip_to_gate(gate: Gate, x: wp.vec3, u: wp.vec3, path: float, lens: wp.vec3, interval: wp.vec2) -> wp.vec2:
    """The part of the interval [s0, s1] of the flight x + s u whose light arrives within the gate by way of a lens
    point; empty where s0 >= s1. The arrival path s + r(s) rises with s, so that the gate cuts out an interval: it is L
    at s = (L^2 - |x|^2)/(2 (L - t_c)), x from the lens point, t_c = -x.u."""
    if interval[0] >= interval[1]:
        return interval

    y = x - lens
    distance = wp.length(y)
    t_c = -wp.dot(y, u)
    to_stop = gate.stop - path
    if to_stop <= distance:
        return wp.vec2(0.0, -1.0)
    lower = interval[0]
    # (L^2 - |x|^2) as a product: the difference of squares would cancel near the gate's end.
    upper = wp.min(interval[1], 0.5 * (to_stop - distance) * (to_stop + distance) / wp.max(to_stop - t_c, 1.0e-12))
    to_start = gate.start - path
    if to_start > distance:
        lower = wp.max(lower, 0.5 * (to_start - distance) * (to_start + distance) / wp.max(to_start - t_c, 1.0e-12))
    return wp.vec2(lower, upper)


# ---- Ways of imaging, as the transport kernels take them: with square pixels, and what a calibrated camera does.
# `view` holds the tangents (left, top, right, bottom) of what the photon at hand may be seen in: the view of the
# camera, or in a scan that of one pixel, `target` (else -1). o is a point of the lens.


class Lens(NamedTuple):
    """A way of imaging, as Warp functions for the camera that the transport kernel gets, see `Camera.focal`."""

    name: str  # "plain" or "calibrated"; identifies it in the kernel cache
    project: wp.Function  # (camera, view, target, x, o) -> the pixel that images x by way of o, or -1
    view: wp.Function
    """(camera, view) -> tangents (left, top, right, bottom) of a box that holds what the image, or the pixel of a scan,
    shows."""
    shows: wp.Function = in_view  # as `in_view`, for such a view without a port
    toward_middle: wp.Function = toward_middle  # as the function of that name, for such a view


@wp.func
def _view_plain(camera: Camera, view: wp.vec4) -> wp.vec4:
    return camera.view


@wp.func
def _view_calibrated(camera: Camera, view: wp.vec4) -> wp.vec4:
    return view


PLAIN = Lens("plain", project, _view_plain, in_field, toward_axis)
"""Square pixels about the optical axis: the first six attributes of `Camera`, the others stay 0."""

CALIBRATED = Lens("calibrated", project_calibrated, _view_calibrated)
"""Focal lengths and principal point in pixels, Brown's distortion: all of `Camera` but `columns`."""

SCANNED = Lens("scanned", project_shot, _view_calibrated)
"""A row of `Camera.columns` pixels that moves with the laser, see `Scan.pose`: the image holds shot after shot."""
