"""Cameras in the simulation: each lens images as optics has it, the estimators agree behind every one of them."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.estimators import PHOTONS, SEEDS, agreeing_cells
from helpers.opencv import project_points
from helpers.scenes import PLATE, scene
from spadwarp import simulate
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.scene.camera import to_world
from spadwarp.scene.pose import rotation_angles, rotation_matrix
from spadwarp.transport.model import build_model
from spadwarp.values import ConfigError

pytestmark = pytest.mark.physics

BENT = {"horizontal_fov_deg": None, "fx": 4.3, "fy": 4.6, "cx": 1.2, "cy": 1.9}
BENT["distortion"] = [-0.15, 0.02, 0.01, -0.02, 0]
POSE = {"position": [0.4, -0.3, -0.2], "rotation_deg": [6.0, -9.0, 20.0]}
WORLD = {"position": [0.7, 0.2, -0.1], "direction": [-0.2, -0.1, 1.0], "frame": "world"}
CAMERAS = {
    "thin lens": (PHOTONS, {"camera": {"focus_distance": 1.2}}),
    "calibrated, posed, laser in the world": (
        {"analog": 60_000, "guided": 30_000},
        {"camera": {**BENT, **POSE, "focus_distance": 3.0}, "laser": WORLD},
    ),
}


@pytest.mark.slow
@pytest.mark.parametrize("camera", CAMERAS)
def test_estimators_agree_behind_every_lens(camera, device):
    photons, sections = CAMERAS[camera]
    one, clear = scene(**sections), photons is PHOTONS
    cells = agreeing_cells(one, device, photons=photons, pixels=True, converged=0.1, clear=clear)
    # Every component and pixel is seen.
    pixels = cells["guided"][:, -16:]
    assert (pixels.std(axis=0) / pixels.mean(axis=0) / math.sqrt(SEEDS) < 0.1).all()
    assert (cells["guided"][:, :24].reshape(SEEDS, 3, 8).sum(axis=(0, 2)) > 0).all()


@pytest.mark.parametrize("estimator", ["next_event", "guided"])
def test_a_thin_lens_stopped_down_is_a_pinhole(estimator, device):
    """The same photons through a hole of 20 µm, focused at 1.2 m, or a point: the same image to what rounding
    moves from a pixel to its neighbour."""
    camera = {"width": 16, "height": 16, "aperture_diameter": 2e-5}
    thin, pinhole = (
        simulate(
            scene(transport={"estimator": estimator}, camera={**camera, **lens}), photons=100_000, seed=1, device=device
        )
        for lens in ({"focus_distance": 1.2}, {"pinhole": True})
    )
    wrong = np.abs(thin.intensity - pinhole.intensity).sum() / pinhole.intensity.sum()
    assert wrong < 0.01
    np.testing.assert_allclose(thin.histogram.sum(axis=(0, 1)), pinhole.histogram.sum(axis=(0, 1)), rtol=0.01)


@pytest.mark.parametrize("focus", [0.6, 2.5, math.inf])
def test_a_point_out_of_focus_is_a_disc_of_confusion(focus, device):
    """Radius a·|1/z − 1/focus| as a tangent: for a small spot at z its image is even, and ends there."""
    z, radius, pixel = 1.0, 0.05, 2e-3
    camera = {"width": 64, "height": 64, "horizontal_fov_deg": None, "fx": 1 / pixel}
    one = scene(
        medium={"albedo": 0.0},
        laser={"half_angle_deg": 0.2, "position": [0.0, 0.0, 0.0]},
        camera={**camera, "aperture_diameter": 2 * radius, "focus_distance": focus},
        targets=[{"builtin": "plane", "size": 4e-3, "translation": [0.0, 0.0, z], "reflectance": 1.0}],
    )
    image = simulate(one, photons=200_000, seed=4, device=device).intensity
    disc = radius * abs(1 / z - (0 if math.isinf(focus) else 1 / focus)) / pixel  # [pixels]
    place = np.arange(64) + 0.5 - 32
    r2 = place[:, None] ** 2 + place**2
    spread = (image * r2).sum() / image.sum()
    spot = (4e-3 / z / pixel) ** 2 / 6 + 1 / 6  # of a square of 2 pixels, and of a pixel
    assert spread == pytest.approx(disc**2 / 2 + spot, rel=0.01)
    assert image[r2 > (disc + 2.5) ** 2].sum() == 0
    inner = r2 < (disc / 2) ** 2
    # Even, but for cos^4 of the angle at the lens: a quarter of the light in a quarter of the area.
    assert image[inner].sum() / image.sum() == pytest.approx(np.count_nonzero(inner) / (math.pi * disc**2), rel=0.03)


@pytest.mark.slow
def test_a_spot_in_the_world_is_imaged_where_opencv_puts_it(device):
    rvec, tvec, coefficients = (0.2, -0.3, 0.4), (0.1, -0.05, 1.0), (-0.25, 0.05, 0.01, -0.008, 0.0)
    spots = np.array([[0.55, 0.35, 2.0], [-0.5, 0.4, 1.5]])  # as the camera sees them
    world = to_world(scene(camera=spadwarp.scene.opencv_pose(rvec, tvec)).camera, spots)
    camera = {"width": 64, "height": 48, "horizontal_fov_deg": None, "aperture_diameter": 1e-3}
    camera |= {"fx": 70.0, "fy": 66.0, "cx": 30.3, "cy": 22.2, "distortion": coefficients}
    for seen, place in zip(spots, world, strict=True):
        one = scene(
            medium={"albedo": 0.0},
            camera={**camera, **spadwarp.scene.opencv_pose(rvec, tvec)},
            laser={"half_angle_deg": 3.0, "position": [0.0, 0.0, 0.0], "direction": seen.tolist()},
            targets=[{"builtin": "sphere", "size": 0.12, "translation": place.tolist()}],
        )
        result = simulate(one, photons=200_000, seed=2, device=device)
        row, column = np.indices(result.intensity.shape)
        mean = [np.average(axis, weights=result.intensity) for axis in (column, row)]
        (expected,) = project_points([place], rvec, tvec, 70.0, 66.0, 30.3, 22.2, coefficients)
        np.testing.assert_allclose(mean, expected, atol=0.1)
        # And the truth maps know it there, with the range to the ball's near side.
        there = result.truth.range[round(expected[1]), round(expected[0])]
        assert there == pytest.approx(np.linalg.norm(place - one.camera.position) - 0.06, abs=0.005)


def test_moving_everything_together_changes_nothing(device):
    """Camera, laser and target under one rigid motion: the same histories to float32, so the same histogram."""
    turn, shift = rotation_matrix((25.0, -40.0, 70.0)), np.array([3.0, -1.0, 2.0])
    here = simulate(scene(), photons=100_000, seed=3, device=device)
    target = {**PLATE, "translation": (turn @ [0, 0, 2.2] + shift).tolist(), "rotation_deg": [25.0, -40.0, 70.0]}
    camera = {"position": shift.tolist(), "rotation_deg": rotation_angles(turn)}
    standing = {"position": (turn @ [-0.1, 0, 0] + shift).tolist(), "direction": turn[:, 2].tolist(), "frame": "world"}
    for laser in ({}, standing):  # it rides on the camera, or stands in the world
        moved = scene(camera=camera, targets=[target], laser=laser)
        there = simulate(moved, photons=100_000, seed=3, device=device)
        np.testing.assert_allclose(there.truth.range, here.truth.range, rtol=1e-5)
        np.testing.assert_allclose(there.truth.normal, here.truth.normal, atol=1e-5)
        np.testing.assert_allclose(there.true_path(), here.true_path(), rtol=1e-5)
        assert np.abs(there.histogram - here.histogram).sum() < 0.01 * here.histogram.sum()
        np.testing.assert_allclose(there.depth(), here.depth(), rtol=0.01)


def test_a_camera_outside_the_water_is_refused():
    """Where the model is built: nothing is compiled."""
    camera = {"domain": {"shape": "slab", "lower": 0.5, "upper": 9.0}, "laser": {"position": [0, 0, 1.0]}}
    laser = {"domain": {"shape": "box", "lower": 1.0, "upper": 9.0}}
    for sections, text in (
        (camera, r"camera\.position: z = 0\.0 is outside \[0\.5, 9\.0\] m, the domain"),
        (laser, r"laser\.position: x = -0\.1 is outside \[1\.0, 9\.0\] m, the domain"),
    ):
        one = scene(**sections)
        with pytest.raises(ConfigError, match=text):
            build_model(one, pick_device("cpu"), build_mesh(one))


@pytest.mark.slow
def test_layers_of_water_stand_in_the_world(device):
    """Camera, laser and layers under one motion: photons end where the motion takes their ends."""
    turn, shift = rotation_matrix((25.0, -40.0, 70.0)), np.array([3.0, -1.0, 2.0])
    layers = [{"start": 0.7, "extinction": 3.0, "albedo": 0.5}, {"start": 1.5, "extinction": 0.2, "albedo": 0.9}]
    pose, apart = rotation_matrix((10.0, 20.0, 30.0)), {"translation": [0.0, 0.0, -400.0]}
    around = {"domain": {"shape": "box", "lower": -900.0, "upper": 900.0}, "targets": [PLATE | apart]}
    here = scene(
        medium={"layers": layers, "layer_axis": [0.6, 0.0, 0.8]}, camera={"rotation_deg": [10.0, 20.0, 30.0]}, **around
    )
    start = float(turn @ [0.6, 0.0, 0.8] @ shift)
    moved = [{**layer, "start": layer["start"] + start} for layer in layers]
    there = scene(
        medium={"layers": moved, "layer_axis": (turn @ [0.6, 0.0, 0.8]).tolist()},
        camera={"position": shift.tolist(), "rotation_deg": rotation_angles(turn @ pose)},
        **around,
    )
    along, same = (one.optical_depth((0.1, 0, 0), (0.3, 0.2, 4.0)) for one in (there, here))
    assert along == pytest.approx(same)
    first, second = (spadwarp.transport.trace(one, photons=20_000, seed=1, device=device) for one in (here, there))
    apart = np.linalg.norm(second.position - (first.position @ turn.T + shift), axis=1)
    # A rounding may tip one history over an edge of something; most end where they must to float32.
    assert np.quantile(apart, 0.98) < 1e-3
    assert (first.collisions == second.collisions).mean() > 0.98
