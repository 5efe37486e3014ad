"""Intrinsics, distortion and pose mean what OpenCV means by them: against its published formulas, in float64."""

import math

import numpy as np
import pytest

from helpers.opencv import project_points
from spadwarp import load_scene
from spadwarp.scene import Camera, look_at, opencv_pose, save_calibration
from spadwarp.scene.camera import (
    image_points,
    image_tangents,
    pixel_directions,
    pixel_views,
    to_camera,
    to_world,
    view_box,
)
from spadwarp.scene.pose import rotation_angles, rotation_matrix
from spadwarp.values import ConfigError, FileError

# Calibrations of a barrel, a pincushion and a decentred lens.
LENSES = {
    "barrel": (-0.28, 0.07, 0.0, 0.0, -0.01),
    "pincushion": (0.12, -0.02, 0.0, 0.0, 0.0),
    "decentred": (-0.1, 0.01, 0.004, -0.006, 0.002),
}
MATRIX = (61.0, 63.5, 29.2, 25.1)
INTRINSICS = dict(zip(("fx", "fy", "cx", "cy"), MATRIX, strict=True))
INTRINSICS |= {"width": 64, "height": 48, "aperture_diameter": 0.01}


@pytest.fixture(params=LENSES)
def lens(request):
    return LENSES[request.param]


@pytest.mark.parametrize("rvec", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.9), (-2.0, 0.4, 1.1)])
def test_points_of_the_world_fall_where_opencv_puts_them(lens, rvec):
    tvec = (0.2, -0.4, 3.0)
    camera = Camera(**INTRINSICS, distortion=lens, **opencv_pose(rvec, tvec))
    seen = np.random.default_rng(1).uniform([-0.35, -0.3, 1.0], [0.35, 0.3, 5.0], size=(40, 3))
    seen[:, :2] *= seen[:, 2:]
    world = to_world(camera, seen)
    np.testing.assert_allclose(to_camera(camera, world), seen, atol=1e-12)
    ours = image_points(camera, seen[:, :2] / seen[:, 2:])
    np.testing.assert_allclose(ours - 0.5, project_points(world, rvec, tvec, *MATRIX, lens), atol=1e-9)


def test_pixel_directions_are_imaged_in_the_middle_of_their_pixels(lens):
    view = pixel_directions(Camera(**INTRINSICS, distortion=lens))
    expected = project_points(view.reshape(-1, 3), (0, 0, 0), (0, 0, 0), *MATRIX, lens)
    row, column = np.mgrid[:48, :64]
    np.testing.assert_allclose(expected.reshape(48, 64, 2), np.stack([column, row], axis=-1), atol=1e-8)
    np.testing.assert_allclose(np.linalg.norm(view, axis=-1), 1.0)


def test_the_view_holds_every_pixel_and_little_more(lens):
    camera = Camera(**INTRINSICS, distortion=lens)
    left, top, right, bottom = view_box(camera)
    random = np.random.default_rng(2)
    inner = image_tangents(camera, random.uniform((0, 0), (64, 48), size=(4000, 2)))
    assert (inner > (left, top)).all() and (inner < (right, bottom)).all()
    # Each side is touched by the image's border.
    sides = [(c, r) for c in np.linspace(0, 64, 200) for r in (0, 48)]
    sides += [(c, r) for r in np.linspace(0, 48, 200) for c in (0, 64)]
    border = image_tangents(camera, np.array(sides))
    np.testing.assert_allclose((*border.min(axis=0), *border.max(axis=0)), (left, top, right, bottom), atol=0.001)
    views = pixel_views(camera)
    row, column = random.integers((0, 0), (48, 64), size=(500, 2)).T
    inside = image_tangents(camera, np.stack([column, row], -1) + random.uniform(size=(500, 2)))
    assert (inside > views[row, column, :2]).all() and (inside < views[row, column, 2:]).all()


def test_all_ways_to_give_a_camera_agree():
    image = {"width": 40, "height": 30}
    ways = (
        {"horizontal_fov_deg": 2 * math.degrees(math.atan(0.2))},
        {"fx": 100.0},
        {"fx": 100.0, "cx": 19.5, "cy": 14.5},
    )
    cameras = [Camera(**image, **way, aperture_diameter=0.005) for way in ways]
    cameras.append(Camera(**image, focal_length=0.01, pixel_pitch_um=100.0, f_number=2.0))
    for camera in cameras:
        assert camera.is_plain and camera.pixel_tangent == pytest.approx(0.01)
        assert camera.aperture_radius == pytest.approx(0.0025)
        assert camera.focal_pixels == pytest.approx((100.0, 100.0)) and camera.principal_point == (20.0, 15.0)
        half = math.tan(camera.horizontal_fov / 2), math.tan(camera.vertical_fov / 2)
        assert half == pytest.approx((0.2, 0.15))
        np.testing.assert_allclose(pixel_directions(camera), pixel_directions(cameras[0]), rtol=1e-14)
    shifted = Camera(**image, fx=100.0, cx=0.0, cy=0.0, aperture_diameter=0.01)
    np.testing.assert_array_equal(pixel_directions(shifted)[0, 0], [0.0, 0.0, 1.0])
    assert shifted.horizontal_fov == pytest.approx(math.atan(0.395) + math.atan(0.005))


