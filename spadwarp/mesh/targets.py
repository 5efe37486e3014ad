"""Targets: mesh files and built-in shapes, placed in the world and seen from the camera."""

from __future__ import annotations

import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import MeshError
from spadwarp.mesh.colours import Images, Pattern, read_coloured_mesh
from spadwarp.scene.pose import rotation_matrix, to_camera

if TYPE_CHECKING:
    import trimesh

    from spadwarp.scene import Scene, Target

__all__ = ["BUILTINS", "SIZED_BUILTINS", "TriangleMesh", "build_mesh", "builtin_names", "load_target"]

MAX_FACES = 2**31 - 1


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """All targets of a scene as one mesh in the camera frame: +x right, +y down, +z away from the camera.

    Attributes:
        vertices: float32 `[V, 3]` [m].
        faces: int32 `[F, 3]`, indices into `vertices`.
        reflectance: float32 `[F]`, Lambertian reflectance of both sides, in [0, 1].
        target: int32 `[F]`, index into `scene.targets`.
        pattern: Where the reflectance varies within faces; `reflectance` then has their means over the corners, times
            the mean of the face's image.
        specular, roughness: float32 `[F]`, of the specular lobe; None if no target has one.
    """

    vertices: NDArray[np.float32]
    faces: NDArray[np.int32]
    reflectance: NDArray[np.float32]
    target: NDArray[np.int32]
    pattern: Pattern | None = None
    specular: NDArray[np.float32] | None = None
    roughness: NDArray[np.float32] | None = None

    @property
    def face_count(self) -> int:
        """Number of triangles."""
        return len(self.faces)

    @property
    def bounds(self) -> NDArray[np.float32]:
        """Lowest and highest coordinates of the faces [m], `[2, 3]`."""
        corners = self.vertices[self.faces.ravel()]
        return np.stack([corners.min(axis=0), corners.max(axis=0)])


def build_mesh(scene: Scene) -> TriangleMesh | None:
    """The scene's targets as one mesh, or None if it has none.

    Raises:
        MeshError: A target that is missing, unreadable, empty, not finite or without area; names file and field.
    """
    parts: list[TriangleMesh] = []
    vertex_count = 0
    varied = any(target.reflectance == "from_file" for target in scene.targets)
    lobes = any(target.specular > 0 for target in scene.targets)
    for index, target in enumerate(scene.targets):
        field = f"targets[{index}]" if scene.source is None else f"{scene.source}: targets[{index}]"
        mesh, images = _load(target, field, scene.laser.wavelength_nm)
        faces = np.asarray(mesh.faces, dtype=np.int64) + vertex_count
        vertex_count += len(mesh.vertices)
        if vertex_count > MAX_FACES or sum(part.face_count for part in parts) + len(faces) > MAX_FACES:
            raise MeshError(f"{field}: the targets have more than {MAX_FACES} faces or vertices together")
        pattern = _pattern(mesh, images, target, field) if varied else None
        parts.append(
            TriangleMesh(
                vertices=to_camera(scene.camera, mesh.vertices).astype(np.float32),
                faces=faces.astype(np.int32),
                reflectance=_number(target, len(faces)) if pattern is None else _means(pattern),
                target=np.full(len(faces), index, dtype=np.int32),
                pattern=pattern,
                specular=np.full(len(faces), target.specular, dtype=np.float32) if lobes else None,
                roughness=np.full(len(faces), target.roughness, dtype=np.float32) if lobes else None,
            )
        )
    if not parts:
        return None
    return TriangleMesh(
        vertices=np.concatenate([part.vertices for part in parts]),
        faces=np.concatenate([part.faces for part in parts]),
        reflectance=np.concatenate([part.reflectance for part in parts]),
        target=np.concatenate([part.target for part in parts]),
        pattern=_join([part.pattern for part in parts if part.pattern is not None]),
        specular=_concatenate([part.specular for part in parts]),
        roughness=_concatenate([part.roughness for part in parts]),
    )


def _number(target: Target, count: int) -> NDArray[np.float32]:
    return np.full(count, target.reflectance, dtype=np.float32)


def _concatenate(arrays: Sequence[NDArray[np.float32] | None]) -> NDArray[np.float32] | None:
    given = [array for array in arrays if array is not None]
    return np.concatenate(given) if given else None


def _pattern(mesh: trimesh.Trimesh, images: Images, target: Target, field: str) -> Pattern:
    """The reflectance of a loaded target's faces."""
    count = len(mesh.faces)
    texture, coordinates = np.full(count, -1, dtype=np.int32), np.zeros((count, 3, 2), dtype=np.float32)
    if target.reflectance != "from_file":
        return Pattern(np.repeat(_number(target, count)[:, None], 3, axis=1), texture, coordinates, ())
    surface: NDArray[np.float64] = np.asarray(mesh.vertex_attributes["surface"])[mesh.faces]
    corners = surface[:, :, 0] * target.reflectance_scale
    texture = surface[:, 0, 1].round().astype(np.int32)
    coordinates = np.ascontiguousarray(surface[:, :, 2:], dtype=np.float32)
    brightest = np.array([*(image.max() for image in images), 1.0], dtype=np.float64)[texture]
    highest = float((corners.max(axis=1) * brightest).max())
    if highest + target.specular > 1.0 + 1e-6:
        raise MeshError(
            f"{field}: the file's reflectance reaches {highest / target.reflectance_scale:.4g}; times"
            f" reflectance_scale = {target.reflectance_scale:g}, plus specular = {target.specular:g}, that is"
            f" {highest + target.specular:.4g}, outside [0, 1]"
        )
    return Pattern(corners.astype(np.float32), texture, coordinates, images)


