"""Targets: the staircase's measures, built-ins, mesh files, placement and what is refused."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import trimesh

from helpers.synthetic_result import cast_truth, make_scene
from spadwarp.mesh import BUILTINS, build_mesh, builtin_names, describe_mesh, load_target
from spadwarp.scene import Scene, Target
from spadwarp.values import ConfigError, MeshError

FORMATS = ("stl", "obj", "ply", "off", "glb")


def scene_of(*targets: dict) -> Scene:
    return make_scene(targets=list(targets))


# The staircase


def test_staircase_is_one_closed_solid_of_exactly_the_plates_and_bars_volume() -> None:
    mesh = load_target(Target(builtin="staircase"))
    assert mesh.is_watertight
    assert mesh.is_winding_consistent
    assert mesh.body_count == 1
    plate = 4.0 * 4.0 * 0.1
    left = 0.63 * 4.0 * (0.60 + 0.50 + 0.40)
    upper = 2.0 * 0.6 * (0.30 + 0.20 + 0.10)
    lower = 0.63 * 2.0 * (0.30 + 0.20 + 0.10)
    assert mesh.volume == pytest.approx(plate + left + upper + lower, abs=1e-9)
    np.testing.assert_allclose(mesh.bounds, [[-2.0, -2.0, -0.6], [2.0, 2.0, 0.1]], atol=1e-9)
    # Every edge belongs to two faces: a manifold.
    assert (np.unique(mesh.edges_sorted, axis=0, return_counts=True)[1] == 2).all()


@pytest.mark.parametrize(
    ("x", "y", "proud"),
    [
        # Left half, every height: bars 0.63 m wide with gaps of 0.04 m, from the plate's left edge.
        *[(x, y, 0.60) for x in (-1.999, -1.371) for y in (-1.99, -0.3, 1.99)],
        *[(x, y, 0.50) for x in (-1.329, -0.701) for y in (-1.99, -0.3, 1.99)],
        *[(x, y, 0.40) for x in (-0.659, -0.031) for y in (-1.99, -0.3, 1.99)],
        *[(x, y, 0.0) for x in (-1.369, -1.331, -0.699, -0.661, -0.029, -0.001) for y in (-1.99, 1.99)],
        # Upper right (−y): bars 2 m wide and 0.6 m tall, 0.1 m apart, the lowest ending at mid-height.
        *[(x, y, 0.30) for x in (0.001, 1.999) for y in (-1.999, -1.401)],
        *[(x, y, 0.20) for x in (0.001, 1.999) for y in (-1.299, -0.701)],
        *[(x, y, 0.10) for x in (0.001, 1.999) for y in (-0.599, -0.001)],
        *[(x, y, 0.0) for x in (0.001, 1.999) for y in (-1.399, -1.301, -0.699, -0.601)],
        # Lower right: bars 0.63 m wide and 2 m tall with gaps of 0.04 m, to the plate's right edge.
        *[(x, y, 0.30) for x in (0.031, 0.659) for y in (0.001, 1.999)],
        *[(x, y, 0.20) for x in (0.701, 1.329) for y in (0.001, 1.999)],
        *[(x, y, 0.10) for x in (1.371, 1.999) for y in (0.001, 1.999)],
        *[(x, y, 0.0) for x in (0.029, 0.661, 0.699, 1.331, 1.369) for y in (0.001, 1.999)],
    ],
)
def test_staircase_seen_from_the_camera(x: float, y: float, proud: float) -> None:
    mesh = load_target(Target(builtin="staircase"))
    assert first_depth(mesh, x, y) == pytest.approx(-proud, abs=1e-9)


def test_staircase_faces_the_camera_and_ends_at_the_plates_edge() -> None:
    mesh = load_target(Target(builtin="staircase"))
    assert first_depth(mesh, 2.001, 0.0) == np.inf
    assert first_depth(mesh, 0.0, -2.001) == np.inf
    # The illuminated side: what looks towards −z has the plate's area, 16 m².
    towards = mesh.face_normals[:, 2] < -0.5
    assert mesh.area_faces[towards].sum() == pytest.approx(16.0, abs=1e-9)


def first_depth(mesh: trimesh.Trimesh, x: float, y: float) -> float:
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


# The other built-ins


def test_plane_is_a_rectangle_at_zero_that_faces_the_camera() -> None:
    mesh = load_target(Target(builtin="plane", size=(3.0, 2.0)))
    assert len(mesh.faces) == 2
    np.testing.assert_allclose(mesh.bounds, [[-1.5, -1.0, 0.0], [1.5, 1.0, 0.0]])
    np.testing.assert_allclose(mesh.face_normals, [[0, 0, -1]] * 2)
    assert mesh.area == pytest.approx(6.0)


def test_box_has_its_side_lengths() -> None:
    mesh = load_target(Target(builtin="box", size=(1.0, 2.0, 3.0)))
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -1.0, -1.5], [0.5, 1.0, 1.5]])
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(6.0)


def test_sphere_has_its_diameter_and_gets_rounder_with_every_subdivision() -> None:
    missing = []
    for subdivisions in range(3):
        mesh = load_target(Target(builtin="sphere", size=(2.0,), subdivisions=subdivisions))
        assert mesh.is_watertight
        np.testing.assert_allclose(np.linalg.norm(mesh.vertices, axis=1), 1.0, rtol=1e-6)
        missing.append(4 / 3 * np.pi - mesh.volume)
    # Second order: half the edge, a quarter of the error.
    np.testing.assert_allclose(np.array(missing[:-1]) / missing[1:], 4.0, rtol=0.02)


@pytest.mark.parametrize("name", BUILTINS)
def test_subdivision_makes_four_faces_of_one(name: str) -> None:
    plain = load_target(Target(builtin=name))
    fine = load_target(Target(builtin=name, subdivisions=2))
    assert len(fine.faces) == 16 * len(plain.faces)
    np.testing.assert_allclose(fine.bounds, plain.bounds, atol=1e-6)
    if name != "sphere":
        assert fine.area == pytest.approx(plain.area)


def test_objects_are_placed_like_every_other_target() -> None:
    own = load_target(Target(builtin="anchor"))
    placed = load_target(Target(builtin="anchor", scale=(2.0, 2.0, 2.0), translation=(0.0, 0.0, 10.0)))
    np.testing.assert_allclose(placed.vertices, 2.0 * own.vertices + [0.0, 0.0, 10.0])
    assert placed.is_watertight


# Placement


def test_rotation_is_about_the_targets_own_axes_x_then_y_then_z() -> None:
    corners = load_target(Target(builtin="box", size=(1.0, 2.0, 3.0))).vertices
    x, y, z = np.radians([20.0, 30.0, 40.0])
    about_x = np.array([[1, 0, 0], [0, np.cos(x), -np.sin(x)], [0, np.sin(x), np.cos(x)]])
    turned_y = about_x @ [0.0, 1.0, 0.0]
    turned_z = about_x @ [np.sin(y), 0.0, np.cos(y)]
    expected = np.array([1.0, 2.0, 3.0]) + turn(turn(corners @ about_x.T, turned_y, y), turned_z, z)
    placed = load_target(
        Target(builtin="box", size=(1.0, 2.0, 3.0), rotation_deg=(20.0, 30.0, 40.0), translation=(1.0, 2.0, 3.0))
    )
    np.testing.assert_allclose(placed.vertices, expected, atol=1e-12)


def turn(points: np.ndarray, axis: np.ndarray, angle: float) -> np.ndarray:
    """Rodrigues' rotation."""
    cross = np.cross(axis, points)
    return points * np.cos(angle) + cross * np.sin(angle) + np.outer(points @ axis, axis) * (1 - np.cos(angle))


