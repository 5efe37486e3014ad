"""A handful of faces, all of which are tried: which of them make parallelograms, and what rays hit."""

import numpy as np
import pytest
import trimesh
import warp as wp

from helpers.brute_force import check_hits
from helpers.launch import each, on_device, unit
from helpers.meshes import mesh_of, soup
from spadwarp_kernels.base.native import bits_of, load_row
from spadwarp_kernels.surface.mesh import Surfaces
from spadwarp_kernels.surface.patches import nearest_patch, pack_patches, set_patches
from spadwarp_kernels.surface.ray_cast import patch_hit

SQUARE = np.array([[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0]], float)
Rows = wp.array(dtype=wp.vec4)


@wp.func
def hit_patch(patches: Rows, normals: Rows, x: wp.vec3, u: wp.vec3, reach: float):
    """Distance, normal against the ray, and (slot, face, face in that slot)."""
    met = nearest_patch(patches, x, u, reach)
    normal, faces = wp.vec3(), wp.vec3i(-1)
    if bits_of(met[3]) >= 0:
        surfaces = Surfaces()
        surfaces.patches = patches
        hit = patch_hit(surfaces, met)
        normal = hit.normal
        faces = wp.vec3i(hit.slot, hit.face, bits_of(load_row(normals, hit.slot)[3]))
    return met[0], normal, faces


def cast(patches, normals, x, u, device="cpu", reach=4.0):
    return each(hit_patch, [patches, normals, x, u, reach], (float, wp.vec3, wp.vec3i), device)


def pairs_of(points, faces):
    """(face, second face, corner) of the patches; a triangle is its own second face."""
    patches, _ = pack_patches(mesh_of(points, faces), np.arange(len(faces)))
    rows = patches.numpy().reshape(-1, 5, 4).view(np.int32)
    return [(int(row[4, 1]), int(row[4, 3]), int(row[3, 3])) for row in rows]


def packed(shape, pairs=True, device="cpu"):
    """The mesh, its patches, and the normals of its faces, which stand in slots in the opposite order."""
    mesh = mesh_of(shape.vertices, shape.faces, device)
    return mesh, *pack_patches(mesh, np.arange(len(shape.faces))[::-1], pairs)


def turned_box(extents, angles):
    turn = trimesh.transformations.random_rotation_matrix(np.array(angles))
    return trimesh.creation.box(extents=extents, transform=turn)


def scenes():
    rng = np.random.default_rng(11)
    quads = [[o, o + a, o + a + b, o, o + a + b, o + b] for o, a, b in rng.normal(size=(3, 3, 3))]
    quads, triangles = list(np.reshape(quads, (6, 3, 3))), list(rng.normal(size=(4, 3, 3)))
    shapes = {"parallelograms": quads, "triangles": triangles, "both": [*quads[:3], *triangles, *quads[3:]]}
    shapes = {name: soup(corners) for name, corners in shapes.items()}
    return shapes | {"box": turned_box((1.0, 2.0, 0.5), (0.3, 0.6, 0.9))}


SCENES = scenes()


@pytest.mark.parametrize("pairs", [True, False])
@pytest.mark.parametrize("name", SCENES)
def test_rays_hit_what_a_search_in_float64_hits(name, pairs, device):
    """At random, and aimed within 1e-3 of edges, diagonals and corners."""
    shape = SCENES[name]
    rng = np.random.default_rng(2)
    kept, patches, normals = packed(shape, pairs, device)
    corners = np.asarray(shape.vertices, np.float32).astype(float)[shape.faces]
    x = rng.normal(size=(40_000, 3)).astype(np.float32)
    aim = corners[rng.integers(len(corners), size=len(x)), rng.integers(3, size=len(x))]
    other = corners[rng.integers(len(corners), size=len(x)), 0]
    share = rng.uniform(size=(len(x), 1))
    ends = rng.integers(len(corners), size=20_000)
    aim[:20_000], other[:20_000] = corners[ends, 0], corners[ends, 2 - (np.arange(20_000) % 2)]
    to = aim + share * (other - aim) + 1e-3 * rng.normal(size=x.shape) * rng.integers(2, size=(len(x), 1))
    u = unit(to - x).astype(np.float32)
    distance, normal, faces = cast(patches, normals, x, u, device)
    check_hits(corners, x, u, 4.0, (faces[:, 1], distance))
    hit = faces[:, 1] >= 0
    named = faces[hit, 1]
    n = unit(np.cross(corners[:, 1] - corners[:, 0], corners[:, 2] - corners[:, 0]))[named]
    y = x + distance[:, None] * u
    assert np.abs(((y[hit] - corners[named, 0]) * n).sum(axis=1)).max() < 1e-5
    np.testing.assert_array_equal(faces[hit, 0], len(shape.faces) - 1 - named)
    np.testing.assert_array_equal(faces[hit, 2], named)
    assert ((normal[hit] * u[hit]).sum(axis=1) <= 0).all()
    np.testing.assert_allclose(np.abs((normal[hit] * n).sum(axis=1)), 1.0, atol=1e-6)
    assert kept.id


