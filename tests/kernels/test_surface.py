"""Rays against meshes: no leaks, exact distances, offsets that clear the surface."""

import numpy as np
import pytest
import trimesh
import warp as wp

import spadwarp_kernels as sk
from helpers.statistics_of_samples import DEVICES
from spadwarp_kernels import (
    intersect_mesh,
    intersect_surfaces,
    offset_from_surface,
    random_block,
    rotate_direction,
    segment_meets_box,
    u01,
)


def _mesh(shape, device, *, builder=None, leaf_size=1):
    """The mesh, which has to outlive its surfaces, and these."""
    mesh = wp.Mesh(
        wp.array(np.asarray(shape.vertices, np.float32), dtype=wp.vec3, device=device),
        wp.array(np.asarray(shape.faces, np.int32).ravel(), dtype=int, device=device),
        bvh_constructor=builder,
        bvh_leaf_size=leaf_size,
    )
    return mesh, sk.make_surfaces(mesh)


@wp.kernel(enable_backward=False)
def _leaks(surfaces: sk.Surfaces, extent: wp.vec3, rays: int, leaks: wp.array(dtype=int)):
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
def _aim(surfaces: sk.Surfaces, x: wp.array(dtype=wp.vec3), to: wp.array(dtype=wp.vec3), hit: wp.array(dtype=int)):
    i = wp.tid()
    u = wp.normalize(to[i] - x[i])
    hit[i] = wp.where(intersect_surfaces(surfaces, x[i], u, 1.0e6, False).face >= 0, 1, 0)


@wp.kernel(enable_backward=False)
def _bounce(surfaces: sk.Surfaces, x: wp.array(dtype=wp.vec3), u: wp.array(dtype=wp.vec3), gap: wp.array(dtype=float)):
    """Distance to the next surface after a bounce back along the normal; the sphere's diameter unless it hits
    itself."""
    i = wp.tid()
    hit = intersect_surfaces(surfaces, x[i], u[i], 1.0e6, False)
    start = offset_from_surface(x[i] + hit.distance * u[i], hit.normal, hit.distance)
    gap[i] = intersect_surfaces(surfaces, start, hit.normal, 1.0e6, False).distance


@wp.kernel(enable_backward=False)
def _boxes(x: wp.array(dtype=wp.vec3), u: wp.array(dtype=wp.vec3), length: float, meets: wp.array(dtype=int)):
    i = wp.tid()
    box = segment_meets_box(x[i], u[i], length, wp.vec3(-1.0, -2.0, -0.5), wp.vec3(1.0, 2.0, 0.5))
    meets[i] = wp.where(box, 1, 0)


@wp.kernel(enable_backward=False)
def _both_walks(
    surfaces: sk.Surfaces,
    x: wp.array(dtype=wp.vec3),
    u: wp.array(dtype=wp.vec3),
    reach: float,
    face: wp.array2d(dtype=int),
    distance: wp.array2d(dtype=float),
):
    """Nearest hit by Warp's walk and by ours, and any hit by ours."""
    i = wp.tid()
    query = intersect_mesh(surfaces.mesh, x[i], u[i], reach)
    face[i, 0] = query.face
    distance[i, 0] = query.distance
    nearest = intersect_surfaces(surfaces, x[i], u[i], reach, False)
    face[i, 1] = nearest.face
    distance[i, 1] = nearest.distance
    some = intersect_surfaces(surfaces, x[i], u[i], reach, True)
    face[i, 2] = some.face
    distance[i, 2] = some.distance


