"""Surfaces: their arrays, surfaces that follow a moving mesh, and rays by Warp's own queries."""

import dataclasses
import math

import numpy as np
import pytest
import trimesh
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import each, on_device, unit
from helpers.lit_box import lit_box
from helpers.meshes import mesh_and_surfaces, mesh_of
from spadwarp_kernels.optics.visibility import near_depth_map
from spadwarp_kernels.surface.bvh import read_tree
from spadwarp_kernels.surface.ray_cast import SurfaceHit

PRIVATE_LAYOUT = (
    f"Warp {wp.__version__} keeps its BVH in another layout than surface/bvh.py reads (members of wp::Mesh::bvh: "
    "node_lowers, node_uppers, root, primitive_indices, num_nodes, max_nodes). Mend `_read_node` there; until then "
    "make_surfaces(..., use_warp_bvh=True) takes wp.mesh_query_ray."
)


def ball(device, count=24):
    """Points and triangles of a sphere of radius 1, a little dented."""
    theta, phi = np.meshgrid(np.linspace(0.05, math.pi - 0.05, count), np.linspace(0.0, 2 * math.pi, 2 * count))
    r = 1.0 + 0.1 * np.sin(3 * phi) * np.sin(2 * theta)
    points = np.stack([r * np.sin(theta) * np.cos(phi), r * np.sin(theta) * np.sin(phi), r * np.cos(theta)], axis=-1)
    first = (np.arange(2 * count - 1)[:, None] * count + np.arange(count - 1)).ravel()
    faces = np.stack([first, first + count, first + 1, first + 1, first + count, first + count + 1], axis=1)
    points = points.reshape(-1, 3).astype(np.float32)
    return mesh_of(points, faces, device), points


def distances(surfaces, mesh, device, count=20_000):
    """By our walk and by Warp's."""
    rng = np.random.default_rng(2)
    u = unit(rng.normal(size=(count, 3)))
    x = rng.uniform(-2, 2, (count, 3)) - 5.0 * u
    mine = each(sk.intersect_surfaces, [surfaces, x, u, 100.0, False], [SurfaceHit], device)
    return mine["distance"], each(sk.intersect_mesh, [mesh.id, x, u, 100.0], [SurfaceHit], device)["distance"]


def test_the_tree_is_read_as_warp_writes_it(device):
    """Warp's private structs: `read_tree` finds each face once, in boxes that hold it, whatever the builder."""
    for constructor in ("sah", "median", "cubql", *(["lbvh"] if wp.get_device(device).is_cuda else [])):
        mesh, points = ball(device)
        mesh = wp.Mesh(mesh.points, mesh.indices, bvh_constructor=constructor, bvh_leaf_size=1)
        try:
            tree = read_tree(mesh, 1.2)
            assert sorted(tree.faces) == list(range(len(tree.faces))), "faces are missing"
            corners, stack, seen = points[mesh.indices.numpy().reshape(-1, 3)[tree.faces]], [tree.root], 0
            while stack:
                node = stack.pop()
                held = corners[tree.start[node] : tree.stop[node]]
                inside = (held >= tree.lower[node]).all() and (held <= tree.upper[node]).all()
                assert inside, "a face leaves a box"
                if tree.children[node, 0] >= 0:
                    stack += tree.children[node].tolist()
                else:
                    seen += len(held)
            assert seen == len(tree.faces), "faces are in no leaf"
        except Exception as error:
            pytest.fail(f"{PRIVATE_LAYOUT} ({error}, {constructor})")


