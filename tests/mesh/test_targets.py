"""Targets: the staircase's measures, built-ins, mesh files, placement and what is refused."""

import itertools

import numpy as np
import pytest
import trimesh
from scipy.spatial.transform import Rotation

from helpers.synthetic_result import cast_truth, make_scene
from spadwarp.mesh import BUILTINS, build_mesh, builtin_names, describe_mesh, load_target
from spadwarp.scene import Scene, Target
from spadwarp.values import ConfigError, MeshError

PLY = "ply\nformat ascii 1.0\nelement vertex 3\nproperty float x\nproperty float y\nproperty float z\n{}"


def scene_of(*targets):
    return make_scene(targets=list(targets))


def first_depth(mesh, x, y):
    """Lowest z at which the line along +z through (x, y) meets the mesh: barycentric coordinates in projection."""
    a, b, c = np.moveaxis(mesh.triangles, 1, 0)
    ab, ac, ap = (b - a)[:, :2], (c - a)[:, :2], np.array([x, y]) - a[:, :2]
    det = ab[:, 0] * ac[:, 1] - ab[:, 1] * ac[:, 0]
    flat = np.abs(det) > 1e-12
    u = (ap[flat, 0] * ac[flat, 1] - ap[flat, 1] * ac[flat, 0]) / det[flat]
    v = (ab[flat, 0] * ap[flat, 1] - ab[flat, 1] * ap[flat, 0]) / det[flat]
    inside = (u >= 0) & (v >= 0) & (u + v <= 1)
    z = a[flat, 2] + u * (b - a)[flat, 2] + v * (c - a)[flat, 2]
    return float(z[inside].min(initial=np.inf))


# The staircase


@pytest.fixture(scope="module")
def staircase():
    return load_target(Target(builtin="staircase"))


def test_staircase_is_one_closed_solid_of_exactly_the_plates_and_bars_volume(staircase):
    assert staircase.is_watertight and staircase.is_winding_consistent and staircase.body_count == 1
    plate = 4.0 * 4.0 * 0.1
    left = 0.63 * 4.0 * (0.60 + 0.50 + 0.40)
    upper = 2.0 * 0.6 * (0.30 + 0.20 + 0.10)
    lower = 0.63 * 2.0 * (0.30 + 0.20 + 0.10)
    assert staircase.volume == pytest.approx(plate + left + upper + lower, abs=1e-9)
    np.testing.assert_allclose(staircase.bounds, [[-2.0, -2.0, -0.6], [2.0, 2.0, 0.1]], atol=1e-9)
    assert first_depth(staircase, 2.001, 0.0) == first_depth(staircase, 0.0, -2.001) == np.inf
    # The illuminated side: what looks towards −z has the plate's area, 16 m².
    towards = staircase.face_normals[:, 2] < -0.5
    assert staircase.area_faces[towards].sum() == pytest.approx(16.0, abs=1e-9)


@pytest.mark.parametrize(
    ("columns", "rows", "proud"),
    [
        # Left half, every height: bars 0.63 m wide with gaps of 0.04 m, from the plate's left edge.
        ((-1.999, -1.371), (-1.99, -0.3, 1.99), 0.60),
        ((-1.329, -0.701), (-1.99, -0.3, 1.99), 0.50),
        ((-0.659, -0.031), (-1.99, -0.3, 1.99), 0.40),
        ((-1.369, -1.331, -0.699, -0.661, -0.029, -0.001), (-1.99, 1.99), 0.0),
        # Upper right (−y): bars 2 m wide and 0.6 m tall, 0.1 m apart, the lowest ending at mid-height.
        ((0.001, 1.999), (-1.999, -1.401), 0.30),
        ((0.001, 1.999), (-1.299, -0.701), 0.20),
        ((0.001, 1.999), (-0.599, -0.001), 0.10),
        ((0.001, 1.999), (-1.399, -1.301, -0.699, -0.601), 0.0),
        # Lower right: bars 0.63 m wide and 2 m tall with gaps of 0.04 m, to the plate's right edge.
        ((0.031, 0.659), (0.001, 1.999), 0.30),
        ((0.701, 1.329), (0.001, 1.999), 0.20),
        ((1.371, 1.999), (0.001, 1.999), 0.10),
        ((0.029, 0.661, 0.699, 1.331, 1.369), (0.001, 1.999), 0.0),
    ],
)
def test_staircase_seen_from_the_camera(staircase, columns, rows, proud):
    for x, y in itertools.product(columns, rows):
        assert first_depth(staircase, x, y) == pytest.approx(-proud, abs=1e-9), (x, y)


