"""Raman scattering and fluorescence: against quadrature, a walk that changes its wavelength, and closed forms."""

import math

import numpy as np
import pytest

import spadwarp
import spadwarp_kernels as sk
from helpers.runs import of_seeds
from helpers.scenes import BEYOND, PENCIL, scene
from helpers.statistics_of_samples import equal_means_p
from reference.walk import scattering_cosine, turned
from spadwarp.result import analyser_channel
from spadwarp.scene.medium import Inelastic, Medium
from spadwarp.values import ConfigError

pytestmark = pytest.mark.physics

EDGES = np.linspace(3.0, 7.0, 5)  # of path [m]
RAMAN = {"process": "raman", "coefficient": 2e-3, "absorption": 0.3, "scattering": 0.15}
GLOW = {"process": "fluorescence", "coefficient": 1e-2, "absorption": 0.5, "passed": 0.5}
A = Inelastic(process="raman", absorption=0.3).anisotropy


def pencil(*lines, medium=(), camera=(), **transport):
    """Light of a pencil beam at x = -0.1 m that is scattered in the view of 50° of a lens at the origin."""
    water = {"absorption": 0.1, "scattering": 0.2, "extinction": None, "albedo": None, "group_index": 1.0}
    gate = {"start_ns": EDGES[0] / 0.299792458, "bin_width_ps": 1e3 / 0.299792458, "bins": len(EDGES) - 1}
    return scene(
        medium={**water, "inelastic": list(lines), **dict(medium)},
        laser={**PENCIL, "position": [-0.1, 0.0, 0.0]},
        camera={"aperture_diameter": 0.01, **dict(camera)},
        gate=gate,
        targets=BEYOND,
        transport={"max_collisions": 1, "estimator": "guided", **transport},
    )


DEEPER = {"start": 2.3, "absorption": 0.25, "scattering": 0.4}


def by_path(run, channel=0):
    """Light of a channel by bin, all pixels and components together."""
    return run.signed[channel].sum(axis=(0, 1, 2))


def quadrature(extinction, new, coefficient, anisotropy, start=math.inf):
    """What is scattered once, with the extinction before and the new one after it: two of each, of the water up to
    `start` [m] and beyond."""
    z = np.linspace(0.3, 8.0, 100_001)
    r, area, deep = np.hypot(0.1, z), math.pi * 0.005**2, np.clip(z - start, 0.0, z)
    p = (1.0 + anisotropy * (z / r) ** 2) / (4.0 * math.pi * (1.0 + anisotropy / 3.0))
    before, after = (c[0] * (z - deep) + c[1] * deep for c in (extinction, new))
    light = np.where(z > start, *coefficient[::-1]) * p * np.exp(-before - after * r / z) * area * z / r**3
    bins = np.digitize(z + r, EDGES) - 1
    return np.array([np.trapezoid(np.where(bins == k, light, 0.0), z) for k in range(len(EDGES) - 1)])


@pytest.mark.parametrize("estimator", ["guided", pytest.param("next_event", marks=pytest.mark.slow)])
def test_single_scatter_is_the_quadrature_with_both_coefficients(estimator, device):
    one = pencil(RAMAN, GLOW, estimator=estimator)
    (run,) = of_seeds(one, device, 400_000, [1])
    for k, (new, b, anisotropy) in enumerate(((0.45, 2e-3, A), (0.7, 5e-3, 0.0))):
        expected = quadrature((0.3, 0.3), (new, new), (b, b), anisotropy)
        assert by_path(run, k).sum() == pytest.approx(expected.sum(), rel=5e-3)
        np.testing.assert_allclose(by_path(run, k), expected, rtol=2e-2)


@pytest.mark.slow
@pytest.mark.parametrize("start", [2.3, -5.0])
def test_each_layer_has_coefficients_of_its_own(start, device):
    """Two waters, and two of which the second is everywhere in sight, against quadrature of single scattering."""
    line = {**RAMAN, "coefficient": [2e-3, 8e-3], "absorption": [0.3, 0.1], "scattering": [0.15, 0.05]}
    (run,) = of_seeds(pencil(line, medium={"layers": [{**DEEPER, "start": start}]}), device, 100_000, [1])
    expected = quadrature((0.3, 0.65), (0.45, 0.15), (2e-3, 8e-3), A, start)
    assert by_path(run).sum() == pytest.approx(expected.sum(), rel=1e-2)
    np.testing.assert_allclose(by_path(run), expected, rtol=3e-2)