def _means(pattern: Pattern) -> NDArray[np.float32]:
    """One reflectance a face: exact where it does not vary."""
    means = pattern.corners.mean(axis=1, dtype=np.float64)
    flat = (pattern.corners == pattern.corners[:, :1]).all(axis=1)
    means[flat] = pattern.corners[flat, 0]
    brightness = np.array([*(image.mean() for image in pattern.images), 1.0], dtype=np.float64)
    return (means * brightness[pattern.texture]).astype(np.float32)


def _join(patterns: Sequence[Pattern]) -> Pattern | None:
    """All targets' patterns as one; None if no face's reflectance varies."""
    if not patterns:
        return None
    corners = np.concatenate([pattern.corners for pattern in patterns])
    before = np.cumsum([0, *(len(pattern.images) for pattern in patterns)])
    textures = [np.where(p.texture < 0, -1, p.texture + n) for p, n in zip(patterns, before, strict=False)]
    texture = np.concatenate(textures).astype(np.int32)
    if (texture < 0).all() and (corners == corners[:, :1]).all():
        return None
    coordinates = np.concatenate([pattern.coordinates for pattern in patterns])
    return Pattern(corners, texture, coordinates, tuple(image for pattern in patterns for image in pattern.images))


def load_target(target: Target, *, field: str = "target") -> trimesh.Trimesh:
    """One target as a mesh in the world [m].

    In this order: subdivided, stretched by `size` and `scale`, rotated, translated. `rotation_deg` (x, y, z) turns it
    about its own axes, first x, then the turned y, then the twice turned z (intrinsic; R = Rx·Ry·Rz). A mesh file's
    axes are taken as they stand.

    Faces that have no area in float32 are dropped, those of a mesh file with a warning that counts them.

    Args:
        target: What and where.
        field: How errors and warnings name the target.

    Raises:
        MeshError: Missing or unreadable file, unknown built-in, or a mesh that is empty, not finite or has no area.
    """
    return _load(target, field)[0]


def _load(target: Target, field: str, wavelength_nm: float = 532.0) -> tuple[trimesh.Trimesh, Images]:
    """`load_target`, and the images of a file that gives the reflectance."""
    images: Images = ()
    if target.mesh is not None:
        name, path = f"{field}.mesh = {target.mesh!r}", Path(target.mesh)
        if not path.is_file():
            raise MeshError(f"{name}: {'is not a file' if path.exists() else 'no such file'}")
        if target.reflectance == "from_file":
            mesh, images = read_coloured_mesh(path, name, wavelength_nm=wavelength_nm, encoding=target.colour_encoding)
        else:
            mesh = _read_mesh(path, name)
    else:
        name, mesh = f"{field}.builtin = {target.builtin!r}", _make_builtin(str(target.builtin), field)
        if target.size is not None and target.builtin not in SIZED_BUILTINS:
            raise MeshError(
                f"{field}.size = {list(target.size)} does not go with builtin = {target.builtin!r}, which has its own;"
                f" it goes with {', '.join(SIZED_BUILTINS)}, and scale with all"
            )
    if len(mesh.faces) * 4**target.subdivisions > MAX_FACES:
        raise MeshError(
            f"{field}.subdivisions = {target.subdivisions} makes {len(mesh.faces) * 4**target.subdivisions} faces"
            f" of {len(mesh.faces)}; at most {MAX_FACES} are allowed"
        )
    for _ in range(target.subdivisions):
        mesh = mesh.subdivide()
        if target.builtin == "sphere":  # new corners lie on chords
            mesh.vertices *= 0.5 / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)

    size = target.size or (1.0,)  # one number for all axes, two for x and y, or three
    stretch = np.array([*size, 1.0] if len(size) == 2 else np.broadcast_to(size, 3))
    mesh.apply_transform(placement(stretch * target.scale, target.rotation_deg, target.translation))
    if len(mesh.faces) == 0:
        raise MeshError(f"{name}: the mesh has no faces")
    with np.errstate(over="ignore"):  # becomes infinite, which is refused
        corners = np.asarray(mesh.vertices, dtype=np.float32)[mesh.faces].astype(np.float64)
    if not np.isfinite(corners).all():
        bad = int((~np.isfinite(corners)).any(axis=(1, 2)).sum())
        raise MeshError(f"{name}: {bad} of {len(mesh.faces)} faces have coordinates that are not finite")
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    solid = (normals != 0.0).any(axis=1)
    if not solid.any():
        raise MeshError(f"{name}: none of the {len(mesh.faces)} faces has an area")
    if not solid.all():
        if target.mesh is not None:  # slivers of a built-in are no news
            warnings.warn(f"{name}: dropped {(~solid).sum()} of {len(solid)} faces, which have no area", stacklevel=2)
        mesh.update_faces(solid)
    mesh.remove_unreferenced_vertices()
    return mesh, images


