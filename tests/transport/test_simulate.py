"""Weight that `simulate` and `trace` account for to the last unit: every history ends for a reason."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

import spadwarp
from helpers.runs import of_seeds
from helpers.scenes import scene
from spadwarp import simulate
from spadwarp.scene.pose import rotation_matrix

WIDE = {"shape": "box", "lower": -60.0, "upper": 60.0}  # that no light of the gate leaves


@settings(max_examples=15)
@given(
    extinction=st.floats(0.01, 20),
    albedo=st.floats(0, 1),
    anisotropy=st.floats(-0.9, 0.99),
    weight_cutoff=st.sampled_from([0.0, 2e-4, 0.3]),
    max_collisions=st.integers(1, 200),
    max_path=st.floats(0.01, 60),
    lateral_limit=st.floats(0.05, 50),
    reflectance=st.floats(0, 1),
    seed=st.integers(0, 2**64 - 1),
)
@pytest.mark.filterwarnings("ignore:.*rounding to the histogram's unit:RuntimeWarning")  # nearly black targets
@pytest.mark.parametrize(
    ("estimator", "termination"), [pytest.param("next_event", "cutoff", marks=pytest.mark.slow), ("guided", "roulette")]
)
def test_the_ledger_closes_exactly(estimator, termination, **values):
    """Emitted weight = the sum of all entries, in integers, for random waters, limits and targets in a box of water."""
    limits = ("weight_cutoff", "max_collisions", "max_path", "lateral_limit")
    transport = {"estimator": estimator, **{name: values[name] for name in limits}}
    one = scene(
        medium={name: values[name] for name in ("extinction", "albedo", "anisotropy")},
        domain={"shape": "box", "lower": [-3.0, -2.0, -1.0], "upper": [3.0, 2.0, 4.0]},
        targets=[{"builtin": "box", "size": [0.9], "translation": [0.2, 0, 1.5], "reflectance": values["reflectance"]}],
        transport=transport | {"termination": termination},
    )
    result = simulate(one, photons=2000, seed=values["seed"], device="cpu")
    report = result.energy_report()
    assert report["difference"] == 0 and report["exact"]
    assert result.counters["invalid"] == 0
    entries = {
        name: value
        for name, value in result.energy_balance.items()
        if name not in ("roulette", "importance_sampling_residual")
    }
    assert all(value >= 0 for value in entries.values())


@pytest.mark.physics
def test_signed_entries_of_the_ledger_have_expectation_zero(device):
    """Guided directions and roulette move weight between photons and create none, on the mean over 20 seeds."""
    one = scene(domain=WIDE, transport={"termination": "roulette", "weight_cutoff": 0.2})
    rows = [run.energy_balance for run in of_seeds(one, device, 20_000, range(20))]
    for name in ("importance_sampling_residual", "roulette"):
        values = np.array([row[name] for row in rows], np.float64)
        assert values.std() > 0
        assert abs(values.mean()) < 4.5 * values.std(ddof=1) / np.sqrt(len(values))


@pytest.mark.physics
def test_roulette_leaves_the_expectation_alone_and_the_cutoff_does_not(device):
    """With an absurd cut-off the rule of the paper loses light that scattered more than once; roulette loses none."""
    values = {}
    for name, transport in {
        "exact": {"weight_cutoff": 0.0, "termination": "roulette"},
        "roulette": {"weight_cutoff": 0.85, "termination": "roulette"},
        "cutoff": {"weight_cutoff": 0.85},
    }.items():
        domain = WIDE if "termination" in transport else {}
        one = scene(domain=domain, transport={"max_collisions": 40, **transport})
        runs = of_seeds(one, device, 20_000, range(20))
        values[name] = np.array([run.light[2].sum() for run in runs])  # backscatter
    error = {name: v.std(ddof=1) / np.sqrt(20) for name, v in values.items()}
    mean = {name: v.mean() for name, v in values.items()}
    assert abs(mean["roulette"] - mean["exact"]) < 4 * np.hypot(error["roulette"], error["exact"])
    assert mean["exact"] - mean["cutoff"] > 10 * np.hypot(error["cutoff"], error["exact"])


@pytest.mark.physics
def test_a_closed_target_keeps_its_light(device):
    """A laser inside a closed box of reflectance 0.9: no weight leaves the domain around it."""
    one = scene(
        medium={"extinction": 0.1, "albedo": 0.9},
        laser={"half_angle_deg": 180.0, "position": [0.1, 0.2, 1.3]},
        targets=[{"builtin": "box", "size": [1.0], "translation": [0.0, 0.0, 1.5], "reflectance": 0.9}],
        domain={"shape": "box", "lower": [-0.6, -0.6, 0.0], "upper": [0.6, 0.6, 2.1]},
        transport={"termination": "roulette", "weight_cutoff": 0.0, "max_collisions": 100},
    )
    result = simulate(one, photons=20_000, seed=1, device=device)
    assert sum(value for name, value in result.energy_balance.items() if name.startswith("exit")) == 0
    assert not result.tallies.any()
    assert result.counters["surface_events"] > 20_000


def test_every_light_path_ends_for_a_reason_and_records_agree_with_the_ledger(device):
    one = scene(
        domain={"shape": "slab", "lower": 0.0, "upper": 2.0},
        targets=[],
        camera={"rotation_deg": [10.0, 20.0, 30.0]},
        laser={"frame": "world", "direction": [0.0, 0.0, 1.0], "position": [0, 0, 0]},
        transport={"max_path": 6.0, "lateral_limit": 2.5, "max_collisions": 5},
    )
    records = spadwarp.transport.trace(one, photons=50_000, seed=4, device=device)
    assert sum(records.energy_balance.values()) == round(50_000 / records.energy_balance_unit)
    for name in ("exit_z_low", "exit_z_high", "max_path", "max_collisions", "lateral_limit"):
        ended = records.ended(name)
        assert ended.any()
        # Weights are rounded to half a ledger unit each.
        expected = records.weight[ended].sum(dtype=np.float64) / records.energy_balance_unit
        assert abs(records.energy_balance[name] - expected) <= 0.5 * ended.sum() + 1e-6 * expected
    np.testing.assert_allclose(records.position[records.ended("exit_z_high"), 2], 2.0, atol=2e-6)
    np.testing.assert_allclose(np.linalg.norm(records.direction, axis=1), 1.0, atol=1e-6)
    assert (records.collisions[records.ended("max_collisions")] == 5).all()
    np.testing.assert_allclose(records.path[records.ended("max_path")], 6.0, rtol=1e-6)
    aside = records.position[records.ended("lateral_limit")] @ rotation_matrix((10.0, 20.0, 30.0))  # as the camera sees
    np.testing.assert_allclose(np.abs(aside[:, :2]).max(axis=1), 2.5, rtol=1e-6)


def test_what_falls_outside_the_gate_is_counted():
    """The same light in a wide and in a narrow gate: inside + before + after is conserved."""
    one = scene(transport={"estimator": "next_event"})
    wide, narrow = (
        simulate(one.with_overrides(gate=gate), photons=50_000, seed=3, device="cpu")
        for gate in ({}, {"start_ns": 3.33564095 * 2, "bins": 6})
    )
    total = wide.tallies.sum() * wide.unit
    parts = (narrow.tallies.sum() + narrow.counters["before_gate"]) * narrow.unit
    assert narrow.counters["before_gate"] > 0
    assert parts == pytest.approx(total, rel=1e-6)
