"""Two faces that make a parallelogram, tried as one in the tree on CUDA."""

import numpy as np
import pytest
import trimesh
import warp as wp

import spadwarp_kernels as sk
from helpers.brute_force import check_hits
from helpers.launch import each, on_device, unit
from helpers.meshes import mesh_and_surfaces, mesh_of, soup
from spadwarp_kernels import intersect_mesh, intersect_surfaces
from spadwarp_kernels.base.native import bits_of
from spadwarp_kernels.surface.bvh import LARGEST_LEAF, pack_bvh
from spadwarp_kernels.surface.ray_cast import SurfaceHit
from spadwarp_kernels.surface.triangle import meet_planes

Rows, Slots = wp.array(dtype=wp.vec4), wp.array(dtype=int)


@wp.func
def nearest_of(rows: Rows, slots: Slots, x: wp.vec3, u: wp.vec3, reach: float):
    """Distance and slot of the nearest of what is kept in the slots."""
    nearest, found = float(reach), int(-1)
    for k in range(slots.shape[0]):
        row = 3 * slots[k]
        hit = meet_planes(rows[row], rows[row + 1], rows[row + 2], x, u)
        if hit[0] >= 0.0 and hit[0] < nearest:
            nearest = hit[0]
            found = slots[k] + wp.where(hit[1] > 0.0 and bits_of(rows[row + 2][3]) < 0, 1, 0)
    return nearest, found


def walked(surfaces, x, u, device):
    return each(intersect_surfaces, [surfaces, x, u, 4.0, False], [SurfaceHit], device)


def packed(shape, leaf_size, device="cpu"):
    """Mesh, nodes, faces as CUDA takes them, and the face in each slot, or its complement."""
    mesh = mesh_of(shape.vertices, shape.faces, device, "cubql", leaf_size)
    nodes, rows, order, _ = pack_bvh(mesh, float(np.abs(shape.vertices).max()))
    return mesh, nodes.numpy(), rows, order.numpy()


def leaves(nodes):
    """(leaf, lower, upper) of all leaves that the root leads to."""
    rows, found, stack = nodes.reshape(-1, 16), [], [0]
    while stack:
        row = rows[stack.pop()]
        sides = row[6:12].view(np.uint8).reshape(2, 3, 4)
        boxes = row[:3, None] + row[3:6, None] * (1.0 + sides / 32768.0)
        for k, child in enumerate(row[12:].view(np.int32)):
            if child >= 0:
                stack.append(int(child))
            elif child < -1:
                found.append((int(child), boxes[0, :, k], boxes[1, :, k]))
    return found


