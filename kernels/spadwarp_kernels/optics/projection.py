"""Ways of imaging, as the transport kernels take them: with square pixels, and what a calibrated camera does.

In what follows `view` holds the tangents (left, top, right, bottom) of what the photon at hand may be seen in: the view
of the camera, or in a scan that of one pixel, `target` (else -1). o is a point of the lens.
"""

from typing import NamedTuple

import warp as wp

from .camera import (
    Camera,
    in_field,
    in_view,
    project,
    project_about_axis,
    project_calibrated,
    toward_axis,
    toward_middle,
)

__all__ = ["CALIBRATED", "PLAIN", "Lens"]


class Lens(NamedTuple):
    """A way of imaging; its name identifies it in the kernel cache.

    Attributes:
        name: "plain" or "calibrated".
        project: Warp function (camera, view, target, x, o) -> the pixel that images x by way of o, or -1.
        view: Warp function (camera, view) -> tangents (left, top, right, bottom) of a box that holds what the image,
            or the pixel of a scan, shows.
        shows: As `in_view`, for such a view without a port.
        image: As `project`, for the camera that the transport kernel gets, see `Camera.focal`; None: `project`.
        toward_middle: As the function of that name, for such a view.
    """

    name: str
    project: wp.Function
    view: wp.Function
    shows: wp.Function = in_view
    image: wp.Function | None = None
    toward_middle: wp.Function = toward_middle


@wp.func
def _project_plain(camera: Camera, view: wp.vec4, target: int, x: wp.vec3, o: wp.vec3) -> int:
    return project(camera, x, o)


@wp.func
def _image_plain(camera: Camera, view: wp.vec4, target: int, x: wp.vec3, o: wp.vec3) -> int:
    return project_about_axis(camera, x, o)


@wp.func
def _view_plain(camera: Camera, view: wp.vec4) -> wp.vec4:
    return camera.view


@wp.func
def _view_calibrated(camera: Camera, view: wp.vec4) -> wp.vec4:
    return view


PLAIN = Lens("plain", _project_plain, _view_plain, in_field, _image_plain, toward_axis)
"""Square pixels about the optical axis: the first six attributes of `Camera`, the others stay 0."""

CALIBRATED = Lens("calibrated", project_calibrated, _view_calibrated)
"""Focal lengths and principal point in pixels, Brown's distortion: all of `Camera`."""