def builtin_names() -> tuple[str, ...]:
    """Names that `builtin` can take."""
    from spadwarp.mesh.shapes import SHAPES

    return (*BUILTINS, *SHAPES)


def _make_builtin(name: str, field: str) -> trimesh.Trimesh:
    """A new mesh of a built-in in its own frame [m]."""
    if name in BUILTINS:
        return BUILTINS[name]()
    if name not in builtin_names():
        raise MeshError(f"{field}.builtin = {name!r} is not one of {', '.join(map(repr, builtin_names()))}")
    from spadwarp.mesh.shapes import make_shape

    return make_shape(name)


def placement(
    scale: NDArray[np.float64], rotation_deg: Sequence[float], translation: Sequence[float]
) -> NDArray[np.float64]:
    """4 × 4 matrix that scales, rotates (intrinsic x, y, z) and translates column vectors."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(rotation_deg) * scale
    matrix[:3, 3] = translation
    return matrix


def _read_mesh(path: Path, name: str) -> trimesh.Trimesh:
    """A mesh file in the file's own units and axes; several objects in it become one."""
    import trimesh

    try:
        mesh = trimesh.load_mesh(path, process=False)  # processing drops what is not finite without a word
    except Exception as error:  # what trimesh raises depends on the format and its parser
        known = "STL, OBJ, PLY, OFF and GLB can be read"
        raise MeshError(f"{name}: not a readable mesh file ({type(error).__name__}: {error}); {known}") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise MeshError(f"{name}: the file holds no triangles")
    if np.isfinite(mesh.vertices).all():
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh


# Built-in targets


def _staircase() -> trimesh.Trimesh:
    """The paper's staircase (a 4 m plate with nine bars): one closed mesh, face at z = 0, bars towards −z.

    Seen from the camera. Left half: three vertical bars over the full height. Upper right quarter: three horizontal
    bars, the lowest ending at mid-height. Lower right quarter: three vertical bars. Where the bars leave 3 cm of a half
    free, the strip is at the middle of the plate, as in the depth maps that the paper's authors published.
    """
    plate = ((-2.0, -2.0, 0.0), (2.0, 2.0, 0.1))
    left = [((x, -2.0, -proud), (x + 0.63, 2.0, 0.1)) for x, proud in ((-2.0, 0.6), (-1.33, 0.5), (-0.66, 0.4))]
    upper = [((0.0, y, -proud), (2.0, y + 0.6, 0.1)) for y, proud in ((-2.0, 0.3), (-1.3, 0.2), (-0.6, 0.1))]
    lower = [((x, 0.0, -proud), (x + 0.63, 2.0, 0.1)) for x, proud in ((0.03, 0.3), (0.7, 0.2), (1.37, 0.1))]
    return _union([plate, *left, *upper, *lower])


def _union(boxes: Sequence[tuple[Sequence[float], Sequence[float]]]) -> trimesh.Trimesh:
    """One closed mesh of axis-aligned boxes, each given by its lowest and its highest corner."""
    import trimesh

    mesh = trimesh.boolean.union([trimesh.creation.box(bounds=bounds) for bounds in boxes], engine="manifold")
    mesh.vertices = np.round(mesh.vertices, 6)  # the union came back in float32
    return mesh


def _plane() -> trimesh.Trimesh:
    """A square of side 1 m at z = 0 that faces −z, two triangles."""
    import trimesh

    corners = [(-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0)]
    return trimesh.Trimesh(corners, [(0, 2, 1), (0, 3, 2)], process=False)


def _box() -> trimesh.Trimesh:
    """A cube of side 1 m about the origin, twelve triangles."""
    import trimesh

    return trimesh.creation.box(extents=(1.0, 1.0, 1.0))


def _sphere() -> trimesh.Trimesh:
    """A ball of diameter 1 m about the origin: an icosahedron subdivided three times, 1280 triangles, corners on it."""
    import trimesh

    return trimesh.creation.icosphere(subdivisions=3, radius=0.5)


BUILTINS: dict[str, Callable[[], trimesh.Trimesh]] = {
    "staircase": _staircase,
    "plane": _plane,
    "box": _box,
    "sphere": _sphere,
}
"""The geometric built-ins: functions without arguments that make a new mesh in its own frame [m].

The objects of `spadwarp.mesh.shapes` join them; `builtin_names` has all.
"""

SIZED_BUILTINS = ("plane", "box", "sphere")
"""Built-ins of 1 m that `size` stretches; the others have sizes of their own."""
