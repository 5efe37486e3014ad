"""The table `surface`: where camera and laser may be, what it excludes, and what is seen through the mean plane."""

import math

import numpy as np
import pytest
from scipy.optimize import brentq

import spadwarp
from helpers.scenes import scene
from spadwarp.scene.camera import pixel_directions
from spadwarp.scene.scene import mean_plane
from spadwarp.scene.sea import jonswap, peak_length
from spadwarp.scene.sight import depth_from_time, lines_of_sight
from spadwarp.transport import wave_errors
from spadwarp.values import ConfigError, FileError
from spadwarp_kernels.optics.sea import facet_covariance, unresolved_covariance

BAY = {"surface": {"point": [0.0, 0.0, 3.0], "up": [0.0, 0.0, -1.0], "wind": 5.0}}
BOTTOM = {"builtin": "plane", "size": [40.0, 40.0], "translation": [0.0, 0.0, 8.0], "reflectance": 0.4}


@pytest.mark.parametrize(
    ("sections", "text"),
    [
        ({"surface": {"wind": 5.0, "mean_square_slope": 0.01}}, "needs either wind or mean_square_slope"),
        ({**BAY, "transport": {"axis_threshold": 0.99}}, "axis_threshold = 0.99 does not go with surface"),
        ({**BAY, "camera": {"port": {"distance": 0.1}}}, "camera.port, a table: cannot be combined with surface"),
        ({**BAY, "scan": {"mode": "confocal"}}, "scan.mode = 'confocal': cannot be combined with surface"),
        ({**BAY, "medium": {"grid": {"shape": "plume", "extinction": 1.0, "size": 1.0}}}, "medium.grid, a table"),
        ({"surface": {"point": [0.0, 0.0, 3.0], "up": [0.0, 0.0, 1.0], "preset": "calm"}}, "outside_index"),
        ({"surface": {**BAY["surface"], "direction": [0.0, 0.0, 1.0]}}, "wind and waves go along the sea"),
        ({"surface": {**BAY["surface"], "waves": {"size": 5.0}}}, "5.0 m holds no wave of the peak, 8.23 m long"),
        ({"surface": {**BAY["surface"], "waves": {"shortest": 0.01}}}, "shortest = 0.01 m is less than two nodes"),
        (
            {"surface": {**BAY["surface"], "waves": {"heights": "a.npy", "seed": 2}}},
            "seed = 2 goes with a spectrum, in",
        ),
        ({"surface": {**BAY["surface"], "wind": None, "mean_square_slope": 0.02, "waves": {}}}, "spectrum needs wind"),
    ],
)
def test_what_cannot_be(sections, text):
    with pytest.raises(ConfigError, match=text.replace(".", r"\.")):
        scene(**sections)


def test_slopes_by_wind_and_direction():
    assert sum(scene(**BAY).surface.slope_variances) == pytest.approx(0.0286)
    turned = scene(surface={**BAY["surface"], "direction": [1.0, 0.0, 0.0]}).surface
    assert turned.slope_variances == pytest.approx((0.0158, 0.0126))
    rough = scene(surface={"preset": "rough", "point": [0.0, 0.0, 3.0], "up": [0.0, 0.0, -1.0]}).surface
    assert sum(rough.slope_variances) == pytest.approx(0.003 + 5.12e-3 * 12)
    assert scene(surface={**BAY["surface"], "wind": None, "preset": "calm"}).surface.is_flat


