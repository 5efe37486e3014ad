"""Rays against the target: its nearest face, and where the next ray starts."""

from typing import NamedTuple

import warp as wp

from spadwarp_kernels.base.kernels import memoised
from spadwarp_kernels.base.native import bits_of, load_row, times_sign
from spadwarp_kernels.base.rotations import inverse_direction
from spadwarp_kernels.optics.camera import Camera, pixel_direction

from .bvh import NO_NODE, Stack, TreeWalk, place, step_leaf, step_node
from .mesh import Surfaces
from .patches import nearest_patch, patch_faces
from .reflectance import (
    face_reflectance,
    ggx_brdf,
    lambert_brdf,
    pattern_reflectance,
    reflectance_at,
    reflection_pdf,
)
from .triangle import face_in, face_normal
from .wide import walk_wide

__all__ = ["SurfaceHit", "intersect_mesh", "intersect_surfaces", "offset_from_surface", "truth_kernel"]


@wp.struct
class SurfaceHit:
    """Nearest surface along a ray."""

    distance: float  # [m]
    normal: wp.vec3  # unit vector on the ray's side
    face: int  # its index; -1 for a miss
    slot: int  # its index in the order of the mesh's tree, where that was walked; -1 for a miss


@wp.func
def surface_hit(surfaces: Surfaces, walk: TreeWalk, u: wp.vec3) -> SurfaceHit:
    """The hit of a ray along u that has come down the tree."""
    hit = SurfaceHit()
    hit.distance = walk.nearest
    hit.slot = walk.found
    hit.face = -1
    if walk.found >= 0:
        hit.face = face_in(surfaces.order, walk.found)
        hit.normal = face_normal(surfaces.faces, walk.found, u)
    return hit


@wp.func
def intersect_mesh(mesh: wp.uint64, x: wp.vec3, u: wp.vec3, max_distance: float) -> SurfaceHit:
    """Nearest hit of the ray x + s u, 0 <= s < max_distance, against the BVH of a `wp.Mesh`."""
    hit = SurfaceHit()
    hit.face = -1
    hit.slot = -1
    hit.distance = max_distance
    query = wp.mesh_query_ray(mesh, x, u, max_distance)
    if query.result:
        hit.face = query.face
        hit.distance = query.t
        hit.normal = wp.where(wp.dot(query.normal, u) > 0.0, -query.normal, query.normal)
    return hit


@wp.func
def patch_hit(surfaces: Surfaces, met: wp.vec4) -> SurfaceHit:
    """The hit on the patch that `nearest_patch` has found."""
    row = bits_of(met[3])
    faces = patch_faces(surfaces.patches, row, met[2] > 0.0)
    normal = load_row(surfaces.patches, row)
    hit = SurfaceHit()
    hit.distance = met[0]
    hit.normal = times_sign(-1.0, met[1]) * wp.vec3(normal[0], normal[1], normal[2])
    hit.slot = faces[0]
    hit.face = faces[1]
    return hit


@wp.func_native("""
#if defined(__CUDA_ARCH__)
    return false;
#else
    return true;
#endif
""")
def _on_cpu() -> bool:
    """Known when the kernel is compiled, so that each device has one of the two walks."""
    ...


@wp.func
def tree_face(surfaces: Surfaces, slot: int, u: wp.vec3):
    """The face in a slot: its index, and its unit normal against u."""
    return face_in(surfaces.order, slot), face_normal(surfaces.faces, slot, u)


@wp.func
def patch_face(surfaces: Surfaces, slot: int, u: wp.vec3):
    """`tree_face` for surfaces with patches, on CUDA."""
    row = load_row(surfaces.normals, slot)
    normal = wp.vec3(row[0], row[1], row[2])
    return place(bits_of(row[3])), wp.where(wp.dot(normal, u) > 0.0, -normal, normal)