@pytest.mark.parametrize("use_warp_bvh", [False, True])
def test_surfaces_follow_moving_points(use_warp_bvh, device):
    """Updated in place; and made of the mesh that has been refitted, whatever its builder."""
    mesh, points = ball(device)
    moved = (points * (1.0, 1.5, 0.7) + (0.5, -0.3, 1.0)).astype(np.float32)
    new = wp.Mesh(on_device(moved, device), mesh.indices)
    surfaces = sk.make_surfaces(mesh, extent=5.0, use_warp_bvh=use_warp_bvh)
    assert sk.surface_choices(surfaces)["use_warp_bvh"] == use_warp_bvh
    before, fresh = distances(surfaces, mesh, device)[0], distances(sk.make_surfaces(new), new, device)[0]
    mesh.points.assign(moved)
    sk.update_surfaces(surfaces, mesh)
    pairs = [(surfaces, mesh)]
    for constructor in ("sah", "cubql"):
        refitted = wp.Mesh(on_device(points, device), mesh.indices, bvh_constructor=constructor, bvh_leaf_size=1)
        refitted.points.assign(moved)
        refitted.refit()
        pairs.append((sk.make_surfaces(refitted, use_warp_bvh=use_warp_bvh), refitted))
    mesh.refit()
    for one, its_mesh in pairs:
        mine, hers = distances(one, its_mesh, device)
        assert np.abs(mine - hers).max() < 2e-5 and np.abs(mine - fresh).max() < 2e-5
        assert (np.abs(mine - before) > 1e-3).mean() > 0.1


def wide_camera():
    camera = sk.Camera()
    camera.width = camera.height = 64
    camera.pixel_tangent, camera.aperture_radius, camera.aperture_area = 0.025, 0.1, math.pi * 1e-2
    return camera


def test_the_map_of_a_camera_follows(device):
    mesh, points = ball(device)
    camera = wide_camera()
    surfaces = sk.make_surfaces(mesh, camera=camera, extent=9.0)
    inside = surfaces.near_depth.numpy()  # the lens is in the ball
    assert inside.min() > 0.3 and inside.max() < 1.1
    for shift in (3.0, 5.0):
        mesh.points.assign(points + np.array([0.5, 0.0, shift], np.float32))
        sk.update_surfaces(surfaces, mesh, camera)
        found = surfaces.near_depth.numpy()
        assert np.array_equal(found, near_depth_map(mesh, camera).numpy())
        assert found[64, 64] == pytest.approx(shift - 1.0, abs=0.25) and found[64, 0] > 1e29
    bare = sk.make_surfaces(mesh)
    for args, text in (
        ((surfaces, mesh), "made with a camera; update_surfaces needs the same"),
        ((sk.make_surfaces(mesh, extent=9.0), mesh, camera), "made without a camera"),
        ((bare, mesh), "make_surfaces needs an extent"),
        ((bare, ball(device)[0]), "not those of mesh"),
    ):
        with pytest.raises(sk.ArgumentError, match=text):
            sk.update_surfaces(*args)


def test_nothing_hides_what_lies_before_the_map(device):
    """A floor and a tilted wall that go past a wide lens, faces behind it, a small one: rays from points before the map
    to all of the lens meet none, and the map reaches far along the floor."""
    turn = np.array([[0.8, 0.1, 0.59], [0.0, 0.98, -0.17], [-0.6, 0.14, 0.79]])
    square = np.array([(-20.0, 0, -20), (20, 0, -20), (20, 0, 20), (-20, 0, 20)])
    small = np.array([(-0.3, -0.8, 2.0), (0.2, -0.7, 2.2), (0.0, -0.4, 1.9), (0.1, -0.9, 2.1)])
    behind, wall = 0.1 * square - (0, 0, 2.5), square[:, [1, 0, 2]] @ turn - (3.0, 0, 0)
    corners = np.concatenate([square - (0, -0.5, 0), wall, behind, small]).astype(np.float32)
    faces = (np.array([0, 1, 2, 0, 2, 3]) + 4 * np.arange(4)[:, None]).ravel()
    mesh = mesh_of(corners, faces, device)
    camera = wide_camera()
    near = near_depth_map(mesh, camera).numpy().astype(float)
    assert near[100, 64] == pytest.approx(0.4 / (0.8 * 73.0 / 128), rel=0.05)  # of the floor, less the lens's radius
    assert (near[:62] > 1.0).mean() > 0.5 and (near > 0.1).mean() > 0.9
    rng = np.random.default_rng(4)
    count = 20_000
    row, column = rng.integers(0, 128, (2, count))
    tangent = (np.stack([column, row], axis=1) + rng.uniform(0.01, 0.99, (count, 2)) - 64.0) / 80.0
    depth = np.minimum(near[row, column], 15.0) * np.where(rng.random(count) < 0.5, 1.0 - 1e-6, rng.random(count))
    start = np.concatenate([tangent, np.ones((count, 1))], axis=1) * depth[:, None]
    turn = rng.uniform(0, 2 * np.pi, count)
    lens = camera.aperture_radius * np.stack([np.cos(turn), np.sin(turn), np.zeros(count)], axis=1)
    way = np.linalg.norm(lens - start, axis=1, keepdims=True)
    inputs = [sk.make_surfaces(mesh), start, (lens - start) / way, way[:, 0].astype(np.float32), True]
    assert (each(sk.intersect_surfaces, inputs, [SurfaceHit], device)["face"] < 0).all()


