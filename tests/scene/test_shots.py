"""Scans along a trajectory: where each shot is and looks, against formulas of their own."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene
from spadwarp.scene import shot_scene, shots_of
from spadwarp.scene.pose import rotation_matrix

ATTITUDE = [12.0, -7.0, 30.0]
RATE = {"detector": {"pulses_per_frame": 5}, "laser": {"repetition_rate": 1000.0}}


def moving(pattern="raster", *, camera=(), laser=(), **scan):
    """A scan of 3 rows of 8 pixels, 5 ms from shot to shot."""
    camera = {"width": 8, "height": 3, "position": [1.0, 2.0, 3.0], "rotation_deg": ATTITUDE, **dict(camera)}
    scan = {"mode": "trajectory", "pattern": pattern, **scan}
    return scene(camera=camera, scan=scan, detector=RATE["detector"], laser={**RATE["laser"], **dict(laser)})


def axes_of(one):
    """Axes of the shots in the frame of the platform, from the lines of sight of single-pixel receivers."""
    _, along = shots_of(one).lines()
    return along.reshape(-1, 3) @ rotation_matrix(ATTITUDE)


def test_the_platform_flies_along_a_line():
    shots = shots_of(moving(velocity=[2.0, 0.0, -1.0]))
    np.testing.assert_allclose(shots.time, 0.005 * np.arange(24), rtol=1e-12)
    np.testing.assert_allclose(shots.position[7], [1.0 + 2.0 * 0.035, 2.0, 3.0 - 0.035], rtol=1e-12)
    identity = shots.rotation @ shots.rotation.transpose(0, 2, 1)
    np.testing.assert_allclose(identity, np.eye(3)[None].repeat(24, axis=0), atol=1e-12)
    assert np.allclose(np.linalg.det(shots.rotation), 1.0)


def test_patterns_turn_the_axis_as_they_say():
    angle = math.radians(20.0)
    raster = axes_of(moving(half_angle_deg=20.0))
    # 8 shots a line, evenly in angle about y, the same in each line.
    expected = angle * (2.0 * (np.arange(8) + 0.5) / 8 - 1.0)
    np.testing.assert_allclose(np.arctan2(raster[:, 0], raster[:, 2]), np.tile(expected, 3), atol=1e-12)
    np.testing.assert_allclose(raster[:, 1], 0.0, atol=1e-12)
    # A Palmer scanner keeps its angle with the axis and goes round once a row.
    cone = axes_of(moving("conical", half_angle_deg=20.0))
    np.testing.assert_allclose(np.arccos(cone[:, 2]), angle, atol=1e-9)
    azimuth = np.unwrap(np.arctan2(cone[:, 1], cone[:, 0]))
    np.testing.assert_allclose(azimuth, 2.0 * math.pi * np.arange(24) / 8, atol=1e-9)
    ellipse = axes_of(moving("elliptic", half_angle_deg=20.0, half_angle_y_deg=5.0))
    x, y = (ellipse[:, :2] / ellipse[:, 2:]).T
    np.testing.assert_allclose((x / math.tan(angle)) ** 2 + (y / math.tan(math.radians(5.0))) ** 2, 1.0, rtol=1e-9)
    # Two prisms of equal power: through the middle and out to the edge, where the first has 2 turns to the other's -3.
    rose = axes_of(moving("rosette", half_angle_deg=20.0, rosette_ratio=3.0))
    radius = np.hypot(rose[:, 0], rose[:, 1]) / rose[:, 2] / math.tan(angle)
    np.testing.assert_allclose(radius, np.abs(np.cos(2.0 * 2.0 * math.pi * np.arange(24) / 8)), atol=1e-9)
    np.testing.assert_allclose(axes_of(moving("fixed")), np.tile([0.0, 0.0, 1.0], (24, 1)), atol=1e-12)


def test_a_push_broom_array_sees_a_row_in_each_shot():
    one = moving("push_broom", camera={"horizontal_fov_deg": 40.0}, velocity=[0.0, 1.0, 0.0])
    shots = shots_of(one)
    assert one.scan_positions == len(shots) == 3
    start, along = shots.lines()
    np.testing.assert_allclose(start[2], [[1.0, 2.0 + 0.01, 3.0]] * 8, rtol=1e-12)
    local = along[1] @ rotation_matrix(ATTITUDE)
    edge = math.tan(math.radians(20.0))
    np.testing.assert_allclose(local[:, 0] / local[:, 2], edge * (2 * np.arange(8) + 1 - 8) / 8, atol=1e-12)
    # A receiver of one pixel sees all of the field of view in each shot.
    assert moving(camera={"horizontal_fov_deg": 40.0}).receiver.pixel_tangent == pytest.approx(2.0 * edge)


def test_a_file_gives_the_poses(tmp_path):
    path = tmp_path / "flight.csv"
    path.write_text("time,camera.position[0],camera.rotation_deg[2]\n10,0,0\n10.1,1,90\n10.2,3,90\n")
    shots = shots_of(moving("fixed", path=str(path), camera={"rotation_deg": [0.0, 0.0, 0.0]}))
    np.testing.assert_allclose(shots.position[[10, 21]], [[0.5, 2.0, 3.0], [1.1, 2.0, 3.0]], atol=1e-9)
    np.testing.assert_allclose(shots.rotation[10], rotation_matrix([0.0, 0.0, 45.0]), atol=1e-9)
    path.write_text("time,camera.position[0]\n0,0\n0.05,1\n")
    with pytest.raises(spadwarp.ConfigError, match=r"time = 0.05 is the last, and the last shot is at 0.115 s"):
        shots_of(moving(path=str(path)))
    path.write_text("time,laser.position[0]\n0,0\n1,1\n")
    with pytest.raises(spadwarp.ConfigError, match=r"laser.position\[0\] is no part of the camera's pose"):
        shots_of(moving(path=str(path)))


def test_one_shot_alone_is_a_scene_of_its_pose():
    one = moving("conical", velocity=[1.0, 0.0, 0.0], camera={"horizontal_fov_deg": 2.0})
    alone, shots = shot_scene(one, 9), shots_of(one)
    np.testing.assert_allclose(alone.camera.position, shots.position[9], rtol=1e-12)
    np.testing.assert_allclose(rotation_matrix(alone.camera.rotation_deg), shots.rotation[9], atol=1e-9)
    assert (alone.camera.width, alone.camera.height, alone.scan.mode) == (1, 1, "none")
    assert alone.camera.pixel_tangent == pytest.approx(2.0 * math.tan(math.radians(1.0)))
    with pytest.raises(spadwarp.ArgumentError, match=r"shot = 24 is outside \[0, 23\]"):
        shot_scene(one, 24)
    with pytest.raises(spadwarp.ArgumentError, match="'trajectory' is needed"):
        shots_of(scene())


def test_what_a_moving_scan_excludes_is_named(tmp_path):
    one = moving()
    assert one.from_toml(one.to_toml()) == one
    for changes, problem in (
        ({"laser.frame": "world"}, "laser.frame = 'world'"),
        ({"scan.distance": 3.0}, "scan.distance = 3.0"),
        ({"transport.lateral_limit": 3.0}, "transport.lateral_limit = 3.0"),
        ({"camera.distortion": [-0.1, 0.0, 0.0, 0.0]}, "camera.distortion"),
        ({"camera.port": {"distance": 0.1}}, "camera.port"),
    ):
        with pytest.raises(spadwarp.ConfigError, match=r"does not go with scan.mode = 'trajectory'") as error:
            one.with_overrides(changes)
        assert problem in str(error.value)
