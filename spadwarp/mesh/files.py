"""Mesh files: checks of what trimesh passes over, reflectance from colours, and OpenUSD."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from spadwarp.values import MeshError

if TYPE_CHECKING:
    import trimesh

_JSON_CHUNK = 0x4E4F534A


def check_triangles(mesh: trimesh.Trimesh, name: str) -> None:
    """Raises `MeshError` where vertices are not points or faces refer to none."""
    if mesh.vertices.shape[1:] != (3,):
        raise MeshError(f"{name}: its vertices have {mesh.vertices.shape[-1]} coordinates; three are needed")
    if len(mesh.faces) and not 0 <= mesh.faces.min() <= mesh.faces.max() < len(mesh.vertices):
        raise MeshError(f"{name}: a face refers to a vertex that does not exist")


def check_sizes(path: Path, name: str) -> None:
    """Raises `MeshError` for a GLB file that declares more numbers than it has bytes, for which memory would be taken.

    What is no GLB file is left to its reader.
    """
    if path.suffix.lower() != ".glb":
        return
    size = path.stat().st_size
    try:
        with path.open("rb") as file:
            _, _, _, length, kind = struct.unpack("<4sIIII", file.read(20))
            accessors = json.loads(file.read(min(length, size))).get("accessors", []) if kind == _JSON_CHUNK else []
        counts = [int(accessor["count"]) for accessor in accessors]
    except (OSError, struct.error, ValueError, LookupError, TypeError, AttributeError, RecursionError) as error:
        raise MeshError(f"{name}: not a readable mesh file ({type(error).__name__}: {error})") from error
    if counts and not 0 <= min(counts) <= max(counts) <= size:
        raise MeshError(f"{name}: declares {max(counts)} numbers in a file of {size} bytes")


# Colours

Array = NDArray[np.float64]
Images = tuple[NDArray[np.float32], ...]

COLOUR_CHANNELS = (("red", 580.0), ("green", 490.0), ("blue", 0.0))
"""Which channel of a colour counts, by the shortest wavelength [nm] for which it does."""

_LARGEST_IMAGE = 1 << 26  # pixels
_KNOWN = "PLY, OBJ, GLB and OFF files can hold colours"


@dataclass(frozen=True, eq=False)
class Pattern:
    """Reflectance that varies within the faces of a mesh: at their corners, times an image."""

    corners: NDArray[np.float32]  # float32 `[F, 3]`, reflectance at the corners of each face
    texture: NDArray[np.int32]  # int32 `[F]`, index into `images`, -1 for none
    coordinates: NDArray[np.float32]
    """float32 `[F, 3, 2]`, (u, v) at the corners: (0, 0) is an image's lower left corner, (1, 1) its upper right one;
    images repeat."""
    images: Images  # float32 `[rows, columns]` each, factors in [0, 1]


def colour_channel(wavelength_nm: float) -> int:
    """Index of the colour channel for a laser: red from 580 nm, green from 490 nm, else blue."""
    return next(index for index, (_, shortest) in enumerate(COLOUR_CHANNELS) if wavelength_nm >= shortest)


def srgb_to_linear(value: Array) -> Array:
    """Reflectance of an sRGB component in [0, 1] (IEC 61966-2-1)."""
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4)


def read_coloured_mesh(
    path: Path, name: str, *, wavelength_nm: float = 532.0, encoding: str = "srgb"
) -> tuple[trimesh.Trimesh, Images]:
    """A mesh whose faces share no vertices, and the images on them.

    `vertex_attributes["surface"]`, `[V, 4]`, has the reflectance of each vertex (in [0, 1], images left out), the index
    of its image (-1 for none), u and v. Of colours the channel of the wavelength counts. Colours of vertices and faces
    and the texels of images are decoded from sRGB unless `encoding` is "linear"; colours of materials, and of vertices
    in GLB, are linear already.

    Raises `MeshError`: the file cannot be read, or has no colours.
    """
    import trimesh

    channel, ending = colour_channel(wavelength_nm), path.suffix.lower()[1:]

    def decode(values: Any, encoded: bool) -> Array:
        if np.ndim(values) < 1 or np.shape(values)[-1] < 3 or np.asarray(values).dtype.kind not in "iuf":
            raise MeshError(f"{name}: a colour of the file, {values!r}, is not red, green and blue")
        colours = _as_fraction(np.asarray(values)[..., :3], name)[..., channel]
        return srgb_to_linear(colours) if encoded and encoding == "srgb" else colours

    corners, surfaces = [], []
    images: dict[int, NDArray[np.float32]] = {}
    places: dict[int, int] = {}
    for mesh, transform in _parts(path, ending, name):
        count = len(mesh.faces)
        shade, texture, uv, found = np.ones((count, 3)), -1, np.zeros((count, 3, 2)), False
        colours = mesh.vertex_attributes.get("colour", mesh.face_attributes.get("colour"))
        if colours is not None:
            values, found = decode(colours, ending != "glb"), True
            shade *= values[mesh.faces] if "colour" in mesh.vertex_attributes else values[:, None]
        visual: Any = mesh.visual
        if visual.kind == "texture":
            image, factor = _material(visual.material)
            if factor is not None:
                shade, found = shade * decode(factor, False), True
            if image is not None and visual.uv is not None and len(visual.uv) == len(mesh.vertices):
                if np.shape(visual.uv)[1:] != (2,) or not np.isfinite(visual.uv).all():
                    raise MeshError(f"{name}: texture coordinates that are not two finite numbers for each vertex")
                uv, found = visual.uv[mesh.faces], True
                texture = places.setdefault(id(image), len(places))
                if texture not in images:
                    images[texture] = np.ascontiguousarray(decode(_pixels(image, name), True), np.float32)
        if not found:
            raise MeshError(
                f"{name}: reflectance = 'from_file', but {_what_it_has(visual)}; give a number, or a file with colours"
                f" ({_KNOWN})"
            )
        corners.append(trimesh.transform_points(mesh.vertices, transform)[mesh.faces].reshape(-1, 3))
        if np.linalg.det(transform[:3, :3]) < 0.0:  # keep outsides outside
            order = np.arange(3 * count).reshape(-1, 3)[:, ::-1].ravel()
            corners[-1], shade, uv = corners[-1][order], shade[:, ::-1], uv[:, ::-1]
        index = np.full(3 * count, float(texture))
        surfaces.append(np.column_stack([shade.ravel(), index, uv.reshape(-1, 2)]))
    vertices = np.concatenate(corners)
    faces = np.arange(len(vertices)).reshape(-1, 3)
    attributes: dict[str, Any] = {"surface": np.concatenate(surfaces)}
    soup = trimesh.Trimesh(vertices, faces, vertex_attributes=attributes, process=False)
    return soup, tuple(images[number] for number in range(len(images)))


def _parts(path: Path, ending: str, name: str) -> Iterator[tuple[trimesh.Trimesh, Array]]:
    """The meshes of a file and where they stand, the file's colours as attributes `colour` without rounding."""
    import trimesh
    from trimesh.exchange.load import mesh_loaders
    from trimesh.resolvers import FilePathResolver

    if ending not in ("ply", "obj", "glb", "off"):
        given = path.suffix or "this file"
        raise MeshError(f"{name}: reflectance = 'from_file' cannot be combined with {given}; {_KNOWN}")
    if ending == "obj":
        _check_materials(path, name)
    check_sizes(path, name)
    try:
        with path.open("rb") as file:
            if ending == "off":
                parsed = _read_off(file.read().decode(errors="replace"))
            else:
                parsed = mesh_loaders[ending](file_obj=file, file_type=ending, resolver=FilePathResolver(str(path)))
        for part in parsed.get("geometry", {"": parsed}).values():
            part["process"] = False
            for kind in ("vertex", "face"):
                if (colours := part.pop(f"{kind}_colors", None)) is not None:
                    part[f"{kind}_attributes"] = {"colour": np.asarray(colours)}
            visual = part.get("visual")
            if visual is not None and (colours := visual.vertex_attributes.get("color")) is not None and len(colours):
                part["vertex_attributes"] = {"colour": np.asarray(colours)}
        scene = trimesh.load_scene(parsed)
    except Exception as error:  # what trimesh raises depends on the format and its parser
        raise MeshError(f"{name}: not a readable mesh file ({type(error).__name__}: {error})") from error
    nodes = [scene.graph[node] for node in scene.graph.nodes_geometry]
    parts = [(scene.geometry[geometry], transform) for transform, geometry in nodes]
    parts = [(mesh, where) for mesh, where in parts if isinstance(mesh, trimesh.Trimesh) and len(mesh.faces)]
    if not parts:
        raise MeshError(f"{name}: the file holds no triangles")
    for mesh, where in parts:
        check_triangles(mesh, name)
        colours = mesh.face_attributes.get("colour")
        if colours is not None and len(colours) != len(mesh.faces):
            number = len(mesh.faces)
            raise MeshError(f"{name}: {len(colours)} colours of faces for {number} triangles; triangulate the file")
        yield mesh, np.asarray(where, dtype=np.float64)


