"""Water of several constituents: against one phase function that is their sum, in layers too; the estimators."""

import math

import numpy as np
import pytest

import spadwarp_kernels as sk
from helpers.estimators import agreeing_cells, cells
from helpers.scenes import scene
from helpers.statistics_of_samples import equal_means_p
from spadwarp.scene import phase_function
from spadwarp.scene.medium import MOST_CONSTITUENTS, cell_shares, grid_cells
from spadwarp.values import ConfigError

pytestmark = pytest.mark.physics

MOLECULES = {"name": "molecules", "absorption": 0.05, "scattering": 0.15, "phase_function": "rayleigh"}
ALGAE = {"name": "algae", "absorption": 0.05, "scattering": 0.25, "anisotropy": 0.8}
NO_LAW = {"albedo": None, "extinction": None, "anisotropy": None}


def mixed(*parts, **fields):
    return {**NO_LAW, "constituents": list(parts), **fields}


def summed(path, one, layer=None):
    """The medium with a table of the sum of its constituents' phase functions."""
    angles = np.degrees(np.concatenate([np.geomspace(1e-4, 0.05, 60), np.linspace(0.051, math.pi, 600)]))
    values = phase_function(one.medium, layer).density(np.radians(angles))
    rows = "\n".join(f"{a:.10g},{v:.10g}" for a, v in zip(angles, values, strict=True))
    path.write_text(f"angle_deg,value\n{rows}\n")
    water = layer or one.medium
    law = {"phase_function": "tabulated", "phase_table": str(path)}
    return {"absorption": water.absorption, "scattering": water.scattering, **law}


def test_kernels_take_as_many_constituents_as_scenes():
    assert MOST_CONSTITUENTS == sk.MOST_CONSTITUENTS


def test_coefficients_add_up_by_concentration():
    one = scene(medium=mixed(MOLECULES, {**ALGAE, "concentration": 2.0}, layers=[{"start": 1.0, "concentrations": {}}]))
    layered = one.with_overrides({"medium.layers[0].concentrations": {"algae": 4.0}}).medium
    assert (one.medium.absorption, one.medium.scattering) == pytest.approx((0.15, 0.65))
    assert one.medium.layers[0].extinction == pytest.approx(0.8)
    assert layered.layers[0].scattering == pytest.approx(1.15)
    assert layered.shares_in(layered.layers[0]) == pytest.approx([0.15 / 1.15, 1.0 / 1.15])
    law = phase_function(one.medium)
    assert law.mean_cosine == pytest.approx(0.8 * 0.5 / 0.65, rel=1e-5)
    assert type(one).from_dict(one.to_dict()) == one


@pytest.mark.parametrize("estimator", ["next_event", "guided"])
def test_molecules_and_algae_are_their_summed_table(estimator, tmp_path, device):
    one = scene(medium=mixed(MOLECULES, ALGAE), transport={"estimator": estimator})
    table = scene(medium={**NO_LAW, **summed(tmp_path / "sum.csv", one)}, transport={"estimator": estimator})
    found, expected = (cells(each, device, 20_000) for each in (one, table))
    assert equal_means_p(found, expected, 0.2) > 1e-3


def test_two_of_a_kind_are_one(device):
    half = {**ALGAE, "concentration": 0.5}
    two, one = (
        scene(medium=mixed(MOLECULES, *parts), transport={"estimator": "guided"})
        for parts in ((half, {**half, "name": "others"}), (ALGAE,))
    )
    assert equal_means_p(*(cells(each, device, 20_000) for each in (two, one)), 0.2) > 1e-3


def test_layers_in_which_one_kind_scatters_are_layers_of_its_water(device):
    """Of Henyey and Greenstein's law, whose layers have an anisotropy each."""
    others = {**ALGAE, "name": "others", "scattering": 0.15, "concentration": 0.5}
    sand = {"name": "sand", "absorption": 0.6, "scattering": 0.9, "anisotropy": 0.5, "concentration": 0.0}
    far = {"start": 1.2, "concentrations": {"algae": 0.0, "others": 0.0, "sand": 1.0}}
    guided = {"estimator": "guided"}
    found = scene(medium=mixed(sand, ALGAE, others, layers=[far]), transport=guided)
    near = {"extinction": None, "albedo": None, "absorption": 0.075, "scattering": 0.325, "anisotropy": 0.8}
    layer = {"start": 1.2, "absorption": 0.6, "scattering": 0.9, "anisotropy": 0.5}
    expected = scene(medium={**near, "layers": [layer]}, transport=guided)
    assert equal_means_p(*(cells(each, device, 20_000) for each in (found, expected)), 0.2) > 1e-3


@pytest.mark.parametrize("tracking", ["regular", "delta"])
def test_cells_of_one_more_constituent_are_cells_of_suspended_matter(tracking, device):
    """Of Henyey and Greenstein's law with one g; and the shares of a cell's light are those of its coefficients."""
    sand = {"name": "sand", "absorption": 0.6, "scattering": 0.9, "anisotropy": 0.8, "concentration": 0.0}
    box = {"shape": "cloud", "size": 1.2, "cells": 8, "translation": [0.0, 0.0, 1.2], "tracking": tracking}
    guided = {"estimator": "guided"}
    found = scene(medium=mixed(sand, ALGAE, grid={**box, "constituent": "sand"}), transport=guided)
    near = {"extinction": None, "albedo": None, "absorption": 0.05, "scattering": 0.25, "anisotropy": 0.8}
    expected = scene(medium={**near, "grid": {**box, "extinction": 1.5, "albedo": 0.6}}, transport=guided)
    cells_of, shares = grid_cells(found.medium), cell_shares(found.medium)
    assert (cells_of.extinction * cells_of.albedo * shares[..., 1]).ravel() == pytest.approx(0.25, rel=1e-5)
    assert equal_means_p(*(cells(each, device, 10_000) for each in (found, expected)), 0.2) > 1e-3


@pytest.mark.slow
def test_estimators_agree(device):
    """In water that is clear next to the lens."""
    clear = [{**part, "concentration": 1e-4} for part in (MOLECULES, ALGAE)]
    layers = [
        {"start": start, "concentrations": {"algae": algae, "molecules": molecules}}
        for start, algae, molecules in ((0.3, 1.0, 1.0), (1.2, 4.0, 0.5))
    ]
    agreeing_cells(scene(medium=mixed(*clear, layers=layers)), device)


@pytest.mark.parametrize(
    ("medium", "text"),
    [
        (mixed(MOLECULES, MOLECULES), "not different names"),
        (mixed(MOLECULES, absorption=0.1), "absorption"),
        (mixed(MOLECULES, phase_function="rayleigh"), "phase functions of their own; phase_function"),
        (mixed(MOLECULES, layers=[{"start": 1.0, "concentrations": {"sand": 1.0}}]), "sand is not one of molecules"),
        (mixed(MOLECULES, layers=[{"start": 1.0, "extinction": 1.0, "albedo": 0.5}]), "needs concentrations"),
        (mixed({**ALGAE, "g1": 0.5}), "g1 = 0.5 goes with phase_function = 'two_term_henyey_greenstein' only"),
    ],
)
def test_what_excludes_constituents_is_named(medium, text):
    with pytest.raises(ConfigError, match=text):
        scene(medium=medium)
