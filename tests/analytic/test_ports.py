"""The analytic family behind ports: held to Monte Carlo, to radiometry, and to the same scene in the water."""

import math

import numpy as np
import pytest
from scipy import stats

import spadwarp
from spadwarp.analytic import eye_limit, pixel_maps
from spadwarp.analytic.eye_safety import as_if_bare
from spadwarp.checks import summary
from spadwarp.files.loader import gate_of, stored_depth
from spadwarp.scene import Scene, daylight_rate
from spadwarp.scene.camera import pixel_directions
from spadwarp.scene.scene import camera_port
from spadwarp.scene.scene import laser_port as laser_port_of
from spadwarp.scene.sight import lines_of_sight
from spadwarp.values import ArgumentError, ConfigError

WATER = {"extinction": 0.3, "albedo": 0.8, "phase_index": "seawater", "group_index": "seawater"}
WINDOW = {"distance": 0.05, "thickness": 0.01, "material": "BK7"}
DOME = {"shape": "dome", "radius": 0.05, "thickness": 0.005, "material": "acrylic"}
# Indices of the water on both sides: no port at all, but for the water that it takes away.
SAME = {"inside_index": 1.3415, "inside_group_index": 1.3638}
PLATE = {"builtin": "plane", "size": [8, 8], "translation": [0, 0, 3.0], "rotation_deg": [0, 20, 0], "reflectance": 0.5}


def ported(port=None, laser_port=None, **sections):
    tables = {
        "medium": WATER,
        "laser": {"position": [0.03, 0.0, 0.0], "half_angle_deg": 25.0, "pulse_energy": 1e-8},
        "camera": {"width": 12, "height": 8, "horizontal_fov_deg": 40.0, "aperture_diameter": 2e-3},
        "gate": {"start_ns": 0.0, "bin_width_ps": 400.0, "bins": 120},
        "targets": [PLATE],
    }
    for name, fields in sections.items():
        tables[name] = fields if isinstance(fields, list) else {**tables.get(name, {}), **fields}
    for name, one in {"camera": port, "laser": laser_port}.items():
        tables[name] = tables[name] if one is None else {**tables[name], "port": one}
    return Scene.from_dict(tables)


def maps_of(one, frames=0, **options):
    return spadwarp.simulate_analytic(one, frames=frames, device="cpu", **options)


def detected(one, component, *, photons, seed):
    """Photons that a pulse of a traced scene brings, by pixel and bin."""
    traced = spadwarp.simulate(one, photons=photons, seed=seed, device="cpu")
    return traced.component(component) * one.laser.photons_per_pulse * one.detections_per_photon


def narrow(port, laser_port, angle, half_angle, **sections):
    """Two pixels by two of half a degree, about an angle in air, with the beam on what they see."""
    slope, focal = math.tan(math.radians(angle)), 1.0 / math.radians(0.5)
    pixels = {"width": 2, "height": 2, "fx": focal, "fy": focal, "cx": 0.5 - slope * focal, "cy": 0.5}
    fine = {"start_ns": 0.0, "bin_width_ps": 20.0, "bins": 2400}
    camera = {"aperture_diameter": 2e-3, "horizontal_fov_deg": None, **pixels}
    one = ported(port, laser_port, camera=camera, laser={"half_angle_deg": half_angle}, gate=fine, **sections)
    point = lines_of_sight(one, np.array([[slope, 0.0, 1.0]]) / math.hypot(slope, 1.0)).points(3.2)[0]
    origin, behind = np.array(one.laser.position), laser_port_of(one)
    aim = (point - origin) if behind is None else behind.connect(point, origin)[0]
    return one.with_overrides({"laser.direction": [float(x) for x in aim]})


CASES = {
    "flat": (WINDOW, "camera"),
    "tilted": (WINDOW | {"normal": [0.15, 0.0, 1.0]}, WINDOW | {"distance": 0.02}),
    "dome": (DOME | {"offset": [0.0, 0.002, -0.005]}, "camera"),
}


# Of light that nearly is not.
few_units = pytest.mark.filterwarnings("ignore:.*rounding to the histogram:RuntimeWarning")


