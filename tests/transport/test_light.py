"""Light that stays on its device is that of `simulate`, part after part."""

import numpy as np
import pytest
import warp as wp

import spadwarp
import spadwarp_kernels as sk
from helpers.inverse import plate
from spadwarp.transport import LightTracer

NAMES = ["medium.absorption", "medium.scattering", "targets[0].reflectance"]


def test_light_and_derivatives_are_those_of_simulate():
    scene = plate()
    tracer = LightTracer(scene, photons=20_000, seed=5, device="cpu", derivatives=NAMES, separate_targets=True)
    tracer(0, 20_000)  # what was traced before does not stay
    light, slopes = tracer(20_000, 20_000)
    run = {"photons": 20_000, "run": spadwarp.RunOptions(first_photon=20_000), "seed": 5, "device": "cpu"}
    result = spadwarp.simulate(scene, derivatives=NAMES, **run)
    scale = scene.laser.photons_per_pulse * scene.detections_per_photon
    np.testing.assert_allclose(light.total.numpy(), result.detections.reshape(64, -1), rtol=1e-6)
    target = result.component("ballistic") + result.component("forward_scattered")
    np.testing.assert_allclose(light.target.numpy(), scale * target.reshape(64, -1), rtol=1e-6)
    for name in NAMES:
        parts = scale * result.derivatives[name].reshape(3, 64, -1)
        size = np.abs(parts).max()
        np.testing.assert_allclose(slopes[name].total.numpy(), parts.sum(axis=0), rtol=1e-6, atol=1e-9 * size)
        np.testing.assert_allclose(slopes[name].target.numpy(), parts[:2].sum(axis=0), rtol=1e-6, atol=1e-9 * size)
    assert tracer.truth.depth.shape == (8, 8)


def test_rates_of_a_tally_need_arrays_that_fit():
    tally = wp.array(np.arange(24), dtype=wp.int64, device="cpu")
    scale = wp.array([1.0, 2.0], dtype=wp.float64, device="cpu")
    rates = sk.tally_rates(tally, scale, bins=2, components=(1, 3), parameters=2, parameter=1).numpy()
    cube = np.arange(24).reshape(3, 2, 2, 2)[1:, ..., 1].sum(axis=0)
    np.testing.assert_array_equal(rates, cube * np.array([[1.0], [2.0]]))
    for wrong in ({"bins": 3}, {"bins": 2, "parameters": 2, "parameter": 2}, {"bins": 4, "components": (2, 2)}):
        with pytest.raises(sk.ArgumentError):
            sk.tally_rates(tally, scale, **wrong)