@pytest.mark.slow
def test_estimators_agree_under_a_sea_and_in_layers():
    """Light of another wavelength by way of a rough surface, out of two waters."""
    line = {**RAMAN, "coefficient": [0.05, 0.1], "absorption": [0.3, 0.1]}
    layers = [{"start": 1.0, "absorption": 0.25, "scattering": 0.4}]
    water = {"absorption": 0.1, "scattering": 0.4, "extinction": None, "albedo": None}
    found = {}
    for estimator, photons in (("guided", 20_000), ("analog", 100_000)):
        one = scene(
            medium={**water, "inelastic": [line], "layers": layers},
            surface={"point": [0.0, 0.0, 0.6], "up": [0.0, 0.0, -1.0], "wind": 5.0},
            laser={"position": [-0.3, 0.0, 0.2]},
            camera={"aperture_diameter": 0.5},
            transport={"estimator": estimator},
        )
        runs = of_seeds(one, "cpu", photons, range(12))
        found[estimator] = np.array([run.signed[0].sum(axis=(1, 2)).ravel() for run in runs])
    assert equal_means_p(found["analog"], found["guided"], 0.5) > 1e-3
    assert found["guided"].sum() > 0.0


@pytest.mark.slow
def test_alike_waters_bring_a_share_of_each_scattering(device):
    """Where light keeps its coefficients and its phase function, what has become Raman light is b_R times the sum of
    1/b over the scatterings: b_R (∂/∂b - ∂/∂a) of all light."""
    law = {"phase_function": "rayleigh", "depolarisation_ratio": (1.0 - A) / (1.0 + A), "anisotropy": None}
    same = {**RAMAN, "absorption": 0.1, "scattering": 0.2}
    one = pencil(same, medium=law, max_collisions=8)
    (run,) = of_seeds(one, device, 20_000, [1])
    plain = one.with_overrides({"medium.inelastic": []})
    (slopes,) = of_seeds(plain, device, 20_000, [1], ["absorption", "scattering"])
    np.testing.assert_allclose(run.light, slopes.light, rtol=0.0 if device == "cpu" else 1e-5, atol=1e-20)
    np.testing.assert_allclose(by_path(run), 2e-3 * (by_path(slopes, 1) - by_path(slopes, 0)), rtol=1e-3)


def test_energy_balance_has_what_becomes_other_light(device):
    """Of all light that water takes, each process takes its part of the absorption."""
    one = pencil(RAMAN, GLOW, max_collisions=8)
    (run,) = of_seeds(one, device, 20_000, [1])
    (plain,) = of_seeds(one.with_overrides({"medium.inelastic": []}), device, 20_000, [1])
    balance, taken = run.energy_balance, plain.energy_balance["absorbed_water"]
    assert sum(balance[name] for name in ("absorbed_water", "raman", "fluorescence")) == taken
    for name, coefficient in (("raman", 2e-3), ("fluorescence", 1e-2)):
        assert balance[name] == pytest.approx(taken * coefficient / 0.1, rel=1e-5)
    assert {name: n for name, n in balance.items() if name not in ("absorbed_water", "raman", "fluorescence")} == {
        name: n for name, n in plain.energy_balance.items() if name != "absorbed_water"
    }


def walk(count, rng, *, raman, new, events, g=0.5, extinction=0.3, scattering=0.2, radius=0.2):
    """Raman light by path through a lens in the plane z = 0, by photons that change their wavelength at a collision."""
    x, u = np.tile([-0.1, 0.0, 0.0], (count, 1)), np.tile([0.0, 0.0, 1.0], (count, 1))
    path, weight, shifted = np.zeros(count), np.ones(count), np.zeros(count, bool)
    found, tangent = np.zeros(len(EDGES) - 1), math.tan(math.radians(25.0))
    for _ in range(events + 1):
        length = -np.log(1.0 - rng.random(len(x))) / np.where(shifted, sum(new), extinction)
        to_plane = -x[:, 2] / np.where(u[:, 2] < 0.0, u[:, 2], -1.0)
        seen = (u[:, 2] < 0.0) & (np.abs(u[:, :2]).max(axis=1) < -tangent * u[:, 2]) & shifted
        at = np.hypot(*(x + to_plane[:, None] * u).T[:2])
        seen &= (to_plane > 0.0) & (to_plane < length) & (at < radius)
        found += np.histogram((path + to_plane)[seen], EDGES, weights=weight[seen])[0]
        x, path = x + length[:, None] * u, path + length
        turns = ~shifted & (rng.random(len(x)) < raman / (scattering + raman))
        weight = weight * np.where(shifted, new[1] / sum(new), (scattering + raman) / extinction)
        shifted = shifted | turns
        elastic = scattering_cosine(g, rng, len(x))
        even, cosine = rng.random(len(x)) < 1.0 / (1.0 + A / 3.0), 2.0 * rng.random(len(x)) - 1.0
        u = turned(u, np.where(turns, np.where(even, cosine, np.cbrt(cosine)), elastic), rng)
        kept = path < EDGES[-1]
        x, u, path, weight, shifted = x[kept], u[kept], path[kept], weight[kept], shifted[kept]
    return found / count


