"""Shapes and poses from Newton and from MuJoCo, on the simulator's own arrays.

Nothing of either is imported before it is there: a model is read by its attributes.
"""

import sys
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError

from .shapes import SHAPE_KINDS, Shapes, make_shapes

__all__ = ["mujoco_shapes", "newton_shapes", "write_poses"]

wp.set_module_options({"enable_backward": False})

GREEN = 1  # the colour that stands for the reflectance at 532 nm

# mjtGeom, in MuJoCo's order.
_MUJOCO_KINDS = ("plane", "mesh", "sphere", "capsule", "ellipsoid", "cylinder", "box", "mesh")
_HEIGHT_FIELD, _MESH = 1, 7


def srgb_to_linear(value: np.ndarray) -> np.ndarray:
    """Linear reflectance of a colour channel in [0, 1] (IEC 61966-2-1)."""
    value = np.clip(value, 0.0, 1.0)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def newton_shapes(model: Any, *, reflectance: Any = None) -> Shapes:
    """The visible shapes of a finalised `newton.Model`, in all its worlds.

    Sizes, poses on bodies and meshes are the model's own arrays: what changes there is seen. Cameras are then updated
    with `state.body_q`, and their poses are in the frame "opengl", which the shapes carry.

    Args:
        model: `newton.Model`.
        reflectance: A number, or one for each shape of the model; by default the green of `model.shape_color`.

    Raises:
        ArgumentError: A model without shapes.
    """
    newton = sys.modules.get("newton")  # there if the model is
    if newton is None:
        raise ArgumentError(f"model is {type(model).__name__}; a newton.Model is needed")
    if not model.shape_count:
        raise ArgumentError("model.shape_count = 0; a camera needs something to look at")
    kinds = {getattr(newton.GeoType, name.upper()): index for index, name in enumerate(SHAPE_KINDS)}
    kinds |= {newton.GeoType.CONVEX_MESH: kinds[newton.GeoType.MESH], newton.GeoType.HFIELD: kinds[newton.GeoType.MESH]}
    types = model.shape_type.numpy().tolist()
    visible = (model.shape_flags.numpy() & int(newton.ShapeFlags.VISIBLE)) != 0
    visible &= np.array([kind in kinds for kind in types])  # neither empty nor made of Gaussians
    if reflectance is None:
        reflectance = srgb_to_linear(model.shape_color.numpy()[:, GREEN])
    return make_shapes(
        np.array([kinds.get(kind, 0) for kind in types]),
        model.shape_scale,
        body=model.shape_body,
        local=model.shape_transform,
        mesh=model.shape_source_ptr,
        meshes=_meshes_of(model),
        reflectance=reflectance,
        world=model.shape_world.numpy(),
        worlds=max(int(model.world_count), 1),
        visible=visible,
        frame="opengl",
        device=model.device,
    )


def _meshes_of(model: Any) -> list[wp.Mesh]:
    """The meshes that a finalised model of Newton keeps in its lists, those of height fields too, and its shapes'."""
    lists = [value for value in vars(model).values() if isinstance(value, (list, tuple))]
    sources = [getattr(one, "mesh", None) for one in model.shape_source]
    return [one for value in [*lists, sources] for one in value if isinstance(one, wp.Mesh)]


