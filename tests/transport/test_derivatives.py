"""Derivatives of the histogram by the water and the targets: closed forms, identities, agreement of the estimators."""

import numpy as np
import pytest
from scipy import stats

import spadwarp
from helpers.estimators import clear_at_the_lens
from helpers.scenes import PLATE, scene, single_scatter_case
from helpers.statistics_of_samples import equal_means_p
from reference.single_scatter import Lidar, single_scatter
from spadwarp import RunOptions
from spadwarp.result import COMPONENTS
from spadwarp.transport import derivative_names, load_records, resolve_derivatives, save_records, trace

WATER = ("absorption", "scattering", "anisotropy")
ALL = ("medium.absorption", "medium.scattering", "medium.anisotropy", "targets[0].reflectance")


def simulated(one, device, derivatives=ALL, photons=100_000, **choices):
    return spadwarp.simulate(one, photons=photons, device=device, derivatives=derivatives, **choices)


def sums(result):
    """Components of the histogram and of its derivatives, each pixel and bin together: [1 + derivatives, 3]."""
    cubes = [np.stack([result.component(name) for name in COMPONENTS]), *result.derivatives.values()]
    return np.array([cube.sum(axis=(1, 2, 3)) for cube in cubes])


def within_path_limits(result):
    """Whether -∂h/∂a ÷ h, a mean over the photons of a bin, lies between the paths of its edges."""
    path = -result.derivatives["medium.absorption"].sum(axis=(0, 1, 2))
    light = result.histogram.sum(axis=(0, 1))
    edges, seen = result.path_edges, light > 1e-3 * light.max()
    mean = path[seen] / light[seen]
    assert seen.any()
    return (mean > edges[:-1][seen] - 1e-3).all() and (mean < edges[1:][seen] + 1e-3).all()


@pytest.mark.parametrize("estimator", ["analog", "next_event", "guided"])
def test_the_photons_stay_the_same(estimator, device):
    one = scene(transport={"estimator": estimator})
    plain, result = simulated(one, device, (), 20_000), simulated(one, device, ALL, 20_000)
    np.testing.assert_array_equal(result.tallies, plain.tallies)
    assert result.energy_balance == plain.energy_balance
    assert result.counters == plain.counters
    assert list(result.derivatives) == list(ALL)
    assert not plain.derivatives
    assert within_path_limits(result)


def test_clear_opticsin_closed_form(device):
    """Light that no water has scattered, off one Lambertian plate: h ∝ Γ exp(-(a + b) L)."""
    result = simulated(scene(transport={"estimator": "guided"}), device)
    h, by_a, by_b, by_g, by_reflectance = sums(result)[:, 0]
    assert by_a == pytest.approx(by_b, rel=1e-5)
    assert by_g == 0.0
    assert by_reflectance == pytest.approx(h / PLATE["reflectance"], rel=1e-5)


LIDAR, ONCE = single_scatter_case(10.0, 2.5)


def test_single_scatter_in_closed_form(device):
    """h ∝ b p(g) exp(-(a + b) L), against identities bin by bin and the quadrature of p."""
    result = simulated(scene(**ONCE), device, WATER, 400_000)
    h, by_a, by_b, by_g = (cube.sum(axis=(0, 1, 2)) for cube in (result.histogram[None], *result.derivatives.values()))
    np.testing.assert_allclose(by_b, h / 0.24 + by_a, rtol=1e-4)
    assert within_path_limits(result)
    step = 1e-3
    higher, lower = (
        single_scatter(Lidar(**{**vars(LIDAR), "anisotropy": 0.6 + k * step})).sum(axis=(0, 1)) for k in (1, -1)
    )
    expected = (higher - lower) / (2 * step) / single_scatter(LIDAR).sum(axis=(0, 1))
    np.testing.assert_allclose(by_g / h, expected, rtol=2e-3)


def test_estimators_agree(device):
    """Each component's bins over all pixels, of each derivative."""

    def cells(one, estimator, photons, names):
        one = one.with_overrides({"transport.estimator": estimator})
        runs = [simulated(one, device, names, photons, seed=seed) for seed in range(24)]
        return np.array([np.stack([*run.derivatives.values()]).sum(axis=(2, 3)).ravel() for run in runs])

    for threshold in (1.0, 0.97):  # without and with a near-axis rule that is felt
        one = scene(transport={"axis_threshold": threshold})
        assert equal_means_p(cells(one, "analog", 60_000, ALL), cells(one, "guided", 20_000, ALL)) > 1e-3
    clear, names = clear_at_the_lens(scene()), [f"medium.layers[0].{kind}" for kind in WATER]
    next_event, guided = (cells(clear, name, 20_000, [*names, ALL[3]]) for name in ("next_event", "guided"))
    assert equal_means_p(next_event, guided) > 1e-3


