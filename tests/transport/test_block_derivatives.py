"""Derivatives by block of a grid's cells: against one water, closed forms, quadrature and central differences."""

import itertools
import math

import numpy as np
import pytest
from scipy import stats
from scipy.integrate import quad

import spadwarp
from helpers.runs import of_seeds
from helpers.scenes import BEYOND, ELSEWHERE, PENCIL, scattered_once, scene
from spadwarp import simulate
from spadwarp.transport import derivative_names, resolve_derivatives, trace

pytestmark = pytest.mark.physics

KINDS = ("absorption", "scattering", "extinction")
NAMES = tuple(f"medium.grid.{kind}" for kind in KINDS)
WITH_TARGET = (*NAMES, "reflectance")  # what all tests ask for, since each list is a kernel of its own
WATER = ("medium.absorption", "medium.scattering", "medium.anisotropy", "targets[0].reflectance")


@pytest.fixture(scope="module")
def everywhere(tmp_path_factory):
    """Cells of the medium's own water, in a box that no light leaves."""
    path = tmp_path_factory.mktemp("cells") / "one.npz"
    np.savez(path, extinction=np.full((8, 6, 10), 0.5), albedo=np.full((8, 6, 10), 0.8), size=[60.0, 60.0, 60.0])
    return {"file": str(path), "translation": [0.31, 0.2, 1.1], "rotation_deg": [10.0, 20.0, 30.0]}


def simulated(one, device, blocks):
    return simulate(one, photons=20_000, seed=1, device=device, derivatives=WITH_TARGET, blocks=blocks)


@pytest.mark.slow
@pytest.mark.parametrize(("estimator", "tracking"), [("analog", "regular"), ("guided", "regular")])
def test_blocks_share_the_derivatives_of_one_water(estimator, tracking, everywhere, device):
    """The same photons; with the derivatives of a target beside them."""
    transport = {"estimator": estimator, "points_per_flight": 1}  # what derivatives by block have
    water = scene(medium={"layers": ELSEWHERE}, transport=transport)
    whole = simulate(water, photons=20_000, device=device, derivatives=WATER)
    one = scene(medium={"grid": {**everywhere, "tracking": tracking}}, transport=transport)
    plain = simulate(one, photons=20_000, device=device)
    result = simulated(one, device, (4, 3, 5))
    # On a GPU products are rounded with sums (FMA), in kernels of two texts not the same ones.
    np.testing.assert_allclose(result.tallies, plain.tallies, rtol=0 if device == "cpu" else 1e-6, atol=device != "cpu")
    assert (result.energy_balance, result.counters) == (plain.energy_balance, plain.counters)
    assert list(result.derivatives)[:2] == [WATER[3], "medium.grid.absorption[0,0,0]"]
    assert len(result.derivatives) == 1 + 3 * 60
    rtol = 1e-5 if device == "cpu" else 2e-2  # on a GPU some histories differ
    rtol = 0.1 if estimator == "guided" else rtol  # in cells no light is taken to the target: other histories
    for kind in KINDS[:2]:
        found = result.derivatives[f"medium.grid.{kind}"]
        assert found.shape == (4, 3, 5, 3, 4, 4, 8)
        expected = whole.derivatives[f"medium.{kind}"].sum(axis=(1, 2))
        total = found.sum(axis=(0, 1, 2, 4, 5))
        np.testing.assert_allclose(total, expected, rtol=0, atol=rtol * np.abs(expected).max())
    a, b, c = (result.derivatives[name] for name in NAMES)
    np.testing.assert_allclose(c, 0.2 * a + 0.8 * b, rtol=0, atol=1e-4 * np.abs(c).max())  # at fixed albedo


