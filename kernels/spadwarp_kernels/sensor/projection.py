"""Ways of imaging, as the transport kernels take them: a plain pinhole, and what a calibrated camera does.

In what follows `view` holds the tangents (left, top, right, bottom) of what the photon at hand may be seen in: the view
of the camera, or in a scan that of one pixel, `target` (else -1). o is a point of the lens.
"""

from typing import NamedTuple

import warp as wp

from .camera import Camera, clip_to_planes, field, in_view, project, project_calibrated
from .visibility import may_be_hidden, may_be_hidden_in


class Lens(NamedTuple):
    """A way of imaging; its name identifies it in the kernel cache.

    Attributes:
        name: "pinhole" or "calibrated".
        project: Warp function (camera, view, target, x, o) -> the pixel that images x by way of o, or -1.
        clip: Warp function (camera, view, x, u, o, limit) -> the part [s0, s1] of the flight x + s u, 0 <= s <= limit,
            that holds all of it that the view shows by way of o; empty where s0 >= s1.
        may_be_hidden: Warp function (camera, near depth map, x) -> whether a point that is seen may have something
            before it.
        in_view: Warp function (camera, view, target, x) -> whether x lies in the view, up to rounding.
        toward_axis: Warp function (view, x) -> vector across the optical axis from x towards the middle of the view.
    """

    name: str
    project: wp.Function
    clip: wp.Function
    may_be_hidden: wp.Function
    in_view: wp.Function
    toward_axis: wp.Function


@wp.func
def _project_pinhole(camera: Camera, view: wp.vec4, target: int, x: wp.vec3, o: wp.vec3) -> int:
    return project(camera, x)


@wp.func
def _clip_pinhole(camera: Camera, view: wp.vec4, x: wp.vec3, u: wp.vec3, o: wp.vec3, limit: float) -> wp.vec2:
    return clip_to_planes(field(camera), x, u, limit)


@wp.func
def _in_view_pinhole(camera: Camera, view: wp.vec4, target: int, x: wp.vec3) -> bool:
    return in_view(camera, x)


@wp.func
def _toward_axis_pinhole(view: wp.vec4, x: wp.vec3) -> wp.vec3:
    return wp.vec3(-x[0], -x[1], 0.0)


@wp.func
def _clip_calibrated(camera: Camera, view: wp.vec4, x: wp.vec3, u: wp.vec3, o: wp.vec3, limit: float) -> wp.vec2:
    # Side planes through o and the field on the focus plane: x - o + z (o/focus - tangent) > 0.
    shift = camera.thin * camera.inverse_focus
    left = view[0] - shift * o[0]
    top = view[1] - shift * o[1]
    right = view[2] - shift * o[0]
    bottom = view[3] - shift * o[1]
    return clip_to_planes(wp.vec4(left, top, right, bottom), x - camera.thin * o, u, limit)


@wp.func
def _in_view_calibrated(camera: Camera, view: wp.vec4, target: int, x: wp.vec3) -> bool:
    return project_calibrated(camera, view, target, x, wp.vec3(0.0, 0.0, 0.0)) >= 0


@wp.func
def _toward_axis_calibrated(view: wp.vec4, x: wp.vec3) -> wp.vec3:
    depth = 0.5 * wp.max(x[2], 0.0)
    return wp.vec3(depth * (view[0] + view[2]) - x[0], depth * (view[1] + view[3]) - x[1], 0.0)


PINHOLE = Lens("pinhole", _project_pinhole, _clip_pinhole, may_be_hidden, _in_view_pinhole, _toward_axis_pinhole)
"""Square pixels about the optical axis, everything sharp: the first five attributes of `Camera`."""

CALIBRATED = Lens(
    "calibrated", project_calibrated, _clip_calibrated, may_be_hidden_in, _in_view_calibrated, _toward_axis_calibrated
)
"""Focal lengths and principal point in pixels, Brown's distortion, pinhole or thin lens: all of `Camera`."""
