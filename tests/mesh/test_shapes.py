"""The built-in targets: closed, of the size they state, the same every time, and worth a depth image."""

import re

import numpy as np
import pytest
import trimesh

from spadwarp.mesh import make_builtin
from spadwarp.mesh import solids as so
from spadwarp.mesh.shapes import SHAPES


def solid(made):
    return trimesh.Trimesh(*so.to_triangles(made), process=False)


def front_depth(mesh, cells=64):
    """Nearest z [cells, cells] of 60 000 surface points, seen along +z from far away; NaN where there are none."""
    rng = np.random.default_rng(5)
    areas = mesh.area_faces
    faces = rng.choice(len(areas), 60_000, p=areas / areas.sum())
    u, v = rng.random((2, 60_000, 1))
    over = u + v > 1
    u, v = np.where(over, 1 - u, u), np.where(over, 1 - v, v)
    a, b, c = np.moveaxis(mesh.vertices[mesh.faces[faces]], 1, 0)
    points = a + u * (b - a) + v * (c - a)
    column, row = np.clip(((points[:, :2] / 4 + 0.5) * cells).astype(int), 0, cells - 1).T
    depth = np.full((cells, cells), np.inf)
    np.minimum.at(depth, (row, column), points[:, 2])
    return np.where(np.isfinite(depth), depth, np.nan)


@pytest.mark.parametrize("name", SHAPES)
def test_mesh_is_one_closed_outward_oriented_piece_with_relief(name):
    mesh = make_builtin(name)
    assert re.fullmatch(r"[a-z]+(_[a-z]+)*", name)
    assert mesh.is_watertight and mesh.is_winding_consistent and mesh.body_count == 1
    assert mesh.volume > 0.1 and 1_000 <= len(mesh.faces) <= 60_000
    a, b, c = np.moveaxis(mesh.vertices.astype(np.float32)[mesh.faces], 1, 0)
    assert (np.cross(b - a, c - a) != 0).any(axis=1).all()  # in single precision, too
    depth = front_depth(mesh)
    seen = depth[np.isfinite(depth)]
    near, far = np.percentile(seen, [5, 95])
    assert seen.size > 0.1 * depth.size and 0.1 < far - near < 2.5


@pytest.mark.parametrize("name", SHAPES)
def test_size_is_the_one_stated_and_fits_the_view(name):
    mesh = make_builtin(name)
    stated = re.search(r"Size ([\d.]+) × ([\d.]+) × ([\d.]+) m\.", SHAPES[name].__doc__)
    np.testing.assert_allclose(mesh.extents, [float(side) for side in stated.groups()], atol=0.006)
    np.testing.assert_allclose(mesh.bounds.sum(axis=0), 0, atol=1e-9)
    # 20° by 15° at 15 m, up to the front of the box: the target is neither cut off nor lost in the picture.
    distance = 15 - mesh.extents[2] / 2
    width, height = 2 * distance * np.tan(np.radians(10)) * np.array([1, 0.75])
    assert mesh.extents[0] < width and mesh.extents[1] < height
    assert max(mesh.extents[:2]) >= 3.2


def test_no_two_targets_look_alike():
    silhouettes = [np.isfinite(front_depth(make_builtin(name), 32)) for name in SHAPES]
    for k, one in enumerate(silhouettes):
        for other in silhouettes[:k]:
            assert (one & other).sum() < 0.9 * (one | other).sum()


@pytest.mark.parametrize("name", ["pipe_valve", "television"])
def test_same_bits_in_every_call_and_copies(name):
    first, second = (solid(SHAPES[name]()) for _ in range(2))
    assert first.vertices.tobytes() == second.vertices.tobytes() and first.faces.tobytes() == second.faces.tobytes()
    make_builtin(name).apply_scale(2.0)
    assert make_builtin(name).extents == pytest.approx(first.extents)


def test_camera_frame_has_top_at_minus_y_and_front_at_minus_z():
    mesh = solid(so.union(so.box((0.2, 0.2, 0.2), (1, 1, 1)), so.box((0.01, 0.01, 0.01))))
    assert np.sign(mesh.center_mass).tolist() == [1, -1, -1] and mesh.volume > 0  # heavy right, up and near


# Solids


def test_lathe_and_torus_follow_pappus():
    ring = so.lathe([(1.0, 0), (1.2, 0), (1.2, 0.3), (1.0, 0.3)], segments=256)
    assert ring.volume() == pytest.approx(2 * np.pi * 1.1 * 0.2 * 0.3, rel=1e-3)
    assert ring.bounding_box() == pytest.approx((-1.2, 0, -1.2, 1.2, 0.3, 1.2), abs=1e-3)
    assert so.torus(1.0, 0.1, segments=256).volume() == pytest.approx(2 * np.pi * np.pi * 0.01, rel=0.02)
    for number, axis in enumerate("xyz"):
        box = so.lathe([(0, 0.5), (0.1, 0.5), (0, 2)], axis=axis).bounding_box()
        assert (box[number], box[number + 3]) == pytest.approx((0.5, 2))


def test_tube_along_a_bent_path_has_the_volume_of_its_straightened_self():
    turn = np.linspace(0, np.pi, 200)
    path = np.stack([np.cos(turn), np.sin(turn), 0.3 * turn], axis=1)
    expected = np.pi * 0.01 * np.pi * np.hypot(1, 0.3)
    assert so.tube(path, 0.1, sides=128).volume() == pytest.approx(expected, rel=2e-3)


def test_implicit_ball_in_every_octant():
    corners = (-1, -1, -1), (1, 1, 1)
    ball = so.implicit(lambda x, y, z: 0.8 - np.sqrt((x - 0.1) ** 2 + y**2 + z**2), *corners, 0.05)
    assert ball.volume() == pytest.approx(4 / 3 * np.pi * 0.8**3, rel=0.005) and ball.genus() == 0
    assert np.linalg.norm(solid(ball).vertices, axis=1) == pytest.approx(0.8, abs=0.01)
    with pytest.raises(ValueError, match="not a closed manifold"):  # cut by the grid
        so.implicit(lambda x, y, z: 0.5 - np.abs(x) + 0 * (y + z), *corners, 0.2)


def test_smooth_union_covers_the_union_and_adds_at_most_a_quarter_radius():
    a, b = np.random.default_rng(3).normal(size=(2, 1000))
    joined = so.smooth_union([a, b], 0.4)
    assert (joined >= np.maximum(a, b)).all() and (joined - np.maximum(a, b)).max() <= 0.1


def test_spline_passes_through_its_points():
    points = np.array([(0.0, 0), (1, 2), (3, 1), (4, 4)])
    for closed in (False, True):
        np.testing.assert_allclose(so.spline(points, 5, closed=closed)[::5], points)
