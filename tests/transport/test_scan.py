"""Confocal scanning: laser and pixel move together, and each position is a run of its own."""

import dataclasses
import math

import numpy as np
import pytest

import spadwarp
import spadwarp_kernels as sk
from helpers.estimators import agreeing_cells
from helpers.scenes import scene
from spadwarp import RunOptions, simulate
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.scene import Camera, shot_scene, shots_of
from spadwarp.scene.sight import scan_axes
from spadwarp.transport.model import build_model, transport_spec

pytestmark = pytest.mark.physics

CONFOCAL = {"scan": {"mode": "confocal"}, "laser": {"half_angle_deg": 3.0}}


def _one_pixel(one, row, column):
    """The scene of one position: a camera of one pixel, and the laser aimed where the scan aims it."""
    (fx, fy), (cx, cy) = one.camera.focal_pixels, one.camera.principal_point
    camera = {"width": 1, "height": 1, "horizontal_fov_deg": None, "distortion": one.camera.distortion}
    camera |= {"fx": fx, "fy": fy, "cx": cx - 0.5 - column, "cy": cy - 0.5 - row}
    direction = scan_axes(one)[row, column].tolist()
    return one.with_overrides(camera=camera, laser={"direction": direction}, scan={"mode": "none"})


@pytest.mark.slow
@pytest.mark.parametrize("camera", [{}, {"distortion": [-0.1, 0.0, 0.01, 0.0, 0.0], "focus_distance": 1.5}])
def test_a_scan_is_one_run_a_pixel_bit_for_bit(camera, device):
    """The photons of each position, walked one by one through a scene of that pixel alone, leave the same integers."""
    one = scene(**CONFOCAL, camera=camera)
    rounds, pixels = 40, 16
    result = simulate(one, photons=rounds * pixels, seed=9, device=device)
    target, mesh = pick_device(device), build_mesh(one)
    scale = build_model(one, target, mesh).scale
    for row, column in np.ndindex(4, 4):
        single = _one_pixel(one, row, column)
        model = dataclasses.replace(build_model(single, target, mesh), scale=scale)
        spec, data = transport_spec(single, mesh), sk.make_data(model)
        assert not spec.confocal
        for photon in range(4 * row + column, rounds * pixels, pixels):
            sk.launch_transport(spec, model, data, seed=9, first_id=photon, photon_count=1)
        tallies = data.tally.numpy().reshape(3, 8)
        # Another kernel: on a GPU it may round products and sums otherwise.
        np.testing.assert_allclose(result.tallies[:, row, column], tallies, rtol=0.0 if device == "cpu" else 1e-6)
        # And per photon of the position the values are those of the single run.
        expected = tallies.sum(axis=0) * (1.0 / scale / rounds)
        np.testing.assert_allclose(result.histogram[row, column], expected, rtol=1e-12 if device == "cpu" else 1e-6)
    assert result.tallies.any(axis=(0, 3)).all()


@pytest.mark.slow
def test_the_estimators_agree_in_a_scan(device):
    one = scene(**CONFOCAL, gate={"start_ns": 6.671, "bins": 4})
    agreeing_cells(one, device, photons={"analog": 100_000, "guided": 40_000}, seeds=16, converged=0.1)


def test_pixels_of_a_scan_see_their_own_light_alone(device):
    """Clear water, a beam narrower than a pixel: each pixel gets the full return of a pencil beam, R/pi e^(-2cr) A
    cos^2/r^2 times the cosine at the lens, whatever the number of pixels; without a scan the beam is in one alone."""
    one = scene(
        medium={"albedo": 0.0},
        laser={"profile": "collimated", "position": [0.0, 0.0, 0.0]},
        camera={"aperture_diameter": 0.02, "width": 6, "height": 4},
        scan={"mode": "confocal"},
    )
    result = simulate(one, photons=6 * 4 * 20_000, seed=2, device=device)
    distance = result.truth.range.astype(float)
    cosine = 2.2 / distance
    expected = 0.7 / math.pi * np.exp(-2 * 0.5 * distance) * math.pi * 0.01**2 * cosine**2 / distance**2
    lit = np.isfinite(expected)
    assert lit.all()
    np.testing.assert_allclose(result.component("ballistic").sum(axis=2), expected, rtol=0.06)
    assert result.component("ballistic").sum() == pytest.approx(expected.sum(), rel=0.01)