SHAPES = {
    "box": (trimesh.creation.box(extents=(1, 2, 3)), (0.9, 1.8, 2.7)),
    "sphere": (trimesh.creation.icosphere(subdivisions=4, radius=1.0), (1.0, 1.0, 1.0)),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", SHAPES)
def test_random_rays_do_not_leak(name, device):
    shape, extent = SHAPES[name]
    _kept, surfaces = _mesh(shape, device)
    # 1e8 rays on a GPU; at most ten may leak. On the CPU 2e6 and none.
    threads, rays = (100_000, 1000) if device != "cpu" else (20_000, 100)
    leaks = wp.zeros(threads, dtype=int, device=device)
    wp.launch(_leaks, threads, [surfaces, wp.vec3(*extent), rays, leaks], device=device)
    assert leaks.numpy().sum() <= (10 if device != "cpu" else 0)


@pytest.mark.parametrize("device", DEVICES)
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
        _kept, surfaces = _mesh(shape, device, builder=builder, leaf_size=leaf_size)
        arrays = [wp.array(a.astype(np.float32), dtype=wp.vec3, device=device) for a in (x, u)]
        face = wp.zeros((len(x), 3), dtype=int, device=device)
        distance = wp.zeros((len(x), 3), dtype=float, device=device)
        wp.launch(_both_walks, len(x), [surfaces, *arrays, 4.0, face, distance], device=device)
        face, distance = face.numpy(), distance.numpy()
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


def test_faces_that_lie_on_each_other_and_faces_without_area_are_no_trouble():
    """A leaf of any size: two hundred copies of one triangle, one of a point, one of a line."""
    corners = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1]], float)
    copies = np.concatenate([np.tile(corners, (200, 1)), np.ones((3, 3)), [[0, 0, 2], [1, 1, 2], [2, 2, 2]]])
    _kept, surfaces = _mesh(trimesh.Trimesh(copies, np.arange(606).reshape(-1, 3), process=False), "cpu")
    x = wp.array([[0.2, 0.2, 0.0], [0.9, 0.9, 0.0], [1.0, 1.0, 0.0]], dtype=wp.vec3, device="cpu")
    u = wp.array([[0.0, 0.0, 1.0]] * 3, dtype=wp.vec3, device="cpu")
    face = wp.zeros((3, 3), dtype=int, device="cpu")
    distance = wp.zeros((3, 3), dtype=float, device="cpu")
    wp.launch(_both_walks, 3, [surfaces, x, u, 4.0, face, distance], device="cpu")
    assert 0 <= face.numpy()[0, 1] < 200
    assert distance.numpy()[0, 1] == pytest.approx(1.0, abs=1e-6)
    assert (face.numpy()[1:, 1] == -1).all()


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", SHAPES)
def test_rays_aimed_at_vertices_and_edges_are_caught(name, device):
    shape, extent = SHAPES[name]
    _kept, surfaces = _mesh(shape, device)
    rng = np.random.default_rng(3)
    edges = shape.vertices[shape.edges_unique]
    aims = np.concatenate([shape.vertices, edges.mean(axis=1), edges[:, 0] * 0.75 + edges[:, 1] * 0.25])
    to = aims[rng.integers(len(aims), size=200_000)]
    x = (rng.random(to.shape) - 0.5) * np.array(extent) * np.round(rng.random(to.shape) * 4) / 4
    hit = wp.zeros(len(to), dtype=int, device=device)
    arrays = [wp.array(a.astype(np.float32), dtype=wp.vec3, device=device) for a in (x, to)]
    wp.launch(_aim, len(to), [surfaces, *arrays, hit], device=device)
    assert 1 - hit.numpy().mean() < 1e-4


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("centre", [0.0, 15.0, 400.0])
def test_a_bounce_does_not_hit_its_own_face(centre, device):
    """From inside a finely faceted sphere that lies far from the origin, where float32 is coarse."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    sphere.apply_translation([centre, -centre, centre])
    rng = np.random.default_rng(8)
    u = rng.normal(size=(100_000, 3))
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    x = np.broadcast_to([centre, -centre, centre], u.shape)
    arrays = [wp.array(a.astype(np.float32), dtype=wp.vec3, device=device) for a in (x, u)]
    gap = wp.zeros(len(u), dtype=float, device=device)
    _kept, surfaces = _mesh(sphere, device)
    wp.launch(_bounce, len(u), [surfaces, *arrays, gap], device=device)
    assert gap.numpy().min() > 1.5


def test_segments_meet_the_box_that_they_cross():
    rng = np.random.default_rng(2)
    x = rng.uniform(-4, 4, size=(20_000, 3))
    u = rng.normal(size=x.shape)
    u[:1000, 0] = 0.0
    u /= np.linalg.norm(u, axis=1, keepdims=True)
    meets = wp.zeros(len(x), dtype=int, device="cpu")
    arrays = [wp.array(a.astype(np.float32), dtype=wp.vec3, device="cpu") for a in (x, u)]
    wp.launch(_boxes, len(x), [*arrays, 3.0, meets], device="cpu")
    # Points of the segment inside the box prove that it meets it; a box grown by 1e-3 that is missed proves the
    # contrary.
    s = np.linspace(0, 3, 201)[:, None, None]
    points = x + s * u
    inside = (np.abs(points) < [1, 2, 0.5]).all(axis=2).any(axis=0)
    near = (np.abs(points) < np.array([1, 2, 0.5]) + 0.02).all(axis=2).any(axis=0)
    assert meets.numpy()[inside].all()
    assert not meets.numpy()[~near].any()


def test_surfaces_check_their_arrays_and_the_spec_that_goes_with_them():
    mesh, _ = _mesh(trimesh.creation.box(), "cpu")
    with pytest.raises(ValueError, match="specular has 5 entries; the mesh has 12 faces"):
        sk.make_surfaces(mesh, 0.5, specular=wp.zeros(5, dtype=float, device="cpu"))
    image = np.linspace(0, 1, 6).reshape(2, 3)
    textures = sk.make_textures(np.full(12, -1), np.zeros((12, 3, 2)), [image], device="cpu")
    surfaces = sk.make_surfaces(mesh, 0.25, specular=0.5, roughness=0.1, textures=textures)
    assert sk.surface_choices(surfaces) == {"pattern": True, "specular": True}
    assert (surfaces.corner_reflectance.numpy() == 0.25).all()
    np.testing.assert_allclose(surfaces.roughness.numpy(), 0.1)
    plain = sk.make_surfaces(mesh, 0.25)
    assert sk.surface_choices(plain) == {"pattern": False, "specular": False}
    limits = sk.Limits()
    model = sk.Model(
        mesh.device, sk.Medium(), sk.Laser(), sk.Camera(), sk.Gate(), limits, sk.Guiding(), mesh, surfaces, 1.0
    )
    data = sk.make_data(model, histogram=False)
    with pytest.raises(ValueError, match=r"spec.pattern = False does not go with the model's surfaces"):
        sk.launch_transport(sk.TransportSpec("none"), model, data, seed=1, first_id=0, photon_count=1)
