"""What stands in the worlds: shapes on bodies, as the arrays that a simulator has on the device."""

import gc
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base.arguments import (
    ArgumentError,
    check_array,
    check_device,
    check_integer,
    check_items,
    check_kind,
    check_struct,
)
from spadwarp_kernels.surface.mesh import Textures, no_textures
from spadwarp_kernels.surface.reflectance import texture_at

from .closed_forms import MESH, SHAPE_KINDS, ShapeHit, intersect_shape

__all__ = ["Shapes", "make_shapes"]

wp.set_module_options({"enable_backward": False})

_FAR = wp.constant(1.0e10)


@wp.struct
class ShapeTable:
    """Shapes of all worlds as kernels take them. The arrays may be the simulator's own, and may change in place."""

    kind: wp.array[int]  # index into SHAPE_KINDS, [shapes]
    # [m], [shapes]. Plane: full width along x and y, 0 for none. Sphere: radius. Capsule, cylinder, cone: radius and
    # half the height along z. Ellipsoid: half axes. Box: half edges. Mesh: factors of its points
    size: wp.array[wp.vec3]
    body: wp.array[int]  # index of the pose that carries the shape, -1 for none, [shapes]
    local: wp.array[wp.transform]  # pose of the shape on its body, [shapes]
    mesh: wp.array[wp.uint64]  # id of a `wp.Mesh`, which shapes may share; 0 for the other kinds, [shapes]
    reflectance: wp.array[float]  # Lambertian, in [0, 1], [shapes]
    # where each world's shapes begin in `member`, [worlds + 2]; those of all worlds are the last
    first: wp.array[int]
    member: wp.array[int]  # shapes in the order of their worlds
    # of a textured mesh, its first row in `textures.face` and `textures.coordinates`; -1 for none
    first_face: wp.array[int]
    textures: Textures  # images on the faces of meshes, which multiply the reflectance; see `make_textures`
    pose: wp.array[wp.transform]  # of each shape in its world, written by `move_shapes`, [shapes]


@dataclass(frozen=True)
class Shapes:
    """Shapes of all worlds, from `make_shapes`, `newton_shapes` or `mujoco_shapes`.

    Attributes:
        table: The struct that kernels take.
        worlds: Number of worlds.
        device: Warp device of the arrays.
        meshes: Meshes that are kept alive with the shapes.
        bodies: Number of poses that `move_shapes` needs.
    """

    table: ShapeTable
    worlds: int
    device: wp.Device
    meshes: tuple[wp.Mesh, ...] = ()
    bodies: int = 0

    def __len__(self) -> int:
        return int(self.table.kind.size)


