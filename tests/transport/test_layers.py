"""Stratified water: against closed forms, quadrature and adding; the estimators against each other."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.estimators import SEEDS, agreeing_cells, means
from helpers.scenes import BEYOND, LAYERS, PENCIL, PLATE, WATER, scene
from reference.adding_doubling import stack
from reference.single_scatter import Lidar, single_scatter_total
from spadwarp import simulate
from spadwarp.checks import summary
from spadwarp.scene import Scene
from spadwarp.values import SPEED_OF_LIGHT
from spadwarp.water import water_optics

pytestmark = pytest.mark.physics

MURKY, CLEAR = LAYERS
LAYERED = {"layers": LAYERS}
SAME = {"layers": [{"start": start, "extinction": 0.5, "albedo": 0.8} for start in (0.3, 1.2, 1.21)]}
# To the plate at 2.2 m.
DEPTH = 0.5 * 1.2 + 1.5 * 0.5 + 0.2 * 0.5


@pytest.mark.parametrize(
    "estimator", ["guided", *(pytest.param(one, marks=pytest.mark.slow) for one in ("analog", "next_event"))]
)
def test_layers_of_one_water_are_that_water(estimator, device):
    """Not a bit differs on the CPU; on CUDA the compiler may round differently."""
    transport = {"estimator": estimator}
    plain, layered = (
        simulate(scene(medium=medium, transport=transport), photons=100_000, seed=3, device=device)
        for medium in ({}, SAME)
    )
    assert layered.tallies.any() and layered.energy_report()["exact"]
    if device == "cpu":
        np.testing.assert_array_equal(layered.tallies, plain.tallies)
        assert layered.energy_balance == plain.energy_balance and layered.counters == plain.counters
    else:
        np.testing.assert_allclose(layered.tallies.sum(axis=(1, 2)), plain.tallies.sum(axis=(1, 2)), rtol=1e-3)


@pytest.mark.slow
def test_estimators_agree_through_layers(device):
    cells = agreeing_cells(scene(medium=LAYERED), device, clear=True)
    assert (cells["guided"].reshape(SEEDS, 3, -1).sum(axis=(0, 2)) > 0).all()


@pytest.mark.slow
@pytest.mark.parametrize("estimator", ["next_event", "guided"])
def test_single_scattering_is_that_of_the_quadrature(estimator, device):
    """By bins of 25 cm of path, which show each layer; the plate is black and behind the gate."""
    one = scene(
        medium=LAYERED,
        camera={"aperture_diameter": 0.02},
        gate={"start_ns": 1.5e9 / SPEED_OF_LIGHT, "bin_width_ps": 0.25e12 / SPEED_OF_LIGHT, "bins": 10},
        targets=[{**PLATE, "reflectance": 0.0}],
        transport={"estimator": estimator, "max_collisions": 1},
    )
    reference = Lidar(
        half_angle=math.radians(20.0),
        field_of_view=math.radians(50.0),
        aperture_area=math.pi * 0.01**2,
        extinction=0.5,
        albedo=0.8,
        anisotropy=0.8,
        edges=np.arange(1.5, 4.0 + 1e-9, 0.0125),
        layers=((1.2, 1.5, 0.6, 0.5), (1.7, 0.2, 0.9, 0.8)),
    )
    expected = single_scatter_total(reference, order=60).reshape(-1, 20).sum(axis=1)
    mean, error, *_ = means(one, device, 30_000, 16)
    # 0.2 %: the quadrature, whose nodes do not know where the layers begin.
    assert (np.abs(mean - expected) < 4.0 * error + 0.002 * expected).all(), (mean - expected) / error
    assert (error < 0.05 * expected).all()


@pytest.mark.slow
def test_a_slab_of_three_layers_passes_and_returns_what_adding_says(device):
    one = scene(
        medium=LAYERED,
        laser={**PENCIL, "frame": "world", "direction": [0.0, 0.0, 1.0]},
        camera={"rotation_deg": [10.0, 20.0, 30.0]},
        domain={"shape": "slab", "lower": 0.0, "upper": 3.0},
        targets=BEYOND,
        transport={"max_path": 1000.0, "weight_cutoff": 1e-5, "max_collisions": 1000},
    )
    count = 400_000
    records = spadwarp.transport.trace(one, photons=count, seed=5, device=device)
    reflected, transmitted = (records.weight[records.ended(face)] for face in ("exit_z_low", "exit_z_high"))
    expected = stack([(0.8, 0.8, 0.6), (0.5, 0.6, 0.75), (0.8, 0.9, 0.26)])
    for part, exact in zip((reflected, transmitted), expected, strict=True):
        mean = part.sum() / count
        error = math.sqrt(((part**2).sum() / count - mean**2) / count)
        assert mean == pytest.approx(exact, abs=4.0 * error)
    # What never collided: Beer and Lambert.
    passed = (records.collisions == 0).mean()
    depth = one.medium.optical_depth((0.0, 0.0, 0.0), (0.0, 0.0, 3.0))
    assert passed == pytest.approx(math.exp(-depth), abs=4.0 * math.sqrt(math.exp(-depth) / count))


def test_layers_may_be_counted_from_the_far_side():
    """The axis turned round, and of any length: the same water."""
    layers = [{**MURKY, "start": -1.7}, {"start": -1.2, "extinction": 0.5, "albedo": 0.8}]
    turned = {**WATER, "extinction": 0.2, "albedo": 0.9, "layer_axis": [0.0, 0.0, -2.0], "layers": layers}
    one, other = (simulate(scene(medium=medium), photons=50_000, seed=3, device="cpu") for medium in (LAYERED, turned))
    # The tallies' unit is chosen from the first water.
    np.testing.assert_allclose(one.histogram.sum(axis=(0, 1)), other.histogram.sum(axis=(0, 1)), rtol=1e-3)


# Configuration


def test_layers_survive_the_way_through_toml(tmp_path):
    layers = [{"start": -1, "preset": "uwoc-harbour"}, {"start": 2.0, "chlorophyll": 0.5}]
    layers += [{"start": 2.5, "absorption": 0.1, "extinction": 0.4, "anisotropy": 0.7}]
    one = scene(medium={"layer_axis": [0.0, 1.0, 0.0], "layers": layers})
    path = tmp_path / "scene.toml"
    path.write_text(one.to_toml())
    assert path.read_text().count("[[medium.layers]]") == 3
    again = spadwarp.load_scene(path)
    assert again == one and hash(again) == hash(one) and again.to_toml() == one.to_toml()
    blue = again.with_overrides({"laser.wavelength_nm": 450.0})
    assert blue.medium.layers[1].absorption == water_optics(450.0, chlorophyll=0.5).absorption
    assert blue.medium.layers[0].anisotropy == 0.924 and blue.medium.layers[1].anisotropy is None
    assert one.with_overrides({"medium.layers": None}).medium.layers == ()


@pytest.mark.parametrize(
    ("medium", "text"),
    [
        ({"layers": [MURKY, MURKY]}, "medium.layers[1].start = 1.2 is outside (1.2, inf) m, the layer before it"),
        ({"layers": [{"start": 1.0}]}, "medium.layers[0] needs exactly two of"),
        ({"layers": [{**MURKY, "albedo": "lu2024"}]}, "medium.layers[0].albedo = 'lu2024' does not go with 0.8"),
        ({"layers": [{**MURKY, "group_index": 1.3}]}, "medium.layers[0].group_index is not a known field"),
        (
            {"phase_function": "fournier_forand", "layers": [MURKY]},
            "medium.layers[0].anisotropy = 0.5 goes with phase_function = 'henyey_greenstein' only",
        ),
        ({"layers": [MURKY], "layer_axis": [0.0, 0.0, 0.0]}, "medium.layer_axis = [0.0, 0.0, 0.0] has no length"),
    ],
)
def test_layers_that_cannot_be_are_refused(medium, text):
    with pytest.raises(spadwarp.ConfigError) as caught:
        scene(medium=medium)
    assert str(caught.value).startswith(text)


def test_optical_depth_along_and_across_layers():
    medium = scene(medium=LAYERED).medium
    assert medium.optical_depth((0.0, 0.0, 0.0), (0.0, 0.0, 1.0)) == pytest.approx(0.5)
    assert medium.optical_depth((1.0, 0.0, 1.5), (4.0, 4.0, 1.5)) == pytest.approx(5.0 * 1.5)
    there, back = medium.optical_depth((0.0, 0.0, 1.0), (3.0, 0.0, 5.0)), medium.optical_depth((3, 0, 5), (0, 0, 1))
    assert there == back == pytest.approx(5.0 / 4.0 * (0.2 * 0.5 + 0.5 * 1.5 + 3.3 * 0.2))
    assert medium.optical_depth((0.0, 0.0, 1.5), (0.0, 0.0, 1.5)) == 0.0


def test_checks_and_the_analytic_simulator_know_of_layers():
    one = scene(medium=LAYERED, camera={"aperture_diameter": 0.02})
    printed = summary(one)
    assert printed["optical_depth"] == pytest.approx(DEPTH * printed["target_range"][0] / 2.2)
    assert [(layer["start"], layer["albedo"]) for layer in printed["layers"]] == [(1.2, 0.6), (1.7, pytest.approx(0.9))]
    assert [layer["attenuation_length"] for layer in printed["layers"]] == pytest.approx([1 / 1.5, 1 / 0.2])
    with pytest.raises(spadwarp.ConfigError, match=r"medium\.layers: 2 given; the analytic simulator takes one water"):
        spadwarp.simulate_analytic(one, device="cpu")
    harbour = {"layers": [{"start": 1.0, "preset": "uwoc-harbour"}]}
    blue = Scene.from_dict({**scene(medium=harbour).to_dict(), "laser": {"wavelength_nm": 450.0}})
    assert [message.field for message in spadwarp.check(blue) if message.field.endswith("preset")] == [
        "medium.layers[0].preset"
    ]