@pytest.mark.slow
@few_units
@pytest.mark.physics
@pytest.mark.parametrize(("name", "angle"), [("flat", 0.0), ("flat", 25.0), ("tilted", 25.0), ("dome", 25.0)])
def test_return_and_its_time_are_those_of_unscattered_photons(name, angle):
    """Photons are refracted one by one: 250 000 of them, of which 60 000 or more are seen, say it to 0.4 %."""
    one = narrow(*CASES[name], angle, 1.2, medium=WATER | {"albedo": 1e-6})
    light, found = detected(one, "ballistic", photons=250_000, seed=1), maps_of(one)
    assert found.signal.sum() == pytest.approx(light.sum(), rel=0.016)
    time = light.sum(axis=(0, 1)) @ ((np.arange(2400) + 0.5) * 2e-11) / light.sum()
    mean = (found.signal * found.arrival).sum() / found.signal.sum()
    assert mean == pytest.approx(time, abs=8e-12)  # 1 mm; the pixels' own spread is 60 ps


@pytest.mark.slow
@pytest.mark.physics
@pytest.mark.parametrize("name", CASES)
def test_backscatter_is_that_of_photons_that_scatter_once(name):
    behind = {**PLATE, "translation": [0.0, 0.0, 60.0]}  # the gate: the kernel is that of the scenes with a target
    one = narrow(*CASES[name], 25.0, 8.0, targets=[behind], transport={"max_collisions": 1})
    one = one.with_overrides({"gate.start_ns": 4.0})
    photons = detected(one, "backscatter", photons=2_000_000, seed=2)
    nothing = {"distance": np.full(4, np.nan), "normal": np.zeros((4, 3)), "reflectance": np.zeros(4)}
    maps, table = pixel_maps(one, view=pixel_directions(one.camera).reshape(-1, 3), device="cpu", **nothing)
    assert maps["backscatter"].sum() == pytest.approx(photons.sum(), rel=0.02)
    # As much of it comes before the photons' median time as after it.
    paths = (4e-9 + np.arange(2401) * 2e-11) * one.medium.pulse_speed
    rows = zip(table.paths, table.cumulative, maps["backscatter"], strict=True)
    profile = sum(np.diff(np.interp(paths, x, share)) * total for x, share, total in rows)
    median = np.searchsorted(np.cumsum(photons.sum(axis=(0, 1))), 0.5 * photons.sum())
    assert profile[:median].sum() == pytest.approx(0.5 * profile.sum(), rel=0.04)


@pytest.mark.slow
@pytest.mark.parametrize("form", [{"distance": 1e-6}, {"shape": "dome", "radius": 2e-3}])
@pytest.mark.parametrize("laser", [None, "camera"])
def test_equal_indices_are_a_camera_in_the_water(form, laser):
    """To what the water takes that the port leaves out: 1 µm, and 2 mm."""
    optics = {"camera": {"aperture_diameter": 1e-4, "pinhole": True}, "laser": {"position": [1e-4, 0.0, 0.0]}}
    optics["gate"] = {"start_ns": 5.0}
    maps, expected = maps_of(ported(form | SAME, laser, **optics)), maps_of(ported(**optics))
    close = 3e-5 if "distance" in form else 4e-3
    for name in ("signal", "arrival", "backscatter", "sigma_depth", "fisher"):
        np.testing.assert_allclose(getattr(maps, name), getattr(expected, name), rtol=close, err_msg=name)


@pytest.mark.parametrize("port", [WINDOW, pytest.param(DOME, marks=pytest.mark.slow)], ids=["window", "dome"])
def test_a_port_of_both_takes_its_transmission_squared_and_a_dome_a_smaller_aperture(port):
    """Of a far face on the axis, with the laser in the lens (section 7 of the physics)."""
    at_lens = {"laser": {"position": [0.0, 0.0, 0.0]}, "medium": WATER | {"extinction": 1e-6}}
    bare, seen = (
        spadwarp.budget(ported(*ports, **at_lens), [100.0], device="cpu")[0].signal for ports in ((), (port, "camera"))
    )
    index = camera_port(ported(port)).index[1]
    through = 4 * 1.000277 * index / (1.000277 + index) ** 2 * 4 * index * 1.3415 / (index + 1.3415) ** 2
    smaller = 1.0 if port is WINDOW else 1.000277 / 1.3415
    assert seen / bare == pytest.approx((through * smaller) ** 2, rel=2e-3)


@pytest.mark.physics
def test_frames_report_background_evenly_over_the_gate_behind_a_port():
    """Depths of pixels that report dark counts, turned back into times along the bent rays."""
    dark = {"detector": {"dark_count_rate": 1e9}, "analytic": {"backscatter_fraction": 0.9, "backscatter": "constant"}}
    one = ported(WINDOW, WINDOW | {"distance": 0.02}, gate={"start_ns": 5.0}, **dark)
    found = maps_of(one, frames=60, seed=5)
    lines = lines_of_sight(one)
    path = lines.path_from_range(lines.range_from_depth(found.depth.astype(np.float64)))
    time = path[found.labels] / one.medium.pulse_speed
    assert found.labels.mean() == pytest.approx(0.9, abs=0.02)
    gate = (one.gate.start, one.gate.stop - one.gate.start)
    assert stats.kstest(time, stats.uniform(*gate).cdf).pvalue > 1e-3


