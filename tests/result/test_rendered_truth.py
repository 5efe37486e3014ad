"""Truth maps from a program's EXR: axes, units, sky, float16, named errors; two real exports where they are at hand."""

import os
from pathlib import Path

import numpy as np
import pytest

from helpers.scenes import scene
from spadwarp.io.arrays import write_exr
from spadwarp.result import load_truth_exr
from spadwarp.scene.camera import pixel_directions
from spadwarp.values import FileError

CAMERA = scene(camera={"width": 4, "height": 3}).camera


def planes(**changes):
    """A 4 x 3 export: a wall at 12.5 m with sky, NaN, infinity and 0 in the top row."""
    depth = np.full((3, 4), 1250.0)
    depth[0] = [65504.0, np.nan, np.inf, 0.0]
    return {**{name: np.full((3, 4), 0.25) for name in "RGB"}, "A": depth, **changes}


def halves(channels):
    return {name: values.astype(np.float16) for name, values in channels.items()}


def filled(**values):
    return {name: np.full((3, 4), value, np.float32) for name, value in values.items()}


@pytest.fixture
def export(tmp_path):
    """Files as Unreal writes them: float16, upper-case ending, world normals."""
    write_exr(tmp_path / "wall_RGBD.EXR", halves(planes()))
    # A face that looks back at a camera along +X, turned to the right (+Y) and up (+Z).
    write_exr(tmp_path / "wall_Surf_Norm.EXR", halves(filled(R=-0.6, G=0.64, B=0.48)))
    write_exr(tmp_path / "wall_Base_Col.EXR", halves(filled(R=0.8, G=0.7, B=0.6)))
    return tmp_path


def maps(folder, name, **options):
    files = {"depth": "RGBD", "normal": "Surf_Norm", "albedo": "Base_Col"}
    return load_truth_exr(**{kind: folder / f"{name}_{ending}.EXR" for kind, ending in files.items()}, **options)


def test_unreal_depth_is_planar_centimetres_and_its_axes_become_the_cameras(export):
    truth = maps(export, "wall", camera=CAMERA)
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
    normal = {"X": 0.6, "Y": 0.64, "Z": 0.48}  # away from a camera along +Y: the other side is seen
    layers = {"DiffCol.G": 0.3, "Depth.Z": 3.0, **{f"Normal.{name}": value for name, value in normal.items()}}
    layers = filled(**{f"ViewLayer.{name}": value for name, value in layers.items()})
    layers["ViewLayer.Depth.Z"][2] = 1e10
    path = write_exr(tmp_path / "render.exr", layers)
    truth = load_truth_exr(depth=path, normal=path, albedo=path, camera=CAMERA, preset="blender")
    assert (truth.depth[:2] == 3.0).all() and np.isnan(truth.depth[2]).all()
    np.testing.assert_allclose(truth.normal[0], np.broadcast_to([-0.6, 0.48, -0.64], (4, 3)), atol=1e-6)
    np.testing.assert_allclose(truth.reflectance[0], 0.3, rtol=1e-6)


def test_normals_stored_as_colours_are_refused(export):
    write_exr(export / "wall_Surf_Norm.EXR", halves(filled(R=0.2, G=0.82, B=0.74)))
    with pytest.raises(FileError, match=r"normals of length 1.12, not 1"):
        maps(export, "wall", camera=CAMERA)


def test_own_channels_scale_and_rotated_cameras(tmp_path):
    path = write_exr(tmp_path / "d.exr", {**planes(), **filled(distance=7.0)})
    options = {"depth": path, "depth_channel": "distance", "radial": True, "camera": CAMERA}
    truth = load_truth_exr(depth_scale=0.3048, albedo=0.2, **options)
    np.testing.assert_allclose(truth.range, 7 * 0.3048, rtol=1e-6)
    np.testing.assert_allclose(truth.depth, 7 * 0.3048 * pixel_directions(CAMERA)[..., 2], rtol=1e-6)
    normal = write_exr(tmp_path / "n.exr", filled(R=0, G=-1, B=0))
    # An Unreal camera that looks along +Y: its right is -X.
    truth = load_truth_exr(normal=normal, axes=[[-1, 0, 0], [0, 0, -1], [0, 1, 0]], **options)
    np.testing.assert_allclose(truth.normal, np.broadcast_to([0, 0, -1], (3, 4, 3)), atol=1e-7)