def test_counts_of_photons_a_position_hold_for_any_range_of_ids():
    """Runs that stop within a round of the raster: each pixel is divided by its own photons."""
    one = scene(**CONFOCAL)
    whole = simulate(one, photons=1000, seed=5, device="cpu")
    parts = [
        simulate(one, photons=count, seed=5, device="cpu", run=RunOptions(first_photon=first))
        for first, count in ((0, 333), (333, 667))
    ]
    for result in (whole, *parts):
        start, stop = result.photon_ranges[0]
        ids = np.arange(start, stop) % 16
        expected = np.bincount(ids, minlength=16).reshape(4, 4)
        np.testing.assert_array_equal(result.unit / result.tally_value, expected)
    joined = spadwarp.merge(parts)
    np.testing.assert_array_equal(joined.histogram, whole.histogram)
    resumed = simulate(one, photons=1000, device="cpu", run=RunOptions(resume=parts[0]))
    np.testing.assert_array_equal(resumed.tallies, whole.tallies)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*few heavy photons decide it")
def test_the_standard_error_of_a_scan_is_the_spread_between_seeds():
    runs = [simulate(scene(**CONFOCAL), photons=16 * 640, seed=seed, device="cpu") for seed in range(48)]
    assert runs[0].batch_size % 16 == 0 and runs[0].photons % runs[0].batch_size == 0
    totals = np.array([run.histogram.sum(axis=2) for run in runs])
    errors = np.sqrt(np.array([(run.standard_error**2).sum(axis=2) for run in runs]).mean(axis=0))
    # Bins of a pixel are nearly independent; 16 pixels of 48 runs tell a standard deviation to 3 %.
    assert np.mean(totals.std(axis=0, ddof=1) / errors) == pytest.approx(1.0, abs=0.12)


def test_a_scan_survives_its_file_and_gives_depth(tmp_path):
    one = scene(**CONFOCAL, gate={"bin_width_ps": 100.0, "bins": 200})
    result = simulate(one, photons=16 * 4000, seed=1, device="cpu")
    loaded = spadwarp.load(result.save(tmp_path / "scan.h5"))
    assert loaded.scene == one
    np.testing.assert_array_equal(loaded.histogram, result.histogram)
    np.testing.assert_allclose(result.depth(method="peak"), 2.2, atol=0.05)
    with pytest.raises(ValueError, match="CALIBRATED"):
        sk.make_transport_kernel(sk.TransportSpec(confocal=True))


def test_beam_and_line_of_sight_cross_at_the_distance_of_the_scan():
    one = scene(scan={"mode": "confocal", "distance": 2.5}, laser={"position": [-0.3, 0.1, 0.0]})
    axes = scan_axes(one)
    view = spadwarp.scene.camera.pixel_directions(one.camera)
    np.testing.assert_allclose(np.cross(axes, 2.5 * view - np.array([-0.3, 0.1, 0.0])), 0.0, atol=1e-12)
    np.testing.assert_array_equal(scan_axes(scene(scan={"mode": "confocal"})), view)
    assert isinstance(one.camera, Camera)


def test_the_check_knows_that_a_pixel_gets_the_photons_of_its_position_alone():
    few = {"laser": CONFOCAL["laser"], "transport": {"estimator": "analog", "photons": 100}}
    printed = [
        next(message for message in spadwarp.check(one) if message.field == "transport.estimator")
        for one in (scene(**few), scene(**few, scan={"mode": "confocal"}))
    ]
    flash, scan = (message.values["photons_per_pixel"] for message in printed)
    assert scan == pytest.approx(flash / 16, rel=0.05)


# Laser and camera that move

