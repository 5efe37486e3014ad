"""Measured histograms in, depth and point clouds out."""

import numpy as np
import pytest

import spadwarp
from spadwarp.frames.depth import depth_of
from spadwarp.frames.measured import read_histograms
from spadwarp.io.ply import point_cloud, write_ply
from spadwarp.scene import Camera
from spadwarp.scene.geometry import pixel_directions

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