# The other built-ins


def test_plane_is_a_rectangle_at_zero_that_faces_the_camera_and_box_has_its_sides():
    mesh = load_target(Target(builtin="plane", size=(3.0, 2.0)))
    assert len(mesh.faces) == 2 and mesh.area == pytest.approx(6.0)
    np.testing.assert_allclose(mesh.bounds, [[-1.5, -1.0, 0.0], [1.5, 1.0, 0.0]])
    np.testing.assert_allclose(mesh.face_normals, [[0, 0, -1]] * 2)
    mesh = load_target(Target(builtin="box", size=(1.0, 2.0, 3.0)))
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -1.0, -1.5], [0.5, 1.0, 1.5]])
    assert mesh.is_watertight and mesh.volume == pytest.approx(6.0)


@pytest.mark.parametrize("name", BUILTINS)
def test_subdivision_makes_four_faces_of_one_and_a_sphere_rounder(name):
    size = {"size": (2.0,)} if name == "sphere" else {}
    meshes = [load_target(Target(builtin=name, **size, subdivisions=n)) for n in range(3)]
    assert len(meshes[2].faces) == 16 * len(meshes[0].faces)
    np.testing.assert_allclose(meshes[2].bounds, meshes[0].bounds, atol=1e-6)
    if name != "sphere":
        assert meshes[2].area == pytest.approx(meshes[0].area)
        return
    for mesh in meshes:
        assert mesh.is_watertight
        np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1.0, rtol=1e-6)
    # Second order: half the edge, a quarter of the error.
    missing = np.array([4 / 3 * np.pi - mesh.volume for mesh in meshes])
    np.testing.assert_allclose(missing[:-1] / missing[1:], 4.0, rtol=0.02)


# Placement


def test_rotation_is_about_the_targets_own_axes_x_then_y_then_z(staircase):
    """After the scale; a positive angle about z turns right to down."""
    size = {"builtin": "box", "size": (1.0, 2.0, 3.0)}
    turn = Rotation.from_euler("XYZ", [20.0, 30.0, 40.0], degrees=True)
    expected = np.add(turn.apply(2.0 * load_target(Target(**size)).vertices), (1.0, 2.0, 3.0))
    place = {"rotation_deg": (20.0, 30.0, 40.0), "translation": (1.0, 2.0, 3.0), "scale": (2.0, 2.0, 2.0)}
    np.testing.assert_allclose(load_target(Target(**size, **place)).vertices, expected, atol=1e-12)
    place = {"translation": (0.0, 0.0, 5.0), "rotation_deg": (0.0, 0.0, 90.0)}
    mesh = load_target(Target(builtin="plane", size=(4.0, 1.0), **place))
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -2.0, 5.0], [0.5, 2.0, 5.0]], atol=1e-12)
    # Mirrored targets keep their normals outwards.
    mesh = load_target(Target(builtin="staircase", scale=(-1.0, 1.0, 1.0)))
    assert mesh.is_watertight and mesh.volume == pytest.approx(staircase.volume)
    assert first_depth(mesh, 1.9, 0.0) == pytest.approx(-0.6)


# Scenes


