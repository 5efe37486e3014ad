"""Daylight seen by the pixels."""

import math
from dataclasses import replace

import numpy as np
import pytest

import spadwarp
from reference.single_scatter import henyey_greenstein
from reference.walk import scatter
from spadwarp.scene import daylight_radiance, daylight_rate, downwelling_irradiance, noise_rate, phase_function
from spadwarp.values import PLANCK, SPEED_OF_LIGHT, ConfigError

pytestmark = pytest.mark.physics

SUN = {"sun_elevation_deg": 60.0, "depth": 5.0}
LEVEL, DOWN, UP = [0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [0.0, -1.0, 0.0]


def lit(daylight=None, **fields):
    sections = {name.replace("__", "."): value for name, value in fields.items()}
    sections.setdefault("camera.width", 8), sections.setdefault("camera.height", 6)
    return spadwarp.load_scene("staircase_5m", {"daylight": {**SUN, **(daylight or {})}, **sections})


def backward(scene):
    return phase_function(scene.medium).backscatter_fraction * scene.medium.scattering


@pytest.mark.parametrize("albedo", [0.3, 0.6, 0.8])
def test_upward_radiance_is_that_of_gordon(albedo):
    """L_u/E_d below the surface, 0.0949·u + 0.0794·u², u = b_b/(a + b_b) (Gordon et al. 1988), from Petzold's water."""
    law = {"phase_function": "tabulated", "phase_table": "petzold-average-particle"}
    water = {"extinction": 0.4, "albedo": albedo, "preset": None, **law}
    scene = lit({"depth": 0.0, "sun_elevation_deg": 80.0}, medium=water)
    u = backward(scene) / (scene.medium.absorption + backward(scene))
    ratio = daylight_radiance(scene, 532.0, [DOWN])[0] / downwelling_irradiance(scene, 532.0)
    assert ratio == pytest.approx(0.0949 * u + 0.0794 * u**2, rel=0.3)


def walk(albedo, g, cosine, depth, photons=60_000):
    """Σ w·ω·p(Θ) of a Monte Carlo walk about a depth for level directions ahead of the sun, aside and back, per
    downward photon: radiance times extinction. No surface, extinction 1."""
    random, thickness = np.random.default_rng(4), 0.4
    directions = np.tile([math.sqrt(1.0 - cosine**2), 0.0, cosine], (photons, 1))
    place, weight, total = np.zeros(photons), np.ones(photons), np.zeros(3)
    level = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]])
    while place.size:
        place = place - np.log(1.0 - random.random(place.size)) * directions[:, 2]
        inside = (place > 0.0) & (place < 15.0)
        place, directions, weight = place[inside], directions[inside], weight[inside] * albedo
        near = np.abs(place - depth) < 0.5 * thickness
        total += weight[near] @ henyey_greenstein(directions[near] @ level.T, g) / thickness
        faint = weight < 0.02
        stays = ~faint | (random.random(weight.size) <= 0.1)
        weight, place = np.where(faint, 10.0 * weight, weight)[stays], place[stays]
        directions = scatter(directions[stays], g, random)
    return total / photons


@pytest.mark.parametrize("albedo", [0.3, 0.6, 0.8])
def test_level_radiance_is_that_of_a_full_walk(albedo):
    """Within 45 % of radiative transfer with all orders of scattering, and up to 35 % too low in the mean."""
    sky = {"depth": 2.0, "sun_elevation_deg": 47.0, "sun_azimuth_deg": 0.0, "aerosol_optical_depth": 0.0}
    scene = lit(sky, medium={"extinction": 1.0, "albedo": albedo, "preset": None, "anisotropy": 0.924})
    direct = spadwarp.water.clear_sky_irradiance(532.0, sun_elevation_deg=47.0, aerosol_optical_depth=0.0)
    reflected = spadwarp.water.surface_reflectance(47.0, scene.medium.phase_index)
    cosine = scene.daylight.sun_direction(scene.medium.phase_index) @ [0.0, 1.0, 0.0]
    expected = walk(albedo, 0.924, cosine, 2.0) * direct.direct * (1.0 - reflected)
    # Light that goes towards -z (away from the sun ahead), aside, and towards +z.
    views = np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 0.0, -1.0]])
    field = spadwarp.scene.ambient_light._Field(scene, 532.0)
    field.by_sky, field.sky = np.zeros(121), 0.0
    ours = field.of_water(views, np.full(3, np.inf), 2.0)
    assert ours == pytest.approx(expected, rel=0.45)
    assert 0.65 < ours.mean() / expected.mean() < 1.0


def test_radiance_along_a_line_of_sight_builds_up():
    """Duntley: a black target at R shows L∞·(1 − exp(−κR)) of the level radiance; far away the water alone."""
    scene = lit()
    water = daylight_radiance(scene, 532.0, [LEVEL])[0]
    black = {"normal": [[0.0, 0.0, -1.0]], "reflectance": [0.0]}
    for distance in (0.5, 5.0, 500.0):
        seen = daylight_radiance(scene, 532.0, [LEVEL], distance=[distance], **black)
        assert seen[0] == pytest.approx(water * -math.expm1(-(scene.medium.absorption + backward(scene)) * distance))


def test_floor_below_and_sky_above_the_lens():
    """A white floor right below returns the irradiance from above over π. Straight up from just below the surface: n²
    times the radiance of an even sky, less what the surface reflects; no sky outside Snell's window."""
    scene = lit({"depth": 10.0})
    floor = daylight_radiance(scene, 532.0, [DOWN], distance=[1e-6], normal=[UP], reflectance=[1.0])
    assert floor[0] == pytest.approx(downwelling_irradiance(scene, 532.0) / math.pi, rel=0.01)
    scene = lit({"depth": 1e-6})
    sky = spadwarp.water.clear_sky_irradiance(532.0, sun_elevation_deg=60.0).diffuse / math.pi
    expected = scene.medium.phase_index**2 * (1.0 - 0.066) * sky
    assert daylight_radiance(scene, 532.0, [UP])[0] == pytest.approx(expected, rel=1e-4)
    outside = [0.0, -math.cos(math.radians(49.5)), math.sin(math.radians(49.5))]
    assert daylight_radiance(scene, 532.0, [outside])[0] < 1e-3 * expected


