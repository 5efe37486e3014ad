"""Rays against meshes: no leaks, exact distances, offsets that clear the surface."""

import numpy as np
import pytest
import trimesh
import warp as wp

import spadwarp_kernels as sk
from spadwarp_kernels import (
    intersect_mesh,
    intersect_mesh_aimed,
    offset_from_surface,
    random_block,
    rotate_direction,
    segment_meets_box,
    u01,
)
from spadwarp_kernels.surface import intersect_faces, intersect_mesh_cpu
from statistics_of_samples import DEVICES


def _mesh(shape, device):
    return wp.Mesh(
        wp.array(np.asarray(shape.vertices, np.float32), dtype=wp.vec3, device=device),
        wp.array(np.asarray(shape.faces, np.int32).ravel(), dtype=int, device=device),
    )


@wp.kernel(enable_backward=False)
def _leaks(mesh: wp.uint64, extent: wp.vec3, rays: int, leaks: wp.array(dtype=int)):
    """Random rays from random points of a box that lies inside the mesh."""
    i = wp.tid()
    missed = int(0)
    for k in range(rays):
        a = random_block(wp.uint64(1), wp.uint64(i), wp.uint32(k), wp.uint32(1))
        b = random_block(wp.uint64(1), wp.uint64(i), wp.uint32(k), wp.uint32(2))
        x = wp.cw_mul(wp.vec3(u01(a[0]) - 0.5, u01(a[1]) - 0.5, u01(a[2]) - 0.5), extent)
        u = rotate_direction(wp.vec3(0.0, 0.0, 1.0), 2.0 * u01(b[0]), u01(b[1]))
        if intersect_mesh(mesh, x, u, 1.0e6).face < 0:
            missed += 1
    leaks[i] = missed


@wp.kernel(enable_backward=False)
def _aim(mesh: wp.uint64, x: wp.array(dtype=wp.vec3), to: wp.array(dtype=wp.vec3), hit: wp.array(dtype=int)):
    i = wp.tid()
    u = wp.normalize(to[i] - x[i])
    hit[i] = wp.where(intersect_mesh_aimed(mesh, x[i], u, 1.0e6).face >= 0, 1, 0)


@wp.kernel(enable_backward=False)
def _bounce(mesh: wp.uint64, x: wp.array(dtype=wp.vec3), u: wp.array(dtype=wp.vec3), gap: wp.array(dtype=float)):
    """Distance to the next surface after a bounce back along the normal; the sphere's diameter unless it hits
    itself."""
    i = wp.tid()
    hit = intersect_mesh(mesh, x[i], u[i], 1.0e6)
    start = offset_from_surface(x[i] + hit.distance * u[i], hit.normal, hit.distance)
    gap[i] = intersect_mesh(mesh, start, hit.normal, 1.0e6).distance


@wp.kernel(enable_backward=False)
def _boxes(x: wp.array(dtype=wp.vec3), u: wp.array(dtype=wp.vec3), length: float, meets: wp.array(dtype=int)):
    i = wp.tid()
    box = segment_meets_box(x[i], u[i], length, wp.vec3(-1.0, -2.0, -0.5), wp.vec3(1.0, 2.0, 0.5))
    meets[i] = wp.where(box, 1, 0)


@wp.kernel(enable_backward=False)
def _both_walks(
    mesh: wp.uint64,
    x: wp.array(dtype=wp.vec3),
    u: wp.array(dtype=wp.vec3),
    reach: float,
    planes: wp.array(dtype=wp.vec4),
    face: wp.array2d(dtype=int),
    distance: wp.array2d(dtype=float),
):
    """Nearest hit by Warp's walk and by the CPU's; any hit by the CPU's; nearest of the faces tried one by one."""
    i = wp.tid()
    query = wp.mesh_query_ray(mesh, x[i], u[i], reach)
    face[i, 0] = wp.where(query.result, query.face, -1)
    distance[i, 0] = wp.where(query.result, query.t, reach)
    nearest = intersect_mesh_cpu(mesh, x[i], u[i], reach, False)
    face[i, 1] = nearest.face
    distance[i, 1] = nearest.distance
    some = intersect_mesh_cpu(mesh, x[i], u[i], reach, True)
    face[i, 2] = some.face
    distance[i, 2] = some.distance
    tried = intersect_faces(planes, x[i], u[i], reach)
    face[i, 3] = tried.face
    distance[i, 3] = tried.distance


SHAPES = {
    "box": (trimesh.creation.box(extents=(1, 2, 3)), (0.9, 1.8, 2.7)),
    "sphere": (trimesh.creation.icosphere(subdivisions=4, radius=1.0), (1.0, 1.0, 1.0)),
}


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", SHAPES)
def test_random_rays_do_not_leak(name, device):
    shape, extent = SHAPES[name]
    mesh = _mesh(shape, device)
    # 1e8 rays on a GPU; at most ten may leak. On the CPU 2e6 and none.
    threads, rays = (100_000, 1000) if device != "cpu" else (20_000, 100)
    leaks = wp.zeros(threads, dtype=int, device=device)
    wp.launch(_leaks, threads, [mesh.id, wp.vec3(*extent), rays, leaks], device=device)
    assert leaks.numpy().sum() <= (10 if device != "cpu" else 0)


def test_a_cpu_core_hits_what_warp_hits_and_so_do_faces_one_by_one():
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
        mesh = _mesh(shape, "cpu")
        arrays = [wp.array(a.astype(np.float32), dtype=wp.vec3, device="cpu") for a in (x, u)]
        planes = sk.make_surfaces(mesh).planes  # of the box alone
        face = wp.zeros((len(x), 4), dtype=int, device="cpu")
        distance = wp.zeros((len(x), 4), dtype=float, device="cpu")
        wp.launch(_both_walks, len(x), [mesh.id, *arrays, 4.0, planes, face, distance], device="cpu")
        face, distance = face.numpy(), distance.numpy()
        assert 0.05 < (face[:, 0] >= 0).mean() < 0.95
        np.testing.assert_array_equal(distance[:, 1], distance[:, 0])
        assert (face[:, 1] == face[:, 0]).mean() > 0.999  # faces that share an edge may both be hit there
        np.testing.assert_array_equal(face[:, 2] >= 0, face[:, 0] >= 0)
        assert (distance[:, 2] >= distance[:, 0]).all()
        if planes.size:
            assert ((face[:, 3] >= 0) == (face[:, 0] >= 0)).mean() > 0.999
            np.testing.assert_allclose(distance[:, 3], distance[:, 0], rtol=1e-4, atol=0.0)


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("name", SHAPES)
def test_rays_aimed_at_vertices_and_edges_are_caught(name, device):
    shape, extent = SHAPES[name]
    mesh = _mesh(shape, device)
    rng = np.random.default_rng(3)
    edges = shape.vertices[shape.edges_unique]
    aims = np.concatenate([shape.vertices, edges.mean(axis=1), edges[:, 0] * 0.75 + edges[:, 1] * 0.25])
    to = aims[rng.integers(len(aims), size=200_000)]
    x = (rng.random(to.shape) - 0.5) * np.array(extent) * np.round(rng.random(to.shape) * 4) / 4
    hit = wp.zeros(len(to), dtype=int, device=device)
    arrays = [wp.array(a.astype(np.float32), dtype=wp.vec3, device=device) for a in (x, to)]
    wp.launch(_aim, len(to), [mesh.id, *arrays, hit], device=device)
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
    mesh = _mesh(sphere, device)
    wp.launch(_bounce, len(u), [mesh.id, *arrays, gap], device=device)
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
    mesh = _mesh(trimesh.creation.box(), "cpu")
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
