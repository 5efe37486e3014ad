"""Derivatives of the histogram by the water and the targets: closed forms, identities, agreement of the estimators."""

import numpy as np
import pytest

import spadwarp
from helpers.runs import of_seeds
from helpers.scenes import ELSEWHERE, PLATE, scene, single_scatter_case
from helpers.statistics_of_samples import equal_means_p
from reference.single_scatter import Lidar, single_scatter
from spadwarp import RunOptions
from spadwarp.result import COMPONENTS
from spadwarp.transport import derivative_names, load_records, resolve_derivatives, save_records, trace

WATER = ("absorption", "scattering", "anisotropy")
ALL = ("medium.absorption", "medium.scattering", "medium.anisotropy", "targets[0].reflectance")  # one kernel for most


def simulated(one, device, derivatives=ALL, photons=100_000, **choices):
    return spadwarp.simulate(one, photons=photons, device=device, derivatives=derivatives, **choices)


def layered(medium=(), **sections):
    return scene(medium={"layers": ELSEWHERE, **dict(medium)}, **sections)


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


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["analog", "guided"])
def test_the_photons_stay_the_same(estimator, device):
    one = layered(transport={"estimator": estimator})
    plain, result = simulated(one, device, (), 20_000), simulated(one, device, ALL, 20_000)
    # On a GPU two kernels round differently, in the last unit of large tallies.
    np.testing.assert_allclose(result.tallies, plain.tallies, rtol=0.0 if device == "cpu" else 1e-6)
    if device == "cpu":
        assert result.energy_balance == plain.energy_balance
    assert result.counters == plain.counters
    assert list(result.derivatives) == list(ALL) and not plain.derivatives
    assert within_path_limits(result)
    # Light that no water has scattered, off one Lambertian plate: h ∝ Γ exp(-(a + b) L).
    h, by_a, by_b, by_g, by_reflectance = sums(result)[:, 0]
    assert by_a == pytest.approx(by_b, rel=1e-5) and by_g == 0.0
    assert by_reflectance == pytest.approx(h / PLATE["reflectance"], rel=1e-5)


LIDAR, ONCE = single_scatter_case(10.0, 2.5)


def test_single_scatter_in_closed_form(device):
    """h ∝ b p(g) exp(-(a + b) L), against identities bin by bin and the quadrature of p."""
    one = scene(**ONCE | {"medium": ONCE["medium"] | {"layers": ELSEWHERE}})
    result = simulated(one, device, ALL, 400_000)
    cubes = [result.histogram[None], *result.derivatives.values()]
    h, by_a, by_b, by_g, _ = (cube.sum(axis=(0, 1, 2)) for cube in cubes)
    np.testing.assert_allclose(by_b, h / 0.24 + by_a, rtol=1e-4)
    assert within_path_limits(result)
    step = 1e-3
    beside = (Lidar(**{**vars(LIDAR), "anisotropy": 0.6 + k * step}) for k in (1, -1))
    higher, lower = (single_scatter(one).sum(axis=(0, 1)) for one in beside)
    expected = (higher - lower) / (2 * step) / single_scatter(LIDAR).sum(axis=(0, 1))
    np.testing.assert_allclose(by_g / h, expected, rtol=2e-3)


@pytest.mark.slow
def test_estimators_agree(device):
    """Each component's bins over all pixels, of each derivative, without and with a near-axis rule that is felt."""

    def cells(one, estimator, photons):
        one = one.with_overrides({"transport.estimator": estimator})
        runs = of_seeds(one, device, photons, range(16), ALL)
        return np.array([run.signed.sum(axis=(2, 3)).ravel() for run in runs])

    for threshold in (1.0, 0.97):
        one = layered(transport={"axis_threshold": threshold})
        assert equal_means_p(cells(one, "analog", 40_000), cells(one, "guided", 20_000)) > 1e-3


def test_layers_share_the_derivatives_of_one_water(device):
    """Layers of one water: theirs add up to its own, with the same photons; `medium.anisotropy` is inherited."""
    water = {"extinction": 0.5, "albedo": 0.8}
    layers = [{**water, "start": 0.7}, {**water, "start": 1.6, "anisotropy": 0.8}]
    whole = simulated(scene(), device, [ALL[0], ALL[1], ALL[3]], 50_000)
    parts = {}
    own = "medium.layers[1]"
    for place, inherits in (("medium", "medium"), ("medium.layers[0]", "medium"), (own, own)):
        names = [f"{place}.absorption", f"{place}.scattering", f"{inherits}.anisotropy", ALL[3]]
        result = simulated(layered({"layers": layers}), device, names, 50_000)
        np.testing.assert_allclose(result.tallies, whole.tallies, rtol=1e-4, atol=100)  # on a GPU not to the bit
        parts |= {name: cube.sum(axis=(1, 2, 3)) for name, cube in result.derivatives.items()}
    of_one = {**simulated(layered(), device, ALL, 50_000).derivatives, **whole.derivatives}
    for kind in WATER:
        together = sum(part for name, part in parts.items() if name.endswith(kind))
        np.testing.assert_allclose(together, of_one[f"medium.{kind}"].sum(axis=(1, 2, 3)), rtol=1e-3)
    # Ballistic light goes through each layer twice.
    ballistic = result.component("ballistic").sum()
    first, second, third = (-part[0] / ballistic for name, part in parts.items() if name.endswith("absorption"))
    assert second > 1.2 * first and third > 0.8 * first and second == pytest.approx(first * 0.9 / 0.7, rel=0.02)