@wp.func
def intersect_surfaces(surfaces: Surfaces, x: wp.vec3, u: wp.vec3, max_distance: float, any_hit: bool) -> SurfaceHit:
    """As `intersect_mesh`, with the tree of `make_surfaces`; `any_hit` is content with the first face that is found.

    Boxes and faces are a hair wider than they are, so that also rays aimed at vertices and along edges are caught.
    Surfaces of `use_warp_bvh` take `intersect_mesh`.
    """
    if surfaces.nodes.shape[0] == 0:
        hit = intersect_mesh(surfaces.mesh, x, u, max_distance)
        hit.slot = hit.face
        return hit
    stack = Stack()
    stack[0] = NO_NODE
    walk = TreeWalk()
    walk.depth = 1
    walk.nearest = max_distance
    walk.found = -1
    inverse = inverse_direction(u)
    shift = wp.cw_mul(x, inverse)
    if _on_cpu():
        wide = walk_wide(surfaces.nodes, surfaces.faces, surfaces.order, x, u, inverse, shift, max_distance, any_hit)
        walk.nearest = wide[0]
        walk.found = bits_of(wide[1])
        walk.node = NO_NODE
    while walk.node != NO_NODE:
        if walk.node > NO_NODE:
            met = step_node(surfaces.nodes, walk, inverse, shift)
            walk.node = NO_NODE
            if met.entry[0] <= met.reach:
                walk.node = met.child[0]
            for k in range(3):
                if met.entry[3 - k] <= met.reach:
                    stack[place(walk.depth)] = met.child[3 - k]
                    walk.depth += 1
        else:
            step = step_leaf(surfaces.faces, surfaces.order, walk, x, u)
            walk.node = step.node
            if step.hit:
                walk.nearest = step.distance
                walk.found = step.slot
                if any_hit:
                    walk.depth = 1
        if walk.node == NO_NODE and walk.depth > 0:
            walk.depth -= 1
            walk.node = stack[place(walk.depth)]
    return surface_hit(surfaces, walk, u)


@wp.func
def offset_from_surface(x: wp.vec3, normal: wp.vec3, distance: float) -> wp.vec3:
    """x moved off the surface along the normal by a bound of its float32 error, a few units in the last place of its
    coordinates and of the distance, so that a new ray does not hit the same face."""
    magnitude = wp.max(wp.max(wp.abs(x[0]), wp.abs(x[1])), wp.abs(x[2]))
    return x + (5.0e-7 * (magnitude + distance)) * normal


# ---- What transport asks of the faces of a mesh.


class Faces(NamedTuple):
    """What becomes of light on faces, as Warp functions: x is a point of a face, u and v are directions before and
    after."""

    hides: wp.Function  # ``(surfaces, x, u, length) -> bool``, whether a face stands in the way
    survival: wp.Function  # ``(surfaces, hit, x, albedo) -> vec2``, part that an event leaves, of that part the lobe's
    density: wp.Function  # ``(surfaces, slot, x, u, v) -> float``, of what is sent to v [1/sr]
    shares: wp.Function  # ``(surfaces, slot, x, u, v) -> vec2``, of that by the Lambertian law and by the lobe
    pdf: wp.Function  # ``(surfaces, hit, u, v, lobe, other) -> float``, of `sample_reflection` [1/sr]; in water `other`
    mesh: bool  # whether there are any
    tried: bool  # each by itself, on CUDA: none walks the tree
    specular: bool  # with a rough lobe