# Poses


@pytest.mark.parametrize("angles", [(10.0, 20.0, 30.0), (-170.0, 80.0, 5.0), (30.0, 90.0, 0.0), (-40.0, -90.0, 0.0)])
def test_angles_are_read_back_from_the_matrix(angles):
    matrix = rotation_matrix(angles)
    np.testing.assert_allclose(matrix @ matrix.T, np.eye(3), atol=1e-14)
    np.testing.assert_allclose(rotation_matrix(rotation_angles(matrix)), matrix, atol=1e-12)


def test_look_at_puts_the_point_on_the_axis_and_keeps_the_horizon():
    camera = Camera(**INTRINSICS, **look_at((1.0, -2.0, 0.5), (-3.0, 1.0, 4.0)))
    np.testing.assert_allclose(to_camera(camera, (-3.0, 1.0, 4.0)), (0, 0, math.sqrt(16 + 9 + 12.25)), atol=1e-9)
    right, down = rotation_matrix(camera.rotation_deg).T[:2]
    assert right[1] == pytest.approx(0.0, abs=1e-12) and down[1] > 0
    assert look_at((0, 0, 0), (0, 0, 1)) == {"position": (0.0, 0.0, 0.0), "rotation_deg": pytest.approx((0, 0, 0))}


def test_opencv_poses_take_a_vector_or_a_matrix():
    assert opencv_pose((0, 0, 0), (1, 2, 3))["position"] == (-1.0, -2.0, -3.0)
    for rotation, angle in (((0, 0, math.pi / 2), -90), (rotation_matrix((0, 0, 90)), -90)):
        np.testing.assert_allclose(opencv_pose(rotation, (0, 0, 0))["rotation_deg"], (0, 0, angle), atol=1e-9)
    for wrong, problem in (
        ((0, 0), "3 numbers"),
        (np.diag([1, 1, -1]), "not a rotation matrix"),
        ((0, 90, 0), "radians"),
    ):
        with pytest.raises(ValueError, match=problem):
            opencv_pose(wrong, (0, 0, 0))
    with pytest.raises(ValueError, match="no horizon"):
        look_at((0, 0, 0), (0, 3, 0))


# Calibration files

_SIZE = "image_width: 64\nimage_height: 48\n"
_OPENCV_YAML = f"""%YAML:1.0
---
{_SIZE}camera_matrix: !!opencv-matrix
   rows: 3
   cols: 3
   dt: d
   data: [ 6.1e+01, 0., 29.2, 0., 63.5, 25.1,
       0., 0., 1. ]
distortion_coefficients: !!opencv-matrix
   rows: 1
   cols: 5
   dt: d
   data: [ -2.8e-01, 0.07, 0., 0., -0.01 ]
"""
_MATRICES = {"camera_matrix": "3 3 [61.0, 0, 29.2, 0, 63.5, 25.1, 0, 0, 1]"}
_MATRICES["distortion_coefficients"] = "1 5 [-0.28, 0.07, 0, 0, -0.01]"
_ROS_YAML = f"{_SIZE}distortion_model: plumb_bob\n" + "".join(
    "{}:\n  rows: {}\n  cols: {}\n  data: {}\n".format(name, *text.split(" ", 2)) for name, text in _MATRICES.items()
)
_OPENCV_JSON = """{"image_width": 64, "image_height": 48, "camera_matrix": {"type_id": "opencv-matrix",
  "rows": 3, "cols": 3, "dt": "d", "data": [61.0, 0.0, 29.2, 0.0, 63.5, 25.1, 0.0, 0.0, 1.0]},
 "distortion_coefficients": {"type_id": "opencv-matrix", "rows": 5, "cols": 1, "dt": "d",
                             "data": [-0.28, 0.07, 0.0, 0.0, -0.01]}}"""
_PLAIN_JSON = '{"K": [[61.0, 0, 29.2], [0, 63.5, 25.1], [0, 0, 1]], "dist": [[-0.28, 0.07, 0, 0, -0.01, 0, 0, 0]]}'
_OPENCV_XML = """<?xml version="1.0"?>
<opencv_storage><image_width>64</image_width><image_height>48</image_height>
<camera_matrix type_id="opencv-matrix">
  <rows>3</rows><cols>3</cols><dt>d</dt>
  <data>
    61. 0. 29.2 0. 6.3500e+01 25.1 0.
    0. 1.</data></camera_matrix>
<distortion_coefficients type_id="opencv-matrix">
  <rows>1</rows><cols>5</cols><dt>d</dt><data>-0.28 0.07 0. 0. -0.01</data></distortion_coefficients>
</opencv_storage>
"""


@pytest.mark.parametrize("text", [_OPENCV_YAML, _OPENCV_XML, _ROS_YAML, _OPENCV_JSON, _PLAIN_JSON])
def test_a_calibration_file_becomes_fields(tmp_path, text):
    path = tmp_path / "camera.yml"
    path.write_text(text)
    size = {} if "image_width" in text else {"width": 64, "height": 48}
    camera = Camera(calibration=str(path), aperture_diameter=0.01, **size)
    assert camera == Camera(**INTRINSICS, distortion=LENSES["barrel"])
    assert camera.calibration is None  # the numbers stand for it