def test_depth_and_range_go_by_the_mean_plane():
    """Times of flight of the truth are those of light refracted by the plane, and give its depth back."""
    tables = {**BAY, "targets": [BOTTOM], "medium": {"group_index": 1.3638, "phase_index": 1.34}}
    one = scene(**tables, laser={"position": [-0.5, 0.0, 0.5]}, gate={"bins": 40})
    truth = spadwarp.truth_maps(one, device="cpu")
    np.testing.assert_allclose(truth.depth, 8.0, rtol=1e-6)
    # The outermost column: 18.75° aside in the air, by Snell's law 13.9° in the water.
    tangent = 0.75 * math.tan(math.radians(25.0))
    aside = math.hypot(tangent, 0.25 * math.tan(math.radians(25.0)))
    sine = math.sin(math.atan(aside)) * mean_plane(one).index[0] / 1.34
    bent = 3.0 * math.hypot(1.0, aside) + 5.0 / math.sqrt(1.0 - sine**2)
    assert truth.range[1, 0] == pytest.approx(bent, rel=1e-5)
    lines = spadwarp.scene.sight.lines_of_sight(one)
    path = lines.path_from_range(truth.range.astype(np.float64))
    time = path * one.medium.group_index / 299_792_458.0
    np.testing.assert_allclose(depth_from_time(time, scene=one), 8.0, rtol=1e-5)


def test_truth_has_targets_on_both_sides():
    near = {"builtin": "plane", "size": [1.0, 8.0], "translation": [-1.0, 0.0, 2.0], "reflectance": 0.2}
    one = scene(**BAY, targets=[near, BOTTOM])
    truth = spadwarp.truth_maps(one, device="cpu")
    np.testing.assert_allclose(truth.depth[:, 0], 2.0, rtol=1e-5)
    np.testing.assert_allclose(truth.depth[:, 2:], 8.0, rtol=1e-5)
    np.testing.assert_allclose(truth.reflectance[1, [0, 3]], [0.2, 0.4])
    # From below: the plate in the air, seen by refraction; beyond the critical angle nothing.
    below = scene(
        surface={"point": [0.0, 0.0, 1.0], "up": [0.0, 0.0, 1.0], "wind": 5.0},
        camera={"horizontal_fov_deg": 140.0},
        targets=[{**BOTTOM, "translation": [0.0, 0.0, 2.0]}],
    )
    depth = spadwarp.truth_maps(below, device="cpu").depth
    assert np.isnan(depth[0, 0])
    np.testing.assert_allclose(depth[1, 1], 2.0, rtol=1e-5)


def test_the_analytic_model_is_of_an_airborne_lidar():
    for changes, text in (
        ({"surface": {**BAY["surface"], "up": [0.0, 0.0, 1.0]}}, "camera and laser in the air"),
        ({"laser": {"profile": "collimated", "beam_radius": 0.1}}, "and a diverging laser.profile"),
        ({"targets": [{**BOTTOM, "translation": [0.0, 0.0, 2.0]}]}, "a target is seen before the"),
    ):
        with pytest.raises(ConfigError, match=text):
            spadwarp.simulate_analytic(scene(**{**BAY, "targets": [BOTTOM], **changes}), device="cpu")


def test_check_counts_the_way_in_the_water_alone():
    one = scene(**BAY, targets=[BOTTOM], medium={"phase_index": 1.34}, transport={"photons": 100_000})
    messages = spadwarp.check(one)
    assert not [m for m in messages if m.field == "laser.position"]
    depth = next(m for m in messages if "optical depth" in m.text)
    assert "optical depth to the nearest illuminated point 2.5" in depth.text  # 5 m at 0.5 1/m


@pytest.mark.parametrize("scan", [{}, {"mode": "trajectory", "pattern": "conical", "half_angle_deg": 9.0}])
def test_times_before_the_surface_are_depths_in_the_air(scan):
    """Of lens and laser in the air: there light goes straight on, and its times join those of light that enters."""
    one = scene(
        **BAY, laser={"position": [-0.5, 0.0, 0.5]}, medium={"group_index": 1.3638, "phase_index": 1.34}, scan=scan
    )
    lines = lines_of_sight(one)
    for beyond in (-2.0, -1e-3, 0.0, 1e-3, 4.0):
        distance = lines.lead + beyond
        path = lines.path_from_range(distance)
        np.testing.assert_allclose(lines.range_from_path(path), distance, rtol=1e-9)
        np.testing.assert_allclose(lines.range_from_depth(lines.depth_from_range(distance)), distance, rtol=1e-12)
        if beyond <= 0.0:
            view = lines.start / lines.lead[..., None]
            np.testing.assert_allclose(lines.points(distance), distance[..., None] * view, rtol=1e-12)
            way = distance + np.linalg.norm(distance[..., None] * view - lines.laser, axis=-1)
            air = one.surface.air(one.laser.wavelength_nm)[1] / 1.3638
            np.testing.assert_allclose(path, way * air, rtol=1e-12)