def _check_materials(path: Path, name: str) -> None:
    """Refuses an OBJ file whose material file or images are missing, which trimesh passes over."""
    for line in path.read_text(errors="replace").splitlines():
        if line.split(maxsplit=1)[:1] == ["mtllib"]:
            if len(line.split()) < 2:
                raise MeshError(f"{name}: mtllib stands without the name of a material file")
            materials = path.parent / line.split(maxsplit=1)[1].strip()
            if not materials.is_file():
                raise MeshError(f"{name}: its material file {os.fspath(materials)!r} is missing")
            for entry in materials.read_text(errors="replace").splitlines():
                if problem := _material_problem(entry.strip(), materials.parent):
                    raise MeshError(f"{name}: {materials.name} {problem}")


def _material_problem(entry: str, folder: Path) -> str:
    """What makes trimesh pass over a material, or over its image, or nothing."""
    import PIL.Image

    words = entry.split()
    key = words[0].lower() if words else ""
    if key == "kd":
        try:
            whole = len([float(word) for word in words[1:]]) == 3
        except ValueError:
            whole = False
        return "" if whole else f"has {entry[:80]!r}, which is not red, green and blue"
    if key == "map_kd":
        image = folder / entry[len(key) :].strip()
        if not image.is_file():
            return f"names an image that is missing: {entry!r}"
        try:
            PIL.Image.open(image).close()
        except Exception as error:  # what Pillow raises depends on the format
            return f"names {entry!r}, which is no image: {error}"
    return ""