def test_positive_angle_about_z_turns_right_to_down() -> None:
    mesh = load_target(
        Target(builtin="plane", translation=(0.0, 0.0, 5.0), rotation_deg=(0.0, 0.0, 90.0), size=(4.0, 1.0))
    )
    np.testing.assert_allclose(mesh.bounds, [[-0.5, -2.0, 5.0], [0.5, 2.0, 5.0]], atol=1e-12)


def test_mirrored_targets_keep_their_normals_outwards() -> None:
    mesh = load_target(Target(builtin="staircase", scale=(-1.0, 1.0, 1.0)))
    assert mesh.volume == pytest.approx(load_target(Target(builtin="staircase")).volume)
    assert first_depth(mesh, 1.9, 0.0) == pytest.approx(-0.6)


# Scenes


def test_scene_mesh_joins_targets_in_the_camera_frame() -> None:
    mesh = build_mesh(
        scene_of(
            {"builtin": "plane", "size": [6.0, 4.0], "translation": [0, 0, 9.0], "reflectance": 0.25},
            {"builtin": "box", "scale": 0.5, "translation": [0.5, 0, 5.0], "reflectance": 0.75},
        )
    )
    assert mesh is not None
    assert mesh.face_count == 14
    dtypes = (mesh.vertices.dtype, mesh.faces.dtype, mesh.reflectance.dtype, mesh.target.dtype)
    assert dtypes == (np.float32, np.int32, np.float32, np.int32)
    assert mesh.target.tolist() == [0] * 2 + [1] * 12
    assert mesh.reflectance.tolist() == [0.25] * 2 + [0.75] * 12
    np.testing.assert_allclose(mesh.bounds, [[-3.0, -2.0, 4.75], [3.0, 2.0, 9.0]])
    own = mesh.vertices[mesh.faces[mesh.target == 1].ravel()]
    np.testing.assert_allclose([own.min(axis=0), own.max(axis=0)], [[0.25, -0.25, 4.75], [0.75, 0.25, 5.25]])