def waves_of(**waves):
    return scene(surface={**BAY["surface"], "direction": [1.0, 0.0, 0.0], "waves": waves}).surface


def test_waves_of_a_spectrum():
    """Variances of heights and slopes are integrals of JONSWAP's spectrum; the mean over seeds, with its error."""
    wind, fetch, longest, shortest = 5.0, 10e3, 40.0, 0.625
    frequency = np.sqrt(9.81 * 2.0 * math.pi * np.array([1.0 / longest, 1.0 / shortest]))
    w = np.linspace(*frequency, 20_001)
    density = jonswap(w, wind, fetch)
    expected = [np.trapezoid(density, w), np.trapezoid(density * w**4 / 9.81**2, w)]
    found = []
    for seed in range(12):
        heights = waves_of(size=longest, cells=256, shortest=shortest, seed=seed).wave_field.heights
        assert abs(heights.mean()) < 1e-12
        k = 2.0 * math.pi * np.fft.fftfreq(256, longest / 256)
        power = np.abs(np.fft.fft2(heights) / 256**2) ** 2
        found.append([power.sum(), (power * (k**2 + k[:, None] ** 2)).sum()])
    mean, error = np.mean(found, axis=0), np.std(found, axis=0, ddof=1) / math.sqrt(12)
    assert (error < 0.1 * mean).all()
    np.testing.assert_array_less(np.abs(mean - expected), 4.0 * error)
    # Up to 100 1/m, all slopes of Cox and Munk.
    w = np.linspace(0.5, math.sqrt(981.0), 20_001)
    assert np.trapezoid(jonswap(w, wind, fetch) * w**4 / 9.81**2, w) == pytest.approx(0.0289, abs=5e-5)
    assert peak_length(wind, fetch) == pytest.approx(8.23, abs=0.01)


def test_waves_go_with_the_wind():
    """Each wave as fast as it is long, ω² = g k; almost all along the wind where they do not spread."""
    one = {"size": 40.0, "cells": 128, "spreading": 200.0, "seed": 5}
    heights = [waves_of(**one, time=time).wave_field.heights for time in (0.0, 0.05)]
    transform = [np.fft.fft2(h)[0] for h in heights]
    k = np.arange(4, 9)
    # A wave cos(k x - ω t) has the phase -ω t where fft's frequency is k.
    phase = np.angle(transform[1][k] / transform[0][k])
    np.testing.assert_allclose(phase, -0.05 * np.sqrt(9.81 * 2.0 * math.pi * k / 40.0), rtol=1e-6)
    along = facet_covariance(heights[0], (40.0, 40.0))
    assert along[0, 0] > 20.0 * along[1, 1]


def test_facets_keep_a_quarter_of_the_slopes():
    surface = waves_of(cells=256)
    field = surface.wave_field
    rest = unresolved_covariance(surface.slope_variances, (1.0, 0.0), field.heights, field.size)
    assert 0.2 < rest[0, 0] / surface.slope_variances[0] < 0.3


def height_above_waves(surface, point):
    """Of a point of the world, and the slopes of the field below it along its rows and from row to row."""
    field, p = surface.wave_field, point - np.array(surface.point)
    count, normal = len(field.heights), np.array(surface.normal)
    axes = [np.array(surface.wave_axis), np.cross(normal, surface.wave_axis)]
    cell = field.size[0] / count
    (i, a), (j, b) = (divmod(p @ axis / cell, 1.0) for axis in axes)
    h = [[field.heights[int(j + r) % count, int(i + c) % count] for c in (0, 1)] for r in (0, 1)]
    height = (1 - b) * ((1 - a) * h[0][0] + a * h[0][1]) + b * ((1 - a) * h[1][0] + a * h[1][1])
    along = ((1 - b) * (h[0][1] - h[0][0]) + b * (h[1][1] - h[1][0])) / cell
    across = ((1 - a) * (h[1][0] - h[0][0]) + a * (h[1][1] - h[0][1])) / cell
    m = normal - along * axes[0] - across * axes[1]
    return p @ normal - height, m / np.linalg.norm(m)


