"""Camera frames: which axis looks forward and which is up.

Everything that stands in a camera here (laser, normals, points) is in the optical frame; poses are given in the frame
that the caller's simulator uses.
"""

from typing import Any

import warp as wp

from spadwarp_kernels.base.arguments import check_choice

__all__ = ["CAMERA_FRAMES"]

CAMERA_FRAMES = {
    "optical": (0.0, 0.0, 0.0, 1.0),
    "opengl": (1.0, 0.0, 0.0, 0.0),
    "forward_left_up": (-0.5, 0.5, -0.5, 0.5),
}
"""Conventions of a camera's pose, and the rotation (x, y, z, w) that takes the optical frame there.

``optical``: +x right, +y down, +z forward (OpenCV; ROS, REP 103, `_optical` frames). ``opengl``: +x right, +y up, -z
forward (OpenGL, USD, Newton, MuJoCo). ``forward_left_up``: +x forward, +y left, +z up (ROS, REP 103, bodies).
"""


def optical_to(frame: Any) -> wp.transform:
    """The pose of the optical frame in a camera frame of `CAMERA_FRAMES`; raises `ArgumentError`."""
    check_choice("frame", frame, CAMERA_FRAMES)
    return wp.transform(wp.vec3(0.0), wp.quat(*CAMERA_FRAMES[frame]))
