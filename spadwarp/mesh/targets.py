"""Targets: built-in shapes and mesh files, placed in the world and seen from the camera, and where it is focused."""

from __future__ import annotations

import logging
import math
import warnings
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import cache, reduce
from itertools import product
from operator import add
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from spadwarp.io.paths import MESH_ENDINGS, file_problem, similar
from spadwarp.mesh.files import USD_ENDINGS, Images, Pattern, check_sizes, check_triangles, read_coloured_mesh, read_usd
from spadwarp.scene import Scene, Target
from spadwarp.scene.camera import to_camera, to_world
from spadwarp.scene.port import PortGeometry
from spadwarp.scene.pose import rotation_matrix
from spadwarp.scene.scene import camera_port
from spadwarp.scene.sight import points_inside, view_planes
from spadwarp.values import ArgumentError, ConfigError, MeshError, suggestion

__all__ = ["BUILTINS", "SIZED_BUILTINS", "MeshSummary", "TriangleMesh", "build_mesh", "builtin_names", "describe_mesh"]
__all__ += ["focus_distance", "guess_unit", "load_target", "make_builtin"]

if TYPE_CHECKING:
    import trimesh

Triangles = tuple[NDArray[np.float64], NDArray[np.int64]]
"""Corners `[V, 3]` [m] and faces `[F, 3]`: with them alone, scenes of built-ins do without trimesh, which takes most
of a second to import."""

BUILTINS = ("staircase", "plane", "box", "sphere")
"""The geometric built-ins."""
SIZED_BUILTINS = ("plane", "box", "sphere")
"""Built-ins of 1 m that `size` stretches; the others have sizes of their own."""


def builtin_names() -> tuple[str, ...]:
    """Names that `builtin` can take."""
    from spadwarp.mesh.shapes import SHAPES

    return (*BUILTINS, *SHAPES)


def make_builtin(name: str) -> trimesh.Trimesh:
    """The built-in `name` as a mesh in its own frame [m], built once and copied for each caller.

    Raises `ArgumentError` for a name that is not among `builtin_names()`.
    """
    import trimesh

    vertices, faces = _built(name)
    return trimesh.Trimesh(vertices.copy(), faces.copy(), process=False)


@cache
def _built(name: str) -> Triangles:
    from spadwarp.mesh.shapes import SHAPES
    from spadwarp.mesh.solids import to_triangles

    if name not in (known := builtin_names()):
        raise ArgumentError(f"builtin = {name!r} is not one of {', '.join(map(repr, known))}{suggestion(name, known)}")
    match name:
        case "staircase":
            return _staircase()
        case "plane":  # at z = 0, facing −z
            corners = [(-0.5, -0.5, 0.0), (0.5, -0.5, 0.0), (0.5, 0.5, 0.0), (-0.5, 0.5, 0.0)]
            return np.array(corners), np.array([(0, 2, 1), (0, 3, 2)])
        case "box":
            return _box((-0.5, -0.5, -0.5), (0.5, 0.5, 0.5))
        case "sphere":  # 1280 triangles with their corners on it
            from trimesh.creation import icosphere

            sphere = icosphere(subdivisions=3, radius=0.5)
            return np.asarray(sphere.vertices), np.asarray(sphere.faces)
    return to_triangles(SHAPES[name]())


def _box(low: Sequence[float], high: Sequence[float]) -> Triangles:
    corners = np.array(list(product((0.0, 1.0), repeat=3))) * np.subtract(high, low) + low
    faces = "130 410 032 240 173 514 571 372 642 276 654 756"  # wound outwards
    return corners, np.array([[int(corner) for corner in face] for face in faces.split()])


