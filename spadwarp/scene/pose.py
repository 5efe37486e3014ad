"""Where a camera stands and looks: between the world, the camera's own frame and OpenCV's way to write a pose.

The world has the axes of a camera without a pose: +x right, +y down, +z forward. A camera at `position` whose own axes
are the columns of R sees the world's point X at Rᵀ(X − position); R = Rx·Ry·Rz of `rotation_deg`, as for targets.
"""

from __future__ import annotations

import math
import warnings

import numpy as np
from numpy.typing import ArrayLike, NDArray

from spadwarp.arrays import Floats
from spadwarp.values import ArgumentError

__all__ = ["look_at", "opencv_pose"]

Vector = tuple[float, float, float]


def rotation_matrix(rotation_deg: ArrayLike) -> NDArray[np.float64]:
    """Rx·Ry·Rz `[3, 3]`: rotations about x, then the new y, then the new z [°]."""
    angles = np.asarray(rotation_deg, np.float64)
    if angles.shape == (3,) and not angles.any():  # as in most scenes, which then do without scipy's import
        return np.eye(3)
    from scipy.spatial.transform import Rotation

    return Rotation.from_euler("XYZ", angles, degrees=True).as_matrix()


def rotation_angles(matrix: ArrayLike) -> Vector:
    """`rotation_deg` [°] of a rotation matrix: `rotation_matrix` undone, with 0 for the last angle where ry is ±90°."""
    from scipy.spatial.transform import Rotation

    with warnings.catch_warnings():
        warnings.simplefilter("ignore")  # of ry = ±90°, where only the sum of the other two angles is defined
        return vector_of(Rotation.from_matrix(matrix).as_euler("XYZ", degrees=True))


def turned(times: Floats, known: Floats, angles: Floats) -> Floats:
    """Rotation matrices `[N, 3, 3]` at times between those of known `rotation_deg` `[K, 3]`, by the shortest turns."""
    from scipy.spatial.transform import Rotation, Slerp

    turns = Rotation.from_euler("XYZ", angles, degrees=True)
    if len(known) < 2:
        return np.repeat(turns.as_matrix(), len(times), axis=0)
    return Slerp(known, turns)(np.minimum(times, known[-1])).as_matrix()


def opencv_pose(rvec: ArrayLike, tvec: ArrayLike) -> dict[str, Vector]:
    """`position` and `rotation_deg` of the camera that OpenCV calls (rvec, tvec), as `solvePnP` returns them.

    OpenCV maps a point X of the world to R·X + t of the camera, with R the rotation about rvec by |rvec| radians
    (Rodrigues): its position is −Rᵀt, and its axes are the rows of R. `rvec` is the rotation vector [rad], 3 numbers,
    or R `[3, 3]`; `tvec` t [m], 3 numbers. Returns fields of the scene's `camera` section. Raises `ArgumentError` for
    another number of values, or a matrix that is no rotation.
    """
    from scipy.spatial.transform import Rotation

    matrix, shift = np.asarray(rvec, np.float64), np.asarray(tvec, np.float64).ravel()
    if matrix.size not in (3, 9) or (matrix.size == 9 and matrix.shape != (3, 3)) or shift.size != 3:
        raise ArgumentError(f"rvec {np.shape(rvec)} and tvec {np.shape(tvec)}; 3 numbers (or [3, 3]) and 3 are needed")
    if matrix.size == 3:
        if not np.linalg.norm(matrix) <= 2.0 * math.pi:
            raise ArgumentError(f"rvec = {matrix.tolist()} turns by more than 2π; it is in radians")
        matrix = Rotation.from_rotvec(matrix.ravel()).as_matrix()
    elif not (np.allclose(matrix @ matrix.T, np.eye(3), atol=1e-6) and np.linalg.det(matrix) > 0):
        raise ArgumentError(f"rvec = {matrix.tolist()} is not a rotation matrix")
    return {"position": vector_of(-matrix.T @ shift), "rotation_deg": rotation_angles(matrix.T)}


def look_at(position: ArrayLike, point: ArrayLike, *, down: ArrayLike = (0.0, 1.0, 0.0)) -> dict[str, Vector]:
    """`position` and `rotation_deg` of a camera at a position in the world that looks at a point, both [m].

    `down` is the direction of the world that is downwards in the image, as far as the view allows. Returns fields of
    the scene's `camera` section. Raises `ArgumentError` for a point at the position, or along `down`.
    """
    place, end = np.asarray(position, np.float64), np.asarray(point, np.float64)
    forward = end - place
    right = np.cross(np.asarray(down, np.float64), forward)
    if not np.linalg.norm(right) > 1e-9 * np.linalg.norm(forward):
        level = np.asarray(down).tolist()
        raise ArgumentError(f"a camera at {place.tolist()} that looks at {end.tolist()} has no horizon: down = {level}")
    forward, right = forward / np.linalg.norm(forward), right / np.linalg.norm(right)
    axes = np.column_stack([right, np.cross(forward, right), forward])
    return {"position": vector_of(place), "rotation_deg": rotation_angles(axes)}


def sideways(down: Floats, azimuth_deg: float = 0.0) -> Floats:
    """Unit vector across an axis at an azimuth [°], 0 being the world's z axis, or where that has no such part x."""
    for axis in np.eye(3)[[2, 0]]:
        ahead = axis - (axis @ down) * down
        if np.linalg.norm(ahead) > 1e-6:
            break
    ahead /= np.linalg.norm(ahead)
    azimuth = math.radians(azimuth_deg)
    return math.cos(azimuth) * ahead + math.sin(azimuth) * np.cross(down, ahead)


def vector_of(values: NDArray[np.float64]) -> Vector:
    """An array of three numbers as a tuple."""
    return float(values[0]), float(values[1]), float(values[2])


def unit_vector(vector: Vector) -> Vector:
    """A vector over its length."""
    x, y, z = (part / math.hypot(*vector) for part in vector)
    return x, y, z