def test_central_differences(device):
    """Totals of the components, against independent runs of changed scenes; the step's own error is below theirs."""
    water = {"absorption": 0.1, "scattering": 0.4, "anisotropy": 0.8}
    steps = {"absorption": 0.01, "scattering": 0.01, "anisotropy": 0.02, "reflectance": 0.1}
    p_values = []
    runs = 16

    def changed(reflectance=PLATE["reflectance"], **medium):
        medium = {**water, **medium}
        coefficients = {"extinction": medium["absorption"] + medium["scattering"]}
        coefficients["albedo"] = medium["scattering"] / coefficients["extinction"]
        targets = [{**PLATE, "reflectance": reflectance}]
        optics = {**coefficients, "anisotropy": medium["anisotropy"]}
        return scene(medium=optics, targets=targets, transport={"estimator": "guided"})

    def totals(seed, **values):
        result = spadwarp.simulate(changed(**values), photons=20_000, seed=seed, device=device)
        return result.tallies.sum(axis=(1, 2, 3)) * (result.unit / result.photons)

    results = [simulated(changed(), device, ALL, 20_000, seed=seed) for seed in range(runs)]
    slopes = np.array([sums(result)[1:] for result in results])
    for number, (name, step) in enumerate(steps.items()):
        value = {**water, "reflectance": PLATE["reflectance"]}[name]
        seeds = [1000 * (number + 1) + seed for seed in range(runs)]
        differences = np.array(
            [(totals(s, **{name: value + step}) - totals(s, **{name: value - step})) / (2 * step) for s in seeds]
        )
        for component in range(3):
            if slopes[:, number, component].any():
                pair = slopes[:, number, component], differences[:, component]
                p_values.append(stats.ttest_ind(*pair, equal_var=False).pvalue)
    assert len(p_values) == 10
    assert min(p_values) * len(p_values) > 1e-3


def test_layers_share_the_derivatives_of_one_water(device):
    """Layers of one water: theirs add up to its own, with the same photons; `medium.anisotropy` is inherited."""
    water = {"extinction": 0.5, "albedo": 0.8}
    layers = [{**water, "start": 0.7}, {**water, "start": 1.6, "anisotropy": 0.8}]
    layered = scene(medium={"layers": layers}, transport={"estimator": "guided"})
    whole = simulated(scene(transport={"estimator": "guided"}), device, ALL, 50_000)
    names = [f"{place}.{kind}" for kind in WATER[:2] for place in ("medium", "medium.layers[0]", "medium.layers[1]")]
    names += ["medium.anisotropy", "medium.layers[1].anisotropy"]
    result = simulated(layered, device, names, 50_000)
    np.testing.assert_allclose(result.tallies, whole.tallies, rtol=1e-4, atol=100)  # on a GPU not to the bit
    parts = {name: cube.sum(axis=(1, 2, 3)) for name, cube in result.derivatives.items()}
    for kind in WATER:
        together = sum(part for name, part in parts.items() if name.endswith(kind))
        np.testing.assert_allclose(together, whole.derivatives[f"medium.{kind}"].sum(axis=(1, 2, 3)), rtol=1e-3)
    # Ballistic light goes through each layer twice.
    ballistic = result.component("ballistic").sum()
    lengths = np.array([-parts[name][0] / ballistic for name in names[:3]])
    assert (lengths / lengths[0] > np.array([0.99, 1.2, 0.8])).all() and lengths[1] == pytest.approx(
        lengths[0] * 0.9 / 0.7, rel=0.02
    )


def test_light_by_way_of_mirrors(device):
    """A closed box of mirrors: one scattering, any number of reflections, index 1."""
    box = {"shape": "box", "lower": [-1.0, -1.0, -0.5], "upper": [1.0, 1.0, 3.0], "max_reflections": 2}
    box |= {"outside_index": {face: 1e6 for face in ("x_low", "x_high", "z_high")}}
    one = scene(
        medium={"extinction": 0.3, "phase_index": 1.0},
        domain=box,
        targets=[],
        transport={"estimator": "guided", "max_collisions": 6},
    )
    result = simulated(one, device, WATER, 100_000)
    assert within_path_limits(result)
    h, by_a, by_b, _ = sums(result)[:, 2]
    scatterings = 0.24 * (by_b - by_a) / h  # mean number of them
    assert 1.0 < scatterings < 3.0


def test_behind_a_port_the_path_is_that_in_water(device):
    distance = 0.5
    port = {"shape": "flat", "distance": distance, "thickness": 0.0}
    one = scene(
        medium={"extinction": 0.2, "albedo": 0.0, "phase_index": 1.34, "group_index": 1.36},
        laser={"half_angle_deg": 2.0, "position": [0.0, 0.0, 0.6]},
        camera={"horizontal_fov_deg": 10.0, "aperture_diameter": 0.02, "port": port},
        gate={"bins": 16},
        targets=[{**PLATE, "translation": [0.0, 0.0, 4.0]}],
        transport={"estimator": "guided"},
    )
    h, by_a = sums(simulated(one, device, ["absorption"], 20_000))[:, 0]
    assert -by_a / h == pytest.approx((4.0 - 0.6) + (4.0 - distance), rel=3e-3)