def test_scene_mesh_joins_targets_in_the_camera_frame():
    assert build_mesh(scene_of()) is None
    plane = {"builtin": "plane", "size": [6.0, 4.0], "translation": [0, 0, 9.0], "reflectance": 0.25}
    box = {"builtin": "box", "scale": 0.5, "translation": [0.5, 0, 5.0], "reflectance": 0.75}
    mesh = build_mesh(scene_of(plane, box))
    arrays = (mesh.vertices, mesh.faces, mesh.reflectance, mesh.target)
    assert [array.dtype for array in arrays] == [np.float32, np.int32, np.float32, np.int32]
    assert mesh.target.tolist() == [0] * 2 + [1] * 12 and mesh.face_count == 14
    assert mesh.reflectance.tolist() == [0.25] * 2 + [0.75] * 12
    np.testing.assert_allclose(mesh.bounds, [[-3.0, -2.0, 4.75], [3.0, 2.0, 9.0]])
    own = mesh.vertices[mesh.faces[mesh.target == 1].ravel()]
    np.testing.assert_allclose([own.min(axis=0), own.max(axis=0)], [[0.25, -0.25, 4.75], [0.75, 0.25, 5.25]])


def test_staircase_fills_the_papers_view_from_top_to_bottom():
    """20° over 256 pixels are 3.94 m over 192 rows at 14.89 m: less than the 4 m plate; sideways more."""
    scene = make_scene(width=64, height=48)
    depth = cast_truth(scene, build_mesh(scene)).depth
    assert np.isfinite(depth[:, 10:54]).all() and np.isnan(depth[:, [0, -1]]).all()
    assert depth[24, 10] == pytest.approx(14.29)  # the left bar is the nearest
    assert depth[2, 50] < depth[13, 50] < depth[22, 50]  # upper right: the top bar is the nearest


# Mesh files


@pytest.mark.parametrize("ending", ["stl", "obj", "ply", "off", "glb", "STL", "GLB"])
def test_every_format_gives_the_same_cube(tmp_path, ending):
    path = tmp_path / f"cube.{ending.lower()}"
    trimesh.creation.box(extents=(1.0, 2.0, 3.0)).export(path)
    path = path.rename(tmp_path / f"cube.{ending}")
    mesh = load_target(Target(mesh=str(path), scale=(0.1, 0.1, 0.1), translation=(0.0, 0.0, 5.0)))
    assert len(mesh.faces) == 12 and mesh.is_watertight and mesh.volume == pytest.approx(6e-3, rel=1e-6)
    np.testing.assert_allclose(mesh.bounds, [[-0.05, -0.1, 4.85], [0.05, 0.1, 5.15]], atol=1e-7)


# What is refused


def error_of(target):
    with pytest.raises((MeshError, ConfigError)) as caught:
        build_mesh(scene_of({"builtin": "plane"}, target))
    return str(caught.value)


SQUARE_WITH = "OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n1 {} 0\n3 0 1 2\n3 1 3 2\n"
NOT_FINITE = "1 of 2 faces have coordinates that are not finite"


@pytest.mark.parametrize(
    ("name", "content", "problem"),
    [
        ("bust.stl", None, "no such file"),
        ("", None, "is not a file"),
        *((f"empty.{ending}", "", "") for ending in ("stl", "obj", "ply", "off", "glb")),
        ("noise.stl", "solid nothing of the kind\n", ""),
        ("noise.ply", "ply\nformat ascii 1.0\nelement vertex 3\n", ""),
        ("noise.glb", "glTF" + 100 * "\0", ""),
        ("picture.png", "\x89PNG\r\n\x1a\n", ""),
        ("points.ply", PLY.format("end_header\n0 0 0\n1 0 0\n0 1 0\n"), ""),
        ("points.obj", "v 0 0 0\nv 1 0 0\nv 0 1 0\n", ""),
        ("nothing.obj", "# nothing\n", "the mesh has no faces"),
        ("text.stl", "hello", "the mesh has no faces"),
        *((f"{value}.off", SQUARE_WITH.format(value), NOT_FINITE) for value in ("nan", "inf", "1e39")),
        ("line.off", "OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n", "none of the 1 faces has an area"),
    ],
)
def test_files_without_a_mesh_are_refused_by_name(tmp_path, name, content, problem):
    path = tmp_path / name
    if content is not None:
        path.write_bytes(content.encode("latin-1"))
    text = error_of({"mesh": str(path)})
    assert text.startswith(f"targets[1].mesh = {str(path)!r}: ") and problem in text
    if problem in ("the mesh has no faces", "no such file"):
        with pytest.raises(MeshError, match=problem.removeprefix("the mesh has ")):
            describe_mesh(path)


