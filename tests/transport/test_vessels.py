"""Closed bright vessels, in which light meets many surfaces, and wide lenses, next to which it scatters: all of it
arrives, and `guided` keeps its weights and its error."""

import math

import numpy as np
import pytest

import spadwarp_kernels as sk
from helpers.estimators import cells
from helpers.scenes import scene
from helpers.statistics_of_samples import equal_means_p
from reference.aperture import Rig, count
from reference.walk import Medium
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.transport.model import build_model, transport_spec
from spadwarp_kernels.estimators.guided import LARGEST_WEIGHT_RATIO


def vessel(reflectance, *, extinction=0.05, albedo=0.8, max_collisions=200, gate=40.0):
    """A cube of 2 m around laser and camera, seen up to a path of `gate` m."""
    return scene(
        medium={"extinction": extinction, "albedo": albedo},
        camera={"aperture_diameter": 0.05},
        gate={"bin_width_ps": gate / 8 * 3335.64095},
        targets=[{"builtin": "box", "size": [2, 2, 2], "translation": [0, 0, 0.8], "reflectance": reflectance}],
        transport={"max_collisions": max_collisions, "weight_cutoff": 0.0},
    )


VESSELS = {"reflectance 0.95": vessel(0.95), "reflectance 1, capped": vessel(1.0, albedo=1.0, max_collisions=40)}


@pytest.mark.slow
@pytest.mark.physics
@pytest.mark.parametrize("name", VESSELS)
def test_guided_is_next_event_in_a_bright_vessel_with_at_most_its_error(name, device):
    """At equal photons: 1.5 times at most, in every component and in the bins of scattered light; a third of it for
    backscatter, which no surface sends."""
    photons, seeds = 4000, 48
    next_event, guided = (
        cells(VESSELS[name].with_overrides({"transport.estimator": estimator}), device, photons, seeds)
        for estimator in ("next_event", "guided")
    )
    assert equal_means_p(next_event, guided) > 1e-3
    assert guided.shape[1] == 24
    errors = []
    for found in (next_event, guided):
        parts = found.reshape(seeds, 3, 8)
        totals = parts.sum(axis=2)
        bins = parts[:, 1].std(axis=0) / parts[:, 1].mean(axis=0)
        errors.append([*totals.std(axis=0) / totals.mean(axis=0), np.exp(np.log(bins[bins > 0]).mean())])
    ratio = np.array(errors[1]) / errors[0]
    assert (ratio <= 1.5).all() and ratio[2] < 0.3, ratio
    assert errors[1][1] / math.sqrt(seeds) < 0.01  # the comparison has teeth


@pytest.mark.slow
@pytest.mark.parametrize(
    ("extinction", "reflectance", "bound"), [(1e-4, 1.0, 4.0), (4.0, 1.0, float(LARGEST_WEIGHT_RATIO))]
)
def test_weights_of_guided_photons_are_bounded(extinction, reflectance, bound, device):
    """White walls and water without absorption: the analog weight stays 1. Clear: 80 walls, undirected weights of
    0.7^-80 before. Turbid: 240 scatterings."""
    one = vessel(reflectance, extinction=extinction, albedo=1.0, max_collisions=400, gate=60.0)
    mesh = build_mesh(one)
    model = build_model(one, pick_device(device), mesh)
    model.guiding.probability = model.guiding.surface_probability = 0.3
    spec = transport_spec(one, mesh)._replace(records=True)
    data = sk.make_data(model, record_count=4000)
    sk.launch_transport(spec, model, data, seed=2, first_id=0, photon_count=4000)
    weight, collisions = data.records.weight.numpy(), data.records.collisions.numpy()
    assert collisions.mean() > 30
    assert weight.max() <= bound * 1.0001
    # And the mean is that of the analog walk.
    assert weight.mean() == pytest.approx(1.0, abs=4 * weight.std() / np.sqrt(weight.size))


@pytest.mark.slow
@pytest.mark.physics
def test_a_wide_lens_collects_what_a_plain_count_of_photons_does(device):
    """Total of each component: 0.4 m of lens before a plate at 2.2 m, in focus; water that scatters on the way."""
    exact = {"max_collisions": 1000, "weight_cutoff": 0.0}
    half = math.tan(math.radians(25.0))
    rig = Rig(
        medium=Medium(0.5, 0.8, 0.8),
        laser=(-0.1, 0.0),
        half_angle=math.radians(20.0),
        aperture_radius=0.2,
        field=(half, half),
        focus=2.2,
        plate_depth=2.2,
        plate_size=(3.0, 3.0),
        reflectance=0.7,
    )
    expected, error = count(rig, 600_000, np.arange(9.0), np.random.default_rng(1))
    expected, error = expected.sum(axis=1), np.sqrt((error**2).sum(axis=1))
    assert (error < 0.05 * expected).all()
    for estimator, photons in (("analog", 40_000), ("guided", 20_000)):
        found = cells(scene(transport={"estimator": estimator, **exact}), device, photons, seeds=8)
        parts = found.reshape(8, 3, 8).sum(axis=2)
        apart = parts.mean(axis=0) - expected
        assert (np.abs(apart) < 3.5 * np.hypot(error, parts.std(axis=0, ddof=1) / math.sqrt(8))).all(), estimator
