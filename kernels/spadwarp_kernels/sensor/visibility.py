"""Which points the lens sees for certain: a coarse map that answers most shadow rays without a BVH."""

import warp as wp

from spadwarp_kernels.arguments import check_kind

from .camera import Camera, check_camera, field

# Texels along each side of the field of view: fine against the relief of a target, small against a GPU's cache.
_TEXELS = wp.constant(128)
_NOTHING = wp.constant(1.0e30)


@wp.func
def _texel(tangent: float, low: float, high: float) -> float:
    return (tangent - low) / (high - low) * float(_TEXELS)


@wp.func
def _map_view(camera: Camera) -> wp.vec4:
    """Tangents (left, top, right, bottom) of the map: those of the camera's view, or its field where that is empty."""
    view = camera.view
    if view[2] == view[0]:
        view = field(camera)
    return view


@wp.kernel(enable_backward=False)
def _near_depth_kernel(camera: Camera, mesh: wp.uint64, near_depth: wp.array2d(dtype=float)):
    """Lowers each texel to the least depth of the faces that may cover it. Launch: faces."""
    face = wp.tid()
    m = wp.mesh_get(mesh)
    p = m.points[m.indices[3 * face]]
    q = m.points[m.indices[3 * face + 1]]
    r = m.points[m.indices[3 * face + 2]]
    depth = wp.min(p[2], wp.min(q[2], r[2]))
    view = _map_view(camera)
    first_column = int(0)
    first_row = int(0)
    last_column = int(_TEXELS - 1)
    last_row = int(_TEXELS - 1)
    if depth > camera.aperture_radius:
        # A ray to the rim of the lens differs from the line to its centre by less than this, as a tangent.
        spread = camera.aperture_radius / depth
        left = wp.min(p[0] / p[2], wp.min(q[0] / q[2], r[0] / r[2])) - spread
        right = wp.max(p[0] / p[2], wp.max(q[0] / q[2], r[0] / r[2])) + spread
        top = wp.min(p[1] / p[2], wp.min(q[1] / q[2], r[1] / r[2])) - spread
        bottom = wp.max(p[1] / p[2], wp.max(q[1] / q[2], r[1] / r[2])) + spread
        # One texel more on each side makes up for rounding.
        edge = float(_TEXELS)
        first_column = int(wp.clamp(_texel(left, view[0], view[2]) - 1.0, 0.0, edge))
        last_column = int(wp.clamp(_texel(right, view[0], view[2]) + 1.0, -1.0, edge - 1.0))
        first_row = int(wp.clamp(_texel(top, view[1], view[3]) - 1.0, 0.0, edge))
        last_row = int(wp.clamp(_texel(bottom, view[1], view[3]) + 1.0, -1.0, edge - 1.0))
    else:
        depth = 0.0  # beside or behind the lens: nothing is certain
    for row in range(first_row, last_row + 1):
        for column in range(first_column, last_column + 1):
            wp.atomic_min(near_depth, row, column, depth)


def near_depth_map(mesh: wp.Mesh, camera: Camera) -> wp.array:
    """Least depth [m] at which a face of the mesh can stand in each part of the view, float32 [rows, columns].

    A point of the view that lies before it is seen from everywhere on the lens: the segments to the lens stay within
    the texel's cone, up to what the outlines of faces are widened by, and before every face in it. Raises
    `ArgumentError` for a camera that images nothing.
    """
    check_camera("camera", camera, calibrated=False)
    check_kind("mesh", mesh, wp.Mesh)
    near_depth = wp.full((_TEXELS, _TEXELS), _NOTHING, dtype=float, device=mesh.device)
    wp.launch(_near_depth_kernel, mesh.indices.size // 3, [camera, mesh.id], outputs=[near_depth], device=mesh.device)
    return near_depth


@wp.func
def may_be_hidden(view: wp.vec4, near_depth: wp.array2d(dtype=float), x: wp.vec3) -> bool:
    """Whether something may stand between the point x, x[2] > 0, and the lens; False is certain.

    True for points beside the view (left, top, right, bottom), which the lens sees out of focus.
    """
    if near_depth.shape[0] == 0:
        return True
    column = _texel(x[0] / x[2], view[0], view[2])
    row = _texel(x[1] / x[2], view[1], view[3])
    edge = float(_TEXELS)
    if not (column >= 0.0 and row >= 0.0 and column < edge and row < edge):
        return True
    return x[2] >= near_depth[int(row), int(column)]