def tried(leaf, joined, order):
    """Slots of a leaf that a ray tries."""
    slots = [(-2 - leaf) // 2]
    assert (leaf % 2 == 1) == (order[slots[0]] < 0)
    while order[slots[-1]] < 0:
        slots.append(slots[-1] + 1 + joined[slots[-1]])
    return slots


def scenes():
    rng = np.random.default_rng(12)
    boxes = []
    for _ in range(6):
        boxes.append(trimesh.creation.box(extents=rng.uniform(0.2, 1.2, 3)))
        boxes[-1].apply_translation(rng.normal(size=3))
    turned = [box.copy() for box in boxes]
    for box in turned:
        box.apply_transform(trimesh.transformations.random_rotation_matrix(rng.uniform(size=3)))
    triangles = soup(rng.normal(size=(60, 1, 3)) + 0.6 * rng.normal(size=(60, 3, 3)))
    shapes = {"boxes": boxes, "turned": turned, "triangles": [triangles], "both": [*boxes[:3], triangles, *turned[3:]]}
    shapes["dense"] = [box.subdivide() for box in boxes[:2]]
    return {name: trimesh.util.concatenate(parts) for name, parts in shapes.items()}


SCENES = scenes()
LEAST = {"boxes": 36, "turned": 18, "triangles": 0, "both": 18, "dense": 48}  # parallelograms

# Faces of a leaf: Warp's trees on CUDA hold both halves of a rectangle in one, also where leaves of one are asked for.
SIZES = pytest.mark.parametrize("leaf_size", [1, 16])


@SIZES
@pytest.mark.parametrize("name", SCENES)
def test_each_face_is_in_one_leaf_whose_box_holds_it(name, leaf_size, device):
    shape = SCENES[name]
    _kept, nodes, rows, order = packed(shape, leaf_size, device)
    joined = np.signbit(rows.numpy()[2::3, 3])
    faces = np.where(order < 0, ~order, order)
    corners, seen, count = np.asarray(shape.vertices, np.float32)[shape.faces], [], 0
    for leaf, lower, upper in leaves(nodes):
        slots = tried(leaf, joined, order)
        held = [faces[slot + k] for slot in slots for k in range(1 + joined[slot])]
        assert (corners[held] >= lower).all() and (corners[held] <= upper).all()
        assert len(held) <= LARGEST_LEAF or not joined[slots].any()
        seen += held
        count += joined[slots].sum()
    assert sorted(seen) == list(range(len(shape.faces)))
    assert count == joined.sum() <= len(seen) / 2
    assert count >= LEAST[name] or leaf_size > 2
    assert count > 0 or name == "triangles" or leaf_size > LARGEST_LEAF


@SIZES
@pytest.mark.parametrize("name", SCENES)
def test_rays_hit_what_a_search_in_float64_hits(name, leaf_size, device):
    """In all leaves one by one, and in the device's own tree; at random, and aimed near edges and diagonals."""
    shape = SCENES[name]
    rng = np.random.default_rng(2)
    corners = np.asarray(shape.vertices, np.float32).astype(float)[shape.faces]
    x = 2.0 * rng.normal(size=(10_000, 3)).astype(np.float32)
    ends = rng.integers(len(corners), size=len(x))
    aim, other = corners[ends, rng.integers(3, size=len(x))], corners[ends, rng.integers(3, size=len(x))]
    aim += rng.uniform(size=(len(x), 1)) * (other - aim) + 1e-3 * rng.normal(size=x.shape)
    aim[::2] = rng.normal(size=aim[::2].shape)
    u = unit(aim - x).astype(np.float32)
    _kept, nodes, rows, order = packed(shape, leaf_size, device)
    joined = np.signbit(rows.numpy()[2::3, 3])
    slots = np.concatenate([tried(leaf, joined, order) for leaf, _, _ in leaves(nodes)])
    distance, slot = each(nearest_of, [rows, on_device(slots, device, int), x, u, 4.0], (float, int), device)
    found = np.where(slot >= 0, np.where(order[slot] < 0, ~order[slot], order[slot]), -1)
    kept, surfaces = mesh_and_surfaces(shape, device, builder="cubql", leaf_size=leaf_size)
    hit = walked(surfaces, x, u, device)
    assert kept.id
    check_hits(corners, x, u, 4.0, (found, distance), (hit["face"], hit["distance"]))


@SIZES
def test_a_moving_mesh_has_leaves_of_triangles(leaf_size, device):
    """What was a parallelogram is none later."""
    shape = SCENES["boxes"]
    mesh, _ = mesh_and_surfaces(shape, device, builder="cubql", leaf_size=leaf_size)
    surfaces = sk.make_surfaces(mesh, extent=9.0)
    rng = np.random.default_rng(6)
    mesh.points.assign((shape.vertices + rng.normal(scale=0.3, size=shape.vertices.shape)).astype(np.float32))
    sk.update_surfaces(surfaces, mesh)
    mesh.refit()
    x, u = rng.normal(size=(2, 20_000, 3))
    u = unit(u)
    mine, hers = walked(surfaces, x, u, device), each(intersect_mesh, [mesh.id, x, u, 4.0], [SurfaceHit], device)
    assert (mine["face"] >= 0).mean() > 0.2
    assert (mine["face"] == hers["face"]).mean() > 0.999
    assert (np.abs(mine["distance"] - hers["distance"]) < 1e-4).mean() > 0.999