def make_shapes(
    kind: Any,
    size: Any,
    *,
    body: Any = None,
    local: Any = None,
    mesh: Any = None,
    reflectance: Any = 0.2,
    world: Any = None,
    worlds: int = 1,
    visible: Any = None,
    first_face: Any = None,
    textures: "Textures | None" = None,
    device: wp.DeviceLike = None,
) -> Shapes:
    """Shapes from arrays `[shapes]` of NumPy, lists, or Warp arrays, which are kept and not copied.

    Args:
        kind: Names or indices of SHAPE_KINDS.
        size: [m], see `ShapeTable`.
        body: -1, the default, stands still in its world.
        local: Poses on the bodies (x, y, z, qx, qy, qz, qw).
        mesh: `wp.Mesh` objects, or ids of such; None or 0 for the other kinds. The shapes keep them alive.
        reflectance: A number, or one for each shape.
        world: Index of the world of each shape, -1 for a shape that stands in all; read once, on the host. By default
            all stand in world 0, or in all worlds if there are several.
        worlds: Number of worlds.
        visible: Whether cameras see a shape; all by default. Read once, as `world`.
        first_face, textures: See `ShapeTable`.
        device: Where the arrays are.

    Raises:
        ArgumentError: Arrays of another length or on another device, values out of range, or a world or mesh that
            there is not.
    """
    device = check_device("device", device)
    worlds = check_integer("worlds", worlds, 1, 1 << 24)
    table = ShapeTable()
    if not isinstance(kind, wp.array):
        kind = np.array([SHAPE_KINDS.index(one) if one in SHAPE_KINDS else one for one in check_items("kind", kind)])
        if kind.dtype.kind not in "iu" or kind.size == 0:
            raise ArgumentError(
                f"kind = {kind.tolist()} is not a list of {', '.join(SHAPE_KINDS)}, or of their indices"
            )
    count = kind.shape[0]

    def on_device(name: str, value: Any, dtype: Any, default: Any) -> wp.array:
        if value is None:
            value = default
        if isinstance(value, wp.array):
            return check_array(name, value, dtype, (count,), device)
        try:
            width = wp.types.type_size(dtype)
            shape = (count, width) if width > 1 else (count,)
            rows = np.broadcast_to(np.asarray(value, np.uint64 if dtype == wp.uint64 else np.float64), shape)
        except (TypeError, ValueError, OverflowError):
            raise ArgumentError(f"{name} does not fit {count} shapes, [shapes] of {dtype.__name__}") from None
        scalar = {wp.int32: np.int32, wp.uint64: np.uint64}.get(dtype, np.float32)
        if not (np.isfinite(rows).all() and (np.abs(rows) <= np.finfo(np.float32).max).all()):
            raise ArgumentError(f"{name} is not finite for some of {count} shapes")
        if dtype == wp.int32 and not (rows == np.clip(np.rint(rows), -(2**31), 2**31 - 1)).all():
            raise ArgumentError(f"{name} is not an integer of 32 bits for some of {count} shapes")
        return wp.array(rows.astype(scalar), dtype=dtype, device=device)

    meshes: tuple[wp.Mesh, ...] = ()
    if mesh is not None and not isinstance(mesh, wp.array):
        mesh = check_items("mesh", mesh)
        meshes = tuple(one for one in mesh if isinstance(one, wp.Mesh))
        mesh = [one.id if isinstance(one, wp.Mesh) else check_integer("mesh", one or 0, 0, 2**64 - 1) for one in mesh]
    table.kind = on_device("kind", kind, wp.int32, None)
    table.size = on_device("size", size, wp.vec3, None)
    table.body = on_device("body", body, wp.int32, -1)
    table.local = on_device("local", local, wp.transform, (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0))
    table.mesh = on_device("mesh", mesh, wp.uint64, 0)
    table.reflectance = on_device("reflectance", reflectance, wp.float32, None)
    table.first_face = on_device("first_face", first_face, wp.int32, -1)
    if textures is not None:
        check_struct("textures", textures, Textures)
    table.textures = no_textures(device) if textures is None else textures
    if world is None:
        world = np.full(count, 0 if worlds == 1 else -1)
    world = _plain_array("world", world)
    if world.shape != (count,) or world.dtype.kind not in "iu" or world.min() < -1 or world.max() >= worlds:
        raise ArgumentError(f"world is not one of -1 to {worlds - 1} for each of {count} shapes")
    seen = np.arange(count)
    if visible is not None:
        visible = _plain_array("visible", visible)
        if visible.shape not in ((), (count,)) or visible.dtype.kind not in "biu":
            kind_given = f"{visible.dtype} of shape {visible.shape}"
            raise ArgumentError(f"visible is {kind_given}; true or false for each of {count} shapes is needed")
        seen = np.flatnonzero(np.broadcast_to(visible, (count,)))
    meshes = _check_shapes(table, seen, meshes)
    slot = np.where(world < 0, worlds, world)[seen]
    table.member = wp.array(seen[np.argsort(slot, kind="stable")], dtype=int, device=device)
    table.first = wp.array(np.searchsorted(np.sort(slot), np.arange(worlds + 2)), dtype=int, device=device)
    table.pose = wp.clone(table.local)
    return Shapes(table, worlds, device, meshes, int(table.body.numpy().max()) + 1)


# ---- What is read on the host, once: values that kernels trust, and would crash or hang on.


