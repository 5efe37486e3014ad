"""The target as the kernels take it: a mesh, its tree, its reflectance, images on it."""

from collections.abc import Sequence
from typing import Any

import numpy as np
import warp as wp

from spadwarp_kernels.base import check
from spadwarp_kernels.base.check import ArgumentError
from spadwarp_kernels.base.native import fill
from spadwarp_kernels.optics.camera import Camera
from spadwarp_kernels.optics.visibility import near_depth_map

from .bvh import pack_bvh, refit_bvh
from .patches import BRUTE_FORCE_FACES, PATCH_ROWS, pack_patches, set_patches
from .triangle import LANES, face_vectors, pack_faces, set_faces
from .wide import empty_tree, pack_wide, refit_wide

__all__ = ["Surfaces", "Textures", "make_surfaces", "make_textures", "surface_choices", "update_surfaces"]


@wp.struct
class Textures:
    """Images on faces; arrays of length 0 where there are none."""

    face: wp.array[int]  # texture of each face, -1 for none
    coordinates: wp.array2d[wp.vec2]
    """(u, v) of the corners of each face, [faces, 3]; u to the right, v up, images repeat with period 1."""
    region: wp.array[wp.vec3i]  # (offset into `texels`, width, height) of each texture
    texels: wp.array[float]  # reflectance factors in [0, 1], row after row from the top


@wp.struct
class Surfaces:
    """The target as the kernels take it, see `make_surfaces`."""

    mesh: wp.uint64  # id of a `wp.Mesh`
    lower: wp.vec3  # of its bounding box [m], padded against rounding
    upper: wp.vec3  # of the same
    nodes: wp.array[wp.vec4]  # the mesh's tree, see `bvh`, on the CPU `wide`
    faces: wp.array[wp.vec4]  # likewise
    order: wp.array[int]  # likewise
    reflectance: wp.array[float]  # of each face, in [0, 1]
    near_depth: wp.array2d[float]  # what the camera cannot miss, see `near_depth_map`; empty if nothing is known
    corner_reflectance: wp.array[wp.vec3]
    """At the three corners of each face, instead of `reflectance`; empty unless it varies."""
    textures: Textures  # images that multiply the corners' reflectance
    specular: wp.array[float]  # reflectance of the facets of the specular lobe, of each face; empty if there is none
    roughness: wp.array[float]  # their width parameter, see `microfacet`
    depth: wp.array[int]
    """Of the nodes of a moving mesh's tree on CUDA; else empty."""
    levels: int  # their number; 1 for a moving mesh on the CPU
    extent: float  # largest coordinate that the tree is made for [m]
    patches: wp.array[wp.vec4]  # of a mesh of up to BRUTE_FORCE_FACES faces on CUDA, for rays that try them all
    normals: wp.array[wp.vec4]  # likewise