@pytest.mark.parametrize(
    "text, problem",
    [
        ("image_width: 64\n", "holds no camera_matrix"),
        (_ROS_YAML.replace("plumb_bob", "equidistant"), "'equidistant' is not Brown's"),
        (_ROS_YAML.replace("61.0, 0, 29.2", "61.0, 0.3, 29.2"), "is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]"),
        (_PLAIN_JSON.replace("-0.01, 0, 0, 0", "-0.01, 0, 0.1, 0"), "no rational, prism or tilt terms"),
        ('{"K": ' + "[" * 100_000, "not valid JSON"),
        ("<opencv_storage><K>", "not valid XML: "),
        ("<!DOCTYPE a [<!ENTITY b 'c'>]><opencv_storage/>", "declares a document type"),
        ("K: &a [61.0]\nD: *a\n", "not valid YAML: an alias stands in line 2"),
        (_ROS_YAML.replace("61.0", "abc"), "camera_matrix = 'abc' is not a number"),
        (_ROS_YAML.replace("cols: 3", "cols: 2"), "camera_matrix has 9 numbers in 3 rows and 2 columns"),
        (_OPENCV_JSON.replace('"cols": 1', '"cols": 8'), "5 numbers in 5 rows and 8 columns"),
        ("<a>" * 100_000, "not valid XML: "),
        ("<a>" * 50_000 + "</a>" * 50_000, "holds no camera_matrix"),
        (_ROS_YAML.replace("width: 64", "width: 64.5"), "image_width = 64.5 is not an integer in [1, 16384]"),
    ],
)
def test_what_is_no_calibration_is_refused(tmp_path, text, problem):
    path = tmp_path / "camera.json"
    path.write_text(text)
    with pytest.raises(ConfigError) as caught:
        Camera(calibration=str(path), aperture_diameter=0.01, width=64, height=48)
    assert problem in str(caught.value) and str(path) in str(caught.value)


def test_calibrations_that_are_missing_or_too_long_are_refused_before_they_are_parsed(tmp_path):
    (tmp_path / "camera.yml").write_text(_ROS_YAML + "\n" * 600_000)
    for name, problem in (("none", "No such file"), ("camera", r"camera\.yml: has more than 524288 bytes")):
        with pytest.raises(FileError, match=problem):
            Camera(calibration=str(tmp_path / f"{name}.yml"), aperture_diameter=0.01, width=64, height=48)


@pytest.mark.parametrize("ending", [".xml", ".yml", ".json"])
def test_opencv_reads_our_calibration_and_we_read_opencvs(tmp_path, ending):
    cv2 = pytest.importorskip("cv2")
    camera = Camera(**INTRINSICS, distortion=LENSES["barrel"])
    path, theirs = save_calibration(camera, tmp_path / f"camera{ending}"), tmp_path / f"theirs{ending}"

    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
    size = {name: int(storage.getNode(name).real()) for name in ("image_width", "image_height")}
    both = {name: storage.getNode(name).mat() for name in ("camera_matrix", "distortion_coefficients")}
    storage.release()
    assert tuple(size.values()) == (camera.width, camera.height)
    points = np.array([[0.1, -0.05, 1.0], [-0.2, 0.1, 1.5]])
    pixels, _ = cv2.projectPoints(points, np.zeros(3), np.zeros(3), *both.values())
    np.testing.assert_allclose(pixels[:, 0], image_points(camera, points[:, :2] / points[:, 2:]) - 0.5, atol=1e-9)

    storage = cv2.FileStorage(str(theirs), cv2.FILE_STORAGE_WRITE)
    for name, value in {"calibration_time": "Mon 01 Jan 2024", **size, **both}.items():
        storage.write(name, value)
    storage.release()
    for file in (path, theirs):
        assert Camera(calibration=str(file), aperture_diameter=camera.aperture_diameter) == camera


def test_files_beside_a_scene_are_found_from_anywhere(tmp_path):
    (tmp_path / "lens.yml").write_text(_OPENCV_YAML)
    (tmp_path / "scene.toml").write_text(
        "[medium]\nextinction = 0.3\nalbedo = 0.8\n[gate]\nbin_width_ps = 100\nbins = 10\n"
        '[camera]\ncalibration = "lens.yml"\naperture_diameter = 0.01\n'
        '[laser]\nprofile = "measured"\nprofile_image = "beam.npy"\n'
    )
    scene = load_scene(tmp_path / "scene.toml")
    assert scene.camera == Camera(**INTRINSICS, distortion=LENSES["barrel"])
    assert scene.laser.profile_image == str(tmp_path / "beam.npy")
    # The numbers stand in the text of the scene, which needs the calibration's file no more.
    (tmp_path / "lens.yml").unlink()
    (tmp_path / "again.toml").write_text(scene.to_toml())
    assert load_scene(tmp_path / "again.toml") == scene
