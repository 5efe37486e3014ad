"""Truth maps from a program's EXR: axes, units, sky, float16, named errors; two real exports where they are at hand."""

import os
from pathlib import Path

import numpy as np
import pytest

from helpers.scenes import scene
from spadwarp.io.arrays import write_exr
from spadwarp.result.rendered_truth import load_truth_exr
from spadwarp.scene.sight import pixel_directions
from spadwarp.values import FileError

CAMERA = scene(camera={"width": 4, "height": 3}).camera


def planes(**changes):
    """A 4 x 3 export: a wall at 12.5 m with sky, NaN, infinity and 0 in the top row."""
    depth = np.full((3, 4), 1250.0)
    depth[0] = [65504.0, np.nan, np.inf, 0.0]
    return {**{name: np.full((3, 4), 0.25) for name in "RGB"}, "A": depth, **changes}


def halves(channels):
    return {name: values.astype(np.float16) for name, values in channels.items()}


@pytest.fixture
def export(tmp_path):
    """Files as Unreal writes them: float16, upper-case ending, world normals."""
    write_exr(tmp_path / "wall_RGBD.EXR", halves(planes()))
    # A face that looks back at a camera along +X, turned to the right (+Y) and up (+Z).
    world = {"R": -0.6, "G": 0.64, "B": 0.48}
    write_exr(tmp_path / "wall_Surf_Norm.EXR", {name: np.full((3, 4), v, np.float16) for name, v in world.items()})
    base = {"R": 0.8, "G": 0.7, "B": 0.6}
    write_exr(tmp_path / "wall_Base_Col.EXR", {name: np.full((3, 4), v, np.float16) for name, v in base.items()})
    return tmp_path


def test_unreal_depth_is_planar_centimetres_and_its_axes_become_the_cameras(export):
    truth = load_truth_exr(
        depth=export / "wall_RGBD.EXR",
        normal=export / "wall_Surf_Norm.EXR",
        albedo=export / "wall_Base_Col.EXR",
        camera=CAMERA,
    )
    for values in (truth.depth, truth.range, truth.reflectance, truth.normal[..., 0]):
        assert values.dtype == np.float32
        assert np.isnan(values[0]).all() and np.isfinite(values[1:]).all()
    assert (truth.depth[1:] == 12.5).all()
    np.testing.assert_allclose(truth.range[1:], 12.5 / pixel_directions(CAMERA)[1:, :, 2], rtol=1e-6)
    # Right is +x, up is -y, towards the camera is -z.
    np.testing.assert_allclose(truth.normal[1:], np.broadcast_to([0.64, -0.48, -0.6], (2, 4, 3)), atol=5e-4)
    np.testing.assert_allclose(truth.reflectance[1:], 0.7, atol=5e-4)  # green, where 532 nm is


def test_the_ending_is_found_in_either_case(export):
    truth = load_truth_exr(depth=export / "wall_RGBD.exr", camera=CAMERA)
    np.testing.assert_allclose(truth.normal[1:], -pixel_directions(CAMERA)[1:], atol=1e-6)  # faces the camera
    assert (truth.reflectance[1:] == 0.5).all()


def test_blender_depth_is_metres_and_its_normals_are_right_forward_up(tmp_path):
    depth = np.full((3, 4), 3.0, np.float32)
    depth[2] = 1e10
    layers = {"ViewLayer.Depth.Z": depth}
    for name, value in {"X": 0.6, "Y": 0.64, "Z": 0.48}.items():  # away from a camera along +Y: the other side is seen
        layers[f"ViewLayer.Normal.{name}"] = np.full((3, 4), value, np.float32)
    layers["ViewLayer.DiffCol.G"] = np.full((3, 4), 0.3, np.float32)
    path = write_exr(tmp_path / "render.exr", layers)
    truth = load_truth_exr(depth=path, normal=path, albedo=path, camera=CAMERA, preset="blender")
    assert (truth.depth[:2] == 3.0).all() and np.isnan(truth.depth[2]).all()
    np.testing.assert_allclose(truth.normal[0], np.broadcast_to([-0.6, 0.48, -0.64], (4, 3)), atol=1e-6)
    np.testing.assert_allclose(truth.reflectance[0], 0.3, rtol=1e-6)


def test_own_channels_scale_and_rotated_cameras(tmp_path):
    path = write_exr(tmp_path / "d.exr", {"distance": np.full((3, 4), 7.0, np.float32), **planes()})
    truth = load_truth_exr(
        depth=path, depth_channel="distance", depth_scale=0.3048, radial=True, camera=CAMERA, albedo=0.2
    )
    np.testing.assert_allclose(truth.range, 7 * 0.3048, rtol=1e-6)
    np.testing.assert_allclose(truth.depth, 7 * 0.3048 * pixel_directions(CAMERA)[..., 2], rtol=1e-6)
    normal = write_exr(
        tmp_path / "n.exr", {name: np.full((3, 4), v, np.float32) for name, v in {"R": 0, "G": -1, "B": 0}.items()}
    )
    # An Unreal camera that looks along +Y: its right is -X.
    axes = [[-1, 0, 0], [0, 0, -1], [0, 1, 0]]
    truth = load_truth_exr(depth=path, depth_channel="distance", radial=True, normal=normal, axes=axes, camera=CAMERA)
    np.testing.assert_allclose(truth.normal, np.broadcast_to([0, 0, -1], (3, 4, 3)), atol=1e-7)