def _read_off(text: str) -> dict[str, Any]:
    """Vertices, faces (polygons as fans) and colours of an OFF or COFF file, which trimesh drops."""
    lines = [words for line in text.splitlines() if (words := line.split("#")[0].split())]
    if lines[0][0].upper() not in ("OFF", "COFF"):
        raise ValueError(f"the header is {lines[0][0]!r}")
    lines[0] = lines[0][1:]
    lines = [words for words in lines if words]
    vertex_count, face_count = int(lines[0][0]), int(lines[0][1])
    points, polygons = lines[1 : 1 + vertex_count], lines[1 + vertex_count : 1 + vertex_count + face_count]
    parsed: dict[str, Any] = {"vertices": np.array([words[:3] for words in points], dtype=np.float64)}
    if all(len(words) >= 6 for words in points):
        parsed["vertex_colors"] = _numbers([words[3:6] for words in points])
    faces, colours = [], []
    for words in polygons:
        corners = [int(word) for word in words[1 : 1 + int(words[0])]]
        colour = words[1 + len(corners) : 4 + len(corners)]
        for second, third in pairwise(corners[1:]):
            faces.append((corners[0], second, third))
            colours.append(colour)
    parsed["faces"] = np.array(faces, dtype=np.int64).reshape(-1, 3)
    if len(faces) and not 0 <= parsed["faces"].min() <= parsed["faces"].max() < vertex_count:
        raise ValueError("a face refers to a vertex that does not exist")
    if "vertex_colors" not in parsed and colours and all(len(colour) == 3 for colour in colours):
        parsed["face_colors"] = _numbers(colours)
    return parsed


def _numbers(rows: list[list[str]]) -> NDArray[Any]:
    """Colours as 8-bit integers if all are written as integers, else as fractions."""
    whole = all(word.lstrip("+-").isdigit() for row in rows for word in row)
    values = np.array(rows, dtype=np.float64)
    return values / 255.0 if whole else values


