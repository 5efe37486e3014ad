"""The analytic simulator on scenes: maps, frames, files, errors; agreement with Monte Carlo."""

import dataclasses
import math

import numpy as np
import pytest
from scipy import stats

import spadwarp
from helpers.scenes import scene
from reference import crlb
from spadwarp.analytic import simulate_analytic
from spadwarp.result.result import Truth
from spadwarp.scene.camera import pixel_directions
from spadwarp.values import ArgumentError, ConfigError

MAPS = (
    *("signal", "arrival", "backscatter", "alpha", "fisher", "sigma_time", "sigma_depth"),
    *("signal_to_backscatter", "outlier_probability", "background_probability"),
)
GATE = {"start_ns": 5.0, "bin_width_ps": 100.0, "bins": 200}


def lidar_scene(**sections):
    """16 x 12 pixels on a tilted plate at 2.2 m that leaves the view's right edge empty; a GPU is not needed."""
    target = {"builtin": "plane", "size": [1.6, 3.0], "translation": [-0.3, 0.0, 2.2], "rotation_deg": [10, 25, 0]}
    return scene(
        **{
            "medium": {"extinction": 0.2, "albedo": 0.3},
            "laser": {"half_angle_deg": 35.0, "position": [-0.2, 0.05, 0.0]},
            "camera": {"width": 16, "height": 12, "horizontal_fov_deg": 50.0, "aperture_diameter": 0.02},
            "detector": {"pdp": 0.2, "fill_factor": 0.1, "jitter_fwhm_ps": 150.0},
            "gate": GATE,
            "targets": [{**target, "reflectance": 0.6}],
            **sections,
        }
    )


MONTE_CARLO = lidar_scene(analytic={"backscatter": "monte_carlo"})


def flat_truth(one, depth=2.2, reflectance=0.5):
    shape = (one.camera.height, one.camera.width)
    z = np.broadcast_to(np.float32(depth), shape)
    return Truth(
        depth=z,
        range=(z / pixel_directions(one.camera)[..., 2]).astype(np.float32),
        normal=np.tile(np.array([0, 0, -1], np.float32), (*shape, 1)),
        reflectance=np.full(shape, reflectance, np.float32),
    )


def test_maps_and_frames_fit_together():
    one = lidar_scene()
    result = simulate_analytic(one, frames=200, seed=3)
    hit = ~np.isnan(result.truth.depth)
    assert 0.3 < hit.mean() < 1
    assert all(getattr(result, name).shape == (12, 16) for name in MAPS)
    seen = result.fisher > 0
    assert (seen == (result.signal > 0)).all() and seen.sum() == hit.sum()
    assert np.isnan(result.sigma_time[~seen]).all() and np.isfinite(result.sigma_time[seen]).all()
    # 200 frames of the depth that was asked for, with the deviation of the bound; NaN where there is no estimate.
    assert result.depth.dtype == np.float32 and result.depth.shape == result.labels.shape == (200, 12, 16)
    assert np.isnan(result.depth[:, ~seen]).all() and np.isfinite(result.depth[:, seen]).all()
    z = (result.depth - result.truth.depth)[:, seen] / result.sigma_depth[seen]
    assert abs(z.mean()) < 4 / math.sqrt(z.size) and z.std() == pytest.approx(1, abs=4 / math.sqrt(2 * z.size))
    # Path of the return: laser to point to lens.
    points = result.truth.range[..., None] * pixel_directions(one.camera)
    path = np.linalg.norm(points, axis=-1) + np.linalg.norm(points - one.laser.position, axis=-1)
    np.testing.assert_allclose(result.arrival[hit], path[hit] * one.medium.group_index / 299_792_458.0, rtol=1e-6)
    # Moving a point by dz along its line of sight moves its arrival by dz·σ_t/σ_z.
    near, far = (simulate_analytic(one, truth=flat_truth(one, depth=z), frames=0) for z in (2.2, 2.201))
    slope = (far.arrival - near.arrival) / 0.001
    np.testing.assert_allclose(slope, near.sigma_time / near.sigma_depth, rtol=2e-3)


def test_frames_of_a_seed_do_not_depend_on_how_they_are_drawn():
    one = lidar_scene(analytic={"backscatter_fraction": 0.2})
    result = simulate_analytic(one, frames=9, seed=2**63 + 1)
    for first, count in [(0, 4), (3, 3), (8, 1)]:
        depth, labels = result.sample(count, first=first)
        np.testing.assert_array_equal(depth, result.depth[first : first + count])
        np.testing.assert_array_equal(labels, result.labels[first : first + count])
    assert not np.array_equal(result.sample(9, seed=5)[0], result.depth, equal_nan=True)