@memoised
def make_faces(mesh: bool, tried: bool, pattern: bool, specular: bool) -> Faces:
    """The faces of a spec, see `Faces`; `pattern`: their reflectance varies."""
    find, reflectance = patch_face if tried else tree_face, pattern_reflectance if pattern else face_reflectance

    @wp.func
    def hides(surfaces: Surfaces, x: wp.vec3, u: wp.vec3, length: float) -> bool:
        if wp.static(tried):
            return bits_of(nearest_patch(surfaces.patches, x, u, length)[3]) >= 0
        return intersect_surfaces(surfaces, x, u, length, True).slot >= 0

    @wp.func
    def survival(surfaces: Surfaces, hit: SurfaceHit, x: wp.vec3, albedo: float) -> wp.vec2:
        part = wp.vec2(albedo, 0.0)
        if hit.face >= 0:
            part[0] = reflectance(surfaces, hit.face, x)
            if wp.static(specular):
                lobe = surfaces.specular[hit.face]
                part[0] += lobe
                part[1] = lobe / wp.max(part[0], 1.0e-30)
        return part

    @wp.func
    def parts(surfaces: Surfaces, face: int, normal: wp.vec3, x: wp.vec3, u: wp.vec3, v: wp.vec3) -> wp.vec2:
        lobe = float(0.0)
        if wp.static(specular):
            lobe = surfaces.specular[face] * ggx_brdf(u, v, normal, surfaces.roughness[face])
        return wp.vec2(lambert_brdf(reflectance(surfaces, face, x)), lobe)

    @wp.func
    def density(surfaces: Surfaces, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3) -> float:
        face, normal = find(surfaces, slot, u)
        cos_out = wp.max(wp.dot(v, normal), 0.0)
        sent = parts(surfaces, face, normal, x, u, v)
        total = sent[0] * cos_out
        if wp.static(specular):
            total += sent[1] * cos_out
        return total

    @wp.func
    def shares(surfaces: Surfaces, slot: int, x: wp.vec3, u: wp.vec3, v: wp.vec3) -> wp.vec2:
        share = wp.vec2(1.0, 0.0)
        if wp.static(specular):
            face, normal = tree_face(surfaces, slot, u)
            sent = parts(surfaces, face, normal, x, u, v)
            both = wp.max(sent[0] + sent[1], 1.0e-30)
            share = wp.vec2(sent[0] / both, sent[1] / both)
        return share

    @wp.func
    def pdf(surfaces: Surfaces, hit: SurfaceHit, u: wp.vec3, v: wp.vec3, lobe: float, other: float) -> float:
        density = wp.where(hit.face >= 0, lambert_brdf(wp.max(wp.dot(v, hit.normal), 0.0)), other)
        if wp.static(specular):
            if hit.face >= 0:
                density = reflection_pdf(u, v, hit.normal, surfaces.roughness[hit.face], lobe)
        return density

    return Faces(hides, survival, density, shares, pdf, mesh, tried, specular)


# ---- What the camera would see through clear water: one ray a pixel against the mesh.


@wp.kernel(enable_backward=False, module="unique")
def truth_kernel(
    camera: Camera,
    surfaces: Surfaces,
    origins: wp.array2d[wp.vec3],
    directions: wp.array2d[wp.vec3],
    # Out, [height, width]:
    depth: wp.array2d[float],
    range: wp.array2d[float],
    normal: wp.array2d[wp.vec3],
    reflectance: wp.array2d[float],
):
    """Depth z and range along the ray [m], normal on the camera's side, reflectance; NaN for a miss. Launch: (height,
    width).

    Rays go from `origins` [m], from which the range counts, such as those behind a port, else from the lens; along
    `directions`, unit vectors through the pixel centres, else through square pixels about the camera's axis.
    """
    row, column = wp.tid()
    x = wp.vec3(0.0)
    if origins.shape[0] > 0:
        x = origins[row, column]
    u = pixel_direction(camera, float(column) + 0.5, float(row) + 0.5)
    if directions.shape[0] > 0:
        u = directions[row, column]
    hit = intersect_surfaces(surfaces, x, u, 1.0e29, False)
    depth[row, column] = wp.NAN
    range[row, column] = wp.NAN
    normal[row, column] = wp.vec3(wp.NAN)
    reflectance[row, column] = wp.NAN
    if hit.face >= 0:
        depth[row, column] = x[2] + hit.distance * u[2]
        range[row, column] = hit.distance
        normal[row, column] = hit.normal
        reflectance[row, column] = reflectance_at(surfaces, hit.face, x + hit.distance * u)
