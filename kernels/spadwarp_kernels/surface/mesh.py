"""The target as the kernels take it: a mesh, its tree, its reflectance, images on it."""

from collections.abc import Sequence

import numpy as np
import warp as wp

from spadwarp_kernels.intersect.bvh import pack_bvh
from spadwarp_kernels.sensor.camera import Camera
from spadwarp_kernels.sensor.visibility import near_depth_map


@wp.struct
class Textures:
    """Images on faces; arrays of length 0 where there are none.

    Attributes:
        face: Texture of each face, -1 for none.
        coordinates: (u, v) of the corners of each face, [faces, 3]; u to the right, v up, images repeat with period 1.
        region: (offset into `texels`, width, height) of each texture.
        texels: Reflectance factors in [0, 1], row after row from the top.
    """

    face: wp.array(dtype=int)
    coordinates: wp.array2d(dtype=wp.vec2)
    region: wp.array(dtype=wp.vec3i)
    texels: wp.array(dtype=float)


@wp.struct
class Surfaces:
    """The target as the kernels take it, see `make_surfaces`.

    Attributes:
        mesh: Id of a `wp.Mesh`.
        lower, upper: Its bounding box [m], padded against rounding.
        nodes, faces, order: The mesh's tree, see `bvh`.
        reflectance: Of each face, in [0, 1].
        near_depth: What the camera cannot miss, see `near_depth_map`; empty if nothing is known.
        corner_reflectance: At the three corners of each face, instead of `reflectance`; empty unless it varies.
        textures: Images that multiply the corners' reflectance.
        specular: Reflectance of the facets of the specular lobe, of each face; empty if there is none.
        roughness: Their width parameter, see `microfacet`.
    """

    mesh: wp.uint64
    lower: wp.vec3
    upper: wp.vec3
    nodes: wp.array(dtype=wp.vec4)
    faces: wp.array(dtype=wp.vec4)
    order: wp.array(dtype=int)
    reflectance: wp.array(dtype=float)
    near_depth: wp.array2d(dtype=float)
    corner_reflectance: wp.array(dtype=wp.vec3)
    textures: Textures
    specular: wp.array(dtype=float)
    roughness: wp.array(dtype=float)


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
) -> Surfaces:
    """The kernel's view of a mesh.

    Lambertian reflectance plus `specular` must not exceed 1 anywhere. `surface_choices` has the fields of
    `TransportSpec` that go with what is returned.

    Args:
        mesh: Any `wp.Mesh`; None for no surface at all. After a refit, make the surfaces anew; the arrays may stay.
        reflectance: Lambertian, in [0, 1]: one number or a float32 array with one entry a face.
        corner_reflectance: Lambertian reflectance at the corners of each face, vec3 [faces], interpolated between them;
            replaces `reflectance`.
        textures: From `make_textures`; multiplies the corners', which default to `reflectance`.
        specular: Reflectance of the facets of a rough specular lobe, in [0, 1]: one number or an array as above.
        roughness: GGX width parameter of the lobe, in [0.01, 1]: one number or an array as above.
        camera: Saves most of the rays between scattering events and its lens.
        device: Where the empty arrays go if there is no mesh.

    Raises:
        ValueError: An array whose length is not the number of faces.
    """
    surfaces = Surfaces()
    device = device if mesh is None else mesh.device
    face_count = 0 if mesh is None else mesh.indices.size // 3

    def by_face(name: str, value: wp.array | float | None, dtype: type) -> wp.array:
        if mesh is None or value is None:
            return wp.zeros(0, dtype=dtype, device=device)
        if not isinstance(value, wp.array):
            value = wp.full(face_count, value, dtype=dtype, device=device)
        if len(value) != face_count:
            raise ValueError(f"{name} has {len(value)} entries; the mesh has {face_count} faces")
        return value

    surfaces.reflectance = by_face("reflectance", reflectance, float)
    if textures is not None and corner_reflectance is None:
        rows = surfaces.reflectance.numpy()[:, None].repeat(3, axis=1)
        corner_reflectance = wp.array(rows, dtype=wp.vec3, device=device)
    surfaces.corner_reflectance = by_face("corner_reflectance", corner_reflectance, wp.vec3)
    surfaces.specular = by_face("specular", specular, float)
    surfaces.roughness = by_face("roughness", None if specular is None else roughness, float)
    surfaces.textures = no_textures(device) if textures is None else textures
    surfaces.nodes = wp.zeros(0, dtype=wp.vec4, device=device)
    surfaces.faces = wp.zeros(0, dtype=wp.vec4, device=device)
    surfaces.order = wp.zeros(0, dtype=int, device=device)
    surfaces.near_depth = wp.zeros((0, 0), dtype=float, device=device)
    if mesh is None:
        return surfaces
    if textures is not None:
        by_face("textures.face", textures.face, int)
    points = mesh.points.numpy()
    lower, upper = points.min(axis=0), points.max(axis=0)
    extent = float(abs(points).max())
    padding = 1e-6 * extent + 1e-6
    surfaces.mesh = mesh.id
    surfaces.nodes, surfaces.faces, surfaces.order = pack_bvh(mesh, extent)
    surfaces.lower = wp.vec3(*(lower - padding))
    surfaces.upper = wp.vec3(*(upper + padding))
    if camera is not None:
        surfaces.near_depth = near_depth_map(mesh, camera)
    return surfaces


def surface_choices(surfaces: Surfaces) -> dict[str, bool]:
    """The fields of `TransportSpec` that surfaces need: `pattern` and `specular`."""
    return {"pattern": surfaces.corner_reflectance.size > 0, "specular": surfaces.specular.size > 0}


def no_textures(device: wp.DeviceLike = None) -> Textures:
    """Empty arrays in place of `make_textures`."""
    textures = Textures()
    textures.face = wp.zeros(0, dtype=int, device=device)
    textures.coordinates = wp.zeros((0, 3), dtype=wp.vec2, device=device)
    textures.region = wp.zeros(0, dtype=wp.vec3i, device=device)
    textures.texels = wp.zeros(0, dtype=float, device=device)
    return textures


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
    """
    ends = np.cumsum([0, *(image.size for image in images)])
    region = [(start, image.shape[1], image.shape[0]) for start, image in zip(ends, images, strict=False)]
    textures = Textures()
    textures.face = wp.array(np.asarray(face, np.int32), dtype=int, device=device)
    textures.coordinates = wp.array(np.asarray(coordinates, np.float32), dtype=wp.vec2, device=device)
    textures.region = wp.array(np.array(region, np.int32), dtype=wp.vec3i, device=device)
    texels = np.concatenate([np.asarray(image, np.float32).ravel() for image in images])
    textures.texels = wp.array(texels, dtype=float, device=device)
    return textures