def test_irradiance_falls_as_k_d():
    scene = lit()
    shallow, deep = (downwelling_irradiance(scene, 532.0, depth) for depth in (2.0, 12.0))
    decay = spadwarp.water.daylight_attenuation(scene.medium.absorption, backward(scene), sun_elevation_deg=60.0)
    assert math.log(shallow / deep) == pytest.approx(10.0 * decay)


def test_world_may_be_turned():
    """Camera, surface and sun turned together see the same."""
    scene = lit({"sun_azimuth_deg": 30.0})
    pose = {"camera__rotation_deg": [0.0, -30.0, 0.0], "camera__position": [1, 2, 3]}
    turned = lit({"sun_azimuth_deg": 0.0, "up": [0.0, -1.0, 0.0]}, **pose)
    assert daylight_rate(turned) == pytest.approx(daylight_rate(scene), rel=1e-6)
    # Looking up and down differ by the light from above.
    assert (np.diff(daylight_rate(scene), axis=0) < 0.0).all()


def test_rate_of_a_pixel():
    """π/4·d²·Ω·∫L·T·λ/(hc)·PDE by hand, for a filter that is narrow."""
    scene = lit(detector__filter_fwhm_nm=1.0, detector__filter_peak=0.5, detector__filter_centre_nm=540.0)
    axis = np.array([[0.0, 0.0, 1.0]])
    radiance = daylight_radiance(scene, 540.0, axis)[0]
    photons = 540e-9 / (PLANCK * SPEED_OF_LIGHT)
    band = 0.5 * 1.0 * math.sqrt(math.pi / (4.0 * math.log(2.0)))  # area of a Gaussian [nm]
    camera = scene.camera
    etendue = math.pi * camera.aperture_radius**2 * camera.pixel_tangent**2
    expected = radiance * photons * band * etendue * scene.detector.pde
    assert daylight_rate(scene, view=axis)[0] == pytest.approx(expected, rel=1e-3)


@pytest.fixture(scope="module")
def seen():
    """A result 5 m below the surface, and the same at night."""
    scene = lit(detector__filter_fwhm_nm=3.0)
    result = spadwarp.simulate(scene, photons=40_000, seed=1, device="cpu")
    return result, replace(result, scene=result.scene.with_overrides({"daylight.cloud_factor": 0.0}))


def test_detect_and_the_analytic_simulator_count_the_same(seen):
    scene, truth = seen[0].scene, seen[0].truth
    rate = daylight_rate(scene, distance=truth.range, normal=truth.normal, reflectance=truth.reflectance)
    light, dark = (spadwarp.detect(one, pulses=1, seed=0, device="cpu").expected for one in seen)
    assert (light - dark).mean(axis=-1) == pytest.approx(rate * scene.gate.bin_width, rel=2e-3)
    maps, without = (spadwarp.simulate_analytic(one.scene, device="cpu") for one in seen)
    assert maps.daylight == pytest.approx(rate, rel=1e-5)
    assert maps.alpha - without.alpha == pytest.approx(rate * (scene.gate.stop - scene.gate.start), rel=1e-5)
    informed = maps.fisher > 0
    assert (maps.sigma_time[informed] > without.sigma_time[informed]).all()
    assert np.ndim(noise_rate(spadwarp.load_scene("staircase_5m"))) == 0


def test_bound_and_noise_of_a_simulation_know_daylight(seen):
    bound, without = (spadwarp.crlb(one, device="cpu") for one in seen)
    informed = np.isfinite(without)
    assert (bound[informed] > without[informed]).all()
    # Shot noise of daylight hides that of the simulation.
    assert seen[0].target_noise_ratio < seen[1].target_noise_ratio


def test_ambient_of_the_caller():
    gate = {"gate_start": 0.0, "bin_width": 1e-10, "laser": spadwarp.scene.Laser(), "pulses": 1, "seed": 0}
    cube, light = np.zeros((2, 3, 8), np.float32), np.arange(6.0).reshape(2, 3) * 1e6
    detector = spadwarp.scene.Detector(dark_count_rate=0.0)
    frames = spadwarp.detect(cube, ambient=light, device="cpu", detector=detector, **gate)
    assert frames.expected.mean(axis=-1) == pytest.approx(light * 1e-10)
    with pytest.raises(spadwarp.values.ArgumentError, match=r"ambient has shape \(2,\)"):
        spadwarp.detect(cube, ambient=[1.0, 2.0], **gate)


def test_refused():
    with pytest.raises(ConfigError, match="no such section"):
        daylight_radiance(spadwarp.load_scene("plane_5m"), 532.0, [LEVEL])
    with pytest.raises(ConfigError, match="the filter passes nothing from 400 to 700 nm"):
        daylight_rate(lit(laser__wavelength_nm=900.0, detector__filter_fwhm_nm=10.0))


def test_checks_and_round_trip():
    scene = lit()
    assert spadwarp.scene.Scene.from_toml(scene.to_toml()) == scene
    text = next(str(message) for message in spadwarp.check(scene) if message.field == "daylight")
    assert "photons of daylight per second" in text and "no filter" in text
    deep = spadwarp.check(lit({"depth": 200.0}, detector__filter_fwhm_nm=1.0))
    assert next(message for message in deep if message.field == "daylight").level == "note"