def test_ballistic_light_in_closed_form(everywhere, device):
    """A pencil beam there and back: -2 edges of each block that it crosses, times the light, by a and by b."""
    grid = {"shape": "plume", "size": 1.2, "cells": 24, "extinction": 3.0, "turbulence": 0.5, "seed": 5}
    one = scene(
        medium={"grid": {**grid, "translation": [0.0, 0.1, 1.2], "tracking": "regular"}},
        laser=PENCIL,
        camera={"aperture_diameter": 0.02},
    )
    result = simulated(one, device, (3, 3, 4))
    light = result.component("ballistic").sum()
    for name in NAMES:
        lengths = -result.derivatives[name][..., 0, :, :, :].sum(axis=(3, 4, 5)) / light
        expected = np.zeros((3, 3, 4))
        expected[1, 1] = 0.6
        np.testing.assert_allclose(lengths, expected, atol=0.004)


@pytest.mark.slow
@pytest.mark.parametrize("tracking", ["regular", "delta"])
def test_single_scatter_of_two_half_spaces_is_that_of_the_integral(tracking, tmp_path, device):
    """The light, and its derivatives by two blocks, a step from c 0.3 to 1.2 at z = 1.25 m; 0.3 % of each bin
    or of the largest, and 4 standard errors."""
    step, edges = 1.25, np.arange(1.5, 4.01, 0.25)
    c, b = np.array([0.3, 1.2]), np.array([0.24, 0.6])
    path = tmp_path / "halves.npz"
    np.savez(path, extinction=c.reshape(1, 1, 2), scattering=b.reshape(1, 1, 2), size=[80.0, 80.0, 40.0])
    grid = {"file": str(path), "translation": [0.0, 0.0, step]}
    one = scattered_once({"grid": {**grid, "tracking": tracking}}, edges)
    g, area = one.medium.anisotropy, one.camera.aperture_area

    def slope(z, kind, block):
        r, near, here = math.hypot(0.1, z), min(step / z, 1.0), int(z > step)
        lengths = np.array([near, 1.0 - near]) * (z + r)  # both ways cross the step at the same part of their length
        p = (1.0 - g * g) / (4.0 * math.pi * (1.0 + g * g + 2.0 * g * z / r) ** 1.5)
        light = b[here] * p * math.exp(-float(c @ lengths)) * area * (z / r) / r**2
        if kind == "light":
            return light
        per_event = {"absorption": 0.0, "scattering": 1.0 / b[here], "extinction": 1.0 / c[here]}[kind]
        return light * ((per_event if here == block else 0.0) - lengths[block])

    names = resolve_derivatives(one, WITH_TARGET, (1, 1, 2))
    runs = list(of_seeds(one, device, 100_000, range(8), names))
    ends = (edges**2 - 0.01) / (2.0 * edges)
    for kind, block in (("light", 0), *itertools.product(KINDS, (0, 1))):
        if kind == "light":
            rows = [run.light.sum(axis=(0, 1, 2)) for run in runs]
        else:
            place = names.index(f"medium.grid.{kind}[0,0,{block}]")
            rows = [run.signed[place, 2].sum(axis=(0, 1)) for run in runs]
        mean, error = np.mean(rows, axis=0), np.std(rows, axis=0, ddof=1) / math.sqrt(len(rows))
        expected = [
            quad(slope, low, high, args=(kind, block), points=[step], epsabs=1e-15)[0]
            for low, high in itertools.pairwise(ends)
        ]
        scale = np.array(expected) if kind == "light" else 2.0 * np.abs(expected).max()
        assert (np.abs(mean - expected) < 4.0 * error + 0.003 * np.minimum(scale, np.abs(expected).max())).all(), kind
        assert (error < 0.01 * scale).all()


