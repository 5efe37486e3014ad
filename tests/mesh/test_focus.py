"""At which depth a camera is focused."""

import dataclasses
import math

import h5py
import pytest

import spadwarp
from helpers.scenes import scene
from spadwarp.mesh import build_mesh, focus_distance
from spadwarp.values import ConfigError

SQUARE = {"builtin": "plane", "size": [0.2, 0.2]}


def focus(*targets, **camera):
    one = scene(camera={"aperture_diameter": 0.02, **camera}, targets=list(targets))
    return focus_distance(one, build_mesh(one))


def at(x, y, z, **fields):
    return {**SQUARE, "translation": [x, y, z], **fields}


def test_the_first_face_on_the_axis_is_in_focus():
    assert focus(at(0, 0, 3.0), at(0, 0, 2.0), at(0, 0, 4.0)) == pytest.approx(2.0)
    # The axis may run along an edge, here the diagonal of the square and the rim of another.
    assert focus(at(0.1, 0, 1.5), at(0, 0, 2.0)) == pytest.approx(1.5)
    assert focus(at(0, 0, 2.0, rotation_deg=[60.0, 0, 0], size=[9.0, 9.0])) == pytest.approx(2.0)
    assert focus({"builtin": "sphere", "size": 1.0, "translation": [0, 0, 3.0]}) == pytest.approx(2.5, abs=0.01)
    # Behind the camera, around the lens, and nearer than a lens can be focused: these do not count.
    assert focus(at(0, 0, -1.0), at(0, 0, 2.0)) == pytest.approx(2.0)
    assert focus(at(0, 0, 0.0), at(0, 0, 0.005), at(0, 0, 2.0)) == pytest.approx(2.0)
    near = {"horizontal_fov_deg": None, "focal_length": 0.05, "pixel_pitch_um": 10_000.0}
    assert focus(at(0, 0, 0.04), at(0, 0, 2.0), **near) == pytest.approx(2.0)


def test_beside_the_axis_the_point_seen_closest_to_it_is_in_focus():
    assert focus(at(0.5, 0, 2.0), at(0.5, 0, 4.0)) == pytest.approx(4.0)
    assert focus(at(0.3, 0, 2.0), at(0.7, 0, 3.0)) == pytest.approx(2.0)
    slanted = at(1.0, 0, 3.0, size=[1.0, 1.0], rotation_deg=[0, 45.0, 0])
    # Its left edge, at x = 1 - cos 45°/2.
    assert focus(slanted) == pytest.approx(3.0 + 0.5 * math.sin(math.radians(45.0)), abs=0.01)
    assert focus(at(5.0, 0, 2.0)) == math.inf  # outside the view of 50°
    assert focus() == math.inf


def test_the_camera_sees_its_targets_from_where_it_is():
    aside = spadwarp.scene.look_at((1.0, 0.0, 0.0), (0.0, 0.0, 2.0))
    assert focus(at(0, 0, 2.0, size=[0.5, 0.5]), **aside) == pytest.approx(math.sqrt(5.0))


def test_a_number_is_taken_as_it_is_and_a_pinhole_needs_none():
    for given, used in ((3.5, 3.5), ("3 m", 3.0), ("infinity", math.inf)):
        assert focus(at(0, 0, 2.0), focus_distance=given) == used
    assert focus(at(0, 0, 2.0), pinhole=True) is None


def test_the_field_of_view_follows_the_focus_only_where_it_is_a_number():
    """With "target", pitch over focal length, wherever the targets are; 50 mm focused at 1 m has its image at 52.6."""
    lens = {"horizontal_fov_deg": None, "focal_length": 0.05, "pixel_pitch_um": 100.0}
    for more, factor in (({}, 1.0), ({"focus_distance": math.inf}, 1.0), ({"focus_distance": 1.0}, 0.95)):
        assert scene(camera={**lens, **more}).camera.pixel_tangent == pytest.approx(2e-3 * factor)


def test_a_result_knows_its_focus_and_is_added_to_its_like_alone(tmp_path):
    far, near, point = (
        spadwarp.simulate(scene(camera=camera), photons=1000, device="cpu")
        for camera in ({}, {"focus_distance": 1.0}, {"pinhole": True})
    )
    assert (far.focus_distance, near.focus_distance, point.focus_distance) == (pytest.approx(2.2), 1.0, None)
    for result, attribute in ((far, 2.2), (point, math.nan)):
        path = result.save(tmp_path / "one.h5")
        assert spadwarp.load(path).focus_distance == result.focus_distance
        with h5py.File(path) as file:
            assert file.attrs["camera_focus_distance"] == pytest.approx(attribute, nan_ok=True)
    # A target that was moved after the run, or a run of a version with another lens.
    other = dataclasses.replace(far, focus_distance=None, photon_ranges=((1000, 2000),))
    with pytest.raises(ConfigError, match=r"merge: the lenses of the results differ: focus_distance is 2\.2"):
        spadwarp.merge([far, other])
    with pytest.raises(ConfigError, match="resume: the lenses of the results differ: focus_distance is None and 2"):
        resume = spadwarp.RunOptions(resume=dataclasses.replace(far, focus_distance=None))
        spadwarp.simulate(far.scene, photons=2000, device="cpu", run=resume)
