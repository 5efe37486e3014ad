"""Light through the surface of the sea: the estimators agree, energy is kept, a nearly flat sea is a flat one."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.estimators import cells
from helpers.scenes import scene
from helpers.statistics_of_samples import equal_means_p
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.scene import shot_scene
from spadwarp.scene.sight import depth_from_time, lines_of_sight
from spadwarp.transport.model import build_model

PLATE = {"builtin": "plane", "size": [4.0, 4.0], "reflectance": 0.7}

# Where the mean plane, the laser and a target are: +z is the camera's axis, and a wide lens is 1 to 1.5 m from the sea.
PLACES = {
    "camera in air, laser in water": (
        {"point": [0.0, 0.0, 1.0], "up": [0.0, 0.0, -1.0]},
        {"position": [-0.4, 0.0, 1.6]},
        {**PLATE, "translation": [0.0, 0.0, 2.8]},
    ),
    "both in air": (
        {"point": [0.0, 0.0, 1.0], "up": [0.0, 0.0, -1.0]},
        {"position": [-0.3, 0.0, 0.2]},
        {**PLATE, "translation": [0.0, 0.0, 2.2]},
    ),
    "both in water, a target in air": (
        {"point": [0.0, 0.0, 1.2], "up": [0.3, 0.0, 1.0]},
        {"position": [-0.3, 0.0, 0.0]},
        {**PLATE, "translation": [0.0, 0.0, 2.2]},
    ),
    "camera in water, laser in air": (
        {"point": [0.0, 0.0, 1.2], "up": [0.0, 0.0, 1.0]},
        {"position": [-0.5, 0.0, 2.0], "direction": [0.2, 0.0, -1.0]},
        {**PLATE, "translation": [0.0, 0.0, 3.0]},
    ),
}


def sea_scene(place, *, wind=5.0, estimator="guided", **sections):
    surface, laser, target = PLACES[place]
    tables = {
        "surface": {"wind": wind, **surface},
        "laser": laser,
        "camera": {"aperture_diameter": 0.5},
        "targets": [target],
        "gate": {"bins": 12},
        "transport": {"estimator": estimator},
    }
    for name, fields in sections.items():
        tables[name] = {**tables.get(name, {}), **fields} if isinstance(fields, dict) else fields
    return scene(**tables)


# Waves of half a metre, by a wind over 300 m of sea.
WAVES = {"size": 2.0, "cells": 64, "fetch": 300.0}

CASES = [(place, 5.0) for place in PLACES] + [("both in air", 0.0), ("both in air", 12.0)]


@pytest.mark.slow
@pytest.mark.physics
@pytest.mark.parametrize(("place", "wind"), CASES)
def test_estimators_agree(place, wind):
    """In each bin of each component; next events where the lens is in the air: in water their variance
    is infinite."""
    photons = {"guided": 15_000, "analog": 50_000}
    if place == "both in air" and wind == 5.0:
        photons["next_event"] = 15_000
    found = {one: cells(sea_scene(place, wind=wind, estimator=one), "cpu", photons[one], 10) for one in photons}
    for one in photons.keys() - {"guided"}:
        assert equal_means_p(found[one], found["guided"]) > 1e-3, one


POLARISED = {
    "medium": {"scattering_matrix": "voss_fry"},
    "laser": {"position": [-0.3, 0.0, 0.2], "polarisation": "linear", "polarisation_angle_deg": 30.0},
    "camera": {"aperture_diameter": 0.5, "polarisation": "stokes"},
    "targets": [PLACES["both in air"][2]],
    "gate": {"bins": 12},
}


def stokes(estimator, photons, **sections):
    """Of all pixels, `[seed, channel, component, bin]`, but for what met the surface alone."""
    one = scene(**POLARISED | {"transport": {"estimator": estimator}} | sections)
    runs = [spadwarp.simulate(one, photons=photons, seed=seed, device="cpu").channels for seed in range(10)]
    return np.array([[part.sum(axis=(1, 2))[:3] for part in run.values()] for run in runs])


@pytest.mark.slow
@pytest.mark.physics
def test_nearly_flat_and_flat_seas_are_a_calm_surface():
    """As a port without a window, for polarised light that is not scattered: with slopes of 1e-5 and with none. Behind
    a port, what comes from below is not reflected."""
    port = {"distance": 1.0, "inside_index": 1.00028}
    ported = {"camera": {**POLARISED["camera"], "port": port}, "laser": {**POLARISED["laser"], "port": "camera"}}
    behind = stokes("guided", 20_000, **ported)[:, :, 0]
    for mss in (0.0, 1e-5):
        surface = {**PLACES["both in air"][0], "mean_square_slope": mss, "air_index": 1.00028}
        flat = stokes("guided", 20_000, surface=surface)[:, :, 0]
        assert equal_means_p(flat.reshape(10, -1), behind.reshape(10, -1)) > 1e-3
        (i, q, *_), (i_port, q_port, *_) = flat.sum(axis=(0, 2)), behind.sum(axis=(0, 2))
        assert i == pytest.approx(i_port, rel=3e-3) and q / i == pytest.approx(q_port / i_port, rel=0.02)


@pytest.mark.slow
@pytest.mark.physics
def test_estimators_agree_on_polarised_light():
    surface = {"wind": 5.0, **PLACES["both in air"][0]}
    guided, analog = (stokes(name, n, surface=surface) for name, n in (("guided", 15_000), ("analog", 50_000)))
    assert equal_means_p(analog.reshape(10, -1), guided.reshape(10, -1)) > 1e-3


@pytest.mark.slow
@pytest.mark.physics
def test_derivatives_are_differences_of_runs_with_the_same_random_numbers():
    """By absorption, scattering and anisotropy, of each component: of legs in the water alone."""
    names, values, steps = ("absorption", "scattering", "anisotropy"), np.array([0.1, 0.4, 0.8]), (0.01, 0.04, 0.02)

    def light(shift, seed, **choices):
        a, b, g = values + shift
        medium = {"extinction": a + b, "albedo": b / (a + b), "anisotropy": g}
        one = sea_scene("both in air", medium=medium)
        return spadwarp.simulate(one, photons=40_000, seed=seed, device="cpu", **choices)

    def total(result):
        return np.array([result.component(name).sum() for name in result.scene.components[:3]])

    slopes, changes = [], []
    for seed in range(8):
        found = light(np.zeros(3), seed, derivatives=names)
        slopes.append([found.derivatives[f"medium.{name}"].sum(axis=(1, 2, 3)) for name in names])
        shifts = np.diag(steps)
        pairs = [(total(light(one, seed)), total(light(-one, seed))) for one in shifts]
        changes.append([(up - down) / (2.0 * step) for (up, down), step in zip(pairs, steps, strict=True)])
    slopes, off = np.array(slopes), np.array(slopes)[..., :3] - np.array(changes)
    assert not slopes[..., 3].any()  # light that met the surface alone
    error, mean = off.std(axis=0, ddof=1) / math.sqrt(8), np.abs(slopes.mean(axis=0)[:, :3])
    assert (np.abs(off.mean(axis=0)) <= 4.0 * error + 1e-3 * mean).all()
    assert (error < 0.03 * mean)[mean > 0.0].all()


@pytest.mark.slow
def test_masking_is_an_entry_of_the_energy_balance():
    """At most 1.4 % of light from the air up to 60°, and 3 % of light from the water up to 48°, up to 12 m/s."""
    for angle, place, most in ((0.0, "both in air", 0.014), (60.0, "both in air", 0.014), (45.0, "below", 0.03)):
        beam = {"profile": "collimated", "position": [0.0, 0.0, 0.0]}
        beam["direction"] = [math.sin(math.radians(angle)), 0.0, math.cos(math.radians(angle))]
        up = -1.0 if place == "both in air" else 1.0
        one = sea_scene(
            "both in air",
            wind=12.0,
            laser=beam,
            surface={"up": [0.0, 0.0, up]},
            medium={"extinction": 1e-4, "albedo": 0.5},
            targets=[],
            transport={"max_collisions": 1},
        )
        result = spadwarp.simulate(one, photons=200_000, seed=2, device="cpu")
        report = result.energy_report()
        assert report["exact"]
        masked = result.energy_balance["surface_masking"] * result.energy_balance_unit / result.photons
        assert 0.0 < masked < most
        assert result.counters["crossings"] == pytest.approx(200_000, rel=1e-3)


@pytest.mark.slow
@pytest.mark.physics
@pytest.mark.parametrize("place", PLACES)
def test_estimators_agree_over_waves(place):
    """In each bin of each component, over one field of waves: `analog` takes no way to the lens from the others."""
    one = {name: sea_scene(place, estimator=name, surface={"waves": WAVES}) for name in ("guided", "analog")}
    found = {name: cells(one[name], "cpu", photons, 10) for name, photons in (("guided", 15_000), ("analog", 50_000))}
    assert equal_means_p(found["analog"], found["guided"]) > 1e-3
    report = spadwarp.simulate(one["guided"], photons=10_000, seed=1, device="cpu").energy_report()
    assert report["exact"]


@pytest.mark.slow
@pytest.mark.physics
def test_waves_without_height_are_the_mean_plane(tmp_path):
    """A field of heights that are all 0 leaves all slopes to facets: totals of components as without it."""
    np.save(tmp_path / "flat.npy", np.zeros((8, 8)))
    runs = []
    for surface in ({}, {"waves": {"heights": str(tmp_path / "flat.npy"), "size": 1.0}}):
        runs.append(cells(sea_scene("both in air", surface=surface), "cpu", 20_000, 10))
    assert equal_means_p(runs[1], runs[0]) > 1e-3
    assert runs[1].sum(axis=1).mean() == pytest.approx(runs[0].sum(axis=1).mean(), rel=5e-3)


def test_waves_and_shots_stay_on_their_side():
    """Refused where the model is built: nothing is compiled."""
    low = {"point": [0.0, 0.0, 0.1], "waves": {"size": 40.0, "cells": 64}}
    rising = {"camera": {"width": 2, "height": 2}, "scan": {**SCAN, "velocity": [0.0, 0.0, 400.0]}}
    for sections, text in (
        ({"surface": low, "laser": {"position": [0.0] * 3}}, r"camera\.position: 0\.1 m .* waves of up to 0\.\d+ m"),
        ({"surface": {"waves": {**WAVES, "shortest": 0.0625}}}, r"surface\.waves: heights: the waves hold .* outside"),
        (rising, r"camera\.position: -0\.2 m from the surface in shot 3"),
    ):
        one = sea_scene("both in air", **sections)
        with pytest.raises(spadwarp.ConfigError, match=text):
            build_model(one, pick_device("cpu"), build_mesh(one))


SCAN = {"mode": "trajectory", "pattern": "conical", "half_angle_deg": 12.0, "velocity": [0.0, 300.0, 40.0]}


def totals(one, photons, seeds):
    """Fractions of the photons `[seeds, component, pixel]`."""
    runs = [spadwarp.simulate(one, photons=photons, seed=seed, device="cpu") for seed in seeds]
    assert all(run.energy_report()["exact"] for run in runs)
    return np.array([run.tallies.sum(axis=3).reshape(len(run.tallies), -1) * (run.unit / photons) for run in runs])


@pytest.mark.slow
@pytest.mark.physics
@pytest.mark.parametrize("place", ["both in air", "both in water, a target in air"])
def test_each_shot_over_the_sea_is_the_run_of_its_pose_alone(place):
    """Totals by component, truth, and depth from the truth's time of flight; layers below, where they differ."""
    pose = {"width": 2, "height": 4, "rotation_deg": [6.0, -4.0, 20.0], "aperture_diameter": 0.3}
    layers = {"layers": [{"start": 1.5, "extinction": 1.0, "albedo": 0.8}]} if place == "both in air" else {}
    one = sea_scene(place, camera=pose, scan=SCAN, medium={"group_index": 1.36, "phase_index": 1.34, **layers})
    scanned = totals(one, 8 * 4000, range(10)) * 8
    truth = spadwarp.truth_maps(one, device="cpu")
    if place == "both in air":
        time = lines_of_sight(one).path_from_range(truth.range.astype(float)) * 1.36 / 299_792_458.0
        np.testing.assert_allclose(depth_from_time(time, scene=one), truth.depth, rtol=1e-5)
    for shot in (1, 6):
        alone = shot_scene(one, shot)
        for name, array in vars(spadwarp.truth_maps(alone, device="cpu")).items():
            np.testing.assert_allclose(getattr(truth, name).reshape(8, -1)[shot], array.ravel(), rtol=1e-5, atol=1e-5)
        own = totals(alone, 4000, range(50, 60)).sum(axis=2)
        both = np.stack([own, scanned[:, :, shot]])
        mean, error = both.mean(axis=1), np.sqrt(both.var(axis=1, ddof=1).sum(axis=0) / 10)
        assert (np.abs(mean[0] - mean[1]) < 4.0 * error).all(), (mean, error)
        assert (error < 0.1 * mean[0])[mean[0] > 0.1 * mean[0].max()].all()