def tally(model, spec, first_id=0, offset=0):
    data = sk.make_data(model, histogram=not spec.merged)
    if spec.merged:
        data = dataclasses.replace(data, tally=wp.zeros(2 * model.tally_size // 3, dtype=wp.int64, device=model.device))
    data.offset.fill_(offset)
    sk.launch_transport(spec, model, data, seed=3, first_id=first_id, photon_count=20_000)
    return data.tally.numpy()


@pytest.mark.slow
def test_transport_by_public_queries_and_by_steps(device):
    """Warp's own queries give the light of our tree; photons are numbered from the offset on the device."""
    mesh, points = ball(device)
    mesh.points.assign(points + np.array([0.0, 0.0, 3.0], np.float32))
    mesh.refit()
    structs = lit_box()
    structs["gate"].start, structs["gate"].stop, structs["gate"].bins_per_metre = 2.0, 10.0, 1.0
    model = sk.Model(mesh.device, mesh=mesh, surfaces=sk.make_surfaces(mesh, 0.5), scale=2.0**50, **structs)
    spec = sk.TransportSpec("next_event")
    light = tally(model, spec)
    public = dataclasses.replace(model, surfaces=sk.make_surfaces(mesh, 0.5, use_warp_bvh=True))
    with pytest.raises(sk.ArgumentError, match="use_warp_bvh = False does not go with"):
        tally(public, spec)
    other = tally(public, spec._replace(use_warp_bvh=True))
    # A ray on an edge may fall on either side of it: the same photons otherwise.
    assert light.sum() > 0 and np.abs(light - other).sum() < 1e-3 * light.sum()
    # A step has one tally for the light of surfaces and one for backscatter.
    step = spec._replace(stepped=True, merged=True)
    ballistic, forward, back = light.reshape(3, -1)
    assert np.array_equal(tally(model, step), np.concatenate([ballistic + forward, back]))
    ballistic, forward, back = tally(model, spec, first_id=2**40 + 4).reshape(3, -1)
    assert np.array_equal(tally(model, step, first_id=4, offset=2**40), np.concatenate([ballistic + forward, back]))
    with pytest.raises(sk.ArgumentError, match="merged needs guided or next_event"):
        tally(model, sk.TransportSpec("analog", merged=True))


def test_surfaces_check_their_arrays_and_the_spec_that_goes_with_them():
    mesh, _ = mesh_and_surfaces(trimesh.creation.box(), "cpu")
    image = np.linspace(0, 1, 6).reshape(2, 3)
    textures = sk.make_textures(np.full(12, -1), np.zeros((12, 3, 2)), [image], device="cpu")
    surfaces = sk.make_surfaces(mesh, 0.25, specular=0.5, roughness=0.1, textures=textures)
    assert sk.surface_choices(surfaces) == {"pattern": True, "specular": True, "use_warp_bvh": False}
    assert (surfaces.corner_reflectance.numpy() == 0.25).all()
    np.testing.assert_allclose(surfaces.roughness.numpy(), 0.1)
    plain = sk.make_surfaces(mesh, 0.25)
    assert sk.surface_choices(plain) == {"pattern": False, "specular": False, "use_warp_bvh": False}
    model = sk.Model("cpu", mesh=mesh, surfaces=surfaces, scale=1.0, **lit_box())
    with pytest.raises(sk.ArgumentError, match=r"spec.pattern = False does not go with the model's surfaces"):
        tally(model, sk.TransportSpec("next_event"))
