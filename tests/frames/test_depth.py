"""Arrival times from arrays of every kind; measured histograms in, depth and point clouds out."""

import dataclasses

import numpy as np
import pytest
import warp as wp
from scipy.stats import norm

import spadwarp
from spadwarp.files import write_depth
from spadwarp.frames.depth import Reduction, arrival_time, depth_of
from spadwarp.frames.measured import read_histograms
from spadwarp.io.arrays import point_cloud, write_ply
from spadwarp.scene import Camera
from spadwarp.scene.camera import pixel_directions, to_camera
from spadwarp.scene.pose import rotation_matrix
from spadwarp.scene.sight import lines_of_camera

GATE = dict(gate_start=100e-9, bin_width=50e-12)
IRF = spadwarp.frames.InstrumentResponse(sigma=2.0 * 50e-12)


DELAYS = np.array([20.25, 33.5, 41.0, np.nan])  # of four pixels [bins]; one has no light
CUBE = 500 * np.nan_to_num(np.diff(norm.cdf(np.arange(65), DELAYS[:, None], 2.0), axis=1)).reshape(2, 2, 64)


def times_of(cube, **options):
    return arrival_time(cube, **{**GATE, "device": "cpu", **options})


@pytest.mark.parametrize("method", ["peak", "centroid", "matched", "likelihood"])
def test_every_method_gives_seconds_and_nan_where_nothing_returned(method):
    times = times_of(CUBE, method=method, irf=IRF)
    assert times.shape == (2, 2) and times.dtype == np.float64
    tolerance = (0.51 if method == "peak" else 0.02) * 50e-12
    np.testing.assert_allclose(times.ravel(), 100e-9 + DELAYS * 50e-12, rtol=0, atol=tolerance)


def test_arrays_of_every_kind_agree():
    expected, counts = times_of(CUBE), np.rint(CUBE)
    np.testing.assert_array_equal(times_of(wp.array(CUBE, dtype=wp.float64, device="cpu"), device=None), expected)
    np.testing.assert_allclose(times_of(CUBE.astype(np.float32)), expected, rtol=1e-7)
    whole = [counts.astype(kind) for kind in (np.uint8, np.uint16, np.int32, np.int64)]
    for array in (*whole, pytest.importorskip("torch").from_numpy(counts)):
        np.testing.assert_array_equal(times_of(array, device=None), times_of(counts))


def test_frames_share_one_background():
    options = {"irf": IRF, "method": "likelihood"}
    one = times_of(CUBE + 3.0, background=np.full((2, 2, 64), 3.0), **options)
    for background in (np.full((2, 2, 64), 3.0), np.full(64, 3.0)):
        both = times_of(np.stack([CUBE + 3.0] * 2), background=background, **options)
        np.testing.assert_array_equal(both, [one, one])


def test_a_gate_leaves_out_what_lies_before_it():
    early = CUBE.copy()
    early[..., 3] = 1e4
    gate = (100e-9 + 10 * 50e-12, 100e-9 + 60 * 50e-12)
    assert np.nanmax(times_of(early, method="peak")) < gate[0]
    np.testing.assert_array_equal(times_of(early, method="peak", gate=gate), times_of(CUBE, method="peak"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "matched"}, "needs an irf"),
        ({"histogram": np.full((2, 2, 8), -1.0)}, r"pixel \(0, 0\)"),
        ({"histogram": np.full((2, 2, 8), np.nan)}, "non-finite value"),
        ({"histogram": np.zeros(8)}, r"shape \(8,\)"),
        ({"histogram": np.zeros((2, 2, 8), complex)}, "dtype complex128"),
        ({"histogram": np.zeros((2, 2, 0))}, "at least one pixel and one bin"),
        ({"background": np.zeros(7)}, r"background has shape \(7,\)"),
        ({"background": -1.0}, "background holds a negative"),
        ({"gate": (0.0, 1e-9)}, "gate = "),
        ({"irf": [1.0, 2.0], "method": "matched"}, "irf = .* is not an InstrumentResponse"),
    ],
)
def test_wrong_input_is_named(changes, message):
    call = {"histogram": np.zeros((2, 2, 64)), **changes}
    with pytest.raises((ValueError, TypeError), match=message):
        times_of(call.pop("histogram"), **call)


COUNTS = np.random.default_rng(3).poisson(2.0, (3, 5, 40)).astype(np.uint16)
NO_HISTOGRAMS = [
    (r"\(5, 40\); real numbers \[H, W, T\]", COUNTS[0]),
    ("not negative", COUNTS - 2.0),
    ("holds NaN, as depth does", np.full((2, 2, 2), np.nan)),
    ("complex128", COUNTS.astype(complex)),
    (r"\(0, 2, 2\)", np.zeros((0, 2, 2))),
    ("no such file", "missing.npy"),
    *[("damaged or not readable", f"text.{ending}") for ending in ("npy", "mat", "ptu")],
    ("not an HDF5 file", "text.h5"),
    ("'.csv' is not one of .h5, .hdf5, .npy", "text.csv"),
]


