"""Rays against meshes: no leaks, exact distances, offsets that clear the surface."""

import numpy as np
import pytest
import trimesh
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import Floats, Integers, Vectors, launched
from helpers.meshes import mesh_and_surfaces
from spadwarp_kernels import (
    intersect_mesh,
    intersect_surfaces,
    offset_from_surface,
    random_block,
    rotate_direction,
    u01,
)
from spadwarp_kernels.surface.bvh import segment_meets_box


@wp.kernel(enable_backward=False)
def _leaks(surfaces: sk.Surfaces, extent: wp.vec3, rays: int, leaks: Integers):
    """Random rays from random points of a box that lies inside the mesh."""
    i = wp.tid()
    missed = int(0)
    for k in range(rays):
        a = random_block(wp.uint64(1), wp.uint64(i), wp.uint32(k), wp.uint32(1))
        b = random_block(wp.uint64(1), wp.uint64(i), wp.uint32(k), wp.uint32(2))
        x = wp.cw_mul(wp.vec3(u01(a[0]) - 0.5, u01(a[1]) - 0.5, u01(a[2]) - 0.5), extent)
        u = rotate_direction(wp.vec3(0.0, 0.0, 1.0), 2.0 * u01(b[0]), u01(b[1]))
        if intersect_surfaces(surfaces, x, u, 1.0e6, False).face < 0:
            missed += 1
    leaks[i] = missed


@wp.kernel(enable_backward=False)
def _aim(surfaces: sk.Surfaces, x: Vectors, to: Vectors, hit: Integers):
    i = wp.tid()
    u = wp.normalize(to[i] - x[i])
    hit[i] = wp.where(intersect_surfaces(surfaces, x[i], u, 1.0e6, False).face >= 0, 1, 0)


@wp.kernel(enable_backward=False)
def _bounce(surfaces: sk.Surfaces, x: Vectors, u: Vectors, gap: Floats):
    """Distance to the next surface after a bounce back along the normal; the sphere's diameter unless it hits
    itself."""
    i = wp.tid()
    hit = intersect_surfaces(surfaces, x[i], u[i], 1.0e6, False)
    start = offset_from_surface(x[i] + hit.distance * u[i], hit.normal, hit.distance)
    gap[i] = intersect_surfaces(surfaces, start, hit.normal, 1.0e6, False).distance


@wp.kernel(enable_backward=False)
def _boxes(x: Vectors, u: Vectors, length: float, meets: Integers):
    i = wp.tid()
    box = segment_meets_box(x[i], u[i], length, wp.vec3(-1.0, -2.0, -0.5), wp.vec3(1.0, 2.0, 0.5))
    meets[i] = wp.where(box, 1, 0)


@wp.kernel(enable_backward=False)
def _both_walks(
    surfaces: sk.Surfaces, x: Vectors, u: Vectors, reach: float, face: wp.array(dtype=wp.vec3i), distance: Vectors
):
    """Nearest hit by Warp's walk and by ours, and any hit by ours."""
    i = wp.tid()
    query = intersect_mesh(surfaces.mesh, x[i], u[i], reach)
    nearest = intersect_surfaces(surfaces, x[i], u[i], reach, False)
    some = intersect_surfaces(surfaces, x[i], u[i], reach, True)
    face[i] = wp.vec3i(query.face, nearest.face, some.face)
    distance[i] = wp.vec3(query.distance, nearest.distance, some.distance)


SHAPES = {
    "box": (trimesh.creation.box(extents=(1, 2, 3)), (0.9, 1.8, 2.7)),
    "sphere": (trimesh.creation.icosphere(subdivisions=4, radius=1.0), (1.0, 1.0, 1.0)),
}


@pytest.mark.physics
@pytest.mark.parametrize("name", SHAPES)
def test_random_rays_do_not_leak(name, device):
    shape, extent = SHAPES[name]
    _kept, surfaces = mesh_and_surfaces(shape, device)
    # 1e8 rays on a GPU; at most ten may leak. On the CPU 2e6 and none.
    threads, rays = (100_000, 1000) if device != "cpu" else (20_000, 100)
    (leaks,) = launched(_leaks, [surfaces, wp.vec3(*extent), rays], [int], device, threads)
    assert leaks.sum() <= (10 if device != "cpu" else 0)


@pytest.mark.parametrize(("builder", "leaf_size"), [(None, 1), (None, 4), ("sah", 4), ("median", 3), ("cubql", 1)])
def test_our_walk_hits_what_warp_hits(builder, leaf_size, device):
    """In a soup of triangles of all sizes, from outside and inside, along the axes too; and in the shapes above."""
    rng = np.random.default_rng(5)
    corners = rng.normal(size=(3000, 1, 3)) + rng.lognormal(-2.0, 1.0, (3000, 1, 1)) * rng.normal(size=(3000, 3, 3))
    soup = trimesh.Trimesh(corners.reshape(-1, 3), np.arange(9000).reshape(-1, 3), process=False)
    x = rng.uniform(-3, 3, size=(50_000, 3))
    u = rng.normal(size=x.shape)
    u[:5000, 0] = 0.0
    u[2500:7500, 1] = 0.0
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    for shape in (soup, *(shape for shape, _ in SHAPES.values())):
        _kept, surfaces = mesh_and_surfaces(shape, device, builder=builder, leaf_size=leaf_size)
        face, distance = launched(_both_walks, [surfaces, x, u, 4.0], (wp.vec3i, wp.vec3), device)
        assert 0.05 < (face[:, 0] >= 0).mean() < 0.95
        # A ray along an edge may strike either face, and at an outline it may pass or not.
        same = face[:, 1] == face[:, 0]
        assert same.mean() > 0.999
        apart = np.abs(distance[same, 1] - distance[same, 0])
        assert (apart < 5e-6).mean() > 0.999
        assert apart.max() < 1e-3  # a ray that grazes a face meets it where rounding has it
        assert ((face[:, 1] >= 0) == (face[:, 0] >= 0)).mean() > 0.9999
        np.testing.assert_array_equal(face[:, 2] >= 0, face[:, 1] >= 0)
        assert (distance[:, 2] >= distance[:, 1]).all()


