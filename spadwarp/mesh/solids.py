"""The few solids from which the built-in targets are put together.

Everything here is a `manifold3d.Manifold`: closed, oriented, and free of self-intersections after a boolean, so that
the targets are watertight by construction. Shapes are modelled in a studio frame, +x right, +y up, +z towards the
viewer, in metres; `to_triangles` turns that into the camera frame. Angles are in degrees.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from itertools import permutations

import numpy as np
from manifold3d import CrossSection, Manifold, Mesh64, OpType

Point = Sequence[float] | np.ndarray
"""Three coordinates [m]."""

_FROM_Z = {"x": (0.0, 90.0, 0.0), "y": (-90.0, 0.0, 0.0), "z": (0.0, 0.0, 0.0)}  # rotations of what stands along z


def union(*parts: Manifold) -> Manifold:
    """All parts as one solid."""
    return Manifold.batch_boolean(list(parts), OpType.Add)


def box(size: Point, at: Point = (0, 0, 0), *, rounding: float = 0.0) -> Manifold:
    """Box with side lengths `size` centred at `at`, its edges and corners rounded with radius `rounding`."""
    if rounding == 0.0:
        return Manifold.cube(size, center=True).translate(at)
    signs = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)])
    corners = signs * (np.asarray(size) / 2 - rounding)
    return Manifold.batch_hull([ball(rounding, corner, segments=24) for corner in corners]).translate(at)


def ball(radius: float | Point, at: Point = (0, 0, 0), *, segments: int = 48) -> Manifold:
    """Ball, or an ellipsoid if `radius` holds the three half-axes, centred at `at`."""
    half_axes = np.broadcast_to(np.asarray(radius, dtype=float), (3,))
    return Manifold.sphere(1.0, segments).scale(half_axes).translate(at)


def rod(start: Point, end: Point, radius: float, end_radius: float | None = None, *, segments: int = 32) -> Manifold:
    """Cylinder, or cone if `end_radius` differs, between two points; flat ends."""
    radii = [radius, radius if end_radius is None else end_radius]
    return tube([start, end], radii, sides=segments)


def capsule(start: Point, end: Point, radius: float, end_radius: float | None = None) -> Manifold:
    """Rod with round ends."""
    end_radius = radius if end_radius is None else end_radius
    return Manifold.batch_hull([ball(radius, start, segments=24), ball(end_radius, end, segments=24)])


def lathe(profile: Sequence[Sequence[float]] | np.ndarray, *, axis: str = "y", segments: int = 72) -> Manifold:
    """Closed polygon `profile`, pairs (radius, height) in either sense, revolved about the x, y or z axis."""
    return CrossSection([_counterclockwise(profile)]).revolve(segments).rotate(_FROM_Z[axis])


def torus(radius: float, thickness: float, *, axis: str = "y", segments: int = 64) -> Manifold:
    """Ring about the x, y or z axis: a circle of radius `thickness` carried round at `radius`."""
    return CrossSection.circle(thickness, 20).translate((radius, 0)).revolve(segments).rotate(_FROM_Z[axis])


def plate(outline: Sequence[Sequence[float]] | np.ndarray, thickness: float) -> Manifold:
    """Polygon `outline`, pairs (x, y) in either sense, extruded to `thickness` along z, centred on z = 0."""
    return CrossSection([_counterclockwise(outline)]).extrude(thickness).translate((0, 0, -thickness / 2))


def tube(
    path: Sequence[Point] | np.ndarray, radius: float | Sequence[float] | np.ndarray, *, sides: int = 16
) -> Manifold:
    """Round section carried along `path` [N, 3] without twist; `radius` is one number or one a point; flat ends."""
    points = np.asarray(path, dtype=float)
    radii = np.broadcast_to(np.asarray(radius, dtype=float), len(points))
    tangents = np.gradient(points, axis=0)
    tangents /= np.linalg.norm(tangents, axis=1, keepdims=True)
    angle = 2 * np.pi * (np.arange(sides) + 0.5) / sides
    normal = np.cross(tangents[0], np.eye(3)[np.argmin(np.abs(tangents[0]))])
    rings = []
    for point, tangent, r in zip(points, tangents, radii, strict=True):
        normal = normal - tangent * (normal @ tangent)  # parallel transport of the frame
        normal /= np.linalg.norm(normal)
        binormal = np.cross(tangent, normal)
        rings.append(point + r * (np.outer(np.cos(angle), normal) + np.outer(np.sin(angle), binormal)))
    return loft(rings)


def loft(rings: Sequence[np.ndarray] | np.ndarray) -> Manifold:
    """Skin over closed rings of points [S, N, 3], one after the other; the end rings are closed by fans."""
    points = np.asarray(rings, dtype=float)
    sections, n, _ = points.shape
    vertices = np.concatenate([points.reshape(-1, 3), [points[0].mean(axis=0), points[-1].mean(axis=0)]])
    here = np.arange(n)
    after = (here + 1) % n
    faces = []
    for s in range(sections - 1):
        a, b, c, d = s * n + here, s * n + after, (s + 1) * n + here, (s + 1) * n + after
        faces += [np.stack([a, b, c], axis=1), np.stack([b, d, c], axis=1)]
    last, caps = (sections - 1) * n, sections * n
    faces.append(np.stack([after, here, np.full(n, caps)], axis=1))
    faces.append(np.stack([last + here, last + after, np.full(n, caps + 1)], axis=1))
    return _solid(vertices, np.concatenate(faces))


def implicit(
    inside: Callable[[np.ndarray, np.ndarray, np.ndarray], np.ndarray], lower: Point, upper: Point, step: float
) -> Manifold:
    """Solid where `inside(x, y, z)` > 0, by marching tetrahedra.

    The grid has spacing `step` [m] from `lower` to `upper`, six tetrahedra a cell (Kuhn's subdivision, which fits
    together from cell to cell, so that the surface is closed). Raises ValueError if the solid reaches the border.
    """
    grid = np.meshgrid(*(np.arange(lo, hi + step, step) for lo, hi in zip(lower, upper, strict=True)), indexing="ij")
    value = inside(*grid)
    points = np.stack(grid, axis=-1).reshape(-1, 3)
    strides = np.array([value.shape[1] * value.shape[2], value.shape[2], 1])
    cells = np.arange(value.size).reshape(value.shape)[:-1, :-1, :-1].ravel()
    value = value.ravel()
    offsets = np.array([[i, j, k] for i in (0, 1) for j in (0, 1) for k in (0, 1)]) @ strides
    full = (value[cells[:, None] + offsets] > 0).sum(axis=1)
    cells = cells[(full > 0) & (full < 8)]

    edges = []  # triangles, each as three tetrahedron edges, each as two grid points
    for order in permutations(range(3)):
        tetrahedra = cells[:, None] + np.concatenate([[0], np.cumsum(strides[list(order)])])
        if np.linalg.det(np.eye(3)[list(order)]) < 0:
            tetrahedra = tetrahedra[:, [1, 0, 2, 3]]
        code = (value[tetrahedra] > 0) @ [1, 2, 4, 8]
        for pattern, triangles in _TETRAHEDRON_CASES.items():
            edges += [tetrahedra[code == pattern][:, triangle] for triangle in triangles]
    ends = np.sort(np.concatenate(edges), axis=2)
    keys, faces = np.unique(ends[..., 0] * value.size + ends[..., 1], return_inverse=True)
    a, b = np.divmod(keys, value.size)
    t = (value[a] / (value[a] - value[b]))[:, None]
    return _solid(points[a] * (1 - t) + points[b] * t, faces.reshape(-1, 3)).simplify(step / 25)


def _tetrahedron_cases() -> dict[int, list[list[list[int]]]]:
    """Triangles that part the corners inside (set bits) from those outside, for a positively oriented tetrahedron."""
    even = [p for p in permutations(range(4)) if np.linalg.det(np.eye(4)[list(p)]) > 0]
    cases: dict[int, list[list[list[int]]]] = {}
    for i, j, k, l in even:
        cases[1 << i] = [[[i, j], [i, k], [i, l]]]
        cases[15 - (1 << i)] = [[[i, j], [i, l], [i, k]]]
        cases[(1 << i) + (1 << j)] = [[[i, k], [i, l], [j, l]], [[i, k], [j, l], [j, k]]]
    return cases


_TETRAHEDRON_CASES = _tetrahedron_cases()


def around(part: Manifold, count: int, *, axis: str = "y", first: float = 0.0) -> Manifold:
    """`count` copies of `part`, evenly rotated about the x, y or z axis, the first one by `first` degrees."""
    turn = np.eye(3)["xyz".index(axis)]
    return union(*(part.rotate(turn * (first + 360 * k / count)) for k in range(count)))


def copies(part: Manifold, points: Iterable[Point]) -> Manifold:
    """A copy of `part` moved by each of `points`."""
    return union(*(part.translate(point) for point in points))


def mirrored(part: Manifold, axis: str = "x") -> Manifold:
    """`part` together with its mirror image across the plane through the origin normal to `axis`."""
    return union(part, part.mirror(np.eye(3)["xyz".index(axis)]))


def view(part: Manifold, size: float, *, yaw: float = 0.0, pitch: float = 0.0, roll: float = 0.0) -> Manifold:
    """Rotate to a good side and scale until the larger of width and height is `size` [m].

    `yaw` turns the front to the right, `pitch` then shows the top, `roll` lifts the right end.
    """
    rotated = part.rotate((0, yaw, 0)).rotate((pitch, 0, roll))
    x0, y0, _, x1, y1, _ = rotated.bounding_box()
    return rotated.scale(np.full(3, size / max(x1 - x0, y1 - y0)))


def spline(points: Sequence[Point] | np.ndarray, steps: int = 8, *, closed: bool = False) -> np.ndarray:
    """Catmull-Rom curve through `points` [N, D], `steps` pieces between neighbours."""
    p = np.asarray(points, dtype=float)
    p = np.concatenate([p[-1:], p, p[:2]]) if closed else np.concatenate([[2 * p[0] - p[1]], p, [2 * p[-1] - p[-2]]])
    t = np.linspace(0, 1, steps, endpoint=False)[:, None]
    pieces = [
        0.5 * (2 * b + (c - a) * t + (2 * a - 5 * b + 4 * c - d) * t**2 + (3 * b - a - 3 * c + d) * t**3)
        for a, b, c, d in zip(p, p[1:], p[2:], p[3:], strict=False)
    ]
    return np.concatenate(pieces if closed else [*pieces, p[-2:-1]])


def superellipse(
    half_width: float, half_height: float, exponent: float = 2.0, count: int = 48, *, at: Sequence[float] = (0, 0)
) -> np.ndarray:
    """Outline [count, 2] of |x/w|^n + |y/h|^n = 1 about `at`: an ellipse for n = 2, a rounded box for larger n."""
    angle = 2 * np.pi * np.arange(count) / count
    unit = np.stack([np.cos(angle), np.sin(angle)], axis=1)
    return np.sign(unit) * np.abs(unit) ** (2 / exponent) * (half_width, half_height) + np.asarray(at)


def station(x: float, bottom: float, top: float, half_width: float, exponent: float = 2.0) -> np.ndarray:
    """Ring of points [N, 3] for `loft`: the cross-section, a superellipse, of a long body at `x`."""
    outline = superellipse((top - bottom) / 2, half_width, exponent, 64, at=((top + bottom) / 2, 0))
    return np.insert(outline, 0, x, axis=1)


def smooth_union(fields: Iterable[np.ndarray], radius: float) -> np.ndarray:
    """Implicit fields (positive inside, [m]) joined with fillets of about `radius` (polynomial smooth maximum)."""
    joined, *rest = fields
    for field in rest:
        h = np.maximum(radius - np.abs(joined - field), 0.0) / radius
        joined = np.maximum(joined, field) + h * h * radius / 4
    return joined


def to_triangles(solid: Manifold) -> tuple[np.ndarray, np.ndarray]:
    """Corners `[V, 3]` in the camera frame (+x right, +y down, +z away), the bounding box centred at the origin, and
    faces `[F, 3]` of the solid."""
    mesh = solid.to_mesh64()
    vertices = np.asarray(mesh.vert_properties, dtype=float)[:, :3] * (1, -1, -1)
    vertices -= (vertices.min(axis=0) + vertices.max(axis=0)) / 2
    return vertices, np.asarray(mesh.tri_verts, dtype=np.int64)


def _counterclockwise(outline: Sequence[Sequence[float]] | np.ndarray) -> np.ndarray:
    points = np.asarray(outline, dtype=float)
    x, y = points.T
    return points if np.sum(x * np.roll(y, -1) - y * np.roll(x, -1)) > 0 else points[::-1]


def _solid(vertices: np.ndarray, faces: np.ndarray) -> Manifold:
    """Closed surface with either winding to a solid with outward normals."""
    a, b, c = (vertices[faces[:, k]] for k in range(3))
    if np.einsum("ij,ij->", a, np.cross(b, c)) < 0:
        faces = faces[:, ::-1]
    solid = Manifold(Mesh64(np.ascontiguousarray(vertices), np.ascontiguousarray(faces, dtype=np.uint64)))
    if solid.is_empty():
        raise ValueError(f"the surface of {len(faces)} faces is not a closed manifold: {solid.status()}")
    return solid