@pytest.mark.slow
@pytest.mark.physics
def test_the_gate_of_a_plan_holds_the_return_of_a_simulation():
    laser = {"half_angle_deg": 12.0, "repetition_rate": 1e5, "pulse_energy": 1e-9}
    one = ported(WINDOW, "camera", laser=laser, camera={"aperture_diameter": 0.02, "horizontal_fov_deg": 20.0})
    found = spadwarp.plan(one, photons=60_000, device="cpu", largest_range=False)
    inside, everything = (
        spadwarp.simulate(each, photons=200_000, seed=9, device="cpu").component("ballistic").sum()
        for each in (found.scene, one)
    )
    assert inside == pytest.approx(everything, rel=1e-3)
    truth = spadwarp.truth_maps(one, device="cpu").range
    assert found.target_range == (float(truth.min()), float(truth.max()))
    low, high = found.gate_range
    assert low < truth.min() - 0.25 and truth.max() + 0.25 < high
    # Pulses that are apart by the unambiguous range meet: one by the axis, the next by a target so far away.
    line = lines_of_sight(ported(WINDOW, "camera", laser={"position": [0.0, 0.0, 0.0]}), np.array([[0.0, 0.0, 1.0]]))
    path = line.path_from_range(np.array([found.unambiguous_range]))[0]
    assert path / one.medium.pulse_speed == pytest.approx(1.0 / found.scene.laser.repetition_rate, rel=1e-6)


@pytest.mark.physics
@pytest.mark.parametrize("port", [WINDOW, WINDOW | {"normal": [0.1, 0.2, 1.0]}, DOME | {"offset": [0.0, 0.005, 0.01]}])
def test_the_beam_is_as_narrow_as_its_photons(port):
    """Irradiance on the beam's axis: photons through a small disc there."""
    one = ported(None, port, laser={"half_angle_deg": 3.0, "position": [0.0, 0.0, 0.0]})
    behind = laser_port_of(one)
    rng = np.random.default_rng(3)
    t = 2.0 * math.sin(math.radians(1.5)) ** 2 * rng.random(400_000)
    phi = 2.0 * np.pi * rng.random(t.size)
    sine = np.sqrt(t * (2.0 - t))
    u = np.stack([sine * np.cos(phi), sine * np.sin(phi), 1.0 - t], axis=-1)
    start, v, _, _ = behind.enter(np.zeros(3), u)
    begin, axis, lead, _ = behind.enter(np.zeros(3), np.array([0.0, 0.0, 1.0]))
    middle = begin + (4.0 - lead) * axis
    hit = start + (((middle - start) @ axis) / (v @ axis))[:, None] * v
    inside = np.linalg.norm(hit - middle, axis=1) < 0.05
    irradiance = behind.transmission(np.zeros(3), u)[inside].sum() / t.size / (np.pi * 0.05**2)
    bare = 1.0 / (2.0 * np.pi * (1.0 - math.cos(math.radians(3.0))) * as_if_bare(one, 4.0) ** 2)
    assert bare == pytest.approx(irradiance, rel=4.0 / math.sqrt(inside.sum()))
    limit = eye_limit(one, distance=4.0, exposure=100.0)
    assert limit.distance == 4.0
    if 0.0 < limit.hazard_distance < math.inf:
        wide = eye_limit(one.with_overrides({"laser.port": None}), distance=4.0, exposure=100.0)
        assert as_if_bare(one, limit.hazard_distance) == pytest.approx(wide.hazard_distance, rel=1e-6)