def test_errors_name_the_file_and_what_it_lacks(tmp_path, export):
    def fails(match, **arguments):
        with pytest.raises(FileError, match=match):
            load_truth_exr(**{"depth": export / "wall_RGBD.EXR", "camera": CAMERA, **arguments})

    fails(r"wall_RGBD.EXR: no channel 'Z'; it has A, B, G, R", depth_channel="Z")
    fails(r"nothing.exr: no such file", depth=tmp_path / "nothing.exr")
    fails(r"4 x 3 pixels; the camera has 8 x 3", camera=scene(camera={"width": 8, "height": 3}).camera)
    sky = write_exr(tmp_path / "sky.exr", {"A": np.full((3, 4), 65504.0, np.float32)})
    fails(r"sky.exr: no pixel has a depth", depth=sky)
    negative = write_exr(tmp_path / "negative.exr", {"A": np.full((3, 4), -1.0, np.float32)})
    fails(r"negative.exr: depth -1 is outside \(0, inf\)", depth=negative)
    bright = write_exr(tmp_path / "bright.exr", {"G": np.full((3, 4), 1.5, np.float32)})
    fails(r"bright.exr: albedo 1.5 is outside \[0, 1\]", albedo=bright)
    flat = write_exr(tmp_path / "flat.exr", {name: np.zeros((3, 4), np.float32) for name in "RGB"})
    fails(r"flat.exr: no normal at pixel \(1, 0\)", normal=flat)
    two = write_exr(tmp_path / "two.exr", {f"{layer}.Z": np.ones((3, 4), np.float32) for layer in ("a", "b")})
    fails(r"could be a.Z or b.Z", depth=two, depth_channel="Z")
    text = tmp_path / "text.exr"
    text.write_text("no image")
    fails(r"text.exr: not an EXR image", depth=text)
    for arguments, match in [
        ({"preset": "maya"}, "preset = 'maya' is not one of 'unreal', 'blender'"),
        ({"depth_scale": -1.0}, r"depth_scale = -1.0 is outside \[1e-9, 1e9\]"),
        ({"albedo": 1.2}, r"albedo = 1.2 is outside \[0, 1\]"),
        ({"normal": export / "wall_Surf_Norm.EXR", "axes": np.ones((3, 3))}, "not three orthogonal unit vectors"),
    ]:
        with pytest.raises(ValueError, match=match):
            load_truth_exr(**{"depth": export / "wall_RGBD.EXR", "camera": CAMERA, **arguments})


EXTRA = Path(os.environ.get("SPADWARP_EXTRA_DATA", "")) / "ue_exr"


@pytest.mark.skipif(
    not os.environ.get("SPADWARP_EXTRA_DATA") or not EXTRA.is_dir(), reason="SPADWARP_EXTRA_DATA holds no ue_exr"
)
@pytest.mark.parametrize("name", ["cat", "babiao"])
def test_real_exports_of_a_game_engine(name):
    camera = scene(camera={"width": 256, "height": 192, "horizontal_fov_deg": 20.0}).camera
    truth = load_truth_exr(
        depth=EXTRA / f"{name}_RGBD.EXR",
        normal=EXTRA / f"{name}_Surf_Norm.EXR",
        albedo=EXTRA / f"{name}_Base_Col.EXR",
        camera=camera,
    )
    hit = ~np.isnan(truth.depth)
    assert 0.5 < hit.mean() < 1
    near = hit & (truth.depth < 20)
    assert 14.0 < truth.depth[near].min() < truth.depth[near].max() < 15.6
    assert not hit[190, 2]  # below the horizon beside the target: nothing
    lengths = np.linalg.norm(truth.normal[hit], axis=-1)
    np.testing.assert_allclose(lengths, 1.0, atol=1e-5)
    # Nearly every face already looked at the camera: handedness and axes are right.
    assert np.median(-(truth.normal * pixel_directions(camera)).sum(-1)[near]) > 0.6
    assert ((truth.reflectance[hit] >= 0) & (truth.reflectance[hit] <= 1)).all()
    if name == "cat":
        # A round body: its left flank faces left, its right flank right; its top up.
        body = np.where(near[..., None], truth.normal, np.nan)
        rows, columns = np.nonzero(near)
        left, right = body[60:150, columns.min() : 118], body[60:150, 150 : columns.max()]
        assert np.nanmean(left[..., 0]) < -0.2 < 0.2 < np.nanmean(right[..., 0])
        assert np.nanmean(body[rows.min() : rows.min() + 25, :, 1]) < -0.05
