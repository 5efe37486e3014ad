"""Targets: mesh files and built-in shapes, placed in the world and seen from the camera."""

from __future__ import annotations

import logging
import warnings
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.errors import ArgumentError, ConfigError, MeshError
from spadwarp.io.paths import MESH_ENDINGS, file_problem, similar
from spadwarp.mesh.builtins import SIZED_BUILTINS, make_builtin
from spadwarp.mesh.colours import Images, Pattern, read_coloured_mesh
from spadwarp.mesh.files import check_sizes, check_triangles
from spadwarp.mesh.usd import USD_ENDINGS, read_usd
from spadwarp.scene.camera import to_camera
from spadwarp.scene.pose import rotation_matrix

if TYPE_CHECKING:
    import trimesh

    from spadwarp.scene import Scene, Target

__all__ = ["TriangleMesh", "build_mesh", "load_target"]

# What trimesh says about a damaged file, with a stack, is for those who have set up logging; an error says the rest.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

MAX_FACES = 2**31 - 1
FARTHEST = 1e9  # [m], as for all coordinates of a scene


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
        ConfigError: An unknown built-in, or a size for one that has its own.
        MeshError: A target that is missing, unreadable, empty, not finite or without area; names file and field.
    """
    parts: list[TriangleMesh] = []
    vertex_count = face_count = 0
    varied = any(target.reflectance == "from_file" for target in scene.targets)
    lobes = any(target.specular > 0 for target in scene.targets)
    for index, target in enumerate(scene.targets):
        field = f"targets[{index}]" if scene.source is None else f"{scene.source}: targets[{index}]"
        mesh, images = _load(target, field, scene.laser.wavelength_nm)
        faces, count = np.asarray(mesh.faces, dtype=np.int64) + vertex_count, len(mesh.faces)
        vertex_count, face_count = vertex_count + len(mesh.vertices), face_count + count
        if max(vertex_count, face_count) > MAX_FACES:
            raise MeshError(f"{field}: the targets have more than {MAX_FACES} faces or vertices together")
        pattern = _pattern(mesh, images, target, field) if varied else None
        parts.append(
            TriangleMesh(
                vertices=to_camera(scene.camera, mesh.vertices).astype(np.float32),
                faces=faces.astype(np.int32),
                reflectance=_constant(target.reflectance, count) if pattern is None else _means(pattern),
                target=np.full(count, index, dtype=np.int32),
                pattern=pattern,
                specular=_constant(target.specular, count) if lobes else None,
                roughness=_constant(target.roughness, count) if lobes else None,
            )
        )
    if not parts:
        return None
    names = ("vertices", "faces", "reflectance", "target", *(("specular", "roughness") if lobes else ()))
    joined: dict[str, Any] = {name: np.concatenate([getattr(part, name) for part in parts]) for name in names}
    return TriangleMesh(**joined, pattern=_join([part.pattern for part in parts if part.pattern is not None]))


def _constant(value: Any, count: int) -> NDArray[np.float32]:
    return np.full(count, value, dtype=np.float32)


def _pattern(mesh: trimesh.Trimesh, images: Images, target: Target, field: str) -> Pattern:
    """The reflectance of a loaded target's faces."""
    count = len(mesh.faces)
    texture, coordinates = np.full(count, -1, dtype=np.int32), np.zeros((count, 3, 2), dtype=np.float32)
    if target.reflectance != "from_file":
        return Pattern(np.repeat(_constant(target.reflectance, count)[:, None], 3, axis=1), texture, coordinates, ())
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

    In this order: subdivided, stretched by `size` and `scale`, rotated, translated. `rotation_deg` (x, y, z) rotates it
    about its own axes, first x, then the new y, then the new z (intrinsic; R = Rx·Ry·Rz). A mesh file's axes are taken
    as they are.

    Faces that have no area in float32 are dropped, those of a mesh file with a warning that counts them.

    Args:
        target: What and where.
        field: How errors and warnings name the target; if empty, they name its file.

    Raises:
        ConfigError: An unknown built-in, or a size for one that has its own.
        MeshError: Missing or unreadable file, or a mesh that is empty, not finite or has no area.
    """
    return _load(target, field)[0]


def _load(target: Target, field: str, wavelength_nm: float = 532.0) -> tuple[trimesh.Trimesh, Images]:
    """`load_target`, and the images of a file that gives the reflectance."""
    images: Images = ()
    if target.mesh is not None:
        name, path = f"{field}.mesh = {target.mesh!r}" if field else target.mesh, Path(target.mesh)
        if (problem := file_problem(path)) is not None:
            raise MeshError(f"{name}: {problem}{similar(path) if problem == 'no such file' else ''}")
        if path.suffix.lower() not in MESH_ENDINGS and path.suffix[1:].lower() not in _other_endings():
            raise MeshError(f"{name}: {path.suffix!r} is no ending of a mesh file; {', '.join(MESH_ENDINGS)} are read")
        if target.reflectance == "from_file":
            mesh, images = read_coloured_mesh(path, name, wavelength_nm=wavelength_nm, encoding=target.colour_encoding)
        else:
            mesh = _read_mesh(path, name)
    else:
        assert target.builtin is not None  # the one or the other, see `Target`
        name = f"{field}.builtin = {target.builtin!r}"
        try:
            mesh = make_builtin(target.builtin)
        except ArgumentError as error:
            raise ConfigError(f"{field}.{error}") from error
        if target.size is not None and target.builtin not in SIZED_BUILTINS:
            raise ConfigError(
                f"{field}.size = {list(target.size)} does not go with builtin = {target.builtin!r}, which has its own;"
                f" it goes with {', '.join(SIZED_BUILTINS)}, and scale with all"
            )
    if len(mesh.faces) == 0:
        raise MeshError(f"{name}: the mesh has no faces")
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
    with np.errstate(over="ignore"):  # becomes infinite, which is refused
        corners = np.asarray(mesh.vertices, dtype=np.float32)[mesh.faces].astype(np.float64)
    if not (inside := np.abs(corners) <= FARTHEST).all():
        bad = int((~inside).any(axis=(1, 2)).sum())
        raise MeshError(
            f"{name}: {bad} of {len(mesh.faces)} faces have coordinates that are not finite, or beyond {FARTHEST:g} m"
        )
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    solid = (normals != 0.0).any(axis=1)
    if not solid.any():
        raise MeshError(f"{name}: none of the {len(mesh.faces)} faces has an area")
    if not solid.all():
        if target.mesh is not None:  # that a built-in has slivers needs no warning
            warnings.warn(f"{name}: dropped {(~solid).sum()} of {len(solid)} faces, which have no area", stacklevel=2)
        mesh.update_faces(solid)
    mesh.remove_unreferenced_vertices()
    return mesh, images


def placement(
    scale: NDArray[np.float64], rotation_deg: Sequence[float], translation: Sequence[float]
) -> NDArray[np.float64]:
    """4 × 4 matrix that scales, rotates (intrinsic x, y, z) and translates column vectors."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(rotation_deg) * scale
    matrix[:3, 3] = translation
    return matrix


def _other_endings() -> set[str]:
    """Endings, without the dot, of the formats that trimesh reads."""
    import trimesh

    return trimesh.available_formats()


def _read_mesh(path: Path, name: str) -> trimesh.Trimesh:
    """A mesh file in the file's own axes, several objects in it as one; in metres where the format has units."""
    import trimesh

    if path.suffix.lower() in USD_ENDINGS:
        return read_usd(path, name)
    check_sizes(path, name)
    try:
        mesh = trimesh.load_mesh(path, process=False)  # processing would drop what is not finite, without a warning
    except Exception as error:  # what trimesh raises depends on the format and its parser
        known = "STL, OBJ, PLY, OFF, GLB and USD can be read"
        raise MeshError(f"{name}: not a readable mesh file ({type(error).__name__}: {error}); {known}") from error
    if not isinstance(mesh, trimesh.Trimesh):
        raise MeshError(f"{name}: the file holds no triangles")
    check_triangles(mesh, name)
    if (np.abs(mesh.vertices) < 1e15).all():  # else merging would leave the range of integers
        mesh.merge_vertices(merge_tex=True, merge_norm=True)
    return mesh