def _staircase() -> Triangles:
    """The paper's staircase (a 4 m plate with nine bars): one closed mesh, face at z = 0, bars towards −z.

    Seen from the camera. Left half: three vertical bars over the full height. Upper right quarter: three horizontal
    bars, the lowest ending at mid-height. Lower right quarter: three vertical bars. Where the bars leave 3 cm of a half
    free, the strip is at the middle of the plate, as in the depth maps that the paper's authors published.
    """
    from manifold3d import Manifold, Mesh

    plate = ((-2.0, -2.0, 0.0), (2.0, 2.0, 0.1))
    left = [((x, -2.0, -proud), (x + 0.63, 2.0, 0.1)) for x, proud in ((-2.0, 0.6), (-1.33, 0.5), (-0.66, 0.4))]
    upper = [((0.0, y, -proud), (2.0, y + 0.6, 0.1)) for y, proud in ((-2.0, 0.3), (-1.3, 0.2), (-0.6, 0.1))]
    lower = [((x, 0.0, -proud), (x + 0.63, 2.0, 0.1)) for x, proud in ((0.03, 0.3), (0.7, 0.2), (1.37, 0.1))]
    parts = []
    for low, high in (plate, *left, *upper, *lower):
        corners, faces = _box(low, high)
        parts.append(Manifold(Mesh(corners.astype(np.float32), faces.astype(np.uint32))))
    while len(parts) > 1:  # in pairs: the order of the faces is that of earlier versions
        parts = [reduce(add, parts[k : k + 2]) for k in range(0, len(parts), 2)]
    mesh = parts[0].to_mesh()
    return np.round(mesh.vert_properties.astype(np.float64), 6), mesh.tri_verts.astype(np.int64)


# What trimesh says about a damaged file, with a stack, is for those who have set up logging; an error says the rest.
logging.getLogger("trimesh").addHandler(logging.NullHandler())

MAX_FACES = 2**31 - 1
FARTHEST = 1e9  # [m], as for all coordinates of a scene


@dataclass(frozen=True, eq=False)
class TriangleMesh:
    """All targets of a scene as one mesh in the camera frame: +x right, +y down, +z away from the camera."""

    vertices: NDArray[np.float32]  # float32 `[V, 3]` [m]
    faces: NDArray[np.int32]  # int32 `[F, 3]`, indices into `vertices`
    reflectance: NDArray[np.float32]  # float32 `[F]`, Lambertian reflectance of both sides, in [0, 1]
    target: NDArray[np.int32]  # int32 `[F]`, index into `scene.targets`
    pattern: Pattern | None = None
    """Where the reflectance varies within faces; `reflectance` then has their means over the corners, times the mean of
    the face's image."""
    specular: NDArray[np.float32] | None = None  # float32 `[F]`, of the specular lobe; None if no target has one
    roughness: NDArray[np.float32] | None = None  # the same

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
        mesh = _load(target, field, scene.laser.wavelength_nm)
        faces, count = mesh.faces + vertex_count, len(mesh.faces)
        vertex_count, face_count = vertex_count + len(mesh.vertices), face_count + count
        if max(vertex_count, face_count) > MAX_FACES:
            raise MeshError(f"{field}: the targets have more than {MAX_FACES} faces or vertices together")
        pattern = _pattern(mesh, target, field) if varied else None
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


def _pattern(mesh: _Loaded, target: Target, field: str) -> Pattern:
    """The reflectance of a loaded target's faces."""
    count, images = len(mesh.faces), mesh.images
    texture, coordinates = np.full(count, -1, dtype=np.int32), np.zeros((count, 3, 2), dtype=np.float32)
    if mesh.surface is None:
        return Pattern(np.repeat(_constant(target.reflectance, count)[:, None], 3, axis=1), texture, coordinates, ())
    surface = mesh.surface[mesh.faces]
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
    """One target as a mesh in the world [m]; `field`: how errors and warnings name it, if empty by its file.

    In this order: subdivided, stretched by `size` and `scale`, rotated, translated. `rotation_deg` (x, y, z) rotates it
    about its own axes, first x, then the new y, then the new z (intrinsic; R = Rx·Ry·Rz). A mesh file's axes are taken
    as they are. Faces that have no area in float32 are dropped, those of a mesh file with a warning that counts them.

    Raises `ConfigError`: an unknown built-in, or a size for one that has its own; `MeshError`: missing or unreadable
    file, or a mesh that is empty, not finite or has no area.
    """
    import trimesh

    vertices, faces, surface, _ = _load(target, field)
    attributes: dict[str, Any] = {} if surface is None else {"surface": surface}
    return trimesh.Trimesh(vertices, faces, vertex_attributes=attributes, process=False)


class _Loaded(NamedTuple):
    vertices: NDArray[np.float64]
    faces: NDArray[np.int64]
    surface: NDArray[np.float64] | None  # what a file that gives the reflectance says of each vertex
    images: Images = ()  # of that file


