"""The analytic simulator through a cloud of cells, against traced single scattering."""

import numpy as np
import pytest

import spadwarp
from spadwarp.checks import summary

CLOUD = {"shape": "cloud", "size": [2.0, 2.0, 2.0], "cells": 24, "extinction": 1.0, "albedo": 0.7}
CLOUD |= {"translation": [0.0, 0.0, 2.5], "anisotropy": 0.8}
FLAT = {"distance": 0.05, "thickness": 0.01, "material": "BK7"}
DOME = {"shape": "dome", "radius": 0.08, "thickness": 0.006, "material": "BK7"}
PORTS = {
    "none": {},
    "flat": {"camera.port": FLAT, "laser.port": "camera"},
    "dome": {"camera.port": DOME, "laser.port": FLAT},
}
BEAM = {"laser.profile": "collimated", "laser.beam_radius": 0.2, "analytic.backscatter": "constant"}


def scene(**changes):
    single = {"analytic.backscatter": "single_scatter", "transport.max_collisions": 1, "medium.albedo": 0.5}
    size = {"camera.width": 16, "camera.height": 16}
    return spadwarp.load_scene("plane_5m").with_overrides({**single, **size, **changes})


def maps(one, device="cpu"):
    return spadwarp.simulate_analytic(one, frames=0, device=device)


def test_cells_without_matter_change_nothing():
    empty = {name: value for name, value in CLOUD.items() if name != "anisotropy"}
    empty |= {"extinction": 0.0, "size": [9.0, 9.0, 20.0]}
    plain, through = maps(scene()), maps(scene(**{"medium.grid": empty}))
    for name, close in (("signal", 1e-5), ("backscatter", 0.01), ("sigma_time", 0.02)):  # the rim of the cone
        np.testing.assert_allclose(getattr(through, name), getattr(plain, name), rtol=close)


@pytest.mark.slow
@pytest.mark.parametrize("ports", PORTS)
@pytest.mark.parametrize("laser", [{}, BEAM])
def test_cells_of_one_water_are_that_water_behind_ports_too(ports, laser, tmp_path):
    """In a box that holds camera, laser and target."""
    cells, path = np.ones((5, 6, 7), np.float32), tmp_path / "water.npz"
    np.savez(path, extinction=0.6 * cells, albedo=0.7 * cells, anisotropy=0.8 * cells, size=[30.0, 30.0, 30.0])
    one = scene(**PORTS[ports], **laser)
    water = {"medium.extinction": 0.6, "medium.albedo": 0.7, "medium.anisotropy": 0.8}
    plain, cellular = (one.with_overrides(change) for change in (water, {"medium.grid": {"file": str(path)}}))
    expected, found = maps(plain), maps(cellular)
    assert expected.signal.any()
    for name, close in (("signal", 1e-5), ("arrival", 1e-6), ("backscatter", 0.02)):  # the rim of the cone
        np.testing.assert_allclose(getattr(found, name), getattr(expected, name), rtol=close)
    assert found.backscatter.sum() == pytest.approx(expected.backscatter.sum(), rel=0.003)
    depths = [spadwarp.budget(each, ranges=[5.0], device="cpu")[0].optical_depth for each in (plain, cellular)]
    assert depths[1] == pytest.approx(depths[0])


@pytest.mark.slow
@pytest.mark.physics
@pytest.mark.parametrize("ports", ["none", "flat"])
def test_signal_and_backscatter_are_those_of_single_scattering(ports, device):
    """Over the middle of the image, to 2 % (4 standard errors are 1.5 %)."""
    one = scene(**PORTS[ports])
    cloudy = one.with_overrides({"medium.grid": CLOUD})
    analytic, traced = maps(cloudy, device), spadwarp.simulate(cloudy, photons=400_000, seed=1, device=device)
    scale = cloudy.laser.photons_per_pulse * cloudy.detections_per_photon
    middle = np.s_[4:12, 4:12]
    for values, component in ((analytic.signal, "ballistic"), (analytic.backscatter, "backscatter")):
        assert values[middle].sum() == pytest.approx(traced.component(component)[middle].sum() * scale, rel=0.02)
    assert analytic.signal[middle].sum() < 0.3 * maps(one).signal[middle].sum()


def test_budgets_name_the_optical_depth_of_the_cells_and_the_form_of_the_paper_is_refused():
    cloudy = scene(**{"medium.grid": CLOUD})
    rows = spadwarp.budget(cloudy, ranges=[1.0, 5.0], device="cpu")
    assert rows[1].optical_depth == pytest.approx(cloudy.optical_depth((0, 0, 0), (0, 0, 5.0)))
    assert rows[1].optical_depth > 2.0 > 0.4 > rows[0].optical_depth
    assert summary(cloudy)["optical_depth"] == pytest.approx(rows[1].optical_depth, rel=0.02)
    with pytest.raises(spadwarp.ConfigError, match=r"analytic.form = 'lu2024' takes one water"):
        maps(cloudy.with_overrides({"analytic.form": "lu2024"}))
