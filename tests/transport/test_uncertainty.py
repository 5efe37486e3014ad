"""Errors of every bin, the stopping rule, resuming and merging."""

import dataclasses
import signal
import warnings

import numpy as np
import pytest
import warp as wp
from scipy import stats

import spadwarp
from helpers.runs import same
from helpers.scenes import scene
from spadwarp_kernels import ArgumentError, Batches
from spadwarp_kernels.tally import tally as tally_module


def test_squares_are_exact_to_128_bits(device):
    rng = np.random.default_rng(0)
    rows = [rng.integers(0, 2**61, size=(3, 50), dtype=np.int64) // [[1], [2**20], [2**40]] for _ in range(300)]
    rows[0][:] = 0
    tally = wp.zeros(150, dtype=wp.int64, device=device)
    batches = Batches(tally, 3)
    for row in rows:
        tally.assign(row.ravel() // 3)
        batches.close(tally)
        assert not tally.numpy().any()
    sums = [[int(v) // 3 for v in row.ravel()] for row in rows]
    expected = [sum((row[i] + row[50 + i] + row[100 + i]) ** 2 for row in sums) for i in range(50)]
    low, high = (half.numpy() for half in batches.second_moment)
    assert [int(h) << 64 | int(l) for l, h in zip(low, high, strict=True)] == expected
    assert batches.count == 300


def test_batches_of_two_tallies_are_those_of_one(device, monkeypatch):
    monkeypatch.setattr(tally_module, "_PIECE", 7)
    rng = np.random.default_rng(1)
    rows = rng.integers(-(2**59), 2**59, size=(40, 100), dtype=np.int64) >> rng.integers(0, 59, size=(40, 1))

    def closed(rows):
        tally = wp.zeros(100, dtype=wp.int64, device=device)
        batches = Batches(tally, 2, signed=True)
        for row in rows:
            tally.assign(row)
            batches.close(tally)
        return batches

    one, part, rest = closed(rows), closed(rows[:13]), closed(rows[13:])
    part.add(rest)
    assert part.count == one.count and not part.has_overflowed()
    for mine, expected in zip((part.total, *part.second_moment), (one.total, *one.second_moment), strict=True):
        assert np.array_equal(mine.numpy(), expected.numpy())
    # Carries from the lower halves are rare by chance.
    for batches in (part, rest):
        batches.second_moment[0].fill_(2**63 + 5)
        batches.second_moment[1].fill_(7)
    part.add(rest)
    assert set(part.second_moment[0].numpy()) == {10} and set(part.second_moment[1].numpy()) == {15}
    rest.total.fill_(2**62 - 1)
    part.total.fill_(1)
    part.add(rest)
    assert part.has_overflowed()
    for other in (closed(np.zeros((1, 100), np.int64)).total, Batches(wp.zeros(50, dtype=wp.int64, device=device), 1)):
        with pytest.raises(ArgumentError):
            part.add(other)


@pytest.mark.slow
def test_standard_error_is_the_spread_between_seeds(device):
    """The error from the batches of one run against the spread of 64 runs, both pooled over bins: equal within 10 %."""
    # A lens of 0.4 m, as in the other tests, sees much light from next to it, whose sums are skewed.
    one = scene(transport={"estimator": "guided"}, camera={"aperture_diameter": 0.05})
    runs = [spadwarp.simulate(one, photons=2**15, seed=seed, device=device, uncertainty=True) for seed in range(64)]
    values = np.array([run.histogram for run in runs])
    bright = values.mean(axis=0) > 0.05 * values.mean(axis=0).max()
    spread = values.var(axis=0, ddof=1)[bright]
    claimed = np.mean([run.standard_error**2 for run in runs], axis=0)[bright]
    assert bright.sum() > 20
    assert np.sqrt(claimed / spread).mean() == pytest.approx(1.0, abs=0.1)
    z = (values - values.mean(axis=0))[:, bright] / np.array([run.standard_error for run in runs])[:, bright]
    # Coverage, both sides together: a bin's sum is skewed, and its error rises and falls with it.
    beyond = 2 * stats.norm.sf(2)
    assert beyond / 2 < (np.abs(z) > 2).mean() < 2 * beyond


def test_batches_do_not_depend_on_how_the_run_is_cut_up():
    one = scene()
    whole = spadwarp.simulate(
        one, photons=20_000, seed=5, device="cpu", uncertainty=True, run=spadwarp.RunOptions(threads=1)
    )
    cut = spadwarp.simulate(
        one, photons=20_000, seed=5, device="cpu", uncertainty=True, run=spadwarp.RunOptions(threads=2, launch_size=100)
    )
    same(whole, cut)
    assert whole.photons >= 20_000 and whole.photons % whole.batch_size == 0
    plain = spadwarp.simulate(one, photons=whole.photons, seed=5, device="cpu")
    assert plain.tallies.tobytes() == whole.tallies.tobytes() and plain.energy_balance == whole.energy_balance


@pytest.mark.parametrize("uncertainty", [False, True])
def test_a_resumed_run_equals_one_long_run(uncertainty, tmp_path):
    one = scene()
    whole = spadwarp.simulate(one, photons=65_536, seed=5, device="cpu", uncertainty=uncertainty)
    batch = whole.batch_size
    short = spadwarp.simulate(one, photons=24_576, seed=5, device="cpu", uncertainty=uncertainty)
    if uncertainty:
        # A shorter run of its own would choose smaller batches: a run that was interrupted kept the long run's.
        assert short.batch_size < batch
        short = _first_batches(one, whole, 12)
    short.save(tmp_path / "short.h5")
    resumed = spadwarp.simulate(
        one, photons=65_536, device="cpu", run=spadwarp.RunOptions(resume=spadwarp.load_result(tmp_path / "short.h5"))
    )
    same(resumed, whole)
    assert not resumed.partial


def _first_batches(one, whole, count):
    """The run interrupted after so many batches or a few more."""

    def interrupt(stage, done, total):
        if stage == "trace" and done >= count * whole.batch_size and not fired:
            fired.append(True)
            signal.raise_signal(signal.SIGINT)

    fired = []
    part = spadwarp.simulate(
        one,
        photons=65_536,
        seed=5,
        device="cpu",
        uncertainty=True,
        progress=interrupt,
        run=spadwarp.RunOptions(threads=1),
    )
    assert part.partial and count * whole.batch_size <= part.photons < whole.photons
    return part


@pytest.mark.parametrize("uncertainty", [False, True])
def test_merged_parts_equal_one_long_run(uncertainty):
    one = scene()
    options = {"photons": 65_536, "seed": 5, "device": "cpu", "uncertainty": uncertainty}
    parts = [
        spadwarp.simulate(one, **options, run=spadwarp.RunOptions(first_photon=first * 65_536)) for first in (2, 0, 1)
    ]
    gap = spadwarp.merge([parts[0], parts[1]])
    assert gap.photon_ranges == ((0, 65_536), (131_072, 196_608))
    same(spadwarp.merge([gap, parts[2]]), spadwarp.merge(parts))
    same(parts[1], spadwarp.simulate(one, **options))
    if not uncertainty:
        same(spadwarp.merge(parts), spadwarp.simulate(one, photons=196_608, seed=5, device="cpu"))


def test_what_cannot_be_merged_is_refused():
    one = scene()
    a = spadwarp.simulate(one, photons=1000, seed=5, device="cpu")
    with pytest.raises(spadwarp.ConfigError, match="ids 0 to 999 are in more than one"):
        spadwarp.merge([a, a])
    with pytest.raises(spadwarp.ConfigError, match="seed of the results differs"):
        spadwarp.merge(
            [a, spadwarp.simulate(one, photons=1000, seed=6, device="cpu", run=spadwarp.RunOptions(first_photon=1000))]
        )
    other = one.with_overrides({"medium.extinction": 0.6})
    with pytest.raises(spadwarp.ConfigError, match="scene of the results differs in medium: only photons"):
        spadwarp.merge(
            [
                a,
                spadwarp.simulate(
                    other, photons=1000, seed=5, device="cpu", run=spadwarp.RunOptions(first_photon=1000)
                ),
            ]
        )
    with pytest.raises(spadwarp.ConfigError, match="photons = 1000 is outside"):
        spadwarp.simulate(one, photons=1000, device="cpu", run=spadwarp.RunOptions(resume=a))
    with pytest.raises(spadwarp.ConfigError, match="no batches"):
        _ = a.standard_error


def test_a_run_stops_when_its_depth_bins_are_known_well_enough(device):
    one = scene(transport={"estimator": "guided"})
    run = spadwarp.simulate(one, photons=2**22, seed=1, device=device, relative_error=0.05)
    assert run.relative_error <= 0.05 and not run.partial
    assert run.photons < 2**22
    # Where the error so far said that the goal would be reached, not at the next power of two, and a part on.
    assert run.relative_error > 0.6 * 0.05
    never = spadwarp.simulate(one, photons=2**14, seed=1, device=device, relative_error=1e-6)
    assert never.photons == 2**14 and not never.partial and never.relative_error > 1e-6


def test_moments_of_the_components_are_those_of_the_batches(device):
    """A run of 32 batches against a run of each; merged and resumed runs have the same."""
    one, size = scene(), 1024
    whole = spadwarp.simulate(one, photons=32 * size, seed=5, device=device, uncertainty=True)
    assert whole.batch_size == size
    each = [
        spadwarp.simulate(one, photons=size, seed=5, device=device, run=spadwarp.RunOptions(first_photon=k * size))
        for k in range(32)
    ]
    totals = np.array([run.tallies.sum(axis=(1, 2, 3)) for run in each])
    for name, total in zip(("ballistic", "forward_scattered", "backscatter"), totals.T.tolist(), strict=True):
        assert whole.batch_moments[f"{name}_squares"] == sum(x * x for x in total)
        assert whole.batch_moments[f"{name}_smallest"] == min(total)
        assert whole.batch_moments[f"{name}_largest"] == max(total)
        error = spadwarp.result.component_errors(whole)[name]
        assert error.relative_error == pytest.approx(np.std(total, ddof=1) / np.mean(total) / np.sqrt(32))
        squares = (np.array(total, float) - np.mean(total)) ** 2
        assert error.largest_share == pytest.approx(32 / 31 * squares.max() / squares.sum())
    parts = [
        spadwarp.simulate(
            one, photons=32 * size, seed=5, device=device, uncertainty=True, run=spadwarp.RunOptions(shard=(k, 2))
        )
        for k in (1, 2)
    ]
    assert spadwarp.merge(parts).batch_moments == whole.batch_moments


def test_a_heavy_batch_is_named(tmp_path):
    """Nothing is said of many equal photons; a batch with thirty times the light is, and files keep it."""
    run = spadwarp.simulate(scene(), photons=2**15, seed=5, device="cpu", uncertainty=True)
    assert run.warnings == () and run.summary()["warnings"] == []
    heavy = dict(run.batch_moments)
    spike = 30 * int(run.tallies[2].sum()) // 32
    largest = heavy["backscatter_largest"]
    heavy["backscatter_largest"] = largest + spike
    heavy["backscatter_squares"] += (largest + spike) ** 2 - largest**2
    tallies = run.tallies.copy()
    tallies[2, 0, 0, 0] += spike
    run = dataclasses.replace(run, tallies=tallies, batch_moments=heavy)
    for one in (run, spadwarp.load_result(run.save(tmp_path / "heavy.h5"))):
        (text,) = one.warnings
        assert text.startswith("backscatter: one of 32 batches has 100 %") and "more photons" in text
        assert one.summary()["warnings"] == [text]


@pytest.mark.slow
def test_guided_warns_of_no_heavy_photons_where_next_event_does():
    """Narrow lens, forward-peaked water: next events close to the lens are rare and large."""
    one = spadwarp.load_scene("plane_5m")
    warned = {
        estimator: sum(
            bool(_warnings(one.with_overrides({"transport.estimator": estimator}), seed)) for seed in range(12)
        )
        for estimator in ("guided", "next_event")
    }
    assert warned["guided"] == 0 and warned["next_event"] >= 2


def _warnings(one, seed):
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("always")
        result = spadwarp.simulate(one, photons=100_000, seed=seed, device="cpu", uncertainty=True)
    assert [str(one.message) for one in caught if "of the variance" in str(one.message)] == list(result.warnings)
    return result.warnings