def _as_fraction(colours: NDArray[Any], name: str) -> Array:
    """Components in [0, 1] from integers of any width or from fractions."""
    values = colours.astype(np.float64)
    if colours.dtype.kind in "iu":
        values /= np.iinfo(colours.dtype).max
    if (wrong := values[~((values >= 0.0) & (values <= 1.0))]).size:
        raise MeshError(f"{name}: a colour component of {wrong.flat[0]:g} is outside [0, 1]")
    return values


def _material(material: Any) -> tuple[Any, Any]:
    """Image and linear colour factor of a material, None for what it lacks."""
    if hasattr(material, "baseColorTexture"):
        return material.baseColorTexture, material.baseColorFactor
    # Where there is no material, trimesh makes one with an image that no file gave a format.
    image = material.image if material.image is not None and material.image.format else None
    return image, material.kwargs.get("kd")


def _pixels(image: Any, name: str) -> NDArray[Any]:
    """RGB components of a Pillow image, `[rows, columns, 3]`; grey ones in all three. Decodes it."""
    if image.width * image.height > _LARGEST_IMAGE:
        raise MeshError(f"{name}: an image of {image.width} x {image.height} pixels; {_LARGEST_IMAGE} are read at most")
    try:
        if image.mode.startswith("I"):
            return np.repeat(np.asarray(image).astype(np.uint16)[..., None], 3, axis=2)
        return np.asarray(image.convert("RGB"))
    except Exception as error:  # what Pillow raises depends on the format
        raise MeshError(f"{name}: an image that is damaged: {error}") from error


def _what_it_has(visual: Any) -> str:
    if visual.kind != "texture":
        return "the file has neither colours nor materials"
    if visual.uv is not None and len(visual.uv):
        return "the file has texture coordinates and no image"
    return "the file has a material without a colour"


# OpenUSD

USD_ENDINGS = (".usd", ".usda", ".usdc", ".usdz")

_MOST_FACES = 1 << 27
_PURPOSES = ("default", "render")  # guides and proxies are not what a camera sees

Part = tuple[NDArray[np.float64], NDArray[np.int64]]


def read_usd(path: Path, name: str) -> trimesh.Trimesh:
    """All visible meshes and simple shapes of a USD stage at its first time as one mesh [m], in the stage's own axes.

    Transforms of the prims, instances, point instancers and `metersPerUnit` are applied; polygons are divided into
    triangles. Layers and payloads that the file refers to are read, too. `name`: how errors name the target.
    Raises `MeshError` where there is no readable stage or nothing to see in it.
    """
    import trimesh
    from pxr import Tf, Usd, UsdGeom

    try:
        stage = Usd.Stage.Open(str(path))
        time = Usd.TimeCode(stage.GetStartTimeCode()) if stage.HasAuthoredTimeCodeRange() else Usd.TimeCode.Default()
        parts = list(_usd_parts(stage.GetPseudoRoot(), UsdGeom.XformCache(time), time))
    except Tf.ErrorException as error:
        raise MeshError(f"{name}: not a readable USD stage: {' '.join(str(error).split())}") from error
    faces = sum(len(part) for _, part in parts)
    if not faces:
        raise MeshError(f"{name}: the USD stage holds no visible mesh")
    if faces > _MOST_FACES:
        raise MeshError(f"{name}: the USD stage holds {faces} triangles; at most {_MOST_FACES} are allowed")
    starts = np.cumsum([0, *(len(points) for points, _ in parts)])
    points = np.concatenate([points for points, _ in parts]) * UsdGeom.GetStageMetersPerUnit(stage)
    triangles = np.concatenate([part + start for (_, part), start in zip(parts, starts, strict=False)])
    return trimesh.Trimesh(points, triangles, process=False)