@pytest.mark.slow
def test_light_scattered_often_is_that_of_photons_that_change_their_wavelength(device):
    """Against a walk in NumPy, and of the estimators to each other."""
    rng = np.random.default_rng(1)
    expected = np.array([walk(250_000, rng, raman=0.1, new=(0.1, 0.25), events=6) for _ in range(20)])
    line = {**RAMAN, "coefficient": 0.1, "absorption": 0.1, "scattering": 0.25}
    for estimator, photons in (("analog", 100_000), ("next_event", 20_000), ("guided", 20_000)):
        lens = {"aperture_diameter": 0.4}
        one = pencil(line, medium={"anisotropy": 0.5}, camera=lens, max_collisions=6, estimator=estimator)
        found = np.array([by_path(run) for run in of_seeds(one, device, photons, range(20))])
        assert equal_means_p(found, expected, 0.5) > 1e-3, estimator


def test_fluorescence_decays():
    """Behind a black plate nothing is lit: there the light falls by exp(-Δt/τ) from bin to bin, and none is lost."""
    gate = {"start_ns": 0.0, "bin_width_ps": 200.0, "bins": 200}
    plate = {"builtin": "plane", "size": [4.0, 4.0], "translation": [0.0, 0.0, 2.0], "reflectance": 0.0}
    one = pencil(RAMAN, GLOW).with_overrides({"gate": gate, "targets": [plate]})
    prompt, late = (
        spadwarp.simulate(
            one.with_overrides({"medium.inelastic[1].decay_time_ns": decay}), photons=20_000, device="cpu"
        )
        for decay in (0.0, 1.5)
    )
    before, after = (each.channels["fluorescence"].sum(axis=(0, 1, 2)) for each in (prompt, late))
    assert after.sum() == pytest.approx(before.sum(), rel=1e-4)  # 40 ns of gate
    dark = np.flatnonzero(before)[-1] + 1
    tail = after[dark : dark + 20]
    np.testing.assert_allclose(tail[1:] / tail[:-1], math.exp(-0.2 / 1.5), rtol=1e-3)
    middle = np.arange(200) * 0.2
    assert (after @ middle - before @ middle) / before.sum() == pytest.approx(1.5, rel=1e-3)
    alone = analyser_channel(late, "fluorescence")
    np.testing.assert_allclose(alone.histogram.sum(axis=(0, 1)), after, rtol=1e-9)
    assert not alone.scene.medium.inelastic and not alone.channels


def test_raman_coefficient_is_that_of_bartlett():
    line = Inelastic(process="raman", absorption=0.3)
    water = [Medium(absorption=0.1, scattering=0.2)]
    assert line.in_waters(water, 488.0) == [(2.7e-4, 0.5, 0.2)]
    assert line.in_waters(water, 532.0)[0][0] == pytest.approx(1.71e-4, rel=2e-3)
    # p = 0.0673 (1 + 0.550 cos²θ), of unit integral.
    found = sk.make_lines([1e-4], [A], [0.3], [0.1], [1.0], media=[sk.make_medium(0.1, 0.1)], device="cpu")
    assert found.even[0] == pytest.approx(0.0673, abs=5e-5)
    assert pytest.approx(0.550, abs=5e-4) == A


@pytest.mark.parametrize(
    ("lines", "medium", "text"),
    [
        ([RAMAN, RAMAN], {}, "not different processes"),
        ([{**RAMAN, "coefficient": 0.2}], {}, "it can take no more"),
        ([{**GLOW, "coefficient": None}], {}, "needs coefficient"),
        ([{**RAMAN, "decay_time_ns": 1.0}], {}, "goes with process = 'fluorescence' only"),
        ([RAMAN], {"albedo": "lu2024", "extinction": 0.5, "absorption": None, "scattering": None}, "takes one water"),
        ([{**RAMAN, "absorption": [0.3, 0.3, 0.3]}], {"layers": [DEEPER]}, "3 given; one for all water, or 2"),
        ([{**RAMAN, "coefficient": [2e-3, 0.3]}], {"layers": [DEEPER]}, "it can take no more"),
        ([RAMAN], {"grid": {"shape": "cloud", "size": 1.0, "extinction": 1.0}}, "neither with grid"),
    ],
)
def test_what_inelastic_scattering_excludes_is_named(lines, medium, text):
    with pytest.raises(ConfigError, match=text):
        pencil(*lines, medium=medium)