@pytest.mark.parametrize(("words", "held"), NO_HISTOGRAMS)
def test_files_that_hold_no_histograms(tmp_path, words, held):
    path = tmp_path / (held if isinstance(held, str) else "a.npy")
    if not isinstance(held, str):
        np.save(path, held)
    elif held.startswith("text"):
        path.write_text("time,counts\n")
    with pytest.raises(spadwarp.FileError, match=words):
        read_histograms(path, axes=None if isinstance(held, str) else "yxt", gate_start=0.0)


def test_background_is_that_of_all_frames_together(tmp_path):
    """The median bin of a sparse frame is 0 whatever the background."""
    counts = np.random.default_rng(5).poisson(0.2, (60, 2, 2, 200)).astype(np.int32)
    counts[..., 120:123] += np.array([2, 4, 2])
    np.save(tmp_path / "a.npy", counts)
    histograms = read_histograms(tmp_path / "a.npy", gate_start=0.0)
    irf = spadwarp.frames.InstrumentResponse(sigma=80e-12)
    known = type(histograms)(values=counts, bin_width=1e-10, irf=irf, response=irf)
    reduced = depth_of(known, method="likelihood", group_index=1.0, min_significance=0, device="cpu")
    assert reduced.values.shape == (60, 2, 2) and reduced.quantity == "range"
    # 121.5 bins of 100 ps are 1.8212 m; the bound of eight photons is 80 ps / √8.
    assert np.median(reduced.values) == pytest.approx(1.8212, abs=4 * 80e-12 / np.sqrt(8 * 240) * 0.15e9)
    assert np.array_equal(reduced.intensity, counts.sum(-1))


def wall(camera, distance):
    """What is known of the depth of a wall, of which some pixels see nothing."""
    facts = {"values": (distance * pixel_directions(camera)[..., 2])[None], "range": distance[None]}
    facts |= {"intensity": np.ones((1, *distance.shape)), "lines": lines_of_camera(camera), "method": "stored"}
    return Reduction(quantity="depth", **facts)


@pytest.mark.parametrize("frame", ["camera", "world"])
def test_open3d_reads_points_and_normals(frame, tmp_path):
    """A tilted wall, of which some pixels see nothing, by a camera that is tilted, too."""
    open3d = pytest.importorskip("open3d")
    pose = {"position": (1.0, -2.0, 0.5), "rotation_deg": (10.0, -30.0, 5.0)}
    camera = Camera(width=12, height=9, horizontal_fov_deg=50.0, aperture_diameter=0.01, **pose)
    normal = np.array([0.3, -0.2, -1.0]) / np.linalg.norm([0.3, -0.2, -1.0])
    distance = 3.0 * normal[2] / (pixel_directions(camera) @ normal)
    distance[3, 4:7] = np.nan
    seen = dataclasses.replace(wall(camera, distance), camera=camera)
    path = tmp_path / "wall.ply"
    write_depth(seen, tmp_path / "out", ply=path, ply_frame=frame, comment="a wall")
    cloud = open3d.io.read_point_cloud(str(path))
    points, normals = np.asarray(cloud.points), np.asarray(cloud.normals)
    assert points.shape == normals.shape == (12 * 9 - 3, 3)
    assert f"frame {frame}: ".encode() in path.read_bytes()
    if frame == "world":
        points, normals = to_camera(camera, points), normals @ rotation_matrix(pose["rotation_deg"])
    assert np.allclose((points - [0, 0, 3]) @ normal, 0, atol=1e-5)
    assert np.allclose(normals, normal, atol=1e-4)


CAMERA = Camera(width=6, height=4, horizontal_fov_deg=50.0, aperture_diameter=0.01)


def test_normals_at_steps_and_of_lone_pixels():
    view = pixel_directions(CAMERA)
    distance = np.where(np.arange(6) < 3, 2.0, 5.0) / view[..., 2]  # two walls, one behind the other
    assert np.allclose(point_cloud(distance, view)[1], [0, 0, -1], atol=1e-6)
    alone = np.full((4, 6), np.nan)
    alone[2, 3] = 4.0
    assert np.allclose(point_cloud(alone, view)[1], -view[2, 3])
    with pytest.raises(ValueError, match="need the pose of the camera"):
        write_depth(wall(CAMERA, distance), "out", ply="a.ply", ply_frame="world")


def test_points_lie_where_they_were_seen(tmp_path):
    import trimesh

    view = pixel_directions(CAMERA)
    distance = 2.0 / view[..., 2]  # a wall at z = 2
    distance[1, 2] = np.nan
    points, _ = point_cloud(distance, view)
    assert points.shape == (23, 3)
    assert np.allclose(points[:, 2], 2.0) and points[:, 0].max() < 2 * np.tan(np.radians(25))
    columns = dict(zip("xyz", points.T, strict=True)) | {"intensity": np.arange(23, dtype=np.float32)}
    path = write_ply(tmp_path / "wall.ply", columns, comment="a\nwall")
    cloud = trimesh.load(path)
    assert np.array_equal(cloud.vertices.astype(np.float32), points)
    vertex = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(vertex["intensity"].ravel(), columns["intensity"])
    assert b"comment a wall\n" in path.read_bytes()
