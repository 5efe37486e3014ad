"""The shapes of each camera's world as one triangle mesh in the camera's optical frame, placed anew on the device."""

import math
from typing import Any

import numpy as np
import warp as wp

from .closed_forms import BOX, CAPSULE, CONE, CYLINDER, MESH, PLANE, SPHERE
from .shapes import Shapes, ShapeTable

wp.set_module_options({"enable_backward": False})

SEGMENTS, RINGS = 48, 24


def _revolution(profile: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """A surface of revolution from (radius, height, lift) rows: vertices [n, 4] of x, y, z and lift, and faces."""
    angle = 2.0 * np.pi * np.arange(SEGMENTS) / SEGMENTS
    # As much cross-section as the circle has: half of the polygon lies outside.
    size = math.sqrt(2.0 * np.pi / SEGMENTS / math.sin(2.0 * np.pi / SEGMENTS))
    radius = size * profile[:, :1]
    columns = [radius * np.cos(angle), radius * np.sin(angle)]
    columns += [np.broadcast_to(profile[:, k : k + 1], columns[0].shape) for k in (1, 2)]
    vertices = np.stack(columns, axis=-1).reshape(-1, 4)
    row = np.arange(len(profile) - 1)[:, None] * SEGMENTS
    here, there = np.arange(SEGMENTS), (np.arange(SEGMENTS) + 1) % SEGMENTS
    quads = np.stack([row + here, row + there, row + SEGMENTS + here, row + SEGMENTS + there], axis=-1).reshape(-1, 4)
    faces = quads[:, [0, 1, 2, 2, 1, 3]].reshape(-1, 3)
    corners = vertices[faces, :4]
    area = np.linalg.norm(
        np.cross(corners[:, 1, :3] - corners[:, 0, :3], corners[:, 2, :3] - corners[:, 0, :3]), axis=1
    )
    lifted = np.ptp(corners[..., 3], axis=1) > 0.0
    return vertices, faces[(area > 1e-9) | lifted]


def _profile(kind: int) -> np.ndarray:
    """(radius, height, lift) from the bottom to the top, of a shape of size 1."""
    if kind == CYLINDER:
        return np.array([(0.0, -1.0, 0.0), (1.0, -1.0, 0.0), (1.0, 1.0, 0.0), (0.0, 1.0, 0.0)])
    if kind == CONE:
        return np.array([(0.0, -1.0, 0.0), (1.0, -1.0, 0.0), (0.0, 1.0, 0.0)])
    angle = np.linspace(-0.5 * np.pi, 0.5 * np.pi, RINGS + 1)
    rows = np.stack([np.abs(np.cos(angle)), np.sin(angle), np.zeros_like(angle)], axis=1)
    rows[[0, -1], 0] = 0.0
    if kind == CAPSULE:
        low, high = rows[: RINGS // 2 + 1].copy(), rows[RINGS // 2 :].copy()
        low[:, 2], high[:, 2] = -1.0, 1.0
        return np.concatenate([low, high])
    return rows


def _unit_triangles(kind: int) -> tuple[np.ndarray, np.ndarray]:
    """Vertices [n, 4] and faces [m, 3] of a shape of size 1, see `_corner`."""
    if kind == PLANE:
        corners = [(-1, -1, 0, 0), (1, -1, 0, 0), (1, 1, 0, 0), (-1, 1, 0, 0)]
        return np.array(corners, float), np.array([(0, 1, 2), (0, 2, 3)])
    if kind == BOX:
        corners = np.array([(x, y, z, 0) for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], float)
        quads = np.array([(0, 1, 3, 2), (4, 6, 7, 5), (0, 4, 5, 1), (2, 3, 7, 6), (0, 2, 6, 4), (1, 5, 7, 3)])
        return corners, quads[:, [0, 1, 2, 0, 2, 3]].reshape(-1, 3)
    return _revolution(_profile(kind))


@wp.struct
class Corners:
    """Vertices of all cameras' meshes.

    Attributes:
        camera, shape: Of each vertex.
        unit: x, y, z of the vertex of a shape of size 1, and on which end of a capsule it is (lift).
        source: Index of the vertex in the shape's own `wp.Mesh`; -1 for other shapes.
    """

    camera: wp.array(dtype=int)
    shape: wp.array(dtype=int)
    unit: wp.array(dtype=wp.vec4)
    source: wp.array(dtype=int)


@wp.func
def _corner(kind: int, size: wp.vec3, unit: wp.vec4) -> wp.vec3:
    x = wp.vec3(unit[0], unit[1], unit[2])
    if kind == SPHERE:
        return size[0] * x
    if kind == CAPSULE:
        return size[0] * x + wp.vec3(0.0, 0.0, size[1] * unit[3])
    if kind == CYLINDER:
        return wp.vec3(size[0] * x[0], size[0] * x[1], size[1] * x[2])
    if kind == CONE:
        return wp.vec3(size[0] * x[0], size[0] * x[1], size[1] * x[2])
    if kind == PLANE:
        return wp.vec3(0.5 * size[0] * x[0], 0.5 * size[1] * x[1], 0.0)
    return wp.cw_mul(size, x)  # box, ellipsoid


@wp.kernel(enable_backward=False)
def _place_kernel(
    corners: Corners,
    table: ShapeTable,
    camera_q: wp.array(dtype=wp.transform),
    optical: wp.transform,
    reach: float,
    # Out:
    points: wp.array(dtype=wp.vec3),
):
    """Launch: vertices."""
    i = wp.tid()
    k = corners.shape[i]
    kind = table.kind[k]
    size = table.size[k]
    camera = wp.transform_multiply(camera_q[corners.camera[i]], optical)
    x = wp.vec3(0.0)
    if corners.source[i] >= 0:
        mesh = wp.mesh_get(table.mesh[k])
        x = wp.cw_mul(size, mesh.points[corners.source[i]])
    else:
        x = _corner(kind, size, corners.unit[i])
        if kind == PLANE:
            # Without a width it goes as far as the camera can see.
            below = wp.transform_point(wp.transform_inverse(table.pose[k]), wp.transform_get_translation(camera))
            for axis in range(2):
                if size[axis] <= 0.0:
                    x[axis] = below[axis] + reach * corners.unit[i][axis]
    points[i] = wp.transform_point(wp.transform_inverse(camera), wp.transform_point(table.pose[k], x))


@wp.kernel(enable_backward=False)
def _albedo_kernel(
    shape: wp.array(dtype=int),
    table: ShapeTable,
    # Out:
    reflectance: wp.array(dtype=float),
    corner_reflectance: wp.array(dtype=wp.vec3),
):
    """Launch: faces."""
    i = wp.tid()
    value = table.albedo[shape[i]]
    reflectance[i] = value
    if corner_reflectance.shape[0] > 0:
        corner_reflectance[i] = wp.vec3(value)


class CameraMeshes:
    """A triangle mesh for each camera, of what stands in its world.

    Attributes:
        meshes: A `wp.Mesh` for each camera, made by the first `place`.
        reflectance: Of each camera's faces.
        faces: Number of faces of each camera.
    """

    def __init__(self, shapes: Shapes, world: list[int], device: wp.Device) -> None:
        table = shapes.table
        kind, first, member = table.kind.numpy(), table.first.numpy(), table.member.numpy()
        ids = table.mesh.numpy()
        self.shapes, self.device = shapes, device
        own = {one.id: one for one in shapes.meshes}
        parts: dict[tuple[int, int], tuple[np.ndarray, np.ndarray]] = {}
        camera, shape, unit, source, self._indices, self.face_shape = [], [], [], [], [], []
        for v, w in enumerate(world):
            seen = np.concatenate([member[first[w] : first[w + 1]], member[first[-2] : first[-1]]])
            indices, owner, start = [], [], 0
            for k in seen.tolist():
                key = (int(kind[k]), int(ids[k]) if kind[k] == MESH else 0)
                if key not in parts:
                    parts[key] = _mesh_triangles(key[1], own, device) if kind[k] == MESH else _unit_triangles(key[0])
                vertices, faces = parts[key]
                count = len(vertices)
                camera.append(np.full(count, v))
                shape.append(np.full(count, k))
                unit.append(vertices)
                source.append(np.arange(count) if kind[k] == MESH else np.full(count, -1))
                indices.append(faces + start)
                owner.append(np.full(len(faces), k))
                start += count
            self._indices.append(np.concatenate(indices) if indices else np.zeros((0, 3), int))
            self.face_shape.append(np.concatenate(owner) if owner else np.zeros(0, int))
        self._ends = np.cumsum(
            [0, *(int(np.count_nonzero(np.concatenate([[], *camera]) == v)) for v in range(len(world)))]
        )
        self.corners = Corners()
        for name, rows, dtype in (("camera", camera, int), ("shape", shape, int), ("source", source, int)):
            setattr(self.corners, name, wp.array(np.concatenate([[], *rows]), dtype=dtype, device=device))
        self.corners.unit = wp.array(np.concatenate([np.zeros((0, 4)), *unit]), dtype=wp.vec4, device=device)
        self.points = wp.zeros(int(self._ends[-1]), dtype=wp.vec3, device=device)

    def place(self, camera_q: wp.array, optical: wp.transform, reach: float) -> None:
        """Writes all points for the poses of shapes and cameras."""
        inputs = [self.corners, self.shapes.table, camera_q, optical, reach]
        wp.launch(_place_kernel, self.points.size, inputs, [self.points], device=self.device)

    def build(self) -> list[wp.Mesh]:
        """Meshes, whose trees are built for where the points are now."""
        meshes = []
        for v, indices in enumerate(self._indices):
            points = self.points[int(self._ends[v]) : int(self._ends[v + 1])]
            indices = wp.array(indices.ravel(), dtype=int, device=self.device)
            # The fastest to walk, by measurement.
            kind: dict[str, Any] = {"bvh_constructor": "cubql", "bvh_leaf_size": 1} if self.device.is_cuda else {}
            meshes.append(wp.Mesh(points, indices, **kind))
        return meshes


def _mesh_triangles(mesh_id: int, own: dict[int, wp.Mesh], device: wp.Device) -> tuple[np.ndarray, np.ndarray]:
    """Stand-in vertices and the faces of a mesh that is known by its id."""
    if mesh_id in own:
        mesh = own[mesh_id]
        return np.zeros((mesh.points.size, 4)), mesh.indices.numpy().reshape(-1, 3)
    sizes = wp.zeros(2, dtype=int, device=device)
    wp.launch(_mesh_size_kernel, 1, [wp.uint64(mesh_id)], [sizes], device=device)
    points, count = sizes.numpy().tolist()
    indices = wp.zeros(count, dtype=int, device=device)
    wp.launch(_mesh_indices_kernel, count, [wp.uint64(mesh_id)], [indices], device=device)
    return np.zeros((points, 4)), indices.numpy().reshape(-1, 3)


@wp.kernel(enable_backward=False)
def _mesh_size_kernel(mesh: wp.uint64, sizes: wp.array(dtype=int)):
    m = wp.mesh_get(mesh)
    sizes[0] = m.points.shape[0]
    sizes[1] = m.indices.shape[0]


@wp.kernel(enable_backward=False)
def _mesh_indices_kernel(mesh: wp.uint64, indices: wp.array(dtype=int)):
    i = wp.tid()
    indices[i] = wp.mesh_get(mesh).indices[i]