def _read(target: Target, field: str, wavelength_nm: float) -> tuple[str, _Loaded]:
    """A target as errors name it, and in its own frame."""
    if target.mesh is not None:
        import trimesh

        images: Images = ()
        name, path = f"{field}.mesh = {target.mesh!r}" if field else target.mesh, Path(target.mesh)
        if (problem := file_problem(path)) is not None:
            raise MeshError(f"{name}: {problem}{similar(path) if problem == 'no such file' else ''}")
        if path.suffix.lower() not in MESH_ENDINGS and path.suffix[1:].lower() not in trimesh.available_formats():
            raise MeshError(f"{name}: {path.suffix!r} is no ending of a mesh file; {', '.join(MESH_ENDINGS)} are read")
        if target.reflectance == "from_file":
            mesh, images = read_coloured_mesh(path, name, wavelength_nm=wavelength_nm, encoding=target.colour_encoding)
        else:
            mesh = _read_mesh(path, name)
        surface: Any = mesh.vertex_attributes.get("surface") if target.reflectance == "from_file" else None
        return name, _Loaded(np.asarray(mesh.vertices), np.asarray(mesh.faces), surface, images)
    assert target.builtin is not None  # the one or the other, see `Target`
    name = f"{field}.builtin = {target.builtin!r}"
    try:
        loaded = _Loaded(*_built(target.builtin), None)
    except ArgumentError as error:
        raise ConfigError(f"{field}.{error}") from error
    if target.size is not None and target.builtin not in SIZED_BUILTINS:
        raise ConfigError(
            f"{field}.size = {list(target.size)} cannot be combined with builtin = {target.builtin!r}, which"
            f" has its own; it is for {', '.join(SIZED_BUILTINS)}, and scale for all"
        )
    return name, loaded


def _load(target: Target, field: str, wavelength_nm: float = 532.0) -> _Loaded:
    """`load_target`, as arrays."""
    name, loaded = _read(target, field, wavelength_nm)
    if (count := len(loaded.faces)) == 0:
        raise MeshError(f"{name}: the mesh has no faces; the file is empty, cut, or of another format")
    if count * 4**target.subdivisions > MAX_FACES:
        raise MeshError(
            f"{field}.subdivisions = {target.subdivisions} makes {count * 4**target.subdivisions} faces"
            f" of {count}; at most {MAX_FACES} are allowed"
        )
    if target.subdivisions:
        loaded = _subdivided(loaded, target)
    size = target.size or (1.0,)  # one number for all axes, two for x and y, or three
    stretch = np.array([*size, 1.0] if len(size) == 2 else np.broadcast_to(size, 3))
    vertices, faces, surface, images = loaded
    matrix = placement(stretch * target.scale, target.rotation_deg, target.translation)
    if np.abs(matrix - np.eye(4)).max() >= 1e-8:
        vertices = np.dot(matrix, np.column_stack([vertices, np.ones(len(vertices))]).T).T[:, :3]
        if np.linalg.det(matrix[:3, :3]) < 0.0:  # mirrored: normals stay outwards
            faces = np.ascontiguousarray(faces[:, ::-1])
    with np.errstate(over="ignore"):  # becomes infinite, which is refused
        corners = np.asarray(vertices, dtype=np.float32)[faces].astype(np.float64)
    if not (inside := np.abs(corners) <= FARTHEST).all():
        bad = int((~inside).any(axis=(1, 2)).sum())
        raise MeshError(
            f"{name}: {bad} of {len(faces)} faces have coordinates that are not finite, or beyond {FARTHEST:g} m"
        )
    normals = np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0])
    solid = (normals != 0.0).any(axis=1)
    if not solid.any():
        raise MeshError(f"{name}: none of the {len(faces)} faces has an area")
    if not solid.all():
        if target.mesh is not None:  # that a built-in has slivers needs no warning
            warnings.warn(f"{name}: dropped {(~solid).sum()} of {len(solid)} faces, which have no area", stacklevel=2)
        faces = faces[solid]
    used = np.zeros(len(vertices), dtype=bool)
    used[faces] = True
    return _Loaded(vertices[used], (np.cumsum(used) - 1)[faces], None if surface is None else surface[used], images)