# Components of a size that say something; those of a mesh may be negative, which mirrors it.
_COMPONENTS = {"plane": 2, "sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3, "cone": 2, "mesh": 0}


def check_poses(name: str, poses: wp.array, count: int | None = None) -> None:
    """Positions are finite and rotations unit quaternions; waits for the device. `count`: the first ones alone."""
    rows = poses.numpy()[:count]
    finite = np.isfinite(rows).all(axis=1)
    if not finite.all():
        k = int(finite.argmin())
        raise ArgumentError(f"{name}[{k}] = {rows[k].tolist()} is not finite")
    length = np.linalg.norm(rows[:, 3:].astype(np.float64), axis=1)
    if (wrong := abs(length - 1.0) > 0.01).any():
        k = int(wrong.argmax())
        raise ArgumentError(
            f"{name}[{k}] has the quaternion {rows[k, 3:].tolist()} (x, y, z, w) of length {length[k]:.3g}; one of "
            "length 1 is needed"
        )


def _check_shapes(table: ShapeTable, seen: np.ndarray, given: tuple[wp.Mesh, ...]) -> tuple[wp.Mesh, ...]:
    """Shapes that are in range; returns the meshes that they use, as far as they can be found by their ids."""
    kind, mesh, size = table.kind.numpy(), table.mesh.numpy(), table.size.numpy()
    if kind.min() < 0 or kind.max() >= len(SHAPE_KINDS):
        raise ArgumentError(f"kind holds {kind.min()} to {kind.max()}, outside [0, {len(SHAPE_KINDS) - 1}]")
    reflectance = table.reflectance.numpy()
    if not ((reflectance >= 0.0) & (reflectance <= 1.0)).all():
        raise ArgumentError(f"reflectance holds {reflectance.min()} to {reflectance.max()}, outside [0, 1]")
    body = table.body.numpy()
    if body.min() < -1:
        raise ArgumentError(f"body[{body.argmin()}] = {body.min()} is outside [-1, 2147483647]")
    check_poses("local", table.local)
    needed = np.array([_COMPONENTS[name] for name in SHAPE_KINDS])[kind]
    wrong = ~np.isfinite(size) | ((size < 0.0) & (np.arange(3) < needed[:, None]))
    if (bad := seen[wrong[seen].any(axis=1)]).size:
        k = int(bad[0])
        raise ArgumentError(
            f"size[{k}] = {size[k].tolist()} of a {SHAPE_KINDS[kind[k]]} is not finite and 0 or more [m]"
        )
    meshed = np.flatnonzero(kind == MESH)
    without = meshed[mesh[meshed] == 0]
    if without.size:
        raise ArgumentError(f"kind[{without[0]}] is a mesh and mesh[{without[0]}] = 0 is none")
    known = {one.id: one for one in given}
    if not set(mesh[meshed].tolist()) <= set(known):
        known |= _live_meshes()
    for one in set(mesh[meshed].tolist()):
        _check_mesh(int(meshed[mesh[meshed] == one][0]), known.get(one))
    _check_faces(table, meshed, mesh, known)
    return tuple(known[one] for one in dict.fromkeys(mesh[meshed].tolist()) if one in known)


def _live_meshes() -> dict[int, wp.Mesh]:
    """All meshes of this process by id: an id of none is a pointer to anything."""
    return {one.id: one for one in gc.get_objects() if issubclass(type(one), wp.Mesh) and getattr(one, "id", None)}


def _check_mesh(k: int, mesh: wp.Mesh | None) -> None:
    if mesh is None:
        if gc.get_freeze_count():  # some objects are not listed
            return
        raise ArgumentError(f"mesh[{k}] is not the id of a wp.Mesh that exists; keep the wp.Mesh, or give it instead")
    indices = mesh.indices.numpy()
    if indices.size and not (indices.min() >= 0 and indices.max() < mesh.points.size):
        raise ArgumentError(
            f"mesh[{k}] has indices {indices.min()} to {indices.max()}, outside [0, {mesh.points.size - 1}]"
        )


def _check_faces(table: ShapeTable, meshed: np.ndarray, mesh: np.ndarray, known: Mapping[int, wp.Mesh]) -> None:
    """Textured meshes have a row of the textures for each face."""
    first, rows = table.first_face.numpy(), table.textures.face.size
    for k in meshed[first[meshed] >= 0]:
        one = known.get(int(mesh[k]))
        faces = 1 if one is None else one.indices.size // 3
        if first[k] + faces > rows:
            raise ArgumentError(
                f"first_face[{k}] = {first[k]} and {faces} faces of mesh[{k}] reach beyond the {rows} faces of textures"
            )


def _plain_array(name: str, value: Any) -> np.ndarray:
    try:
        return np.asarray(value.numpy() if isinstance(value, wp.array) else value)
    except ValueError:
        raise ArgumentError(f"{name} is not an array: its rows have different lengths") from None


@wp.kernel(enable_backward=False)
def _move_kernel(table: ShapeTable, body_q: wp.array[wp.transform]):
    """Launch: table."""
    k = wp.tid()
    pose = table.local[k]
    body = table.body[k]
    if body >= 0 and body < body_q.shape[0]:
        pose = wp.transform_multiply(body_q[body], pose)
    table.pose[k] = pose


def move_shapes(shapes: Shapes, body_q: wp.array | None) -> None:
    """Carries the shapes to the poses of their bodies, on the device.

    Args:
        shapes: From `make_shapes`.
        body_q: `wp.transform` `[bodies]`, in the worlds' frames; None where no shape is on a body.

    Raises:
        ArgumentError: Fewer poses than the shapes' bodies, or on another device.
    """
    check_kind("shapes", shapes, Shapes)
    if body_q is None:
        body_q = wp.empty(0, dtype=wp.transform, device=shapes.device)
    check_array("body_q", body_q, wp.transform, (None,), shapes.device)
    if body_q.size < shapes.bodies:
        raise ArgumentError(f"body_q has {body_q.size} poses; the shapes are on {shapes.bodies} bodies")
    wp.launch(_move_kernel, len(shapes), [shapes.table, body_q], device=shapes.device)


@wp.struct
class SceneHit:
    """The nearest shape along a ray."""

    distance: float  # [m]; -1 for none
    normal: wp.vec3  # unit vector against the ray
    reflectance: float  # at this point
    shape: int  # its index; -1 for none


@wp.func
def _reflectance_at(table: ShapeTable, k: int, hit: ShapeHit) -> float:
    reflectance = table.reflectance[k]
    first = table.first_face[k]
    if hit.face >= 0 and first >= 0:
        row = first + hit.face
        index = table.textures.face[row]
        if index >= 0:
            uv = hit.corner[0] * table.textures.coordinates[row, 0]
            uv += hit.corner[1] * table.textures.coordinates[row, 1]
            uv += (1.0 - hit.corner[0] - hit.corner[1]) * table.textures.coordinates[row, 2]
            reflectance *= texture_at(table.textures, index, uv)
    return reflectance


@wp.func
def intersect_shapes(table: ShapeTable, world: int, x: wp.vec3, u: wp.vec3) -> SceneHit:
    """The nearest shape of a world along the ray x + s u; every shape of the world is tried."""
    nearest = ShapeHit()
    nearest.distance = _FAR
    nearest.face = -1
    found = int(-1)
    worlds = table.first.shape[0] - 2
    for part in range(2):
        slot = wp.where(part == 0, world, worlds)
        if slot < 0 or slot > worlds:
            continue  # worlds of cameras may change in place
        for m in range(table.first[slot], table.first[slot + 1]):
            k = table.member[m]
            inverse = wp.transform_inverse(table.pose[k])
            local_x = wp.transform_point(inverse, x)
            local_u = wp.transform_vector(inverse, u)
            hit = intersect_shape(table.kind[k], table.size[k], table.mesh[k], local_x, local_u, nearest.distance)
            if hit.distance > 0.0 and hit.distance < nearest.distance:
                nearest = hit
                found = k
    result = SceneHit()
    result.distance = -1.0
    result.shape = found
    if found >= 0:
        normal = wp.transform_vector(table.pose[found], nearest.normal)
        result.distance = nearest.distance
        result.normal = wp.where(wp.dot(normal, u) > 0.0, -normal, normal)
        result.reflectance = _reflectance_at(table, found, nearest)
    return result