def test_several_targets_and_a_specular_lobe(device):
    """Γ ∂h/∂Γ counts the Lambertian bounces: one for the ballistic light of each target without a lobe."""
    plates = [
        {**PLATE, "size": [1.5, 3.0], "translation": [-0.75, 0.0, 2.2], "reflectance": 0.3},
        {**PLATE, "size": [1.5, 3.0], "translation": [0.75, 0.0, 2.2], "reflectance": 0.4, "specular": 0.4},
    ]
    names = ["targets[0].reflectance", "targets[1].reflectance"]
    result = simulated(scene(targets=plates, transport={"estimator": "guided"}), device, names, 50_000)
    left = result.component("ballistic")[:, :1].sum()
    assert 0.3 * result.derivatives[names[0]][0][:, :1].sum() == pytest.approx(left, rel=1e-3)
    assert result.derivatives[names[1]][0][:, :1].sum() == 0.0
    right = result.component("ballistic")[:, 3:].sum()
    assert 0.0 < 0.4 * result.derivatives[names[1]][0][:, 3:].sum() < 0.99 * right


def test_errors_between_batches_are_those_between_seeds(device):
    one = scene(transport={"estimator": "guided"})
    runs = [simulated(one, device, ALL, 32_768, seed=seed, uncertainty=True) for seed in range(24)]
    for name in ALL:
        spread = np.std([run.derivatives[name].sum(axis=0) for run in runs], axis=0, ddof=1)
        stated = np.sqrt(np.mean([run.derivative_errors[name] ** 2 for run in runs], axis=0))
        seen = stated > 0.05 * stated.max()
        assert np.median(spread[seen] / stated[seen]) == pytest.approx(1.0, abs=0.1)


def test_runs_with_other_derivatives_are_not_added():
    one, half = scene(transport={"estimator": "guided"}), {"photons": 4096, "uncertainty": True}
    first, other = (
        simulated(one, "cpu", names, **half, run=RunOptions(shard=(k, 2))) for k, names in ((1, ALL), (2, ALL[:2]))
    )
    with pytest.raises(spadwarp.ConfigError, match="list of derivatives"):
        spadwarp.merge([first, other])
    with pytest.raises(spadwarp.ConfigError, match=r"the run to resume has medium.absorption, .* not medium.sc"):
        simulated(one, "cpu", ["scattering"], 4096, run=RunOptions(resume=first))
    with pytest.raises(KeyError, match="none were asked for"):
        simulated(one, "cpu", (), 256).derivatives["medium.absorption"]


def test_records_have_scores(tmp_path):
    """In water alone the score by absorption is minus the path, that by scattering the mean free path's multiple."""
    one = scene(targets=[], gate={"bins": 8})
    records = trace(one, photons=2000, device="cpu", derivatives=WATER)
    np.testing.assert_allclose(records.log_derivatives[:, 0], -records.path, rtol=1e-5)
    scattered = 0.4 * (records.log_derivatives[:, 1] + records.path)
    np.testing.assert_allclose(scattered, np.round(scattered), atol=1e-3)
    loaded = load_records(save_records(records, tmp_path / "records.h5"))
    assert loaded.derivatives == resolve_derivatives(one, WATER)
    np.testing.assert_array_equal(loaded.log_derivatives, records.log_derivatives)


def test_names():
    assert derivative_names(scene()) == ALL
    two = scene(targets=[PLATE, {**PLATE, "translation": [0.0, 0.0, 3.0]}])
    assert resolve_derivatives(two, ["scattering", "targets[1].reflectance"])[0] == "medium.scattering"
    for one, name, error in (
        (two, "reflectance", "one of 2 parameters of the scene; give one of targets"),
        (scene(), "scatering", "did you mean 'medium.scattering'"),
        (scene(targets=[{**PLATE, "reflectance": 0.0}]), "reflectance", "targets\\[0\\].reflectance = 0 has none"),
        (scene(medium={"albedo": 0.0}), "scattering", "medium.scattering = 0 has none"),
        (scene(medium={"albedo": "lu2024"}), "absorption", "lu2024"),
        (scene(medium={"phase_function": "fournier_forand"}), "anisotropy", "not with fournier_forand"),
    ):
        with pytest.raises(spadwarp.ConfigError, match=error):
            resolve_derivatives(one, [name])
    with pytest.raises(spadwarp.ConfigError, match="named twice"):
        resolve_derivatives(scene(), ["absorption", "medium.absorption"])
    with pytest.raises(spadwarp.ArgumentError, match="is not a list of names"):
        resolve_derivatives(scene(), "absorption")