@pytest.mark.parametrize("backscatter", ["constant", "single_scatter", "monte_carlo"])
def test_the_given_part_of_the_pixels_reports_backscatter(backscatter):
    """The paper's BS, with depths between the gate's ends, and never behind the target for single scattering."""
    one = lidar_scene(analytic={"backscatter": backscatter, "backscatter_fraction": 0.3})
    profile = np.where(np.arange(200) < 60, 1e-4, 0.0) if backscatter == "monte_carlo" else None
    result = simulate_analytic(one, frames=400, seed=1, backscatter_profile=profile)
    seen = result.fisher > 0
    labels = result.labels[:, seen]
    assert abs(labels.mean() - 0.3) < 4 * math.sqrt(0.21 / labels.size)
    assert not result.labels[:, ~seen].any()
    reported = result.depth[result.labels]
    assert (reported >= 0).all() and (reported < 0.5 * 299_792_458.0 * 25.1e-9).all()
    beyond = (result.depth > result.truth.depth + 0.1) & result.labels
    if backscatter == "single_scatter":
        assert not beyond.any()
    if backscatter == "constant":
        assert beyond.sum() > 0.2 * result.labels.sum()
    if backscatter == "monte_carlo":  # bins 0 to 59: paths of up to 11 ns
        assert reported.max() < 0.5 * 299_792_458.0 * 11.01e-9 * 1.05


def test_without_a_given_part_background_is_reported_as_often_as_false_peaks_are_expected():
    """A faint return in dark counts that are flat over the gate."""
    one = lidar_scene(
        analytic={"backscatter": "constant", "pulses_per_depth_frame": 1_000_000},
        laser={"pulse_energy": 2e-17, "half_angle_deg": 35.0},
        detector={"pdp": 0.2, "fill_factor": 0.1, "dark_count_rate": 4000.0},
    )
    result = simulate_analytic(one, truth=flat_truth(one), frames=500, seed=2)
    p = result.outlier_probability
    assert p.min() > 0.02 and p.max() < 0.98 and p.max() > 0.3
    assert abs((result.labels.mean(axis=0) - p).mean()) < 4 * math.sqrt(0.25 / result.labels.size)
    reported = [result.depth[:, row, column][result.labels[:, row, column]].mean() for row, column in [(5, 7), (6, 8)]]
    assert np.allclose(reported, 0.5 * 299_792_458.0 * 15e-9, atol=0.3)  # the middle of the gate
    assert stats.binomtest(int(result.labels[:, 5, 7].sum()), 500, p[5, 7]).pvalue > 1e-3


def test_no_backscatter_is_an_infinite_ratio_and_no_outliers():
    one = lidar_scene(analytic={"backscatter": "constant"}, detector={"dark_count_rate": 0.0})
    result = simulate_analytic(one, frames=3)
    ratio, seen = result.signal_to_backscatter, result.fisher > 0
    assert np.isinf(ratio[seen]).all() and np.isnan(ratio[~seen]).all()
    assert (result.outlier_probability[seen] == 0).all() and not result.labels.any()


def test_a_return_outside_the_gate_is_no_estimate_and_a_gate_without_any_is_an_error():
    one = lidar_scene(gate={"start_ns": 0.0, "bin_width_ps": 100.0, "bins": 250})
    truth = flat_truth(one, depth=np.where(np.arange(16) < 8, 2.2, 9.0))
    result = simulate_analytic(one, truth=truth, frames=1)
    assert np.isfinite(result.sigma_time[:, :8]).all() and np.isnan(result.sigma_time[:, 8:]).all()
    assert np.isnan(result.depth[0, :, 8:]).all() and (result.fisher[:, 8:] == 0).all()
    with pytest.raises(ConfigError, match=r"gate \[0, 0.1\) ns holds no return; the target's arrive from 1\d.* ns"):
        simulate_analytic(lidar_scene(gate={"start_ns": 0.0, "bin_width_ps": 100.0, "bins": 1}), frames=0)


def wrong(field, change, **pixel):
    """A simulation with a truth that is changed, in one pixel or everywhere."""
    values = getattr(flat_truth(lidar_scene()), field).copy()
    values[pixel.get("at", ...)] = change
    truth = dataclasses.replace(flat_truth(lidar_scene()), **{field: values})
    return lambda: simulate_analytic(lidar_scene(), truth=truth, frames=0)


def profiled(profile):
    return lambda: simulate_analytic(MONTE_CARLO, frames=0, backscatter_profile=profile)


def uncovered(**sections):
    one = lidar_scene(**sections)
    return lambda: simulate_analytic(one, truth=flat_truth(one), frames=0)