def test_hits_on_a_cpu_do_not_depend_on_the_tree():
    """Bit for bit, whatever the builder and its leaves, also where ten faces lie on each other or share an edge."""
    box = trimesh.creation.box(extents=(1, 2, 3)).subdivide().subdivide()
    faces = np.concatenate([box.faces, *[box.faces[:20]] * 9])
    rng = np.random.default_rng(6)
    x = rng.uniform(-0.4, 0.4, size=(50_000, 3))
    u = box.vertices[rng.integers(len(box.vertices), size=len(x))] - x  # at corners
    u[::2] = rng.normal(size=u[::2].shape)
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    hits = []
    for builder, leaf_size in ((None, 1), ("sah", 4), ("median", 30)):
        shape = trimesh.Trimesh(box.vertices, faces, process=False)
        _kept, surfaces = mesh_and_surfaces(shape, "cpu", builder=builder, leaf_size=leaf_size)
        face, distance = launched(_both_walks, [surfaces, x, u, 4.0], (wp.vec3i, wp.vec3))
        hits.append(np.concatenate([face[:, 1], distance[:, 1].astype(np.float32).view(np.int32)]))
    assert (hits[0][: len(x)] >= 0).all() and (hits[0][: len(x)] < len(box.faces)).all()
    np.testing.assert_array_equal(hits[1], hits[0])
    np.testing.assert_array_equal(hits[2], hits[0])


def test_faces_that_lie_on_each_other_and_faces_without_area_are_no_trouble():
    """A leaf of any size: two hundred copies of one triangle, one of a point, one of a line."""
    corners = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1]], float)
    copies = np.concatenate([np.tile(corners, (200, 1)), np.ones((3, 3)), [[0, 0, 2], [1, 1, 2], [2, 2, 2]]])
    _kept, surfaces = mesh_and_surfaces(trimesh.Trimesh(copies, np.arange(606).reshape(-1, 3), process=False), "cpu")
    x, u = np.array([[0.2, 0.2, 0.0], [0.9, 0.9, 0.0], [1.0, 1.0, 0.0]]), np.array([[0.0, 0.0, 1.0]] * 3)
    face, distance = launched(_both_walks, [surfaces, x, u, 4.0], (wp.vec3i, wp.vec3))
    assert 0 <= face[0, 1] < 200
    assert distance[0, 1] == pytest.approx(1.0, abs=1e-6)
    assert (face[1:, 1] == -1).all()


@pytest.mark.parametrize("name", SHAPES)
def test_rays_aimed_at_vertices_and_edges_are_caught(name, device):
    shape, extent = SHAPES[name]
    _kept, surfaces = mesh_and_surfaces(shape, device)
    rng = np.random.default_rng(3)
    edges = shape.vertices[shape.edges_unique]
    aims = np.concatenate([shape.vertices, edges.mean(axis=1), edges[:, 0] * 0.75 + edges[:, 1] * 0.25])
    to = aims[rng.integers(len(aims), size=200_000)]
    x = (rng.random(to.shape) - 0.5) * np.array(extent) * np.round(rng.random(to.shape) * 4) / 4
    (hit,) = launched(_aim, [surfaces, x, to], [int], device)
    assert 1 - hit.mean() < 1e-4


@pytest.mark.parametrize("centre", [0.0, 15.0, 400.0])
def test_a_bounce_does_not_hit_its_own_face(centre, device):
    """From inside a finely faceted sphere that lies far from the origin, where float32 is coarse."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    sphere.apply_translation([centre, -centre, centre])
    rng = np.random.default_rng(8)
    u = rng.normal(size=(100_000, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    x = np.broadcast_to([centre, -centre, centre], u.shape)
    _kept, surfaces = mesh_and_surfaces(sphere, device)
    assert launched(_bounce, [surfaces, x, u], device=device)[0].min() > 1.5


def test_segments_meet_the_box_that_they_cross(device):
    rng = np.random.default_rng(2)
    x = rng.uniform(-4, 4, size=(20_000, 3))
    u = rng.normal(size=x.shape)
    u[:1000, 0] = 0.0
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    (meets,) = launched(_boxes, [x, u, 3.0], [int], device)
    # Points of the segment inside the box prove that it meets it; a box grown by 1e-3 that is missed proves the
    # contrary.
    s = np.linspace(0, 3, 201)[:, None, None]
    points = x + s * u
    inside = (np.abs(points) < [1, 2, 0.5]).all(axis=2).any(axis=0)
    near = (np.abs(points) < np.array([1, 2, 0.5]) + 0.02).all(axis=2).any(axis=0)
    assert meets[inside].all()
    assert not meets[~near].any()