def test_daylight_through_a_port_is_that_in_the_water_times_its_own_factor():
    sky = {"daylight": {"sun_elevation_deg": 50.0, "depth": 4.0}}
    bare, flat, dome = (ported(port, **sky) for port in (None, WINDOW, DOME))
    axis = {"view": np.array([[0.0, 0.0, 1.0]])}
    rates = [float(daylight_rate(one, **axis)[0]) for one in (bare, flat, dome)]
    for rate, one in zip(rates[1:], (flat, dome), strict=True):
        port = camera_port(one)
        through = float(port.transmission(np.zeros(3), np.array([0.0, 0.0, 1.0])))
        assert 0.9 < through < 0.97
        assert rate / rates[0] == pytest.approx(through * (port.index[0] / port.index[2]) ** 2, rel=1e-9)
    same = daylight_rate(ported({"distance": 1e-6} | SAME, **sky))
    np.testing.assert_allclose(same, daylight_rate(bare), rtol=1e-6)
    down = {"camera": {"rotation_deg": [-90.0, 0.0, 0.0]}}
    with pytest.raises(ConfigError, match=r"daylight does not go with a camera\.port that is the surface"):
        daylight_rate(ported({"distance": 2.0}, **sky, **down))


def test_what_has_no_model_behind_a_port_is_refused_by_name():
    with pytest.raises(ConfigError, match=r"analytic.form = 'lu2024' knows no port and no surface"):
        maps_of(ported(WINDOW, analytic={"form": "lu2024"}))
    beam = {"profile": "collimated", "beam_radius": 0.005}
    with pytest.raises(ConfigError, match="'collimated' does not stay parallel behind a dome"):
        maps_of(ported(DOME, "camera", laser=beam, analytic={"backscatter": "constant"}))
    with pytest.raises(ArgumentError, match=r"ranges: 1 m is not beyond the camera's port, which ends at 2 m"):
        spadwarp.budget(ported({"distance": 2.0}), [1.0, 3.0])
    assert spadwarp.budget(ported({"distance": 2.0}, "camera"), device="cpu")[0].range == 3.0


@pytest.mark.slow
@few_units
@pytest.mark.physics
def test_a_collimated_beam_behind_a_window_stays_one():
    """Its spot on the plate, and the light in it, as photons have it; the window is tilted against the beam."""
    beam = {"profile": "collimated", "beam_radius": 0.05, "position": [0.0, 0.0, 0.0]}
    few = {"medium": {"albedo": 1e-6}, "camera": {"horizontal_fov_deg": 4.0, "aperture_diameter": 1e-3}}
    window = WINDOW | {"normal": [0.3, 0.0, 1.0]}
    one = ported(window, "camera", laser=beam, analytic={"backscatter": "constant"}, **few)
    found = maps_of(one)
    photons = detected(one, "ballistic", photons=200_000, seed=4).sum(axis=2)
    assert found.signal.sum() == pytest.approx(photons.sum(), rel=0.02)
    lit = photons > 0.5 * photons.max()
    np.testing.assert_allclose(found.signal[lit], photons[lit], rtol=0.12)


def test_depths_and_their_errors_follow_the_bent_rays_also_from_disk(tmp_path):
    """σ of depth over σ of time is dz/dt, by differences of depths of times."""
    one = ported(WINDOW, "camera")
    found, lines = maps_of(one, frames=2, seed=1), lines_of_sight(one)
    early, late = (
        lines.depth_from_range(lines.range_from_path((found.arrival + shift) * one.medium.pulse_speed))
        for shift in (-1e-12, 1e-12)
    )
    np.testing.assert_allclose(found.sigma_depth / found.sigma_time, (late - early) / 2e-12, rtol=1e-3)
    file = spadwarp.load(found.save(tmp_path / "analytic.h5"))
    stored = stored_depth(file)
    np.testing.assert_array_equal(stored.range, lines.range_from_depth(stored.values))
    assert gate_of(file) == pytest.approx(summary(one)["gate_range"], abs=0.02)


@pytest.mark.slow
def test_an_airborne_lidar_is_that_of_monte_carlo_without_scattering_or_with_one():
    """The bottom's return and the water's of a bay in a breeze, spread by slopes on both ways, and the glint."""
    bay = spadwarp.load_scene("bay_200m").with_overrides({"transport.max_collisions": 2})
    result = maps_of(bay)
    traced = spadwarp.simulate(bay, photons=1_000_000, seed=1, device="cpu")
    scale = bay.laser.photons_per_pulse * bay.detections_per_photon
    off_surface = result._table.cumulative[:, 1].reshape(result.signal.shape)  # a step before all else
    modelled = {
        "ballistic": result.signal,
        "backscatter": result.backscatter * (1.0 - off_surface),
        "surface": result.backscatter * off_surface,
    }
    for name, light in modelled.items():
        found = traced.component(name).sum(axis=-1) * scale
        for block in (np.s_[:, :], np.s_[3:5, 3:5]):  # all of the spread light, and its middle
            assert light[block].sum() == pytest.approx(found[block].sum(), rel=0.03), name