@pytest.mark.parametrize(
    ("argument", "name", "channels", "words"),
    [
        ("depth", "nothing.exr", None, "no such file"),
        ("depth", "text.exr", None, "not an EXR image"),
        ("depth", "sky.exr", filled(A=65504.0), "no pixel has a depth"),
        ("depth", "negative.exr", filled(A=-1.0), r"depth -1 m is outside \(0, inf\) m"),
        ("depth", "two.exr", filled(**{"a.A": 1.0, "b.A": 1.0}), "could be a.A or b.A"),
        ("albedo", "bright.exr", filled(G=1.5), r"albedo 1.5 is outside \[0, 1\]"),
        ("normal", "flat.exr", filled(R=0, G=0, B=0), r"no normal at pixel \(1, 0\)"),
    ],
)
def test_files_that_lack_something_are_named(tmp_path, export, argument, name, channels, words):
    if channels is not None:
        write_exr(tmp_path / name, channels)
    elif name == "text.exr":
        (tmp_path / name).write_text("no image")
    with pytest.raises(FileError, match=f"{name}: .*{words}"):
        load_truth_exr(**{"depth": export / "wall_RGBD.EXR", "camera": CAMERA, argument: tmp_path / name})


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ({"depth_channel": "Z"}, "wall_RGBD.EXR: no channel 'Z'; it has A, B, G, R"),
        ({"camera": scene(camera={"width": 8, "height": 3}).camera}, "4 x 3 pixels; the camera has 8 x 3"),
        ({"preset": "maya"}, "preset = 'maya' is not one of 'unreal', 'blender'"),
        ({"depth_scale": -1.0}, r"depth_scale = -1.0 is outside \[1e-9, 1e9\]"),
        ({"albedo": 1.2}, r"albedo = 1.2 is outside \[0, 1\]"),
        ({"axes": np.ones((3, 3))}, "not three orthogonal unit vectors"),
    ],
)
def test_arguments_that_do_not_fit_are_named(export, arguments, words):
    normal = {"normal": export / "wall_Surf_Norm.EXR"} if "axes" in arguments else {}
    with pytest.raises((FileError, ValueError), match=words):
        load_truth_exr(**{"depth": export / "wall_RGBD.EXR", "camera": CAMERA, **normal, **arguments})


EXTRA = Path(os.environ.get("SPADWARP_EXTRA_DATA", "")) / "ue_exr"


@pytest.mark.skipif(
    not os.environ.get("SPADWARP_EXTRA_DATA") or not EXTRA.is_dir(), reason="SPADWARP_EXTRA_DATA holds no ue_exr"
)
@pytest.mark.parametrize("name", ["cat", "babiao"])
def test_real_exports_of_a_game_engine(name):
    camera = scene(camera={"width": 256, "height": 192, "horizontal_fov_deg": 20.0}).camera
    truth = maps(EXTRA, name, camera=camera)
    hit = ~np.isnan(truth.depth)
    assert 0.5 < hit.mean() < 1
    near = hit & (truth.depth < 20)
    assert 14.0 < truth.depth[near].min() < truth.depth[near].max() < 15.6
    if name == "babiao":  # the staircase: plate at 14.89 m, bars 0.1 to 0.6 m proud
        assert {14.29, 14.39, 14.49, 14.59, 14.69, 14.79, 14.89} <= set(np.round(truth.depth[near].astype(float), 4))
    assert not hit[190, 2]  # below the horizon beside the target: nothing
    np.testing.assert_allclose(np.linalg.norm(truth.normal[hit], axis=-1), 1.0, atol=1e-5)
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
