"""Shapes on bodies in many worlds, as the arrays that a simulator has on the device, and rays against them.

Shapes other than meshes are met in closed form, in their own frame: centred at the origin, along z, as in Newton and
MuJoCo. Surfaces have two sides.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.surface.mesh import Textures, no_textures
from spadwarp_kernels.surface.reflectance import texture_at

__all__ = ["CAMERA_FRAMES", "SHAPE_KINDS", "Shapes", "make_shapes"]

wp.set_module_options({"enable_backward": False})

SHAPE_KINDS = ("plane", "sphere", "capsule", "ellipsoid", "cylinder", "box", "cone", "mesh")
CAMERA_FRAMES = {
    "optical": (0.0, 0.0, 0.0, 1.0),
    "opengl": (1.0, 0.0, 0.0, 0.0),
    "forward_left_up": (-0.5, 0.5, -0.5, 0.5),
}
"""Conventions of a camera's pose, and the rotation (x, y, z, w) that takes the optical frame there.

``optical``: +x right, +y down, +z forward (OpenCV; ROS, REP 103, `_optical` frames; Isaac Lab's "ros"). ``opengl``: +x
right, +y up, -z forward (OpenGL, USD, Newton, MuJoCo; Isaac Lab's "opengl"). ``forward_left_up``: +x forward, +y left,
+z up (ROS, REP 103, bodies; Isaac Lab's "world").
"""

PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX, CONE, MESH = (wp.constant(i) for i in range(len(SHAPE_KINDS)))

# Components of a size that say something; those of a mesh may be negative, which mirrors it.
_COMPONENTS = {"plane": 2, "sphere": 1, "capsule": 2, "ellipsoid": 3, "cylinder": 2, "box": 3, "cone": 2, "mesh": 0}

_FAR = wp.constant(1.0e30)
# Farthest shape that counts [m].
_REACH = wp.constant(1.0e10)


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
    """Shapes of all worlds, from `make_shapes`, `newton_shapes` or `mujoco_shapes`."""

    table: ShapeTable  # the struct that kernels take
    worlds: int  # number of worlds
    device: wp.Device  # Warp device of the arrays
    meshes: tuple[wp.Mesh, ...] = ()  # meshes that are kept alive with the shapes
    bodies: int = 0  # number of poses that `move_shapes` needs
    frame: str | None = None  # the simulator's convention of camera poses, one of CAMERA_FRAMES; None: none is known

    def __len__(self) -> int:
        return int(self.table.kind.size)


def make_shapes(
    kind: Any,
    size: Any,
    *,
    body: Any = None,
    local: Any = None,
    mesh: Any = None,
    meshes: Iterable[wp.Mesh] = (),
    reflectance: Any = 0.2,
    world: Any = None,
    worlds: int = 1,
    visible: Any = None,
    first_face: Any = None,
    textures: "Textures | None" = None,
    frame: str | None = None,
    device: wp.DeviceLike = None,
) -> Shapes:
    """Shapes from arrays `[shapes]` of NumPy, lists, or Warp arrays, which are kept and not copied.

    Args:
        kind: Names or indices of SHAPE_KINDS.
        size: [m], see `ShapeTable`.
        body: -1, the default, stands still in its world.
        local: Poses on the bodies (x, y, z, qx, qy, qz, qw).
        mesh: `wp.Mesh` objects, or ids of those in `meshes`; None or 0 for the other kinds.
        meshes: `wp.Mesh` objects whose ids are in `mesh`. The shapes keep those alive that they use.
        reflectance: A number, or one for each shape.
        world: Index of the world of each shape, -1 for a shape that stands in all; read once, on the host. By default
            all stand in world 0, or in all worlds if there are several.
        worlds: Number of worlds.
        visible: Whether cameras see a shape; all by default. Read once, as `world`.
        first_face, textures: See `ShapeTable`.
        frame: The simulator's convention of camera poses, one of CAMERA_FRAMES; cameras then need not be told.
        device: Where the arrays are.

    Raises:
        ArgumentError: Arrays of another length or on another device, values out of range, or a world or mesh that
            there is not.
    """
    device = check.device("device", device)
    if frame is not None:
        check.choice("frame", frame, CAMERA_FRAMES)
    worlds = check.integer("worlds", worlds, 1, 1 << 24)
    if not isinstance(kind, wp.array):
        kind = np.array([SHAPE_KINDS.index(one) if one in SHAPE_KINDS else one for one in check.items("kind", kind)])
        if kind.dtype.kind not in "iu" or kind.size == 0:
            names = ", ".join(SHAPE_KINDS)
            raise ArgumentError(f"kind = {kind.tolist()} is not a list of {names}, or of their indices")
    count = kind.shape[0]
    given = {one.id: one for one in check.items("meshes", meshes)}
    if mesh is not None and not isinstance(mesh, wp.array):
        mesh = check.items("mesh", mesh)
        given |= {one.id: one for one in mesh if isinstance(one, wp.Mesh)}
        mesh = [one.id if isinstance(one, wp.Mesh) else check.integer("mesh", one or 0, 0, 2**64 - 1) for one in mesh]
    table = ShapeTable()
    defaults = {"body": -1, "local": (0.0, 0.0, 0.0, 0.0, 0.0, 0.0, 1.0), "mesh": 0, "first_face": -1}
    columns = {"kind": kind, "size": size, "body": body, "local": local, "mesh": mesh, "reflectance": reflectance}
    for name, value in (columns | {"first_face": first_face}).items():
        setattr(table, name, _column(name, defaults.get(name) if value is None else value, count, device))
    if textures is not None:
        check.kind("textures", textures, Textures)
    table.textures = no_textures(device) if textures is None else textures
    world = np.full(count, 0 if worlds == 1 else -1) if world is None else world
    world = check.numbers("world", world, (count,), f"[-1, {worlds - 1}]", whole=True).astype(np.int64)
    visible = np.full(count, True if visible is None else visible) if np.ndim(visible) == 0 else visible
    seen = np.flatnonzero(check.numbers("visible", visible, (count,)))
    used = _check_shapes(table, seen, given)
    slot = np.where(world < 0, worlds, world)[seen]
    table.member = wp.array(seen[np.argsort(slot, kind="stable")], dtype=int, device=device)
    table.first = wp.array(np.searchsorted(np.sort(slot), np.arange(worlds + 2)), dtype=int, device=device)
    table.pose = wp.clone(table.local)
    return Shapes(table, worlds, device, used, int(table.body.numpy().max()) + 1, frame)


def _column(name: str, value: Any, count: int, device: wp.Device) -> wp.array:
    """An array of the table, of values on the host or on the device."""
    dtype = ShapeTable.vars[name].type.dtype
    if isinstance(value, wp.array):
        return check.array(name, value, dtype, (count,), device)
    width = wp.types.type_size(dtype)
    try:
        rows = np.asarray(value, np.uint64 if dtype == wp.uint64 else np.float64)
        rows = np.broadcast_to(rows, (count, width) if width > 1 else (count,))
    except (TypeError, ValueError, OverflowError):
        raise ArgumentError(f"{name} does not fit {count} shapes, [shapes] of {dtype.__name__}") from None
    if not (np.isfinite(rows).all() and (np.abs(rows) <= np.finfo(np.float32).max).all()):
        raise ArgumentError(f"{name} is not finite for some of {count} shapes")
    if dtype == wp.int32 and not (rows == np.clip(np.rint(rows), -(2**31), 2**31 - 1)).all():
        raise ArgumentError(f"{name} is not an integer of 32 bits for some of {count} shapes")
    scalar = {wp.int32: np.int32, wp.uint64: np.uint64}.get(dtype, np.float32)
    return wp.array(rows.astype(scalar), dtype=dtype, device=device)


# ---- Values that are read on the host, once: kernels trust them, and would crash or hang on others.


def check_poses(name: str, poses: wp.array, count: int | None = None) -> None:
    """Positions are finite and rotations unit quaternions; waits for the device. `count`: the first ones alone."""
    rows = poses.numpy()[:count].astype(np.float64)
    length = np.linalg.norm(rows[:, 3:], axis=1)
    for k in np.flatnonzero(~(abs(length - 1.0) <= 0.01) | ~np.isfinite(rows).all(axis=1))[:1]:
        if not np.isfinite(rows[k]).all():
            raise ArgumentError(f"{name}[{k}] = {rows[k].tolist()} is not finite")
        raise ArgumentError(
            f"{name}[{k}] has the quaternion {rows[k, 3:].tolist()} (x, y, z, w) of length {length[k]:.3g}; one of "
            "length 1 is needed"
        )


def _check_shapes(table: ShapeTable, seen: np.ndarray, given: dict[int, wp.Mesh]) -> tuple[wp.Mesh, ...]:
    """Shapes that are in range; returns the meshes that they use."""
    ranges = {"kind": f"[0, {len(SHAPE_KINDS) - 1}]", "reflectance": "[0, 1]", "body": "[-1, 2147483647]"}
    for name, interval in ranges.items():
        check.numbers(name, getattr(table, name), None, interval)
    check_poses("local", table.local)
    kind, size = table.kind.numpy(), table.size.numpy()
    needed = np.array([_COMPONENTS[name] for name in SHAPE_KINDS])[kind]
    wrong = ~np.isfinite(size) | ((size < 0.0) & (np.arange(3) < needed[:, None]))
    for k in seen[wrong[seen].any(axis=1)][:1]:
        raise ArgumentError(
            f"size[{k}] = {size[k].tolist()} of a {SHAPE_KINDS[kind[k]]} is not finite and 0 or more [m]"
        )
    meshed = np.flatnonzero(kind == MESH)
    ids = table.mesh.numpy()[meshed].tolist()
    faces = {mesh: _checked_faces(int(meshed[ids.index(mesh)]), mesh, given.get(mesh)) for mesh in dict.fromkeys(ids)}
    first, rows = table.first_face.numpy(), table.textures.face.size
    for k, mesh in zip(meshed, ids, strict=True):
        if first[k] >= 0 and first[k] + faces[mesh] > rows:
            reach = f"{faces[mesh]} faces of mesh[{k}] reach beyond the {rows} faces of textures"
            raise ArgumentError(f"first_face[{k}] = {first[k]} and {reach}")
    return tuple(given[mesh] for mesh in faces)


def _checked_faces(k: int, id: int, mesh: wp.Mesh | None) -> int:
    """Number of the faces of a shape's mesh, whose indices are in range."""
    if id == 0:
        raise ArgumentError(f"kind[{k}] is a mesh and mesh[{k}] = 0 is none")
    if mesh is None:
        raise ArgumentError(f"mesh[{k}] is not the id of a wp.Mesh in meshes; give the wp.Mesh itself, or it in meshes")
    check.numbers(f"mesh[{k}].indices", mesh.indices, None, f"[0, {mesh.points.size - 1}]")
    return mesh.indices.size // 3


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
    """Carries the shapes to the poses of their bodies `[bodies]`, None where no shape is on one; on the device."""
    check.kind("shapes", shapes, Shapes)
    if body_q is None:
        body_q = wp.empty(0, dtype=wp.transform, device=shapes.device)
    check.array("body_q", body_q, wp.transform, (None,), shapes.device)
    if body_q.size < shapes.bodies:
        raise ArgumentError(f"body_q has {body_q.size} poses; the shapes are on {shapes.bodies} bodies")
    wp.launch(_move_kernel, len(shapes), [shapes.table, body_q], device=shapes.device)


# ---- Rays.


@wp.struct
class ShapeHit:
    """Where a ray x + s u meets a shape, for s beyond a least one, which may be negative."""

    distance: float  # along the ray [m]; -1 for a miss
    normal: wp.vec3  # unit vector, either side, in the frame of the ray
    face: int  # of a mesh; -1 for other shapes
    corner: wp.vec2  # barycentric shares of the first two corners of the face


@wp.func
def _miss() -> ShapeHit:
    hit = ShapeHit()
    hit.distance = _FAR
    hit.face = -1
    return hit


@wp.func
def _nearer(hit: ShapeHit, least: float, distance: float, normal: wp.vec3) -> ShapeHit:
    """The nearer of a hit and a point of the ray beyond `least`."""
    if distance > least and distance < hit.distance:
        hit.distance = distance
        hit.normal = normal
    return hit


@wp.func
def _roots(a: float, b: float, c: float) -> wp.vec2:
    """Solutions of a s^2 + 2 b s + c = 0, without cancellation; far away twice if there are none."""
    disc = b * b - a * c
    if disc < 0.0 or a == 0.0:
        return wp.vec2(_FAR, _FAR)
    q = -(b + wp.where(b < 0.0, -1.0, 1.0) * wp.sqrt(disc))
    if q == 0.0:
        return wp.vec2(0.0, 0.0)
    return wp.vec2(q / a, c / q)


@wp.func
def _intersect_ball(
    hit: ShapeHit, z: float, radius: float, cut: float, x: wp.vec3, u: wp.vec3, least: float
) -> ShapeHit:
    """A sphere at a height z, of which counts what lies beyond |z| = cut on its side."""
    centre = wp.vec3(0.0, 0.0, z)
    y = x - centre
    along = -wp.dot(y, u)
    rest = y + along * u
    half2 = radius * radius - wp.dot(rest, rest)
    if half2 > 0.0:
        for k in range(2):
            s = along + (2.0 * float(k) - 1.0) * wp.sqrt(half2)
            height = x[2] + s * u[2]
            if cut <= 0.0 or (height * z >= 0.0 and wp.abs(height) >= cut):
                hit = _nearer(hit, least, s, (y + s * u) / radius)
    return hit


@wp.func
def _intersect_side(hit: ShapeHit, radius: float, half: float, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    """The side of a cylinder, |z| < half."""
    roots = _roots(u[0] * u[0] + u[1] * u[1], x[0] * u[0] + x[1] * u[1], x[0] * x[0] + x[1] * x[1] - radius * radius)
    for k in range(2):
        y = x + roots[k] * u
        if wp.abs(y[2]) < half:
            hit = _nearer(hit, least, roots[k], wp.vec3(y[0], y[1], 0.0) / radius)
    return hit


@wp.func
def _intersect_cap(hit: ShapeHit, radius: float, z: float, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    """A disc at a height z."""
    s = (z - x[2]) / u[2]
    y = x + s * u
    if y[0] * y[0] + y[1] * y[1] <= radius * radius:
        hit = _nearer(hit, least, s, wp.vec3(0.0, 0.0, 1.0))
    return hit


@wp.func
def _intersect_ellipsoid(size: wp.vec3, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    stretched = wp.cw_div(u, size)
    length = wp.length(stretched)
    hit = _intersect_ball(_miss(), 0.0, 1.0, 0.0, wp.cw_div(x, size), stretched / length, least * length)
    if hit.distance < _FAR:
        hit.distance = hit.distance / length
        hit.normal = wp.normalize(wp.cw_div(hit.normal, size))
    return hit


@wp.func
def _intersect_box(size: wp.vec3, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    enter = -float(_FAR)
    leave = float(_FAR)
    enter_axis = int(0)
    leave_axis = int(0)
    for k in range(3):
        low = (-size[k] - x[k]) / u[k]
        high = (size[k] - x[k]) / u[k]
        if u[k] == 0.0:
            low = wp.where(wp.abs(x[k]) <= size[k], -_FAR, _FAR)
            high = float(_FAR)
        if wp.min(low, high) > enter:
            enter = wp.min(low, high)
            enter_axis = k
        if wp.max(low, high) < leave:
            leave = wp.max(low, high)
            leave_axis = k
    hit = _miss()
    if enter <= leave:
        normal = wp.vec3(0.0)
        normal[enter_axis] = 1.0
        hit = _nearer(hit, least, enter, normal)
        normal = wp.vec3(0.0)
        normal[leave_axis] = 1.0
        hit = _nearer(hit, least, leave, normal)
    return hit


@wp.func
def _intersect_cone(size: wp.vec3, x: wp.vec3, u: wp.vec3, least: float) -> ShapeHit:
    """Its tip is up."""
    half = size[1]
    k2 = 0.25 * size[0] * size[0] / (half * half)
    below = half - x[2]
    a = u[0] * u[0] + u[1] * u[1] - k2 * u[2] * u[2]
    b = x[0] * u[0] + x[1] * u[1] + k2 * below * u[2]
    roots = _roots(a, b, x[0] * x[0] + x[1] * x[1] - k2 * below * below)
    hit = _miss()
    for k in range(2):
        y = x + roots[k] * u
        if wp.abs(y[2]) <= half:
            hit = _nearer(hit, least, roots[k], wp.normalize(wp.vec3(y[0], y[1], k2 * (half - y[2]))))
    return _intersect_cap(hit, size[0], -half, x, u, least)


@wp.func
def _intersect_scaled_mesh(mesh: wp.uint64, size: wp.vec3, x: wp.vec3, u: wp.vec3, reach: float) -> ShapeHit:
    """A `wp.Mesh` whose points are multiplied by size."""
    stretched = wp.cw_div(u, size)
    length = wp.length(stretched)
    hit = _miss()
    query = wp.mesh_query_ray(mesh, wp.cw_div(x, size), stretched / length, reach * length)
    if query.result:
        hit.distance = query.t / length
        hit.normal = wp.normalize(wp.cw_div(query.normal, size))
        hit.face = query.face
        hit.corner = wp.vec2(query.u, query.v)
    return hit


@wp.func
def intersect_shape(kind: int, size: wp.vec3, mesh: wp.uint64, x: wp.vec3, u: wp.vec3, reach: float) -> ShapeHit:
    """The nearest point, up to `reach`, at which the ray x + s u meets a shape of `ShapeTable` in its own frame."""
    # From the point of the ray that is nearest the centre: differences of squares would cancel far away.
    start = -wp.dot(x, u)
    y = x + start * u
    least = -start
    hit = _miss()
    if kind == PLANE:
        s = -y[2] / u[2]  # infinite or not a number for a ray along the plane, which fails below
        z = y + s * u
        if (size[0] <= 0.0 or wp.abs(z[0]) <= 0.5 * size[0]) and (size[1] <= 0.0 or wp.abs(z[1]) <= 0.5 * size[1]):
            hit = _nearer(hit, least, s, wp.vec3(0.0, 0.0, 1.0))
    elif kind == SPHERE:
        hit = _intersect_ball(hit, 0.0, size[0], 0.0, y, u, least)
    elif kind == CAPSULE:
        hit = _intersect_side(hit, size[0], size[1], y, u, least)
        hit = _intersect_ball(hit, size[1], size[0], size[1], y, u, least)
        hit = _intersect_ball(hit, -size[1], size[0], size[1], y, u, least)
    elif kind == ELLIPSOID:
        hit = _intersect_ellipsoid(size, y, u, least)
    elif kind == CYLINDER:
        hit = _intersect_side(hit, size[0], size[1], y, u, least)
        hit = _intersect_cap(hit, size[0], size[1], y, u, least)
        hit = _intersect_cap(hit, size[0], -size[1], y, u, least)
    elif kind == BOX:
        hit = _intersect_box(size, y, u, least)
    elif kind == CONE:
        hit = _intersect_cone(size, y, u, least)
    elif kind == MESH:
        start = float(0.0)
        hit = _intersect_scaled_mesh(mesh, size, x, u, reach)
    hit.distance += start
    if not hit.distance <= reach:
        hit.distance = -1.0
    return hit


@wp.func
def intersect_shapes(table: ShapeTable, world: int, x: wp.vec3, u: wp.vec3):
    """The nearest shape of a world along the ray x + s u, with the normal against it, and the reflectance at this
    point; every shape of the world is tried."""
    nearest = ShapeHit()
    nearest.distance = _REACH
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
    reflectance = float(0.0)
    if found >= 0:
        normal = wp.transform_vector(table.pose[found], nearest.normal)
        nearest.normal = wp.where(wp.dot(normal, u) > 0.0, -normal, normal)
        reflectance = table.reflectance[found]
        first = table.first_face[found]
        if nearest.face >= 0 and first >= 0:
            corner = nearest.corner
            shares = wp.vec3(corner[0], corner[1], 1.0 - corner[0] - corner[1])
            reflectance *= texture_at(table.textures, first + nearest.face, shares)
    else:
        nearest.distance = -1.0
    return nearest, reflectance