# Behind a port, among mirrors, with facets: one kernel
MIRRORS = {"shape": "box", "lower": [-1.0, -1.0, -0.5], "upper": [1.0, 1.0, 3.0], "max_reflections": 2}
MIRRORS |= {"outside_index": {face: 1e6 for face in ("x_low", "x_high", "z_high")}}
HALVES = [
    {**PLATE, "size": [1.5, 3.0], "translation": [-0.75, 0.0, 4.0], "reflectance": 0.3},
    {**PLATE, "size": [1.5, 3.0], "translation": [0.75, 0.0, 4.0], "reflectance": 0.4, "specular": 0.4},
]
NAMES = (*ALL, "targets[1].reflectance")


@pytest.mark.filterwarnings("ignore:.*rounding to the histogram:RuntimeWarning")  # of what the water scatters
@pytest.mark.slow
def test_behind_a_port_the_path_is_that_in_water_and_lambertian_bounces_are_counted(device):
    """Γ ∂h/∂Γ is the ballistic light of each target without a lobe, and a part of that of one with."""
    distance = 0.5
    one = scene(
        medium={"extinction": 0.2, "albedo": 1e-6, "phase_index": 1.34, "group_index": 1.36},
        laser={"half_angle_deg": 2.0, "position": [0.0, 0.0, 0.6]},
        camera={"horizontal_fov_deg": 10.0, "aperture_diameter": 0.02, "port": {"shape": "flat", "distance": distance}},
        domain={**MIRRORS, "lower": [-9.0, -9.0, -9.0], "upper": [9.0, 9.0, 9.0]},
        gate={"bins": 16},
        targets=HALVES,
    )
    result = simulated(one, device, NAMES, 50_000)
    light, by_a = result.component("ballistic"), result.derivatives["medium.absorption"][0]
    assert -by_a.sum() / light.sum() == pytest.approx((4.0 - 0.6) + (4.0 - distance), rel=3e-3)
    lambertian, glossy = (result.derivatives[name][0] for name in NAMES[3:])
    assert 0.3 * lambertian[:, :2].sum() == pytest.approx(light[:, :2].sum(), rel=1e-3)
    assert glossy[:, :2].sum() < 1e-3 * light[:, :2].sum()
    assert 0.0 < 0.4 * glossy[:, 2:].sum() < 0.99 * light[:, 2:].sum()


@pytest.mark.slow
def test_errors_between_batches_are_those_between_seeds(device):
    runs = [simulated(layered(), device, ALL, 32_768, seed=seed) for seed in range(24)]
    for name in ALL:
        spread = np.std([run.derivatives[name].sum(axis=0) for run in runs], axis=0, ddof=1)
        stated = np.sqrt(np.mean([run.derivative_errors[name] ** 2 for run in runs], axis=0))
        seen = stated > 0.05 * stated.max()
        assert np.median(spread[seen] / stated[seen]) == pytest.approx(1.0, abs=0.1)


def test_runs_with_other_derivatives_are_not_added():
    targets = [{**PLATE, "size": [1.0, 1.0], "translation": [x, 0.0, 2.2]} for x in (-0.6, 0.6)]
    one, half = layered(targets=targets), {"photons": 4096}
    first, other = (
        simulated(one, "cpu", [*ALL[:3], f"targets[{k}].reflectance"], **half, run=RunOptions(shard=(k + 1, 2)))
        for k in (0, 1)
    )
    with pytest.raises(spadwarp.ConfigError, match="list of derivatives"):
        spadwarp.merge([first, other])
    with pytest.raises(spadwarp.ConfigError, match=r"the run to resume has medium.absorption, .* not medium.sc"):
        simulated(one, "cpu", ["medium.scattering"], 4096, run=RunOptions(resume=first))
    with pytest.raises(KeyError, match="none were asked for"):
        simulated(scene(), "cpu", (), 256).derivatives["medium.absorption"]


@pytest.mark.slow
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