def _usd_parts(root: Any, cache: Any, time: Any, within: Any = None) -> Iterator[Part]:
    """Points in the frame of `within` (None: of the stage) and triangles of each visible prim below `root`."""
    from pxr import Usd, UsdGeom

    prims = iter(Usd.PrimRange(root, Usd.TraverseInstanceProxies()))
    for prim in prims:
        shape = UsdGeom.Imageable(prim)
        hidden = shape and shape.ComputeVisibility(time) == UsdGeom.Tokens.invisible
        if hidden or (shape and shape.ComputePurpose() not in _PURPOSES):
            prims.PruneChildren()
            continue
        world = cache.GetLocalToWorldTransform
        placed = world(prim) if within is None else cache.ComputeRelativeTransform(prim, within)[0]
        if prim.IsA(UsdGeom.PointInstancer):
            prims.PruneChildren()
            yield from _instances(UsdGeom.PointInstancer(prim), placed, cache, time)
        elif (part := _mesh(prim, time)) is not None:
            matrix = np.array(placed)  # of row vectors
            yield part[0] @ matrix[:3, :3] + matrix[3, :3], part[1]


def _instances(instancer: Any, placed: Any, cache: Any, time: Any) -> Iterator[Part]:
    """The prototypes of an instancer at each of their places."""
    stage = instancer.GetPrim().GetStage()
    prims = [stage.GetPrimAtPath(path) for path in instancer.GetPrototypesRel().GetTargets()]
    prototypes = [list(_usd_parts(prim, cache, time, within=prim)) for prim in prims]
    which = instancer.GetProtoIndicesAttr().Get(time) or []
    for index, transform in zip(which, instancer.ComputeInstanceTransformsAtTime(time, time), strict=False):
        matrix = np.array(transform * placed)
        for points, triangles in prototypes[index]:
            yield points @ matrix[:3, :3] + matrix[3, :3], triangles


def _mesh(prim: Any, time: Any) -> Part | None:
    """Points and triangles of a prim in its own frame; None for what has no surface."""
    from pxr import UsdGeom

    if not prim.IsA(UsdGeom.Mesh):
        return _simple(prim, time)
    mesh = UsdGeom.Mesh(prim)
    points = np.array(mesh.GetPointsAttr().Get(time) or [], np.float64).reshape(-1, 3)
    counts = np.array(mesh.GetFaceVertexCountsAttr().Get(time) or [], np.int64)
    indices = np.array(mesh.GetFaceVertexIndicesAttr().Get(time) or [], np.int64)
    if counts.sum() != len(indices) or (counts < 0).any():
        raise MeshError(f"{prim.GetPath()}: its faces do not divide its {len(indices)} indices")
    first = np.cumsum(counts) - counts
    # Fans: corner 0 with each pair of the corners that follow.
    fan = np.maximum(counts - 2, 0)
    face = np.repeat(np.arange(len(counts)), fan)
    step = np.arange(len(face)) - (np.cumsum(fan) - fan)[face]
    corners = first[face][:, None] + np.stack([np.zeros_like(step), step + 1, step + 2], axis=1)
    return points, indices[corners].reshape(-1, 3)


def _simple(prim: Any, time: Any) -> Part | None:
    """A cube, sphere, cylinder, cone, capsule or plane as triangles."""
    import trimesh
    from pxr import UsdGeom

    def value(name: str) -> Any:
        return prim.GetAttribute(name).Get(time)

    if prim.IsA(UsdGeom.Cube):
        made = trimesh.creation.box(extents=[value("size")] * 3)
    elif prim.IsA(UsdGeom.Sphere):
        made = trimesh.creation.icosphere(subdivisions=4, radius=value("radius"))
    elif prim.IsA(UsdGeom.Cylinder):
        made = trimesh.creation.cylinder(radius=value("radius"), height=value("height"), sections=64)
    elif prim.IsA(UsdGeom.Cone):
        made = trimesh.creation.cone(radius=value("radius"), height=value("height"), sections=64)
        made.apply_translation([0, 0, -0.5 * value("height")])
    elif prim.IsA(UsdGeom.Capsule):
        made = trimesh.creation.capsule(radius=value("radius"), height=value("height"), count=[64, 64])
    elif prim.IsA(UsdGeom.Plane):
        made = trimesh.creation.box(extents=[value("width"), value("length"), 0.0])
        made.update_faces(made.face_normals[:, 2] > 0.5)
    else:
        return None
    axis = value("axis") if prim.HasAttribute("axis") else "Z"
    points = np.roll(made.vertices, {"X": 1, "Y": 2, "Z": 0}[str(axis)], axis=1)
    return np.asarray(points, np.float64), np.asarray(made.faces, np.int64)
