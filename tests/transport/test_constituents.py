"""Water of several constituents: against one phase function that is their sum, in layers too; the estimators; and the
derivatives by their concentrations."""

import math

import numpy as np
import pytest

import spadwarp
import spadwarp_kernels as sk
from helpers.estimators import agreeing_cells, cells
from helpers.runs import of_seeds, same
from helpers.scenes import scene, single_scatter_case
from helpers.statistics_of_samples import equal_means_p
from reference.single_scatter import Lidar, single_scatter
from spadwarp.scene import phase_function
from spadwarp.scene.medium import MOST_CONSTITUENTS, cell_shares, grid_cells
from spadwarp.transport import derivative_names
from spadwarp.transport.model import transport_spec
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


@pytest.mark.parametrize(
    "law",
    [
        {"anisotropy": 0.8},
        pytest.param({"phase_function": "fournier_forand", "particle_index": 1.06}, marks=pytest.mark.slow),
    ],
)
def test_one_constituent_is_the_water_spelt_out_to_the_bit(law, device):
    part = {"name": "algae", "absorption": 0.1, "scattering": 0.25}
    far = [{"start": 1.2, "concentrations": {"algae": 2.0}}]
    one = scene(medium=mixed({**part, **law}, layers=far))
    coefficients = [{name: n * part[name] for name in ("absorption", "scattering")} for n in (1.0, 2.0)]
    layers = [{"start": 1.2, **coefficients[1]}]
    plain = scene(medium={**NO_LAW, **coefficients[0], **law, "layers": layers})
    assert transport_spec(one, None) == transport_spec(plain, None)
    same(*(spadwarp.simulate(each, photons=5_000, device=device) for each in (one, plain)))


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["next_event", "guided"])
def test_molecules_and_algae_are_their_summed_table(estimator, tmp_path, device):
    one = scene(medium=mixed(MOLECULES, ALGAE), transport={"estimator": estimator})
    table = scene(medium={**NO_LAW, **summed(tmp_path / "sum.csv", one)}, transport={"estimator": estimator})
    found, expected = (cells(each, device, 20_000) for each in (one, table))
    assert equal_means_p(found, expected, 0.2) > 1e-3


@pytest.mark.slow
def test_layers_of_mixtures_are_layers_of_summed_tables(tmp_path, device):
    """Of tables that scatter in one layer each."""
    far = [{"start": 1.2, "concentrations": {"molecules": 0.5, "algae": 2.0}}]
    guided = {"estimator": "guided"}
    one = scene(medium=mixed(MOLECULES, ALGAE, layers=far), transport=guided)
    near, behind = (summed(tmp_path / f"{k}.csv", one, layer) for k, layer in enumerate((None, one.medium.layers[0])))
    parts = [{**near, "name": "near"}, {**behind, "name": "behind", "concentration": 0.0}]
    tables = scene(
        medium=mixed(*parts, layers=[{"start": 1.2, "concentrations": {"near": 0.0, "behind": 1.0}}]), transport=guided
    )
    assert equal_means_p(*(cells(each, device, 20_000) for each in (one, tables)), 0.2) > 1e-3


@pytest.mark.slow
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


# Derivatives


LIDAR, ONCE = single_scatter_case(10.0, 2.5)
NAMES = ["medium.constituents[0].concentration", "medium.constituents[1].concentration"]


def thinner(molecules=1.0, algae=0.6, **sections):
    parts = [{**MOLECULES, "concentration": molecules}, {**ALGAE, "concentration": algae}]
    return scene(**sections | {"medium": mixed(*parts, **sections.get("medium", {}))})


@pytest.mark.slow
def test_single_scatter_and_its_derivatives_are_those_of_the_quadrature(device):
    one = thinner(**ONCE | {"medium": {"group_index": 1.0}})
    found = spadwarp.simulate(one, photons=400_000, device=device, derivatives=["molecules", "algae"])
    light = found.histogram.sum(axis=(0, 1))

    def expected(molecules=1.0, algae=0.6):
        water = thinner(molecules, algae).medium
        law = phase_function(water)
        own = {"extinction": water.extinction, "albedo": water.albedo, "phase_function": lambda mu: law.over_t(1 - mu)}
        return single_scatter(Lidar(**{**vars(LIDAR), **own})).sum(axis=(0, 1))

    np.testing.assert_allclose(light, expected(), rtol=1e-2)
    assert list(found.derivatives) == NAMES
    for name, step in zip(NAMES, np.eye(2) * 1e-3, strict=True):
        higher, lower = (expected(1.0 + side * step[0], 0.6 + side * step[1]) for side in (1, -1))
        slope = (higher - lower) / 2e-3 / expected()
        values = found.derivatives[name].sum(axis=(0, 1, 2))
        np.testing.assert_allclose(values / light, slope, atol=2e-3, err_msg=name)


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["analog", "guided"])
def test_derivatives_are_differences_of_runs(estimator, device):
    """With the same photons, and in layers: of which one has a concentration of its own."""
    far = [{"start": 1.0, "concentrations": {"algae": 2.0}}]
    names, step = [*NAMES, "medium.layers[0].concentrations.algae"], 0.1
    one = thinner(medium={"layers": far}, transport={"estimator": estimator})
    assert set(names) <= set(derivative_names(one))
    photons, seeds = {"analog": 40_000, "guided": 20_000}[estimator], range(16)
    found = np.array([run.signed.sum(axis=(2, 3)) for run in of_seeds(one, device, photons, seeds, names)])
    for p, (name, value) in enumerate(zip(names, (1.0, 0.6, 2.0), strict=True)):
        ends = [one.with_overrides({name: value + side * step}) for side in (1, -1)]
        far, near = (np.array([r.light.sum(axis=(1, 2)) for r in of_seeds(e, device, photons, seeds)]) for e in ends)
        difference = (far - near) / (2 * step)
        assert equal_means_p(found[:, p].reshape(16, -1), difference.reshape(16, -1), 0.3) > 1e-3, name


def test_what_has_no_derivative_is_named():
    one = thinner(algae=0.0)
    assert NAMES[1] not in derivative_names(one) and NAMES[0] in derivative_names(one)
    for name, text in (("algae", "its value is 0"), ("absorption", "their concentrations have derivatives")):
        with pytest.raises(ConfigError, match=text):
            spadwarp.simulate(one, photons=1, device="cpu", derivatives=[name])
