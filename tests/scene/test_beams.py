"""Lasers: a measured profile leaves as it was measured, a scene's checks and its tallies know where the beam is."""

import math

import matplotlib.image
import numpy as np
import pytest
from PIL import Image
from scipy import stats

import spadwarp
from helpers.scenes import scene
from spadwarp.io.arrays import write_exr
from spadwarp.mesh import build_mesh
from spadwarp.scene import laser as beam_profile
from spadwarp.scene.pose import rotation_matrix
from spadwarp.transport import tally_limits
from spadwarp.values import FileError
from spadwarp_kernels import profile_tables

PROFILE = np.random.default_rng(1).gamma(0.7, size=(12, 20))
PROFILE[3:5, 6:9] = 0.0
PROFILE[11] = 0.0
CLEAR = {"medium": {"albedo": 0.0, "extinction": 0.01}, "targets": []}


def measured(path, **laser):
    return {"profile": "measured", "profile_image": str(path), "half_angle_deg": 10.0, **laser}


def profile_of(path):
    return beam_profile.load_profile(scene(laser=measured(path)).laser)


@pytest.mark.physics
@pytest.mark.parametrize("direction", [(0.0, 0.0, 1.0), (0.5, -0.6, 0.4), (0.0, -1.0, 0.0)])
def test_photons_leave_as_the_profile_was_measured(direction, device, tmp_path):
    """On a plane across the axis: χ² of the photons in each pixel, and evenly within the pixels."""
    np.save(tmp_path / "beam.npy", PROFILE)
    one = scene(**CLEAR, laser=measured(tmp_path / "beam.npy", direction=list(direction)))
    photons = 400_000
    u = spadwarp.transport.trace(one, photons=photons, seed=3, device=device).direction.astype(np.float64)
    axis = np.array(direction) / np.linalg.norm(direction)
    right = np.array([axis[2], 0.0, -axis[0]]) if abs(axis[1]) < 1 else np.array([1.0, 0.0, 0.0])
    right /= np.linalg.norm(right)
    down = np.cross(axis, right)
    assert down[1] >= 0  # "down" is the camera's, as far as the axis allows
    pixel = math.tan(math.radians(10.0)) / 10  # 20 columns span both sides
    column = u @ right / (u @ axis) / pixel + 10.0
    row = u @ down / (u @ axis) / pixel + 6.0
    # float32 directions: a photon at the very edge of a pixel may fall on the other side.
    inside = (np.abs(column - np.round(column)) > 1e-3) & (np.abs(row - np.round(row)) > 1e-3)
    seen = np.histogram2d(row[inside], column[inside], bins=(12, 20), range=((0, 12), (0, 20)))[0]
    assert seen.sum() == inside.sum() and inside.mean() > 0.99
    assert not seen[PROFILE == 0].any()
    expected = PROFILE / PROFILE.sum() * inside.sum()
    kept = expected > 10
    assert stats.chisquare(seen[kept], expected[kept] * (seen[kept].sum() / expected[kept].sum())).pvalue > 1e-4
    for place in (row % 1, column % 1):
        assert stats.kstest(place[inside], "uniform").pvalue > 1e-4


def test_a_profile_can_be_an_image(tmp_path):
    levels = np.round(255 * PROFILE / PROFILE.max()).astype(np.uint8)
    np.save(tmp_path / "beam.npy", PROFILE.astype(np.float32))
    write_exr(tmp_path / "beam.exr", {"R": PROFILE.astype(np.float32), "G": 0 * levels.astype(np.float32)})
    colours = np.stack([levels, levels, levels, np.full_like(levels, 255)], axis=-1)
    matplotlib.image.imsave(tmp_path / "beam.png", colours)
    images = {ending: profile_of(tmp_path / f"beam.{ending}") for ending in ("npy", "exr", "png")}
    np.testing.assert_allclose(images["npy"], PROFILE, rtol=1e-6)
    np.testing.assert_allclose(images["exr"], PROFILE / 2, rtol=1e-6)  # the mean of its channels
    np.testing.assert_allclose(images["png"], levels / 255, atol=1e-6)


@pytest.mark.parametrize(
    "image, problem",
    [
        (np.zeros((3, 4)), "finite values >= 0 with light"),
        (np.full((3, 4), np.nan), "finite values >= 0 with light"),
        (np.ones(5), r"real numbers \[height, width\]"),
        (None, "no such file"),
    ],
)
def test_what_is_no_profile_is_refused(image, problem, tmp_path):
    if image is not None:
        np.save(tmp_path / "beam.npy", image)
        with pytest.raises(ValueError):
            profile_tables(image)
    with pytest.raises(FileError, match=problem):
        spadwarp.simulate(scene(laser=measured(tmp_path / "beam.npy")), photons=10, device="cpu")


@pytest.mark.parametrize("ending", ["png", "npy", "exr"])
def test_profiles_of_too_many_pixels_are_refused_before_they_are_decoded(ending, tmp_path, monkeypatch):
    """A small file can hold a huge image of one colour."""
    monkeypatch.setattr(beam_profile, "_LARGEST", 64 * 64)
    monkeypatch.setattr("matplotlib.image.imread", lambda *_: pytest.fail("it was decoded"))
    path, image = tmp_path / f"beam.{ending}", np.ones((65, 256), np.float32)
    if ending == "png":
        Image.new("L", (256, 65), 255).save(path)
    elif ending == "npy":
        np.save(path, image)
    else:
        write_exr(path, {"Y": image})
    with pytest.raises(FileError, match=rf"beam\.{ending}.*at most \d+ are"):
        profile_of(path)


# A laser away from the lens

