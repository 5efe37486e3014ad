"""Water cell by cell: against one water, layers and quadrature; the estimators against each other."""

import math

import h5py
import numpy as np
import pytest
from scipy.integrate import quad
from scipy.special import erf

import spadwarp
from helpers.estimators import SEEDS, cells, means
from helpers.scenes import LAYERS, PLUME, scattered_once, scene
from helpers.statistics_of_samples import equal_means_p
from spadwarp.scene.medium import grid_cells

pytestmark = pytest.mark.physics

TRACKING = ("regular", "delta")


@pytest.fixture(scope="module")
def one_water(tmp_path_factory):
    """Cells of the medium's own water, in a box that stands askew."""
    path = tmp_path_factory.mktemp("cells") / "one.npz"
    np.savez(path, extinction=np.full((8, 9, 10), 0.5), albedo=np.full((8, 9, 10), 0.8), size=[1.0, 2.0, 1.5])
    return {"file": str(path), "translation": [0.0, 0.0, 1.0], "rotation_deg": [10.0, 20.0, 30.0]}


@pytest.fixture(scope="module")
def layered_cells(tmp_path_factory):
    """The layers as cells: from -6 m to 6 m along z, in steps of 0.1 m, and as far aside as light may come."""
    z = np.arange(-6.0, 6.0 - 1e-9, 0.1) + 0.05
    columns = {
        name: np.where(z < 1.2, a, np.where(z < 1.7, b, c)) * np.ones((2, 3, 1))
        for name, (a, b, c) in {
            "extinction": (0.5, 1.5, 0.2),
            "albedo": (0.8, 0.6, 0.9),
            "anisotropy": (0.8, 0.5, 0.8),
        }.items()
    }
    path = tmp_path_factory.mktemp("cells") / "layers.h5"
    with h5py.File(path, "w") as file:
        for name, values in columns.items():
            file[name] = values
        file["size"] = [40.0, 40.0, 12.0]
    return {"file": str(path)}


@pytest.mark.parametrize(
    ("estimator", "tracking"), [("analog", "regular"), pytest.param("next_event", "delta", marks=pytest.mark.slow)]
)
def test_cells_of_one_water_are_that_water(estimator, tracking, one_water, device):
    """No tentative collision is rejected: up to rounding, the same histories."""
    plain, cellular = (
        spadwarp.simulate(
            scene(medium=medium, transport={"estimator": estimator}), photons=60_000, seed=3, device=device
        )
        for medium in ({}, {"grid": {**one_water, "tracking": tracking}})
    )
    assert cellular.tallies.any() and cellular.energy_report()["exact"] and cellular.counters["invalid"] == 0
    light = [result.histogram.sum(axis=(0, 1)) for result in (cellular, plain)]
    np.testing.assert_allclose(*light, rtol=2e-3 if device == "cpu" else 2e-2, atol=1e-6)


@pytest.mark.slow
def test_regular_tracking_of_cells_that_repeat_layers_has_their_histories(layered_cells, device):
    """Not those of guided light, which is taken to the target in layers alone."""
    layered, cellular = (
        spadwarp.simulate(
            scene(medium=medium, transport={"estimator": "analog"}), photons=60_000, seed=3, device=device
        )
        for medium in ({"layers": LAYERS}, {"grid": {**layered_cells, "tracking": "regular"}})
    )
    assert cellular.counters["water_collisions"] == pytest.approx(layered.counters["water_collisions"], rel=1e-3)
    total = [result.histogram.sum(axis=(0, 1)) for result in (cellular, layered)]
    np.testing.assert_allclose(*total, rtol=2e-3, atol=0.02 * total[1].max() if device != "cpu" else 1e-9)


@pytest.mark.slow
def test_estimators_and_tracking_agree_through_a_plume(device):
    """In clear water, so that next_event has a finite variance; guided knows its total to 1 %."""

    def run(estimator, tracking, photons):
        medium = {"extinction": 1e-3, "grid": {**PLUME, "tracking": tracking}}
        one = scene(medium=medium, transport={"estimator": estimator})
        assert 0.3 < one.optical_depth((0.0, 0.0, 0.0), (0.0, 0.1, 2.2)) < 3.0
        return cells(one, device, photons)

    guided = run("guided", "delta", 8000)
    assert (guided.reshape(SEEDS, 3, -1).sum(axis=(0, 2)) > 0).all()
    total = guided.sum(axis=1)
    assert total.std() / total.mean() / math.sqrt(SEEDS) < 0.01
    for other in (("guided", "regular", 8000), ("next_event", "delta", 8000), ("analog", "regular", 20_000)):
        assert equal_means_p(run(*other), guided) > 1e-3, other


# Single scatter of a pencil beam at x = -0.1 m, in cells, against the integral along it


def _cloud_depth(begin, end, sigma, centre, peak):
    """∫ of an isotropic Gaussian along a straight line, in closed form."""
    begin, end = np.array(begin), np.array(end)
    length = np.linalg.norm(end - begin)
    u = (end - begin) / length
    along = (centre - begin) @ u
    aside2 = ((centre - begin) ** 2).sum() - along**2
    ends = erf((length - along) / (math.sqrt(2.0) * sigma)) - erf(-along / (math.sqrt(2.0) * sigma))
    return peak * math.exp(-0.5 * aside2 / sigma**2) * sigma * math.sqrt(0.5 * math.pi) * ends