MOVING = {"mode": "trajectory", "pattern": "conical", "half_angle_deg": 8.0, "velocity": [0.0, 40.0, 0.0]}
POSE = {"position": [0.05, -0.05, -0.1], "rotation_deg": [4.0, -3.0, 20.0], "horizontal_fov_deg": 30.0}


def _moving(**sections):
    """A cone of 4 x 4 shots of a wide receiver, 1 ms from shot to shot."""
    return scene(**{"scan": MOVING, "camera": POSE, "laser": {"half_angle_deg": 8.0}} | sections)


def test_moving_shots_have_the_truth_of_their_pose(device):
    """Range, normal and target on a plane, by the formula of a ray; and nothing where there is none."""
    half = {"builtin": "box", "size": [1.5, 3.0, 0.1], "translation": [-0.75, 0.0, 1.8], "reflectance": 0.2}
    one = _moving(targets=[{"builtin": "plane", "size": [3.0, 3.0], "translation": [0.0, 0.0, 2.2]}, half])
    truth, target = spadwarp.transport.truth_maps(one, device=device), spadwarp.transport.target_map(one, device=device)
    start, along = shots_of(one).lines()
    to_plate, to_box = ((z - start[..., 2]) / along[..., 2] for z in (2.2, 1.75))
    on_box = (start + to_box[..., None] * along)[..., 0] < 0.0
    assert 4 <= on_box.sum() <= 12
    np.testing.assert_array_equal(target, on_box)
    np.testing.assert_allclose(truth.range, np.where(on_box, to_box, to_plate), rtol=1e-6)
    # The normal of both is -z of the world, seen in the frame of each shot.
    np.testing.assert_allclose(truth.normal, -shots_of(one).rotation[:, 2].reshape(4, 4, 3), atol=1e-6)
    assert (spadwarp.transport.target_map(_moving(targets=[]), device=device) == -1).all()


@pytest.mark.slow
def test_each_shot_is_the_run_of_its_pose_alone(device):
    """Totals by component of the shots of a moving scan, against scenes in which nothing moves."""
    one, photons, shots = _moving(), 2000, (0, 6, 13)
    runs = [simulate(one, photons=16 * photons, seed=seed, device=device) for seed in range(8)]
    parts = np.array([run.tallies.sum(axis=3) * (run.unit / photons) for run in runs]).reshape(8, 3, 16)
    assert all(run.energy_report()["exact"] for run in runs)
    for shot in shots:
        alone = [simulate(shot_scene(one, shot), photons=photons, seed=100 + seed, device=device) for seed in range(8)]
        fixed = np.array([run.tallies.sum(axis=(1, 2, 3)) * (run.unit / photons) for run in alone])
        moved = parts[:, :, shot]
        error = np.sqrt((fixed.var(axis=0, ddof=1) + moved.var(axis=0, ddof=1)) / 8)
        assert (np.abs(fixed.mean(axis=0) - moved.mean(axis=0)) < 4.0 * error).all()
        assert (error < 0.1 * fixed.mean(axis=0)).all()


@pytest.mark.slow
@pytest.mark.parametrize("pattern", ["conical", "push_broom"])
def test_the_estimators_agree_in_a_moving_scan(device, pattern):
    one = _moving(scan={**MOVING, "pattern": pattern}, gate={"start_ns": 6.671, "bins": 4})
    photons = {"analog": 100_000, "next_event": 40_000, "guided": 40_000}
    agreeing_cells(one, device, photons=photons, seeds=16, converged=0.1, pixels=pattern == "push_broom", clear=True)


@pytest.mark.slow
def test_a_row_of_a_push_broom_array_shares_the_photons_of_its_shot():
    one = _moving(scan={**MOVING, "pattern": "push_broom"})
    result = simulate(one, photons=1001, seed=5, device="cpu")
    expected = np.bincount(np.arange(1001) % 4, minlength=4)[:, None].repeat(4, axis=1)
    np.testing.assert_array_equal(result.unit / result.tally_value, expected)
    assert result.tallies.any(axis=(0, 3)).all()
