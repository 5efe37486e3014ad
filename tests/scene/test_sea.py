"""The table `surface`: where camera and laser may be, what it excludes, and what is seen through the mean plane."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene
from spadwarp.scene.scene import mean_plane
from spadwarp.scene.sight import depth_from_time
from spadwarp.values import ConfigError

BAY = {"surface": {"point": [0.0, 0.0, 3.0], "up": [0.0, 0.0, -1.0], "wind": 5.0}}
BOTTOM = {"builtin": "plane", "size": [40.0, 40.0], "translation": [0.0, 0.0, 8.0], "reflectance": 0.4}


@pytest.mark.parametrize(
    ("sections", "text"),
    [
        ({"surface": {"wind": 5.0, "mean_square_slope": 0.01}}, "needs either wind or mean_square_slope"),
        ({"surface": {"point": [0.0, 0.0, 0.0], "wind": 5.0}}, "camera.position: 0 m above the surface"),
        ({**BAY, "transport": {"axis_threshold": 0.99}}, "axis_threshold = 0.99 does not go with surface"),
        ({**BAY, "camera": {"port": {"distance": 0.1}}}, "camera.port, a table: cannot be combined with surface"),
        ({**BAY, "scan": {"mode": "confocal"}}, "scan.mode = 'confocal': cannot be combined with surface"),
        ({**BAY, "medium": {"scattering_matrix": "rayleigh"}}, "cannot be combined with polarised light"),
        ({**BAY, "medium": {"grid": {"shape": "plume", "extinction": 1.0, "size": 1.0}}}, "medium.grid, a table"),
        ({"surface": {"point": [0.0, 0.0, 3.0], "up": [0.0, 0.0, 1.0], "preset": "calm"}}, "outside_index"),
        ({"surface": {**BAY["surface"], "direction": [0.0, 0.0, 1.0]}}, "a wind blows along the sea"),
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


def test_models_that_know_no_waves_refuse():
    one = scene(**BAY, targets=[BOTTOM])
    with pytest.raises(ConfigError, match="knows no surface of the sea"):
        spadwarp.simulate_analytic(one, device="cpu")
    with pytest.raises(ConfigError, match=r"plan knows neither \[surface\]"):
        spadwarp.plan(one, device="cpu")
    with pytest.raises(ConfigError, match="cannot be combined with surface"):
        spadwarp.simulate(one, photons=1000, derivatives=["medium.absorption"], device="cpu")


def test_check_counts_the_way_in_the_water_alone():
    one = scene(**BAY, targets=[BOTTOM], medium={"phase_index": 1.34}, transport={"photons": 100_000})
    messages = spadwarp.check(one)
    assert not [m for m in messages if m.field == "laser.position"]
    depth = next(m for m in messages if "optical depth" in m.text)
    assert "optical depth to the nearest illuminated point 2.5" in depth.text  # 5 m at 0.5 1/m
