"""Rays against meshes: no leaks, exact distances, offsets that clear the surface."""

import numpy as np
import pytest
import trimesh
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import each, unit
from helpers.meshes import mesh_and_surfaces, soup
from spadwarp_kernels import intersect_mesh, intersect_surfaces, offset_from_surface
from spadwarp_kernels.surface.bvh import segment_meets_box
from spadwarp_kernels.surface.ray_cast import SurfaceHit


def cast(surfaces, x, u, device="cpu", reach=4.0, any_hit=False):
    """Hits by our walk."""
    return each(intersect_surfaces, [surfaces, x, u, reach, any_hit], [SurfaceHit], device)


SHAPES = {
    "box": (trimesh.creation.box(extents=(1, 2, 3)), (0.9, 1.8, 2.7)),
    "sphere": (trimesh.creation.icosphere(subdivisions=4, radius=1.0), (1.0, 1.0, 1.0)),
}


@pytest.mark.physics
@pytest.mark.parametrize("name", SHAPES)
def test_random_rays_and_rays_aimed_at_vertices_and_edges_do_not_leak(name, device):
    """From points of a box that lies inside the mesh; of the first none on a CPU, one of 1e7 on a GPU."""
    shape, extent = SHAPES[name]
    _kept, surfaces = mesh_and_surfaces(shape, device)
    rng = np.random.default_rng(3)
    x = (rng.random((2_000_000 if device == "cpu" else 10_000_000, 3), np.float32) - 0.5) * np.float32(extent)
    hit = cast(surfaces, x, unit(rng.standard_normal(x.shape, np.float32)), device, 1e6)
    assert (hit["face"] < 0).sum() <= (device != "cpu")
    edges = shape.vertices[shape.edges_unique]
    aims = np.concatenate([shape.vertices, edges.mean(axis=1), edges[:, 0] * 0.75 + edges[:, 1] * 0.25])
    to = aims[rng.integers(len(aims), size=200_000)]
    x = (rng.random(to.shape) - 0.5) * np.array(extent) * np.round(rng.random(to.shape) * 4) / 4
    assert (cast(surfaces, x, unit(to - x), device, 1e6)["face"] < 0).mean() < 1e-4


@pytest.mark.parametrize(("builder", "leaf_size"), [(None, 1), (None, 4), ("sah", 4), ("median", 3), ("cubql", 1)])
def test_our_walk_hits_what_warp_hits(builder, leaf_size, device):
    """In a soup of triangles of all sizes, from outside and inside, along the axes too; and in the shapes above."""
    rng = np.random.default_rng(5)
    corners = rng.normal(size=(3000, 1, 3)) + rng.lognormal(-2.0, 1.0, (3000, 1, 1)) * rng.normal(size=(3000, 3, 3))
    x = rng.uniform(-3, 3, size=(50_000, 3))
    u = rng.normal(size=x.shape)
    u[:5000, 0] = 0.0
    u[2500:7500, 1] = 0.0
    u = unit(u)
    for shape in (soup(corners), *(shape for shape, _ in SHAPES.values())):
        mesh, surfaces = mesh_and_surfaces(shape, device, builder=builder, leaf_size=leaf_size)
        hers = each(intersect_mesh, [mesh.id, x, u, 4.0], [SurfaceHit], device)
        nearest, some = (cast(surfaces, x, u, device, any_hit=any_hit) for any_hit in (False, True))
        assert 0.05 < (hers["face"] >= 0).mean() < 0.95
        # A ray along an edge may strike either face, and at an outline it may pass or not.
        same = nearest["face"] == hers["face"]
        assert same.mean() > 0.999
        apart = np.abs(nearest["distance"] - hers["distance"])[same]
        assert (apart < 5e-6).mean() > 0.999
        assert apart.max() < 1e-3  # a ray that grazes a face meets it where rounding has it
        assert ((nearest["face"] >= 0) == (hers["face"] >= 0)).mean() > 0.9999
        np.testing.assert_array_equal(some["face"] >= 0, nearest["face"] >= 0)
        assert (some["distance"] >= nearest["distance"]).all()