def _brought(one, z, b, tau):
    """By metre of the beam: b p exp(-tau) A cos(psi)/r²."""
    r = np.hypot(0.1, z)
    g = one.medium.anisotropy
    p = (1.0 - g * g) / (4.0 * math.pi * (1.0 + g * g + 2.0 * g * z / r) ** 1.5)
    return b * p * np.exp(-tau) * one.camera.aperture_area * (z / r) / r**2


def _in_bins(one, edges):
    """The integral over the cells themselves, by bins of path, of 8 000 points of the beam."""
    water = grid_cells(one.medium)
    ends = np.linspace(0.4, 3.0, 8001)
    z = 0.5 * (ends[1:] + ends[:-1])
    points = np.stack([np.full_like(z, -0.1), np.full_like(z, 1e-6), z], axis=1)
    tau = water.optical_depths([-0.1, 1e-6, 0.0], points, one.medium.extinction)
    tau += water.optical_depths([0.0, 0.0, 0.0], points, one.medium.extinction)
    inside = water.at(points, 0.0) > 0.0
    b = inside * 0.7 * (water.at(points, 0.0) - one.medium.extinction)
    value = _brought(one, z, b, tau) * np.diff(ends)
    return np.histogram(z + np.hypot(0.1, z), edges, weights=value)[0]


@pytest.mark.slow
@pytest.mark.parametrize("tracking", TRACKING)
def test_single_scatter_of_a_gaussian_cloud_is_that_of_the_integral(tracking, device):
    """Optical depth 2 on the axis. By bins that of the cells, in sum that of the cloud: 0.3 %, 4 standard errors."""
    edges = np.arange(1.5, 4.01, 0.25)
    sigma, centre, peak = 1.8 / 6.0, np.array([0.0, 0.0, 1.4]), 2.0 / (0.3 * math.sqrt(2.0 * math.pi))
    cloud = {"shape": "cloud", "size": 1.8, "cells": 60, "extinction": peak, "albedo": 0.7, "tracking": tracking}
    medium = {"extinction": 0.05, "albedo": 0.0, "grid": {**cloud, "translation": centre.tolist()}}
    one = scattered_once(medium, edges)
    assert one.optical_depth((0.0, 0.0, 0.0), (0.0, 0.0, 4.0)) == pytest.approx(2.0 + 0.2, rel=0.01)

    expected = _in_bins(one, edges)
    mean, error, *_ = means(one, device, 80_000 if tracking == "regular" else 150_000, 8)
    assert (np.abs(mean - expected) < 4.0 * error + 0.003 * expected).all(), (mean - expected) / error
    assert (error < 0.01 * expected).all()

    def gaussian(z):
        """Of the cloud without cells."""
        point = np.array([-0.1, 0.0, z])
        b = 0.7 * peak * math.exp(-0.5 * ((point - centre) ** 2).sum() / sigma**2)
        tau = 0.05 * (z + math.hypot(0.1, z)) + _cloud_depth([-0.1, 0.0, 0.0], point, sigma, centre, peak)
        return _brought(one, z, b, tau + _cloud_depth(point, [0.0, 0.0, 0.0], sigma, centre, peak))

    first, last = ((path**2 - 0.01) / (2.0 * path) for path in edges[[0, -1]])
    total = quad(gaussian, first, last, epsabs=1e-14, limit=200)[0]
    assert mean.sum() == pytest.approx(total, rel=0.003, abs=4.0 * math.sqrt((error**2).sum()))


# One very dense cell among clear ones: the mean free path falls to the rounding of a coordinate


WAYS = (("guided", "delta"), ("next_event", "regular"), ("analog", "regular"))


def components(extinction, path, device, estimator, tracking):
    """Mean and standard error of each component's fraction of the emitted photons."""
    values = np.full((4, 4, 4), 0.1)
    values[2, 2, 1] = extinction
    np.savez(path, extinction=values, albedo=np.full((4, 4, 4), 0.8), size=[1.2, 1.2, 1.2])
    grid = {"file": str(path), "translation": [0.0, 0.0, 1.2], "tracking": tracking}
    one = scene(medium={"extinction": 0.01, "grid": grid}, transport={"estimator": estimator, "max_collisions": 30})
    parts = cells(one, device, 100_000 if estimator == "analog" else 20_000, 16).reshape(16, 3, -1).sum(axis=2)
    return parts.mean(axis=0), parts.std(axis=0, ddof=1) / 4.0


@pytest.mark.slow
@pytest.mark.parametrize("extinction", [1e2, 1e6])
def test_guided_by_regular_tracking_is_every_other_way(extinction, device, tmp_path):
    """Within 4 standard errors; backscatter, half of which is the dense cell's, to 5 %."""
    mean, error = components(extinction, tmp_path / "cell.npz", device, "guided", "regular")
    assert (error < 0.05 * mean).all()
    for way in WAYS:
        other, deviation = components(extinction, tmp_path / "cell.npz", device, *way)
        assert (np.abs(other - mean) < 4.0 * np.hypot(error, deviation)).all(), (way, other / mean)