def _subdivided(loaded: _Loaded, target: Target) -> _Loaded:
    import trimesh

    attributes: dict[str, Any] = {} if loaded.surface is None else {"surface": loaded.surface}
    mesh = trimesh.Trimesh(loaded.vertices, loaded.faces, vertex_attributes=attributes, process=False)
    for _ in range(target.subdivisions):
        mesh = mesh.subdivide()
        if target.builtin == "sphere":  # new corners lie on chords
            mesh.vertices *= 0.5 / np.linalg.norm(mesh.vertices, axis=1, keepdims=True)
    surface: Any = mesh.vertex_attributes.get("surface")
    return _Loaded(np.asarray(mesh.vertices), np.asarray(mesh.faces), surface, loaded.images)


def placement(
    scale: NDArray[np.float64], rotation_deg: Sequence[float], translation: Sequence[float]
) -> NDArray[np.float64]:
    """4 × 4 matrix that scales, rotates (intrinsic x, y, z) and translates column vectors."""
    matrix = np.eye(4)
    matrix[:3, :3] = rotation_matrix(rotation_deg) * scale
    matrix[:3, 3] = translation
    return matrix


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


# What a mesh file holds, before it stands in a scene

# Units of mesh files in the order of likelihood, and the longest sides of things under water [m].
_UNITS = {"m": 1.0, "mm": 1e-3, "cm": 1e-2, "µm": 1e-6}
_SIDES = (0.03, 30.0)


@dataclass(frozen=True, kw_only=True)
class MeshSummary:
    """A mesh file."""

    path: Path  # the file
    faces: int  # triangles with an area
    extent: tuple[float, ...]  # size along x, y, z, in the file's unit
    centre: tuple[float, ...]  # centre of the bounding box, in the file's unit
    unit: str | None  # the unit in which it has the size of a thing under water: m, mm, cm or µm; None if there is none
    scale: float  # for `targets.scale`: this unit in metres; 1 without one
    longest: float  # longest side with this scale [m]
    is_watertight: bool  # whether every edge belongs to two faces, so that there is an inside
    is_inside_out: bool  # whether the faces of a closed mesh are wound inwards: no difference here
    bodies: int  # parts that do not touch

    @property
    def hints(self) -> tuple[str, ...]:
        """Advice for its target in a scene."""
        found = []
        if self.scale != 1.0:
            found.append(f"scale = {self.scale:g} if the unit is {self.unit}: {self.longest:.3g} m long")
        if self.unit is None:
            found.append(f"{max(self.extent):.3g} long: neither m, mm nor cm makes it the size of a thing under water")
        offset = max(abs(place) for place in self.centre)
        if offset > 0.5 * max(self.extent):
            place = ", ".join(f"{self.scale * x:.3g}" for x in self.centre)
            found.append(f"its centre is at ({place}) m, not at the origin: translation has to allow for that")
        if self.extent[2] > 1.5 * max(self.extent[:2]):
            found.append(
                "longest along z, the direction of view: rotation_deg = [90, 0, 0] stands a mesh upright whose z is "
                "up, [0, 90, 0] shows its side"
            )
        if not self.is_watertight:
            found.append("not closed: light may pass through gaps; faces reflect on both sides")
        return tuple(found)


def describe_mesh(path: str | Path) -> MeshSummary:
    """Size, unit, orientation and closedness of a mesh file (STL, OBJ, PLY, OFF, GLB, USD). Raises `MeshError`."""
    import trimesh

    mesh = load_target(Target(mesh=str(path)), field="")
    low, high = np.asarray(mesh.bounds, np.float64)
    extent, centre = high - low, 0.5 * (low + high)
    unit, scale = guess_unit(float(extent.max())) or (None, 1.0)
    labels = trimesh.graph.connected_component_labels(mesh.face_adjacency, node_count=len(mesh.faces))
    return MeshSummary(
        path=Path(path),
        faces=len(mesh.faces),
        extent=tuple(extent.tolist()),
        centre=tuple(centre.tolist()),
        unit=unit,
        scale=scale,
        longest=float(extent.max()) * scale,
        is_watertight=bool(mesh.is_watertight),
        is_inside_out=bool(mesh.is_watertight and mesh.volume < 0.0),
        bodies=int(labels.max(initial=-1)) + 1,
    )