@pytest.mark.parametrize("up", [-1.0, 1.0])
def test_truth_goes_through_the_waves(up):
    """By Snell's law at the facet that a pixel's ray meets, in NumPy; from the air and back into it."""
    surface = {"point": [0.0, 0.0, 3.0], "up": [0.0, 0.0, up], "wind": 5.0, "waves": {"cells": 128}}
    one = scene(surface=surface, targets=[BOTTOM], medium={"phase_index": 1.34})
    truth = spadwarp.truth_maps(one, device="cpu")
    before, behind = mean_plane(one, from_below=up > 0.0).index[::2]
    for pixel in np.ndindex(truth.depth.shape):
        u = pixel_directions(one.camera)[pixel]
        t = brentq(lambda t, u=u: height_above_waves(one.surface, t * u)[0], 2.0, 4.5)
        m = height_above_waves(one.surface, t * u)[1]
        across = (before / behind) * (u - (u @ m) * m)
        v = across + math.copysign(math.sqrt(1.0 - across @ across), u @ m) * m
        assert truth.range[pixel] == pytest.approx(t + (8.0 - t * u[2]) / v[2], rel=2e-5)
        assert truth.depth[pixel] == pytest.approx(8.0, rel=1e-5)


def test_depths_by_the_mean_plane_are_wrong_by_the_waves(tmp_path):
    """Straight above a crest of height h, where nothing is bent, light takes h/n_a more of water: h (1 - n_a/n_w)."""
    heights = 0.1 * np.cos(2.0 * math.pi * np.arange(64) / 64.0) * np.ones((64, 1))
    np.save(tmp_path / "swell.npy", heights)
    waves = {"heights": str(tmp_path / "swell.npy"), "size": 16.0, "direction": [1.0, 0.0, 0.0]}
    one = scene(
        surface={"point": [0.0, 0.0, 3.0], "up": [0.0, 0.0, -1.0], "mean_square_slope": 0.02, "waves": waves},
        targets=[BOTTOM],
        medium={"phase_index": 1.34, "group_index": 1.3638},
        camera={"width": 1, "height": 1, "horizontal_fov_deg": 0.1},
    )
    expected = 0.1 * (1.0 - one.surface.air(532.0)[1] / 1.3638)
    assert wave_errors(one, device="cpu")[0, 0] == pytest.approx(expected, rel=2e-3)
    assert wave_errors(one, [[8.0 + expected]], device="cpu")[0, 0] == pytest.approx(expected, rel=2e-3)
    with pytest.raises(ConfigError, match=r"surface\.waves, and a camera in the air"):
        wave_errors(scene(**BAY, targets=[BOTTOM]), device="cpu")


def test_a_file_of_heights_is_opened_by_check(tmp_path):
    """One that is missing or damaged is no valid scene; one that changed is read anew."""
    path = tmp_path / "swell.npy"
    waves = {"waves": {"heights": str(path), "size": 8.0}}
    one = scene(**{**BAY, "surface": {**BAY["surface"], **waves}}, targets=[BOTTOM])
    with pytest.raises(FileError, match=r"surface\.waves\.heights = .*swell\.npy: "):
        spadwarp.check(one)
    np.save(path, np.tile([0.0, 0.1, 0.0, -0.1], (4, 1)))
    spadwarp.check(one)
    assert one.surface.wave_field.amplitude == 0.1
    np.save(path, np.zeros((4, 8)))
    assert one.surface.wave_field.amplitude == 0.0
    path.write_bytes(b"\x93NUMPY")
    with pytest.raises(FileError, match="damaged or not readable"):
        spadwarp.check(one)