NARROW = {"width": 32, "height": 32, "aperture_diameter": 0.01, "horizontal_fov_deg": 20.0}
WALL = [{"builtin": "plane", "size": [3.0, 3.0], "translation": [0, 0, 8.0], "reflectance": 1.0}]
LASERS = {
    "beside the lens": {},
    "next to the target": {"position": [1.0, 0, 7.5], "direction": [-0.9, 0, 0.5], "half_angle_deg": 0.05},
    "across the view": {"position": [-0.6, 0, 3.0], "direction": [1, 0, 0], "half_angle_deg": 0.2},
    "towards the camera": {"position": [0.3, 0, 7.0], "direction": [-0.3, 0.3, -1.0], "half_angle_deg": 0.2},
    "a measured beam of one bright pixel": measured("beam.npy"),
    "a scan": {"half_angle_deg": 0.2, "position": [0, 0, 0]},
}


@pytest.mark.slow
@pytest.mark.parametrize("name", LASERS)
def test_a_tally_holds_its_photons_wherever_the_laser_stands(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    np.save("beam.npy", np.pad([[1.0]], 50))
    sections = {"laser": LASERS[name]} | ({"scan": {"mode": "confocal"}} if name == "a scan" else {})
    gate = {"start_ns": 0.0, "bin_width_ps": 200.0, "bins": 400}
    one = scene(camera=NARROW, gate=gate, targets=WALL, **sections)
    mesh = build_mesh(one)
    scale, capacity = tally_limits(one, mesh)
    assert math.frexp(scale)[0] == 0.5
    result = spadwarp.simulate(one, photons=100_000, seed=1, device="cpu")
    assert result.unit == 1.0 / scale
    found = result.tallies.sum(axis=0)
    if name == "a scan":
        found = found.mean(axis=(0, 1))  # few photons a pixel
    assert 1e-8 < found.max() / result.photons * capacity / 2.0**62 < 0.5
    assert result.counters["clipped"] == 0


# Checks


def fields(one, level="warning"):
    return {message.field: message.text for message in spadwarp.check(one) if message.level == level}


def test_checks_know_pose_and_frames():
    aside = {"position": [3.0, 0.0, 0.0]}
    assert "in the camera frame" in fields(scene(camera=aside))["targets[0]"]
    looking = scene(camera=spadwarp.scene.look_at((3.0, 0.0, 0.0), (0.0, 0.0, 2.2)), gate={"bins": 20})
    assert "targets[0]" not in fields(looking)
    # A laser that stays behind lights what the camera has turned to, or does not.
    stays = looking.with_overrides(laser={"frame": "world"})
    assert "targets[0]" not in fields(stays)
    away = looking.with_overrides(laser={"frame": "world", "direction": [-1.0, 0.0, 0.0]})
    assert "the beam misses" in fields(away)["targets[0]"]
    box = {"shape": "box", "lower": [-2.0, -2.0, -0.5], "upper": [4.0, 2.0, 3.0]}
    assert not {"domain", "targets[0]"} & fields(looking.with_overrides(domain=box)).keys()
    shorter = looking.with_overrides(domain={**box, "upper": [2.0, 2.0, 3.0]})
    assert any("the lens at (3, 0, 0)" in message.text for message in spadwarp.check(shorter))


def test_checks_tell_where_beam_and_pixel_of_a_scan_miss():
    camera = {"width": 256, "height": 256}
    laser = {"half_angle_deg": 0.1, "position": [-0.1, 0.0, 0.0], "direction": [0.1, 0.0, 1.0]}
    one = scene(scan={"mode": "confocal"}, camera=camera, laser=laser, detector={"hot_pixel_fraction": 0.1})
    assert "0.1 m beside what its pixel sees" in fields(one)["scan.distance"]
    assert {"laser.direction", "detector.hot_pixel_fraction"} <= fields(one, "note").keys()
    assert "scan.distance" not in fields(one.with_overrides({"scan.distance": 2.2}))
    assert "transport.axis_threshold" not in fields(one)
    paper = one.with_overrides({"transport.axis_threshold": 0.9998})
    assert "within 1.15° of the optical axis" in fields(paper)["transport.axis_threshold"]


def test_checks_tell_how_far_out_of_focus_a_target_is_and_one_smaller_than_a_pixel():
    """2 a |1/z - 1/focus| as a tangent, over a pixel's: 0.4 m of lens, pixels of 4 x 4 over 50°."""

    def found(size, focus):
        sphere = {"builtin": "sphere", "size": size, "translation": [0, 0, 2.7]}
        one = scene(camera={"focus_distance": focus}, targets=[sphere])
        return spadwarp.checks.summary(one)["target_range"][1], {m.field: m for m in spadwarp.check(one)}

    far, messages = found(1.2, 1.0)
    pixel = 2 * math.tan(math.radians(25)) / 4
    assert messages["camera.focus_distance"].values["pixels"] == pytest.approx(0.4 * (1.0 - 1 / far) / pixel)
    assert not {"camera.focus_distance", "targets[0]"} & found(1.2, 2.5)[1].keys()
    assert "smaller than a pixel" in found(0.3, 2.5)[1]["targets[0]"].text


def test_the_beam_of_a_laser_in_the_world():
    turn = rotation_matrix((10.0, 20.0, 30.0))
    camera = {"position": [1.0, 2.0, 3.0], "rotation_deg": [10.0, 20.0, 30.0]}
    one = scene(camera=camera, laser={"position": [1.0, 2.0, 4.0], "direction": [0.0, 1.0, 0.0], "frame": "world"})
    np.testing.assert_allclose(one.beam.position, turn.T @ [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(one.beam.axis, turn.T @ [0, 1, 0], atol=1e-12)
    assert scene(camera=camera).beam == scene(camera=camera).laser