@pytest.mark.slow
def test_central_differences_in_a_plume(tmp_path, device):
    """Multiple scattering in cells that differ, by delta tracking: independent runs with one block changed."""
    generator = np.random.default_rng(3)
    a, b = generator.uniform(0.1, 0.5, (4, 4, 4)), generator.uniform(0.5, 3.0, (4, 4, 4))

    def one(**changed):
        path = tmp_path / "cells.npz"
        cells = {"absorption": a.copy(), "scattering": b.copy()}
        for kind, step in changed.items():
            cells[kind][2:, :2, 2:] += step
        np.savez(path, **cells, size=[1.2, 1.2, 1.2])
        grid = {"file": str(path), "translation": [0.0, 0.0, 1.1], "tracking": "delta"}
        return scene(medium={"grid": grid}, targets=BEYOND)

    seeds, photons, bins = 10, 20_000, slice(1, 5)  # 1 to 5 m of path, before and behind the box too
    base = one()
    names = resolve_derivatives(base, WITH_TARGET, (2, 2, 2))
    slope_runs = list(of_seeds(base, device, photons, range(seeds), names))
    p_values = []
    for number, (kind, step) in enumerate({"absorption": 0.1, "scattering": 0.2}.items()):
        block = names.index(f"medium.grid.{kind}[1,0,1]")
        slopes = [run.signed[block].sum(axis=(0, 1, 2))[bins] for run in slope_runs]
        both = []
        for sign in (1, -1):
            changed, first = one(**{kind: sign * step}), 1000 * (2 * number + 3 + sign)
            runs = of_seeds(changed, device, photons, range(first, first + seeds))
            both.append([run.light.sum(axis=(0, 1, 2)) for run in runs])
        differences = (np.array(both[0]) - both[1])[:, bins] / (2.0 * step)
        p_values += list(stats.ttest_ind(slopes, differences, equal_var=False).pvalue)
    assert min(p_values) * len(p_values) > 1e-3, p_values


def test_names_and_what_is_refused(everywhere, tmp_path):
    one = scene(medium={"grid": everywhere})
    assert derivative_names(one) == ("targets[0].reflectance", *NAMES)
    names = resolve_derivatives(one, ["medium.grid.absorption", "reflectance"], (1, 2, 1))
    assert names == ("targets[0].reflectance", "medium.grid.absorption[0,0,0]", "medium.grid.absorption[0,1,0]")
    assert resolve_derivatives(one, names) == names
    path = tmp_path / "clear.npz"
    np.savez(path, absorption=np.ones((2, 2, 2)), scattering=np.zeros((2, 2, 2)), size=[1.0, 1.0, 1.0])
    clear = scene(medium={"grid": {"file": str(path)}})
    assert derivative_names(clear)[1:] == (NAMES[0], NAMES[2])
    walls = {"shape": "box", "lower": [-1.0, -1.0, -0.5], "upper": [1.0, 1.0, 3.0], "outside_index": {"x_low": 1.0}}
    for scene_, asked, blocks, error in (
        (one, NAMES[0], (4, 3, 4), "possible are 1, 2, 5, 10"),
        (one, NAMES[0], (4, 3), "list of 3 whole numbers"),
        (one, "medium.grid.anisotropy", None, "is not one of"),
        (one, names[1], (1, 2, 1), "blocks need names of all blocks"),
        (one, "medium.grid.absorption[0,1,0]", None, "are not all blocks in their order"),
        (one, "absorption", None, "medium.grid.absorption and others go by block"),
        (one, "reflectance", (1, 1, 1), "blocks need derivatives by"),
        (scene(), NAMES[0], None, "has no medium.grid"),
        (clear, NAMES[1], None, "is 0 in 8 of 8 cells"),
        (scene(medium={"grid": everywhere}, domain=walls), NAMES[0], None, "leave out domain.outside_index"),
    ):
        with pytest.raises(spadwarp.SpadwarpError, match=error):
            resolve_derivatives(scene_, [asked], blocks)
    with pytest.raises(spadwarp.ConfigError, match=r"medium.grid.scattering is named twice"):
        resolve_derivatives(one, [NAMES[0], NAMES[1], NAMES[1]])
    with pytest.raises(spadwarp.ArgumentError, match="photon records have no derivatives by block"):
        trace(one, photons=100, device="cpu", derivatives=NAMES[:1])
    large = scene(medium={"grid": everywhere}, camera={"width": 2000, "height": 2000})
    with pytest.raises(spadwarp.ConfigError, match="fewer pixels, bins or blocks"):
        simulate(large, derivatives=WITH_TARGET, blocks=(8, 6, 10), photons=10)
