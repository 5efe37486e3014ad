"""Measured histograms in, depth and point clouds out."""

import numpy as np
import pytest

import spadwarp
from spadwarp.frames.depth import Reduction, depth_of
from spadwarp.frames.measured import read_histograms
from spadwarp.io.ply import point_cloud, point_normals, write_ply
from spadwarp.run import write_depth
from spadwarp.scene import Camera
from spadwarp.scene.camera import to_camera
from spadwarp.scene.pose import rotation_matrix
from spadwarp.scene.sight import lines_of_camera, pixel_directions

COUNTS = np.random.default_rng(3).poisson(2.0, (3, 5, 40)).astype(np.uint16)


@pytest.mark.parametrize(
    ("array", "words"),
    [
        (COUNTS[0], r"\(5, 40\); real numbers \[H, W, T\]"),
        (COUNTS - 2.0, "not negative"),
        (np.full((2, 2, 2), np.nan), "holds NaN, as depth does"),
        (COUNTS.astype(complex), "complex128"),
        (np.zeros((0, 2, 2)), r"\(0, 2, 2\)"),
    ],
)
def test_arrays_that_are_no_histograms(tmp_path, array, words):
    np.save(tmp_path / "a.npy", array)
    with pytest.raises(spadwarp.FileError, match=words):
        read_histograms(tmp_path / "a.npy", axes="yxt", gate_start=0.0)


def test_files_that_cannot_be_read(tmp_path):
    for name, words in (
        ("missing.npy", "no such file"),
        ("text.npy", "damaged or not readable"),
        ("text.mat", "damaged or not readable"),
        ("text.ptu", "damaged or not readable"),
        ("text.h5", "not an HDF5 file"),
        ("text.csv", "'.csv' is not one of .h5, .hdf5, .npy"),
    ):
        if name.startswith("text"):
            (tmp_path / name).write_text("time,counts\n")
        with pytest.raises(spadwarp.FileError, match=words):
            read_histograms(tmp_path / name)


def test_background_is_that_of_all_frames_together(tmp_path):
    """The median bin of a sparse frame is 0 whatever the background."""
    counts = np.random.default_rng(5).poisson(0.2, (60, 2, 2, 200)).astype(np.int32)
    counts[..., 120:123] += np.array([2, 4, 2])
    np.save(tmp_path / "a.npy", counts)
    histograms = read_histograms(tmp_path / "a.npy", gate_start=0.0)
    irf = spadwarp.frames.InstrumentResponse(sigma=80e-12)
    known = type(histograms)(values=counts, bin_width=1e-10, irf=irf, response=irf)
    reduced = depth_of(known, method="likelihood", group_index=1.0, device="cpu")
    assert reduced.values.shape == (60, 2, 2) and reduced.quantity == "range"
    # 121.5 bins of 100 ps are 1.8212 m; the bound of eight photons is 80 ps / √8.
    assert np.median(reduced.values) == pytest.approx(1.8212, abs=4 * 80e-12 / np.sqrt(8 * 240) * 0.15e9)
    assert np.array_equal(reduced.intensity, counts.sum(-1))


@pytest.mark.parametrize("frame", ["camera", "world"])
def test_open3d_reads_points_and_normals(frame, tmp_path):
    """A tilted wall, of which some pixels see nothing, by a camera that is tilted, too."""
    open3d = pytest.importorskip("open3d")
    pose = {"position": (1.0, -2.0, 0.5), "rotation_deg": (10.0, -30.0, 5.0)}
    camera = Camera(width=12, height=9, horizontal_fov_deg=50.0, aperture_diameter=0.01, **pose)
    view = pixel_directions(camera)
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    distance = (np.array([0.0, 0.0, 3.0]) @ normal) / (view @ normal)
    distance[3, 4:7] = np.nan
    reduction = Reduction(
        quantity="depth",
        values=(distance * view[..., 2])[None],
        range=distance[None],
        intensity=np.ones((1, 9, 12)),
        lines=lines_of_camera(camera),
        method="stored",
        camera=camera,
    )
    path = tmp_path / "wall.ply"
    write_depth(reduction, tmp_path / "out", ply=path, ply_frame=frame, comment="a wall")
    cloud = open3d.io.read_point_cloud(str(path))
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    assert points.shape == normals.shape == (12 * 9 - 3, 3)
    assert f"frame {frame}: ".encode() in path.read_bytes()
    if frame == "world":
        points, normals = to_camera(camera, points), normals @ rotation_matrix(pose["rotation_deg"])
    assert np.allclose((points - [0, 0, 3]) @ normal, 0, atol=1e-5)
    assert np.allclose(normals, normal, atol=1e-4)


def test_normals_at_steps_and_of_lone_pixels():
    camera = Camera(width=6, height=4, horizontal_fov_deg=50.0, aperture_diameter=0.01)
    view = pixel_directions(camera)
    distance = np.where(np.arange(6) < 3, 2.0, 5.0) / view[..., 2]  # two walls, one behind the other
    assert np.allclose(point_normals(distance, view), [0, 0, -1], atol=1e-6)
    alone = np.full((4, 6), np.nan)
    alone[2, 3] = 4.0
    assert np.allclose(point_normals(alone, view), -view[2, 3])
    measured = Reduction(
        quantity="depth",
        values=distance[None],
        range=distance[None],
        intensity=distance[None],
        lines=lines_of_camera(camera),
        method="a",
    )
    with pytest.raises(ValueError, match="need the pose of the camera"):
        write_depth(measured, "out", ply="a.ply", ply_frame="world")


def test_points_lie_where_they_were_seen(tmp_path):
    import trimesh

    camera = Camera(width=6, height=4, horizontal_fov_deg=50.0, aperture_diameter=0.01)
    view = pixel_directions(camera)
    distance = 2.0 / view[..., 2]  # a wall at z = 2
    distance[1, 2] = np.nan
    points, valid = point_cloud(distance, view)
    assert points.shape == (23, 3) and not valid[1, 2]
    assert np.allclose(points[:, 2], 2.0) and points[:, 0].max() < 2 * np.tan(np.radians(25))
    bright = np.arange(23, dtype=np.float32)
    path = write_ply(tmp_path / "wall.ply", points, {"intensity": bright, "seen": bright > 3}, comment="a\nwall")
    cloud = trimesh.load(path)
    assert np.array_equal(cloud.vertices.astype(np.float32), points)
    vertex = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(vertex["intensity"].ravel(), bright)
    assert b"comment a wall\n" in path.read_bytes()
    for properties, words in (({"x": bright}, "'x'"), ({"a b": bright}, "'a b'"), ({"i": bright[1:]}, r"\(22,\)")):
        with pytest.raises(ValueError, match=words):
            write_ply(path, points, properties)
    with pytest.raises(ValueError, match=r"points have shape \(3,\)"):
        write_ply(path, points[0])