def guess_unit(longest: float) -> tuple[str, float] | None:
    """Name and metres of the likeliest unit of a mesh whose longest side is `longest`; None if none fits."""
    fitting = ((name, metres) for name, metres in _UNITS.items() if _SIDES[0] <= longest * metres <= _SIDES[1])
    return next(fitting, None)


# Focus

_FAR = 1e6  # stands for infinity behind a port [m]


def focus_distance(scene: Scene, mesh: TriangleMesh | None) -> float | None:
    """Depth that the scene's camera images sharply [m]; None for a pinhole, which images all depths sharply.

    `camera.focus_distance`, or for "target" the depth of the first face on the optical axis; without one there, that of
    the point in view which is seen closest to the axis; without any, infinity. Nothing nearer than the focal length and
    the aperture's radius counts: no lens can be focused there. Behind a port, it is the depth in air at which the lens
    sees that point: 0.75 of it behind a flat one, some radii behind a dome. `mesh`: from `build_mesh`.
    """
    camera, port = scene.camera, camera_port(scene)
    if camera.pinhole:
        return None
    if camera.focus_distance != "target":
        return camera.focus_distance
    if port is not None:
        return _apparent_distance(scene, port, mesh)
    if mesh is None:
        return math.inf
    triangles = mesh.vertices[mesh.faces].astype(np.float64)
    nearest = max(camera.focal_length or 0.0, camera.aperture_radius)
    return _first_depth(triangles, lambda: points_inside(triangles, view_planes(camera)), nearest) or math.inf


def _apparent_distance(scene: Scene, port: PortGeometry, mesh: TriangleMesh | None) -> float:
    """Depth in air at which the lens sees the first target on its axis, or what is seen closest to that."""
    start, axis, _, _ = port.enter((0.0, 0.0, 0.0), (0.0, 0.0, 1.0))
    depth = None
    if mesh is not None:
        frame = np.stack([*np.linalg.svd(axis[None])[2][1:], axis])
        triangles = (mesh.vertices[mesh.faces].astype(np.float64) - start) @ frame.T
        depth = _first_depth(triangles, lambda: triangles.reshape(-1, 3), 0.0)
    return float(port.apparent_distance(start + (depth or _FAR) * axis))


def _first_depth(
    triangles: NDArray[np.float64], points: Callable[[], NDArray[np.float64]], nearest: float
) -> float | None:
    """Depth beyond `nearest` of the first of the triangles `[F, 3, 3]` on the z axis, else that of the point which is
    seen closest to the axis; None without any."""
    depth = _axis_depths(triangles)
    if (depth > nearest).any():
        return float(depth[depth > nearest].min())
    seen = points()
    seen = seen[seen[:, 2] > nearest]
    return float(seen[np.argmin(np.hypot(seen[:, 0], seen[:, 1]) / seen[:, 2]), 2]) if len(seen) else None


def _axis_depths(triangles: NDArray[np.float64]) -> NDArray[np.float64]:
    """Depths at which the z axis meets triangles `[F, 3, 3]`, edges included."""
    x, y, z = np.moveaxis(triangles, 2, 0)
    # Twice the signed areas between the axis and each edge, as seen along it: the corners' weights.
    weights = np.roll(x, -1, axis=1) * np.roll(y, -2, axis=1) - np.roll(x, -2, axis=1) * np.roll(y, -1, axis=1)
    met = ((weights >= 0.0).all(axis=1) | (weights <= 0.0).all(axis=1)) & (weights != 0.0).any(axis=1)
    weights, z = weights[met], z[met]
    return (weights * z).sum(axis=1) / weights.sum(axis=1)


def target_balls(scene: Scene, mesh: TriangleMesh | None) -> list[tuple[NDArray[np.float64], float]]:
    """Middle in the world and radius [m] of a ball that holds each target; none without a mesh."""
    every = [] if mesh is None else [mesh.vertices[mesh.faces[mesh.target == k]] for k in range(len(scene.targets))]
    corners = [to_world(scene.camera, triangles.reshape(-1, 3)) for triangles in every]
    return [(m := 0.5 * (p.min(axis=0) + p.max(axis=0)), float(np.linalg.norm(p - m, axis=1).max())) for p in corners]
