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


@pytest.fixture
def one():
    changes = {"analytic.backscatter": "single_scatter", "transport.max_collisions": 1, "medium.albedo": 0.5}
    changes |= {"camera.width": 16, "camera.height": 16}
    return spadwarp.load_scene("plane_5m").with_overrides(changes)


def test_cells_without_matter_change_nothing(one):
    empty = {**CLOUD, "extinction": 0.0, "size": [9.0, 9.0, 20.0], "anisotropy": None}
    empty = one.with_overrides({"medium.grid": {k: v for k, v in empty.items() if v is not None}})
    plain, through = (spadwarp.simulate_analytic(each, frames=0, device="cpu") for each in (one, empty))
    np.testing.assert_allclose(through.signal, plain.signal, rtol=1e-5)
    np.testing.assert_allclose(through.backscatter, plain.backscatter, rtol=0.01)  # the rim of the cone
    np.testing.assert_allclose(through.sigma_time, plain.sigma_time, rtol=0.02)


@pytest.mark.parametrize("ports", PORTS)
@pytest.mark.parametrize("laser", [{}, {"laser.profile": "collimated", "laser.beam_radius": 0.2}])
def test_cells_of_one_water_are_that_water_behind_ports_too(one, ports, laser, tmp_path):
    """In a box that holds camera, laser and target."""
    if laser:
        one = one.with_overrides({**laser, "analytic.backscatter": "constant"})
    one = one.with_overrides(PORTS[ports])
    path = tmp_path / "water.npz"
    cells = np.ones((5, 6, 7), np.float32)
    np.savez(path, extinction=0.6 * cells, albedo=0.7 * cells, anisotropy=0.8 * cells, size=[30.0, 30.0, 30.0])
    cellular = one.with_overrides({"medium.grid": {"file": str(path)}})
    plain = one.with_overrides({"medium.extinction": 0.6, "medium.albedo": 0.7, "medium.anisotropy": 0.8})
    expected, found = (spadwarp.simulate_analytic(each, frames=0, device="cpu") for each in (plain, cellular))
    assert expected.signal.any()
    np.testing.assert_allclose(found.signal, expected.signal, rtol=1e-5)
    np.testing.assert_allclose(found.arrival, expected.arrival, rtol=1e-6)
    np.testing.assert_allclose(found.backscatter, expected.backscatter, rtol=0.02)  # the rim of the cone
    assert found.backscatter.sum() == pytest.approx(expected.backscatter.sum(), rel=0.003)
    rows = [spadwarp.budget(each, ranges=[5.0], device="cpu")[0] for each in (plain, cellular)]
    assert rows[1].optical_depth == pytest.approx(rows[0].optical_depth)


@pytest.mark.physics
@pytest.mark.parametrize("ports", ["none", "flat"])
def test_signal_and_backscatter_are_those_of_single_scattering(one, ports, device):
    """Over the middle of the image, to 2 % (4 standard errors are 1.5 %)."""
    one = one.with_overrides(PORTS[ports])
    cloudy = one.with_overrides({"medium.grid": CLOUD})
    analytic = spadwarp.simulate_analytic(cloudy, frames=0, device=device)
    traced = spadwarp.simulate(cloudy, photons=400_000, seed=1, device=device)
    scale = cloudy.laser.photons_per_pulse * cloudy.detections_per_photon
    middle = np.s_[4:12, 4:12]
    for values, component in ((analytic.signal, "ballistic"), (analytic.backscatter, "backscatter")):
        assert values[middle].sum() == pytest.approx(traced.component(component)[middle].sum() * scale, rel=0.02)
    assert analytic.signal[middle].sum() < 0.3 * spadwarp.simulate_analytic(one, frames=0).signal[middle].sum()


def test_budgets_name_the_optical_depth_of_the_cells(one):
    cloudy = one.with_overrides({"medium.grid": CLOUD})
    rows = spadwarp.budget(cloudy, ranges=[1.0, 5.0], device="cpu")
    assert rows[1].optical_depth == pytest.approx(cloudy.optical_depth((0, 0, 0), (0, 0, 5.0)))
    assert rows[1].optical_depth > 2.0 > 0.4 > rows[0].optical_depth
    assert summary(cloudy)["optical_depth"] == pytest.approx(rows[1].optical_depth, rel=0.02)


def test_the_form_of_the_paper_is_refused_by_name(one):
    paper = one.with_overrides({"medium.grid": CLOUD, "analytic.form": "lu2024"})
    with pytest.raises(spadwarp.ConfigError, match=r"analytic.form = 'lu2024' takes one water"):
        spadwarp.simulate_analytic(paper, device="cpu")
