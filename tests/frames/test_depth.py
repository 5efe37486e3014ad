"""Arrival times from arrays of every kind; measured histograms in, depth and point clouds out."""

import numpy as np
import pytest
import warp as wp

import spadwarp
from spadwarp.files import write_depth
from spadwarp.frames.depth import Reduction, arrival_time, depth_of
from spadwarp.frames.measured import read_histograms
from spadwarp.io.arrays import point_cloud, write_ply
from spadwarp.scene import Camera
from spadwarp.scene.camera import to_camera
from spadwarp.scene.pose import rotation_matrix
from spadwarp.scene.sight import lines_of_camera, pixel_directions

GATE = dict(gate_start=100e-9, bin_width=50e-12)
IRF = np.exp(-0.5 * ((np.arange(15) - 7) / 2.0) ** 2)


def _cube(delay=(20.25, 33.5, 41.0, np.nan), bins=64, sigma=2.0):
    from scipy.stats import norm

    edges = norm.cdf(np.arange(bins + 1), np.array(delay)[:, None], sigma)
    return 500 * np.nan_to_num(np.diff(edges, axis=1)).reshape(2, 2, bins)


@pytest.mark.parametrize("method", ["peak", "centroid", "matched", "likelihood"])
def test_every_method_gives_seconds_and_nan_where_nothing_returned(method):
    cube = _cube()
    times = arrival_time(cube, **GATE, method=method, irf=IRF, device="cpu")
    assert times.shape == (2, 2) and times.dtype == np.float64
    expected = 100e-9 + np.array([20.25, 33.5, 41.0]) * 50e-12
    np.testing.assert_allclose(times.ravel()[:3], expected, rtol=0, atol=(0.51 if method == "peak" else 0.02) * 50e-12)
    assert np.isnan(times[1, 1])


def test_numpy_torch_and_warp_agree():
    cube = _cube()
    expected = arrival_time(cube, **GATE, device="cpu")
    np.testing.assert_array_equal(arrival_time(wp.array(cube, dtype=wp.float64, device="cpu"), **GATE), expected)
    np.testing.assert_allclose(arrival_time(cube.astype(np.float32), **GATE, device="cpu"), expected, rtol=1e-7)
    counts = np.rint(cube)
    expected = arrival_time(counts, **GATE, device="cpu")
    for dtype in (np.uint8, np.uint16, np.int32, np.int64):
        np.testing.assert_array_equal(arrival_time(counts.astype(dtype), **GATE, device="cpu"), expected)
    torch = pytest.importorskip("torch")
    np.testing.assert_array_equal(arrival_time(torch.from_numpy(counts), **GATE), expected)


def test_frames_share_one_background():
    frames = np.stack([_cube() + 3.0, _cube() + 3.0])
    background = np.full((2, 2, 64), 3.0)
    times = arrival_time(frames, **GATE, background=background, irf=IRF, method="likelihood", device="cpu")
    assert times.shape == (2, 2, 2)
    np.testing.assert_array_equal(times[0], times[1])
    shared = arrival_time(frames, **GATE, background=np.full(64, 3.0), irf=IRF, method="likelihood", device="cpu")
    np.testing.assert_array_equal(times, shared)


def test_a_gate_leaves_out_what_lies_before_it():
    cube = _cube()
    cube[..., 3] = 1e4
    gate = (100e-9 + 10 * 50e-12, 100e-9 + 60 * 50e-12)
    assert np.nanmax(arrival_time(cube, **GATE, method="peak", device="cpu")) < gate[0]
    inside = arrival_time(cube, **GATE, method="peak", gate=gate, device="cpu")
    np.testing.assert_array_equal(inside, arrival_time(_cube(), **GATE, method="peak", device="cpu"))


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"method": "guess"}, "method = 'guess'"),
        ({"bin_width": 0.0}, "bin_width = 0.0 is outside .* s"),
        ({"gate_start": np.nan}, "gate_start = nan"),
        ({"method": "matched"}, "needs an irf"),
        ({"histogram": np.full((2, 2, 8), -1.0)}, r"pixel \(0, 0\)"),
        ({"histogram": np.full((2, 2, 8), np.nan)}, "non-finite value"),
        ({"histogram": np.zeros(8)}, r"shape \(8,\)"),
        ({"histogram": np.zeros((2, 2, 8), complex)}, "dtype complex128"),
        ({"histogram": np.zeros((2, 2, 0))}, "at least one pixel and one bin"),
        ({"background": np.zeros(7)}, r"background has shape \(7,\)"),
        ({"background": -1.0}, "background holds a negative"),
        ({"gate": (0.0, 1e-9)}, "gate = "),
        ({"irf": [-1.0, 2.0], "method": "matched"}, "irf must be"),
        ({"irf": np.ones((2, 2)), "method": "matched"}, "irf has shape"),
    ],
)
def test_wrong_input_is_named(changes, message):
    call = {"histogram": np.zeros((2, 2, 64)), **GATE, **changes}
    with pytest.raises((ValueError, TypeError), match=message):
        arrival_time(call.pop("histogram"), **call, device="cpu")


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
    reduced = depth_of(known, method="likelihood", group_index=1.0, min_significance=0, device="cpu")
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
    assert np.allclose(point_cloud(distance, view)[1], [0, 0, -1], atol=1e-6)
    alone = np.full((4, 6), np.nan)
    alone[2, 3] = 4.0
    assert np.allclose(point_cloud(alone, view)[1], -view[2, 3])
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
    points, _ = point_cloud(distance, view)
    assert points.shape == (23, 3)
    assert np.allclose(points[:, 2], 2.0) and points[:, 0].max() < 2 * np.tan(np.radians(25))
    bright = np.arange(23, dtype=np.float32)
    columns = dict(zip("xyz", points.T, strict=True)) | {"intensity": bright}
    path = write_ply(tmp_path / "wall.ply", columns, comment="a\nwall")
    cloud = trimesh.load(path)
    assert np.array_equal(cloud.vertices.astype(np.float32), points)
    vertex = cloud.metadata["_ply_raw"]["vertex"]["data"]
    assert np.array_equal(vertex["intensity"].ravel(), bright)
    assert b"comment a wall\n" in path.read_bytes()