def test_hits_on_a_cpu_do_not_depend_on_the_tree():
    """Bit for bit, whatever the builder and its leaves, also where ten faces lie on each other or share an edge."""
    box = trimesh.creation.box(extents=(1, 2, 3)).subdivide().subdivide()
    faces = np.concatenate([box.faces, *[box.faces[:20]] * 9])
    rng = np.random.default_rng(6)
    x = rng.uniform(-0.4, 0.4, size=(50_000, 3))
    u = box.vertices[rng.integers(len(box.vertices), size=len(x))] - x  # at corners
    u[::2] = rng.normal(size=u[::2].shape)
    hits = []
    for builder, leaf_size in ((None, 1), ("sah", 4), ("median", 30)):
        shape = trimesh.Trimesh(box.vertices, faces, process=False)
        _kept, surfaces = mesh_and_surfaces(shape, "cpu", builder=builder, leaf_size=leaf_size)
        hits.append(cast(surfaces, x, unit(u)))
        for name in ("face", "distance"):
            np.testing.assert_array_equal(hits[-1][name], hits[0][name])
    assert (hits[0]["face"] >= 0).all() and (hits[0]["face"] < len(box.faces)).all()


def test_faces_that_lie_on_each_other_and_faces_without_area_are_no_trouble():
    """A leaf of any size: two hundred copies of one triangle, one of a point, one of a line."""
    corners = np.array([[0, 0, 1], [1, 0, 1], [0, 1, 1]], float)
    copies = np.concatenate([np.tile(corners, (200, 1)), np.ones((3, 3)), [[0, 0, 2], [1, 1, 2], [2, 2, 2]]])
    _kept, surfaces = mesh_and_surfaces(trimesh.Trimesh(copies, np.arange(606).reshape(-1, 3), process=False), "cpu")
    x, u = np.array([[0.2, 0.2, 0.0], [0.9, 0.9, 0.0], [1.0, 1.0, 0.0]]), np.array([[0.0, 0.0, 1.0]] * 3)
    hit = cast(surfaces, x, u)
    assert 0 <= hit["face"][0] < 200 and hit["distance"][0] == pytest.approx(1.0, abs=1e-6)
    assert (hit["face"][1:] == -1).all()


@wp.func
def bounce(surfaces: sk.Surfaces, x: wp.vec3, u: wp.vec3):
    """Distance to the next surface after a bounce back along the normal; the sphere's diameter unless it hits
    itself."""
    hit = intersect_surfaces(surfaces, x, u, 1.0e6, False)
    start = offset_from_surface(x + hit.distance * u, hit.normal, hit.distance)
    return intersect_surfaces(surfaces, start, hit.normal, 1.0e6, False).distance


@pytest.mark.parametrize("centre", [0.0, 15.0, 400.0])
def test_a_bounce_does_not_hit_its_own_face(centre, device):
    """From inside a finely faceted sphere that lies far from the origin, where float32 is coarse."""
    sphere = trimesh.creation.icosphere(subdivisions=5, radius=1.0)
    sphere.apply_translation([centre, -centre, centre])
    u = unit(np.random.default_rng(8).normal(size=(100_000, 3)))
    _kept, surfaces = mesh_and_surfaces(sphere, device)
    assert each(bounce, [surfaces, wp.vec3(centre, -centre, centre), u], device=device).min() > 1.5


def test_segments_meet_the_box_that_they_cross(device):
    """Points of the segment inside the box prove that it meets it; of none in a box that has grown, the contrary."""
    rng, box = np.random.default_rng(2), np.array([1.0, 2.0, 0.5])
    x = rng.uniform(-4, 4, size=(10_000, 3))
    u = rng.normal(size=x.shape)
    u[:500, 0] = 0.0
    u = unit(u)
    meets = each(segment_meets_box, [x, u, 3.0, wp.vec3(*-box), wp.vec3(*box)], [bool], device)
    points = np.abs(x + np.linspace(0, 3, 201)[:, None, None] * u)
    inside, near = ((points < size).all(axis=2).any(axis=0) for size in (box, box + 0.02))
    assert meets[inside].all() and not meets[~near].any()