def test_scene_without_targets_has_no_mesh() -> None:
    assert build_mesh(scene_of()) is None


def test_staircase_fills_the_papers_view_from_top_to_bottom() -> None:
    # 20° over 256 pixels are 3.94 m over 192 rows at 14.89 m: less than the 4 m plate; sideways more.
    scene = make_scene(width=64, height=48)
    depth = cast_truth(scene, build_mesh(scene)).depth
    assert np.isfinite(depth[:, 10:54]).all()
    assert np.isnan(depth[:, [0, -1]]).all()
    assert depth[24, 10] == pytest.approx(14.29)  # the left bar is the nearest
    assert depth[2, 50] < depth[13, 50] < depth[22, 50]  # upper right: the top bar is the nearest


# Mesh files


@pytest.mark.parametrize("ending", FORMATS)
@pytest.mark.parametrize("upper", [False, True])
def test_every_format_gives_the_same_cube(tmp_path: Path, ending: str, upper: bool) -> None:
    path = tmp_path / f"cube.{ending}"
    trimesh.creation.box(extents=(1.0, 2.0, 3.0)).export(path)
    if upper:
        path = path.rename(tmp_path / f"CUBE.{ending.upper()}")
    mesh = load_target(Target(mesh=str(path), scale=(0.1, 0.1, 0.1), translation=(0.0, 0.0, 5.0)))
    assert len(mesh.faces) == 12
    assert mesh.is_watertight
    assert mesh.volume == pytest.approx(6e-3, rel=1e-6)
    np.testing.assert_allclose(mesh.bounds, [[-0.05, -0.1, 4.85], [0.05, 0.1, 5.15]], atol=1e-7)


# What is refused


def error_of(target: dict) -> str:
    with pytest.raises(MeshError) as caught:
        build_mesh(scene_of({"builtin": "plane"}, target))
    return str(caught.value)


def test_missing_file_and_folder_are_named(tmp_path: Path) -> None:
    missing = str(tmp_path / "bust.stl")
    assert error_of({"mesh": missing}) == f"targets[1].mesh = {missing!r}: no such file"
    assert "is not a file" in error_of({"mesh": str(tmp_path)})


def test_the_scene_file_is_named(tmp_path: Path) -> None:
    scene = Scene.from_dict(scene_of({"mesh": "bust.stl"}).to_dict(), source=tmp_path / "scene.toml")
    with pytest.raises(MeshError, match=r"scene\.toml: targets\[0\]\.mesh = .*bust\.stl': no such file"):
        build_mesh(scene)