def test_no_ray_slips_through_a_diagonal_or_an_edge(device):
    """From inside a closed box, at the edges and diagonals of all faces."""
    rng, box = np.random.default_rng(3), turned_box((1.0, 2.0, 3.0), (0.1, 0.5, 0.7))
    edges = box.vertices[box.edges_unique]
    chosen = rng.integers(len(edges), size=200_000)
    share = rng.uniform(size=(len(chosen), 1))
    to = edges[chosen, 0] + share * (edges[chosen, 1] - edges[chosen, 0])
    x = 0.9 * box.vertices[rng.integers(8, size=len(to))] * rng.uniform(size=(len(to), 1))
    for pairs in (True, False):
        _kept, patches, normals = packed(box, pairs, device)
        faces = cast(patches, normals, x, unit(to - x), device, reach=9.0)[2]
        assert (faces[:, 1] < 0).sum() <= 2


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_a_box_has_six_patches_and_a_plane_one(scale):
    rng = np.random.default_rng(4)
    for turn in range(20):
        pose = trimesh.transformations.random_rotation_matrix(rng.uniform(size=3))
        pose[:3, 3] = rng.normal(size=3) * 3
        box = trimesh.creation.box(extents=scale * rng.uniform(0.3, 3, size=3), transform=pose)
        faces = box.faces
        if turn % 2:  # faces that share no vertices, each beginning at any corner
            box = soup(box.triangles)
            faces = np.array([np.roll(face, rng.integers(3)) for face in box.faces])
        patches = pairs_of(box.vertices, faces)
        assert len(patches) == 6
        assert sorted(face for first, second, _ in patches for face in (first, second)) == list(range(12))
        for first, second, _ in patches:
            assert box.face_normals[first] @ box.face_normals[second] > 0.999
    assert pairs_of(scale * SQUARE, TWO) == [(0, 1, 1)]
    slanted = scale * np.array([[0, 0, 0], [2, 0, 0], [0, 1, 0], [2, -1, 0]])
    assert pairs_of(slanted, [[0, 1, 2], [0, 3, 1]]) == [(0, 1, 2)]


TWO = [[0, 1, 2], [0, 2, 3]]


@pytest.mark.parametrize(
    ("points", "faces", "pairs"),
    [
        (SQUARE + np.outer([0, 0, 1, 0], [0.01, 0, 0]), TWO, [(0, 0, 0), (1, 1, 0)]),  # not a parallelogram
        (SQUARE + np.outer([0, 0, 0, 1], [0, 0, 1e-4]), TWO, [(0, 0, 0), (1, 1, 0)]),  # not flat
        (SQUARE, [[0, 1, 2], [0, 3, 2]], [(0, 0, 0), (1, 1, 0)]),  # turned the other way
        (SQUARE, [[0, 1, 2], [0, 1, 2]], [(0, 0, 0), (1, 1, 0)]),  # twice the same
        (SQUARE, [[0, 1, 2], [0, 1, 3]], [(0, 0, 0), (1, 1, 0)]),  # overlapping
        (SQUARE, [[0, 2, 2], [0, 2, 2]], [(0, 0, 0), (1, 1, 0)]),  # without area
        (SQUARE * [1, 1e-6, 1], TWO, [(0, 0, 0), (1, 1, 0)]),  # less high than what counts as one point
        # Each face is of one parallelogram: three that fit together pairwise, and a square that is there twice.
        ([*SQUARE, [-1, 1, 0]], [[0, 1, 3], [1, 2, 3], [0, 3, 4]], [(0, 1, 0), (2, 2, 0)]),
        (SQUARE, [[0, 1, 3], [1, 2, 3]] * 2, [(0, 1, 0), (2, 3, 0)]),
    ],
)
def test_only_two_faces_that_fit_make_a_parallelogram(points, faces, pairs):
    assert pairs_of(points, faces) == pairs


def test_patches_without_area_are_never_hit():
    shape = trimesh.Trimesh(np.array([[0, 0, 1], [1, 0, 1], [2, 0, 1]], float), [[0, 1, 2], [1, 1, 1]], process=False)
    _kept, patches, normals = packed(shape)
    distance, _, faces = cast(patches, normals, np.zeros((3, 3)), np.array([[0, 0, 1], [0.6, 0, 0.8], [1, 0, 0]]))
    assert (faces == -1).all() and (distance == 4.0).all()


def test_patches_of_single_faces_follow_points_that_move():
    shape = trimesh.Trimesh(np.add(SQUARE, [0, 0, 1]), TWO, process=False)
    mesh, patches, normals = packed(shape, pairs=False)
    mesh.points.assign(on_device(shape.vertices + np.outer([0, 0, 1, 3], [0, 0, 1])))
    set_patches(mesh, patches, normals)
    rays = np.array([[0.7, 0.2, 0.0], [0.2, 0.7, 0.0]]), np.array([[0.0, 0.0, 1.0]] * 2)
    distance, _, faces = cast(patches, normals, *rays, reach=9.0)
    np.testing.assert_array_equal(faces[:, 1], [0, 1])
    np.testing.assert_allclose(distance, [1.2, 1.0 + 0.7 * 3 - 0.2 * 2], atol=1e-6)