def make_surfaces(
    mesh: wp.Mesh | None,
    reflectance: wp.array | float = 0.5,
    *,
    corner_reflectance: wp.array | None = None,
    textures: "Textures | None" = None,
    specular: wp.array | float | None = None,
    roughness: wp.array | float = 0.2,
    camera: "Camera | None" = None,
    device: wp.DeviceLike = None,
    extent: float | None = None,
    use_warp_bvh: bool = False,
) -> Surfaces:
    """The kernel's view of a mesh; `surface_choices` has the fields of `TransportSpec` that go with it.

    Lambertian reflectance plus `specular` must not exceed 1 anywhere.

    Args:
        mesh: Any `wp.Mesh`; None for no surface at all. Where its points move, see `update_surfaces`, or make the
            surfaces anew after a refit; the arrays may stay.
        reflectance: Lambertian, in [0, 1]: one number or a float32 array with one entry a face.
        corner_reflectance: Lambertian reflectance at the corners of each face, vec3 [faces], interpolated between them;
            replaces `reflectance`.
        textures: From `make_textures`; multiplies the corners', which default to `reflectance`.
        specular: Reflectance of the facets of a rough specular lobe, in [0, 1]: one number or an array as above.
        roughness: GGX width parameter of the lobe, in [0.01, 1]: one number or an array as above.
        camera: Saves most of the rays between scattering events and its lens.
        device: Where the empty arrays go if there is no mesh.
        extent: Largest coordinate that a moving mesh will have [m]; then its bounding box is taken to be this large.
        use_warp_bvh: Rays take `wp.mesh_query_ray` instead of a tree that is read from Warp's private structs: slower,
            and the way back when another version of Warp changes these.

    Raises:
        ArgumentError: An array whose length is not the number of faces, a value out of range, a mesh without faces or
            with points that are not finite.
    """
    surfaces = Surfaces()
    face_count = 0
    if mesh is None:
        device = check.device("device", device)
    else:
        check.kind("mesh", mesh, wp.Mesh)
        if mesh.indices.size < 3:
            raise ArgumentError(f"mesh.indices has {mesh.indices.size} entries; 3 for each face are needed")
        check.numbers("mesh.indices", mesh.indices, None, f"[0, {mesh.points.size - 1}]")
        device, face_count = mesh.device, mesh.indices.size // 3

    def by_face(name: str, value: Any, dtype: type, interval: str = "[0, 1]") -> wp.array:
        if mesh is None or (value is None and name != "reflectance"):
            return wp.zeros(0, dtype=dtype, device=device)
        if not isinstance(value, wp.array) and np.ndim(value) == 0:
            return wp.full(face_count, check.number(name, value, interval), dtype=dtype, device=device)
        if isinstance(value, wp.array) and value.ndim == 1 and value.size != face_count:
            raise ArgumentError(f"{name} has {value.size} entries; the mesh has {face_count} faces")
        check.array(name, value, dtype, (face_count,), device, contiguous=True)
        check.numbers(name, value, None, interval)
        return value

    surfaces.reflectance = by_face("reflectance", reflectance, float)
    if textures is not None:
        check.kind("textures", textures, Textures)
        if mesh is not None:
            needs = {"region": (None,), "texels": (None,), "coordinates": (face_count, 3)}
            check.fields("textures", textures, needs, device)
            by_face("textures.face", textures.face, int, f"[-1, {textures.region.size - 1}]")
            if corner_reflectance is None:
                rows = surfaces.reflectance.numpy()[:, None].repeat(3, axis=1)
                corner_reflectance = wp.array(rows, dtype=wp.vec3, device=device)
    surfaces.corner_reflectance = by_face("corner_reflectance", corner_reflectance, wp.vec3)
    surfaces.specular = by_face("specular", specular, float)
    surfaces.roughness = by_face("roughness", None if specular is None else roughness, float, "[0.01, 1]")
    _check_sum(surfaces)
    surfaces.textures = no_textures(device) if textures is None else textures
    surfaces.nodes, surfaces.faces, surfaces.order = empty_tree(device)
    surfaces.depth = wp.zeros(0, dtype=int, device=device)
    surfaces.near_depth = wp.zeros((0, 0), dtype=float, device=device)
    surfaces.patches, surfaces.normals = (wp.zeros(0, dtype=wp.vec4, device=device) for _ in range(2))
    if mesh is not None:
        _set_tree(surfaces, mesh, extent, use_warp_bvh)
        if camera is not None:
            surfaces.near_depth = near_depth_map(mesh, camera)
    return surfaces