def mujoco_shapes(
    model: Any, worlds: int = 1, *, reflectance: Any = None, groups: Any = (0, 1, 2), device: wp.DeviceLike = None
) -> Shapes:
    """The geoms of a `mujoco.MjModel`, in as many worlds as MuJoCo Warp simulates.

    Cameras are updated with body poses that `write_poses` fills from `data.xpos` and `data.xquat` `[worlds, bodies]`,
    and their poses, from `data.cam_xpos` and `data.cam_xmat`, are in the frame "opengl". Height fields have no sides.

    Args:
        model: `mujoco.MjModel`, on the host.
        worlds: `nworld` of the data.
        reflectance: A number, or one for each geom; by default the green of its material or of `geom_rgba`.
        groups: Geom groups that are seen.
        device: Where the arrays go.

    Raises:
        ArgumentError: A model without geoms.
    """
    worlds = check.integer("worlds", worlds, 1)
    count = int(model.ngeom)
    if not count:
        raise ArgumentError("model.ngeom = 0; a camera needs something to look at")
    kind = np.asarray(model.geom_type)
    if kind.max() >= len(_MUJOCO_KINDS):
        raise ArgumentError(f"model.geom_type holds {kind.max()}, which is not the type of a geom that can be seen")
    size = np.array(model.geom_size, np.float32)
    size[kind == 0] *= 2.0  # of a plane MuJoCo has half the width
    size[(kind == _MESH) | (kind == _HEIGHT_FIELD)] = 1.0
    data = list(zip(kind.tolist(), np.asarray(model.geom_dataid).tolist(), strict=True))
    meshes = {key: _mujoco_mesh(model, *key, device) for key in set(data) if key[0] in (_MESH, _HEIGHT_FIELD)}
    mesh = [meshes.get(key) for key in data]
    rgba, material = np.array(model.geom_rgba), np.asarray(model.geom_matid)
    rgba[material >= 0] = model.mat_rgba[material[material >= 0]]
    reflectance = np.broadcast_to(srgb_to_linear(rgba[:, GREEN]) if reflectance is None else reflectance, (count,))
    quat = np.roll(np.asarray(model.geom_quat), -1, axis=1)
    body = np.arange(worlds)[:, None] * int(model.nbody) + np.asarray(model.geom_bodyid)
    return make_shapes(
        np.tile([SHAPE_KINDS.index(_MUJOCO_KINDS[k]) for k in kind], worlds),
        np.tile(size, (worlds, 1)),
        body=body.ravel(),
        local=np.tile(np.concatenate([model.geom_pos, quat], axis=1), (worlds, 1)),
        mesh=mesh * worlds,
        reflectance=np.tile(reflectance, worlds),
        world=np.repeat(np.arange(worlds), count),
        worlds=worlds,
        visible=np.tile(np.isin(model.geom_group, list(groups)) & (rgba[:, 3] > 0.0), worlds),
        frame="opengl",
        device=device,
    )


def _mujoco_mesh(model: Any, kind: int, index: int, device: wp.DeviceLike) -> wp.Mesh:
    if kind == _MESH:
        first, count = model.mesh_vertadr[index], model.mesh_vertnum[index]
        points = model.mesh_vert[first : first + count]
        first, count = model.mesh_faceadr[index], model.mesh_facenum[index]
        faces = model.mesh_face[first : first + count]
    else:
        rows, columns, first = model.hfield_nrow[index], model.hfield_ncol[index], model.hfield_adr[index]
        half_x, half_y, top, _ = model.hfield_size[index]
        x, y = np.meshgrid(np.linspace(-half_x, half_x, columns), np.linspace(-half_y, half_y, rows))
        z = top * model.hfield_data[first : first + rows * columns].reshape(rows, columns)
        points = np.stack([x, y, z], axis=-1).reshape(-1, 3)
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel()
        faces = np.stack(
            [corner, corner + 1, corner + columns + 1, corner, corner + columns + 1, corner + columns], axis=1
        )
    points = wp.array(np.asarray(points, np.float32), dtype=wp.vec3, device=device)
    return wp.Mesh(points, wp.array(np.asarray(faces, np.int32).ravel(), dtype=int, device=device))


@wp.func
def _quaternion(rotation: wp.mat33):
    return wp.quat_from_matrix(rotation)


@wp.func
def _quaternion(rotation: wp.quat):
    return wp.quat(rotation[1], rotation[2], rotation[3], rotation[0])


@wp.kernel(enable_backward=False)
def _poses_kernel(position: wp.array2d[wp.vec3], rotation: wp.array2d[Any], out: wp.array2d[wp.transform]):
    """Launch: (worlds, things)."""
    w, k = wp.tid()
    out[w, k] = wp.transform(position[w, k], wp.normalize(_quaternion(rotation[w, k])))


def write_poses(position: wp.array, rotation: wp.array, out: wp.array) -> None:
    """Poses as `wp.transform` from MuJoCo's positions and rotations, on the device.

    Args:
        position: vec3 `[worlds]` or `[worlds, things]`: `data.xpos`, `data.cam_xpos`, or a column of it.
        rotation: mat33 (`data.cam_xmat`), or quat in MuJoCo's order w, x, y, z (`data.xquat`), of the same shape.
        out: `wp.transform`, as many in a row, the things of a world after each other.

    Raises:
        ArgumentError: Arrays that do not fit.
    """
    check.array("position", position, wp.vec3, (None,) * (2 if getattr(position, "ndim", 1) == 2 else 1))
    shape = (position.shape[0], 1) if position.ndim == 1 else position.shape
    check.array("rotation", rotation, (wp.mat33, wp.quat), position.shape, position.device)
    check.array("out", out, wp.transform, (shape[0] * shape[1],), position.device, contiguous=True)
    if position.ndim == 1:
        # Views [n, 1] of arrays [n] that need not be contiguous.
        position, rotation = (
            wp.array(ptr=x.ptr, dtype=x.dtype, shape=shape, strides=(x.strides[0], 0), device=x.device)
            for x in (position, rotation)
        )
    wp.launch(_poses_kernel, shape, [position, rotation], [out.reshape(shape)], device=out.device)