@pytest.mark.parametrize(
    ("name", "content"),
    [
        ("empty.stl", b""),
        ("empty.obj", b""),
        ("empty.ply", b""),
        ("empty.off", b""),
        ("empty.glb", b""),
        ("noise.stl", b"solid nothing of the kind\n"),
        ("noise.ply", b"ply\nformat ascii 1.0\nelement vertex 3\n"),
        ("noise.glb", b"glTF" + bytes(100)),
        ("picture.png", b"\x89PNG\r\n\x1a\n"),
        ("points.ply", b"ply\nformat ascii 1.0\nelement vertex 1\nproperty float x\nproperty float y\n"
                       b"property float z\nend_header\n0 0 0\n"),
        ("points.obj", b"v 0 0 0\nv 1 0 0\nv 0 1 0\n"),
    ],
)  # fmt: skip
def test_files_without_a_mesh_are_refused_by_name(tmp_path: Path, name: str, content: bytes) -> None:
    path = tmp_path / name
    path.write_bytes(content)
    assert error_of({"mesh": str(path)}).startswith(f"targets[1].mesh = {str(path)!r}: ")


@pytest.mark.parametrize("value", ["nan", "inf", "1e39"])
def test_coordinates_that_are_not_finite_are_refused(tmp_path: Path, value: str) -> None:
    path = tmp_path / "bad.off"
    path.write_text(f"OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n1 {value} 0\n3 0 1 2\n3 1 3 2\n")
    assert "1 of 2 faces have coordinates that are not finite" in error_of({"mesh": str(path)})


@pytest.mark.parametrize(("name", "text"), [("empty.obj", "# nothing\n"), ("text.stl", "hello")])
def test_files_without_faces_are_refused(tmp_path: Path, name: str, text: str) -> None:
    path = tmp_path / name
    path.write_text(text)
    assert error_of({"mesh": str(path)}).endswith(f"{name}': the mesh has no faces")
    with pytest.raises(MeshError, match="no faces"):
        describe_mesh(path)


def test_meshes_without_any_area_are_refused(tmp_path: Path) -> None:
    path = tmp_path / "line.off"
    path.write_text("OFF\n3 1 0\n0 0 0\n1 0 0\n2 0 0\n3 0 1 2\n")
    assert "none of the 1 faces has an area" in error_of({"mesh": str(path)})


def test_faces_without_area_are_dropped_and_counted(tmp_path: Path) -> None:
    path = tmp_path / "sliver.off"
    path.write_text("OFF\n4 2 0\n0 0 0\n1 0 0\n0 1 0\n2 0 0\n3 0 1 2\n3 0 1 3\n")
    with pytest.warns(UserWarning, match="dropped 1 of 2 faces"):
        mesh = build_mesh(scene_of({"mesh": str(path)}))
    assert mesh is not None
    assert mesh.face_count == len(mesh.reflectance) == len(mesh.target) == 1


def test_built_ins_that_do_not_exist_are_refused_with_the_names_of_those_that_do() -> None:
    with pytest.raises(ConfigError) as caught:
        build_mesh(scene_of({"builtin": "plane"}, {"builtin": "stairs"}))
    text = str(caught.value)
    assert text.startswith("targets[1].builtin = 'stairs' is not one of 'staircase', 'plane', 'box', 'sphere', ")
    assert text.endswith("'bust'; did you mean 'staircase'?")
    assert all(repr(name) in text for name in builtin_names())


def test_size_goes_with_those_that_have_none_of_their_own() -> None:
    with pytest.raises(
        ConfigError, match=r"targets\[0\]\.size = \[2\.0, 2\.0\] cannot be combined with builtin = 'staircase'"
    ):
        build_mesh(scene_of({"builtin": "staircase", "size": [2.0, 2.0]}))


def test_too_many_subdivisions_are_refused_before_they_are_made() -> None:
    assert "targets[1].subdivisions = 12 makes 2684354560 faces of 160" in error_of(
        {"builtin": "staircase", "subdivisions": 12}
    )


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
    sphere = trimesh.creation.icosphere()
    sphere.update_faces(np.arange(len(sphere.faces)) > 20)
    sphere.export(tmp_path / "open.ply")
    found = describe_mesh(tmp_path / "open.ply")
    assert not found.is_watertight and any("not closed" in hint for hint in found.hints)
    tiny = trimesh.creation.icosphere(radius=1e-3)
    tiny.export(tmp_path / "tiny.ply")
    found = describe_mesh(tmp_path / "tiny.ply")
    assert found.unit is None and found.scale == 1.0 and any("neither" in hint for hint in found.hints)
    with pytest.raises(MeshError, match="no such file"):
        describe_mesh(tmp_path / "nothing.stl")