def test_the_scene_file_is_named(tmp_path):
    scene = Scene.from_dict(scene_of({"mesh": "bust.stl"}).to_dict(), source=tmp_path / "scene.toml")
    with pytest.raises(MeshError, match=r"scene\.toml: targets\[0\]\.mesh = .*bust\.stl': no such file"):
        build_mesh(scene)


def test_faces_without_area_are_dropped_and_counted(tmp_path):
    path = tmp_path / "sliver.off"
    path.write_text("OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n2 0 0\n3 0 1 2\n3 0 1 3\n")
    with pytest.warns(UserWarning, match="dropped 1 of 2 faces"):
        mesh = build_mesh(scene_of({"mesh": str(path)}))
    assert mesh.face_count == len(mesh.reflectance) == len(mesh.target) == 1


def test_built_ins_that_cannot_be_are_refused():
    text = error_of({"builtin": "stairs"})
    assert text.startswith("targets[1].builtin = 'stairs' is not one of 'staircase', 'plane', 'box', 'sphere', ")
    assert text.endswith("'bust'; did you mean 'staircase'?") and all(repr(name) in text for name in builtin_names())
    for field, value, problem in (
        ("size", [2.0, 2.0], "= [2.0, 2.0] cannot be combined with builtin = 'staircase'"),
        ("subdivisions", 12, "= 12 makes 2684354560 faces of 160"),  # before they are made
    ):
        assert f"targets[1].{field} {problem}" in error_of({"builtin": "staircase", field: value})


# Mesh files before they stand in a scene


@pytest.mark.parametrize(("metres", "unit"), [(1.0, "m"), (1e-3, "mm"), (1e-6, "µm")])
def test_a_mesh_file_is_described_with_its_likely_unit(tmp_path, metres, unit):
    mesh = trimesh.creation.box((0.4 / metres, 0.3 / metres, 2.0 / metres))
    mesh.apply_translation([0, 0, 5.0 / metres])
    mesh.export(tmp_path / "box.stl")
    found = describe_mesh(tmp_path / "box.stl")
    assert (found.unit, found.scale, found.is_watertight, found.bodies) == (unit, metres, True, 1)
    assert np.allclose(np.array(found.extent) * metres, [0.4, 0.3, 2.0]) and found.longest == pytest.approx(2.0)
    assert ("scale = 0.001" in " ".join(found.hints)) == (unit == "mm")
    assert any("translation" in hint for hint in found.hints) and any("[90, 0, 0]" in hint for hint in found.hints)
    built = build_mesh(scene_of({"mesh": str(tmp_path / "box.stl"), "scale": found.scale}))
    assert np.ptp(built.bounds, axis=0)[2] == pytest.approx(2.0, rel=1e-5)


def test_an_open_mesh_and_one_of_no_likely_unit_are_told(tmp_path):
    sphere = trimesh.creation.icosphere(radius=1e-3)
    sphere.update_faces(np.arange(len(sphere.faces)) > 20)
    sphere.export(tmp_path / "open.ply")
    found = describe_mesh(tmp_path / "open.ply")
    assert not found.is_watertight and any("not closed" in hint for hint in found.hints)
    assert found.unit is None and found.scale == 1.0 and any("neither" in hint for hint in found.hints)