BRIGHT = {"pulse_energy": 1e-3, "half_angle_deg": 35.0}
GAUSSIAN = {"profile": "gaussian", "half_angle_deg": 20.0}
REFUSED = {
    "truth.depth is NaN in every pixel": wrong("depth", np.nan),
    r"truth.depth = -1.0 at pixel \(2, 3\) is outside \(0, inf\) m": wrong("depth", -1.0, at=(2, 3)),
    r"truth.depth = inf at pixel \(2, 3\)": wrong("depth", np.inf, at=(2, 3)),
    r"truth.reflectance = 1.5 at pixel \(1, 1\) is outside \[0, 1\]": wrong("reflectance", 1.5, at=(1, 1)),
    r"truth.range = nan at pixel \(0, 4\)": wrong("range", np.nan, at=(0, 4)),
    "truth.normal is not finite": wrong("normal", np.nan),
    r"truth.depth has shape \(12, 16\); the camera's \(4, 4\) is needed": lambda: simulate_analytic(
        scene(), truth=flat_truth(lidar_scene()), frames=0
    ),
    "backscatter_profile is missing": profiled(None),
    r"shape \(7,\); \(200,\) or \(12, 16, 200\) is needed": profiled(np.zeros(7)),
    r"outside \[0, inf\)": profiled(np.full(200, -1e-9)),
    r"backscatter_profile holds nan": profiled(np.full(200, np.nan)),
    "'lu2024' needs": uncovered(analytic={"form": "lu2024"}, laser=GAUSSIAN),
    "needs a diverging laser.profile": uncovered(laser={"profile": "collimated", "beam_radius": 0.5}),
    "the analytic model needs 'gaussian'": uncovered(detector={"irf": "exponentially_modified_gaussian"}),
    "both 0": uncovered(detector={"jitter_fwhm_ps": 0.0}, laser={"pulse_fwhm_ps": 0.0}),
    "'per_frame_lu2024' needs alpha < 1; it reaches": uncovered(
        analytic={"count_law": "per_frame_lu2024"}, laser=BRIGHT
    ),
}


@pytest.mark.parametrize("match", REFUSED)
def test_what_is_refused_is_named(match):
    with pytest.raises((ArgumentError, ConfigError), match=match):
        REFUSED[match]()


def test_the_form_of_lu2024_is_equation_7_in_every_pixel():
    one = lidar_scene(
        analytic={"form": "lu2024", "backscatter": "constant"},
        laser={"half_angle_deg": 20.0, "position": [0.0, 0.0, 0.0]},
    )
    result = simulate_analytic(one, truth=flat_truth(one, depth=3.0, reflectance=0.3), frames=0)
    f = 0.03  # cancels
    lens = f * one.camera.pixel_tangent, f / 0.02, math.tan(math.radians(20.0))
    for place in [(0, 0), (6, 8)]:
        laser = one.laser.pulse_energy, 532e-9, one.detector.pde
        expected = crlb.eq7(*laser, np.float32(0.3), 0.2, result.truth.range[place], *lens)
        assert result.signal[place] == pytest.approx(expected, rel=1e-6)  # the truth is float32


def test_a_file_holds_maps_frames_and_scene(tmp_path):
    one = lidar_scene(analytic={"backscatter_fraction": 0.1})
    result = simulate_analytic(one, frames=4, seed=2**64 - 1)
    held = spadwarp.load(result.save(tmp_path / "deep" / "analytic.h5"))
    assert [path.name for path in (tmp_path / "deep").iterdir()] == ["analytic.h5"]
    for name in MAPS:
        np.testing.assert_array_equal(held.maps[name], getattr(result, name))
    assert np.array_equal(held.depth(), result.depth, equal_nan=True) and np.array_equal(held.labels(), result.labels)
    assert held.seed == 2**64 - 1 and held.scene == one


@pytest.mark.slow
def test_agrees_with_monte_carlo_on_the_ballistic_return_and_on_single_backscatter():
    """A tilted plate filling the field, its corners included: 1 % on the return; thin water: 2 % on the backscatter.

    One collision or surface a photon, so that the Monte Carlo holds what the model claims to hold and nothing else.
    """
    one = scene(
        medium={"extinction": 0.15, "albedo": 0.4, "anisotropy": 0.9},
        laser={"half_angle_deg": 34.0, "position": [-0.3, 0.1, 0.0]},
        camera={"width": 12, "height": 8, "horizontal_fov_deg": 50.0, "aperture_diameter": 0.02},
        gate={"start_ns": 0.0, "bin_width_ps": 200.0, "bins": 400},
        targets=[{"builtin": "plane", "size": [14, 14], "translation": [0, 0, 4], "rotation_deg": [10, 35, 0]}],
        transport={"estimator": "next_event", "max_collisions": 1},
    )
    monte_carlo = spadwarp.simulate(one, photons=3_000_000, seed=2)
    result = simulate_analytic(one, frames=0)
    scale = one.laser.photons_per_pulse * one.detector.pde
    ballistic = monte_carlo.component("ballistic").sum(axis=-1) * scale
    for block in (np.s_[:, :], np.s_[:4, :6], np.s_[:4, 6:], np.s_[4:, :6], np.s_[4:, 6:]):
        assert ballistic[block].sum() == pytest.approx(result.signal[block].sum(), rel=0.01)
    corners = np.ix_([0, -1], [0, -1])  # 1.2 % of standard error each
    np.testing.assert_allclose(ballistic[corners], result.signal[corners], rtol=0.05)
    backscatter = monte_carlo.component("backscatter").sum(axis=-1) * scale
    assert backscatter.sum() == pytest.approx(result.backscatter.sum(), rel=0.02)