def _set_tree(surfaces: Surfaces, mesh: wp.Mesh, extent: float | None, use_warp_bvh: bool) -> None:
    """Box, tree and patches of a mesh; an extent for one that will move."""
    points, device, face_count = mesh.points.numpy(), mesh.device, mesh.indices.size // 3
    check.numbers("mesh.points", points, None, "(-inf, inf)")
    lower, upper, still = points.min(axis=0), points.max(axis=0), extent is None
    if not still:
        upper = np.full(3, check.number("extent", extent, "(0, inf)"))
        lower = -upper
    surfaces.extent = float(abs(points).max() if still else upper[0])
    padding = 1e-6 * surfaces.extent + 1e-6
    surfaces.mesh = mesh.id
    surfaces.lower, surfaces.upper = wp.vec3(*(lower - padding)), wp.vec3(*(upper + padding))
    if use_warp_bvh:
        slots = np.arange(face_count if device.is_cuda else -(-face_count // LANES) * LANES)
        surfaces.nodes = wp.zeros(0, dtype=wp.vec4, device=device)
        # Each face in the slot of its own number.
        surfaces.order = wp.array(np.where(slots < face_count, slots, -1), dtype=int, device=device)
        surfaces.faces = pack_faces(mesh, surfaces.extent, surfaces.order)
    elif device.is_cuda:
        surfaces.nodes, surfaces.faces, surfaces.order, depth = pack_bvh(mesh, surfaces.extent, join=still)
        if not still:
            surfaces.depth, surfaces.levels = depth, int(depth.numpy().max()) + 1
    else:
        surfaces.nodes, surfaces.faces, surfaces.order = pack_wide(mesh, surfaces.extent)
        surfaces.levels = 0 if still else 1
    if device.is_cuda and face_count <= BRUTE_FORCE_FACES:
        surfaces.patches, surfaces.normals = pack_patches(mesh, surfaces.order.numpy(), still)


def update_surfaces(surfaces: Surfaces, mesh: wp.Mesh, camera: "Camera | None" = None) -> None:
    """Follows the points of a mesh that have moved, on the device: refits the surfaces' tree, or with `use_warp_bvh`
    the mesh's own; and the map of what the camera cannot miss, where the surfaces have one.

    Nothing is allocated or read, so that a CUDA graph can hold it. The tree keeps its shape: where faces have gone far
    from each other, surfaces made from a new `wp.Mesh` are faster.

    Args:
        surfaces: From `make_surfaces` of this mesh, with an `extent` that holds its points.
        mesh: The mesh, whose `points` have changed in place.
        camera: That of the surfaces, if they were made with one.

    Raises:
        ArgumentError: Surfaces of another mesh, made with a camera and updated without one, or the other way round.
    """
    check.kind("surfaces", surfaces, Surfaces)
    check.kind("mesh", mesh, wp.Mesh)
    if surfaces.mesh != mesh.id:
        raise ArgumentError("surfaces are not those of mesh")
    for name in ("near_depth", "nodes", "faces", "order", "depth", "levels", "patches", "normals"):
        if getattr(surfaces, name) is None:
            raise ArgumentError(f"surfaces.{name} is None; make_surfaces fills it")
    if (surfaces.near_depth.size > 0) != (camera is not None):
        made = "with" if surfaces.near_depth.size else "without"
        raise ArgumentError(f"surfaces were made {made} a camera; update_surfaces needs the same")
    check_faces("surfaces", surfaces, mesh.indices.size // 3, mesh.device)
    tree = (mesh, surfaces.extent, surfaces.nodes, surfaces.faces, surfaces.order)
    if not surfaces.nodes.size:
        mesh.refit()
        set_faces(mesh, surfaces.extent, surfaces.order, surfaces.faces)
    elif not surfaces.levels:
        raise ArgumentError("surfaces are not made to move: make_surfaces needs an extent")
    elif mesh.device.is_cuda:
        check.array("surfaces.depth", surfaces.depth, wp.int32, (surfaces.nodes.size // 4,), mesh.device)
        refit_bvh(*tree, surfaces.depth, surfaces.levels)
    else:
        refit_wide(*tree)
    if surfaces.patches.size:
        set_patches(mesh, surfaces.patches, surfaces.normals)
    if camera is not None:
        near_depth_map(mesh, camera, surfaces.near_depth)


def check_faces(name: str, surfaces: Surfaces, faces: int, device: wp.Device) -> None:
    """Raises `ArgumentError` for arrays of `Surfaces` that do not hold so many faces."""
    slots = faces if device.is_cuda else None
    slots = check.array(f"{name}.order", surfaces.order, wp.int32, (slots,), device).size
    check.array(f"{name}.faces", surfaces.faces, wp.vec4, (face_vectors(slots, device),), device)


def check_patches(name: str, surfaces: Surfaces, faces: int, device: wp.Device) -> None:
    """Raises `ArgumentError` for patches of another number of faces, or of none."""
    check.fields(name, surfaces, {"normals": (faces,), "patches": (None,)}, device)
    size = surfaces.patches.size
    if size == 0 or size % PATCH_ROWS:
        raise ArgumentError(f"{name}.patches has {size} entries; make_surfaces fills it")


def _check_sum(surfaces: Surfaces) -> None:
    """A face sends back at most what it gets."""
    if not surfaces.specular.size:
        return
    lambert = surfaces.reflectance.numpy()
    if surfaces.corner_reflectance.size:
        lambert = surfaces.corner_reflectance.numpy().max(axis=1)
    total = lambert + surfaces.specular.numpy()
    if total.max() > 1.0 + 1e-5:
        face = int(total.argmax())
        raise ArgumentError(f"reflectance[{face}] + specular[{face}] = {total[face]:g} is outside [0, 1]")


def surface_choices(surfaces: Surfaces) -> dict[str, bool]:
    """The fields of `TransportSpec` that surfaces need: `pattern`, `specular` and `use_warp_bvh`."""
    check.kind("surfaces", surfaces, Surfaces)
    names = ("corner_reflectance", "specular", "nodes")
    check.fields("surfaces", surfaces, dict.fromkeys(names, (None,)))
    pattern, specular, nodes = (getattr(surfaces, name).size > 0 for name in names)
    return {"pattern": pattern, "specular": specular, "use_warp_bvh": not nodes}


def no_textures(device: wp.DeviceLike = None) -> Textures:
    """Empty arrays in place of `make_textures`."""
    made = fill(Textures(), device, face=np.zeros(0), coordinates=np.zeros((0, 3, 2)))
    return fill(made, device, region=np.zeros((0, 3)), texels=np.zeros(0))


def make_textures(
    face: np.ndarray, coordinates: np.ndarray, images: Sequence[np.ndarray], *, device: wp.DeviceLike = None
) -> Textures:
    """Images for the faces of a mesh.

    Args:
        face: Index into `images` for each face, -1 for none; integers [faces].
        coordinates: (u, v) at the corners of each face, [faces, 3, 2]: (0, 0) is the image's lower left corner, (1, 1)
            its upper right one; outside of [0, 1] it repeats.
        images: Reflectance factors in [0, 1], each [rows, columns], the first row on top.
        device: Where to.

    Raises:
        ArgumentError: Another shape, or a value out of range.
    """
    check.kind("images", images, Sequence)
    device = check.device("device", device)
    check.integer("number of images", len(images), 1)
    images = [check.numbers(f"images[{k}]", image, (None, None), "[0, 1]") for k, image in enumerate(images)]
    check.integer("smallest number of texels", min(image.size for image in images), 1)
    face = check.numbers("face", face, (None,), f"[-1, {len(images) - 1}]", whole=True)
    coordinates = check.numbers("coordinates", coordinates, (face.size, 3, 2), "(-inf, inf)")
    ends = np.cumsum([0, *(image.size for image in images)])
    region = [(start, image.shape[1], image.shape[0]) for start, image in zip(ends, images, strict=False)]
    texels = np.concatenate([image.ravel() for image in images])
    return fill(Textures(), device, face=face, coordinates=coordinates, region=region, texels=texels)
