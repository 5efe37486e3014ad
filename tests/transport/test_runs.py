"""Runs cut into launches, batches, devices and shards, in spite of failures: all end with the bits of one run."""

import dataclasses
import itertools
import math
import signal
import threading
import warnings
from functools import partial

import numpy as np
import pytest
import warp as wp
from scipy import stats

import spadwarp
import spadwarp_kernels as sk
from helpers.cli import run
from helpers.inverse import plate
from helpers.runs import PHOTONS, RUN, same
from helpers.scenes import ELSEWHERE, PLATE, TREE, scene
from helpers.statistics_of_samples import DEVICES
from spadwarp import ConfigError, DeviceError, RunOptions, merge, simulate
from spadwarp.result import component_errors
from spadwarp.transport import LightTracer
from spadwarp.transport.simulation import FIRST_LOOK, StoppingRule
from spadwarp_kernels.tally import tally as tally_module

# Few threads: many would have walked all photons before the first of them is reported.
SMALL_LAUNCHES = {"threads": 2, "launch_size": 1000}


def here(**options):
    return simulate(scene(), device="cpu", **options)


@pytest.mark.parametrize("targets", [[PLATE], [TREE]], ids=["plate", "tree"])
@pytest.mark.parametrize("estimator", ["analog", "next_event", "guided"])
def test_one_seed_gives_the_same_bits_however_the_run_is_cut_up(estimator, targets, device):
    one = scene(transport={"estimator": estimator}, targets=targets)

    def cut(threads, launch_size, seed=2**63 + 5):
        options = RunOptions(threads=threads, launch_size=launch_size)
        return simulate(one, photons=20_000, seed=seed, device=device, run=options)

    whole = cut(1, 20_000)
    assert whole.tallies.any()
    for threads, launch_size in [(1, 777), (2, 1000), (3, 4096)]:
        same(cut(threads, launch_size), whole)
    assert cut(1, 20_000, seed=2**63 + 6).tallies.tobytes() != whole.tallies.tobytes()


GPUS = ["cuda:0,cuda:0", "cuda:all"] if "cuda:0" in DEVICES else []


@pytest.mark.parametrize("device", ["cpu,cpu", *GPUS])
def test_devices_with_tallies_of_their_own_add_up_to_one(device, whole):
    options, seen, threads = {**RUN}, [], {*threading.enumerate()}
    one = simulate(scene(), **options, device="cuda:0") if device.startswith("cuda") else whole
    run = {"device": device, "run": RunOptions(threads=4, launch_size=3000)}
    cut = simulate(scene(), **options, **run, progress=lambda *report: seen.append(report))
    same(cut, one)
    assert cut.provenance["device"] == device or device == "cuda:all"
    traced = [done for stage, done, _ in seen if stage == "trace"]
    assert seen[0][0] == "compile" and traced == sorted(traced) and traced[-1] == cut.photons
    for thread in {*threading.enumerate()} - threads:  # none waits for more
        thread.join(30.0)
        assert not thread.is_alive()


@pytest.mark.parametrize("other", sorted({"cpu", *DEVICES}))
def test_tallies_of_two_devices_are_added(other, device, monkeypatch):
    monkeypatch.setattr(tally_module, "_PIECE", 7)
    a, b = np.random.default_rng(0).integers(-(2**62), 2**62, size=(2, 30))
    total, more = wp.array(a, dtype=wp.int64, device=device), wp.array(b, dtype=wp.int64, device=other)
    sk.add_tallies(total, more)
    assert np.array_equal(total.numpy(), a + b) and np.array_equal(more.numpy(), b)
    with pytest.raises(sk.ArgumentError, match="shape \\(30,\\)"):
        sk.add_tallies(total, wp.zeros(29, dtype=wp.int64, device=other))


def test_shards_add_up_to_the_run_and_gaps_can_be_filled(whole):
    def shard(number):
        return here(**RUN, run=RunOptions(shard=(number, 5)))

    parts = [shard(number) for number in (4, 1, 5, 2)]
    assert [part.requested[0] for part in parts] != sorted(part.requested[0] for part in parts)
    gap, third = merge(parts), shard(3)
    assert len(gap.photon_ranges) == 2 and gap.requested == whole.requested
    assert len(gap.provenance["parts"]) == 4
    same(merge([gap, third]), whole)
    filled = here(run=RunOptions(resume=gap))
    same(filled, whole)
    assert [part["photon_ranges"] for part in filled.provenance["parts"]][-1] == [list(third.requested)]


def test_an_interrupted_shard_knows_where_it_ends(whole, tmp_path):
    """Ctrl-C returns the photons that were traced, from a file they are resumed."""

    def interrupt(stage, done, total):
        if stage == "trace" and done > 2 * batch and not fired:
            fired.append(total)
            signal.raise_signal(signal.SIGTERM)

    fired, batch, half = [], whole.batch_size, RUN
    part = here(**half, progress=interrupt, run=RunOptions(**SMALL_LAUNCHES, shard=(2, 2)))
    start, stop = part.requested
    assert part.partial and stop == whole.photons and fired == [stop - start]
    assert abs(2 * start - stop) <= (batch or 1) and start % (batch or 1) == 0
    assert part.photon_ranges == ((start, start + part.photons),) and part.energy_report()["exact"]
    part.save(tmp_path / "part.h5")
    rest = here(run=RunOptions(resume=tmp_path / "part.h5"))
    assert not rest.partial
    both = merge([rest, here(**half, run=RunOptions(shard=(1, 2)))])
    # The batch that was interrupted is two of them.
    assert both.tallies.tobytes() == whole.tallies.tobytes() and both.half.tobytes() == whole.half.tobytes()
    assert both.energy_balance == whole.energy_balance and 0 <= both.batches - whole.batches <= 1


CELLS = {"shape": "plume", "size": 1.2, "cells": 10, "extinction": 2.0, "translation": [0.0, 0.0, 1.1]}
BLOCKS = tuple(f"medium.grid.{kind}" for kind in ("absorption", "scattering", "extinction"))
SIGNED = {
    "derivatives": (
        {"medium": {"layers": ELSEWHERE}},
        {"derivatives": ("medium.absorption", "medium.scattering", "medium.anisotropy", "reflectance")},
        "medium.absorption, medium.scattering",
    ),
    "blocks": (
        {"medium": {"grid": {**CELLS, "tracking": "delta"}}},
        {"derivatives": (*BLOCKS, "reflectance"), "blocks": (2, 1, 5)},
        "medium.grid.scattering of 2 x 1 x 5 blocks",
    ),
    "channels": (
        {
            "medium": {"scattering_matrix": "voss_fry"},
            "laser": {"polarisation": "linear"},
            "camera": {"polarisation": "analyser", "analyser_angle_deg": 30.0, "analyser_extinction_ratio": 50.0},
            "transport": {"estimator": "guided"},
        },
        {},
        "degree of polarisation",
    ),
}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*few heavy photons decide it")
@pytest.mark.parametrize("kind", SIGNED)
def test_derivatives_and_channels_survive_files_merging_and_resuming(kind, tmp_path):
    sections, asked, shown = SIGNED[kind]
    one, options = scene(**sections), {"device": "cpu", "photons": 8192, **asked}
    whole = simulate(one, **options)
    halves = [simulate(one, **options, run=RunOptions(shard=(k, 2))) for k in (1, 2)]
    short = simulate(one, **{**options, "photons": 4096})
    resumed = [simulate(one, photons=8192, device="cpu", run=RunOptions(resume=part)) for part in (halves[0], short)]
    loaded = spadwarp.load(whole.save(tmp_path / "result.h5"))
    for other in (loaded, merge(halves), *resumed):
        found, expected = other.signed_tallies, whole.signed_tallies
        assert (found.group, found.names, found.units) == (expected.group, expected.names, expected.units)
        np.testing.assert_array_equal(found.tallies, expected.tallies)
    for name in ("derivatives", "channels", "derivative_errors", "channel_errors"):
        for key, values in getattr(whole, name).items():
            np.testing.assert_array_equal(getattr(loaded, name)[key], values)
    assert shown in run("info", tmp_path / "result.h5").stdout
    pytest.importorskip("xarray")
    labelled = loaded.to_xarray()["polarisation" if kind == "channels" else "derivative"].sel(component="backscatter")
    parts = whole.channels if kind == "channels" else whole.derivatives
    np.testing.assert_array_equal(labelled, np.stack(list(parts.values()))[:, 2])


def test_what_cannot_be_merged_is_refused():
    def part(first=1000, photons=1000, seed=5, **changes):
        one = scene().with_overrides(changes)
        return simulate(one, photons=photons, seed=seed, device="cpu", run=RunOptions(first_photon=first))

    a = part(0)
    for other, text in (
        (a, "ids 0 to 999 are in more than one"),
        (part(seed=6), "seed of the results differs"),
        (part(medium={"extinction": 0.6}), "scene of the results differs in medium: only photons"),
        (part(transport={"max_collisions": 3}), "scene of the results differs in transport: only photons"),
    ):
        with pytest.raises(ConfigError, match=text):
            merge([a, other])
    both, once = merge([part(), a]), part(0, 2000)
    assert both.tallies.tobytes() == once.tallies.tobytes() and both.batch_size < once.batch_size
    with pytest.raises(ConfigError, match="photons = 1000 is outside"):
        here(photons=1000, run=RunOptions(resume=a))
    with pytest.raises(ConfigError, match="no errors"):
        _ = part(0, 1).standard_error


HUGE = {"camera": {"width": 4096, "height": 4096}, "gate": {"bins": 1000}}


@pytest.mark.parametrize(
    ("arguments", "text"),
    [
        ({"photons": 0}, r"photons = 0 is outside \[1, 1000000000000\]"),
        ({"seed": -1}, "seed = -1 is outside"),
        ({"device": "cuda:99"}, "device = 'cuda:99' is not one of cpu"),
        ({"device": "cpu,cuda:99"}, "not one of cpu"),
        *([] if "cuda:0" in DEVICES else [({"device": "cuda:all"}, "cuda:0")]),
        ({"run": {"launch_size": 2**21}}, r"launch_size = 2097152 is outside \[1, 1048576\]"),
        *(({"run": {"shard": shard}}, "^shard") for shard in (3, (0, 4), (5, 4), (1, 2, 3), (1.5, 2), ("1", 2))),
        ({"run": {"shard": (1, 10**6)}}, "too few"),
        ({"run": {"shard": (1, 2)}, "relative_error": 0.1}, "relative_error cannot be combined with shard"),
        ({"run": {"shard": (1, 2), "resume": "whole"}}, "shard = .* cannot be combined with resume"),
        ({"scene": HUGE}, "outside"),
    ],
)
def test_wrong_use_is_named(arguments, text, whole):
    options = {"photons": 1000, "device": "cpu", **arguments}
    one = scene(**options.pop("scene", {}))
    choices = options.pop("run", {})
    choices = {**choices, "resume": whole if "resume" in choices else None}
    with pytest.raises(spadwarp.SpadwarpError, match=text):
        simulate(one, **options, run=RunOptions(**choices))


# Checkpoints and failures


@pytest.mark.parametrize("device", [pytest.param("cpu", marks=pytest.mark.slow), "cpu,cpu"])
def test_a_device_that_disappears_costs_what_was_not_in_a_checkpoint(device, whole, tmp_path, monkeypatch):
    """After 120 launches."""
    place, prepare, calls = tmp_path / "checkpoint.h5", sk.prepare_transport, itertools.count()

    def failing(*arguments, **options):
        launch = prepare(*arguments, **options)

        def fail(first_id, photon_count):
            if next(calls) >= 120:
                raise RuntimeError("CUDA error 719: unspecified launch failure")
            launch(first_id, photon_count)

        return fail

    monkeypatch.setattr(sk, "prepare_transport", failing)
    often = RunOptions(**SMALL_LAUNCHES, checkpoint=place, checkpoint_every=0.0)
    with pytest.raises(DeviceError) as caught:
        simulate(scene(), **RUN, device=device, run=often)
    monkeypatch.undo()
    saved = spadwarp.load(place)
    assert saved.partial and 0 < saved.photons <= 120_000 and saved.energy_report()["exact"]
    assert "cpu failed: CUDA error 719" in str(caught.value)
    assert f"{place}: the {saved.photons} photons that were done" in str(caught.value)
    same(here(run=RunOptions(resume=saved)), whole)


def test_a_device_without_memory_is_named(monkeypatch):
    def full(*arguments, **options):
        raise RuntimeError("Failed to allocate 1207959552 bytes on device 'cuda:0'")

    monkeypatch.setattr(sk, "make_data", full)
    with pytest.raises(DeviceError, match="cpu has too little memory left: Failed to allocate 1207959552"):
        here(**RUN)


def test_a_full_disk_costs_no_photons(whole, tmp_path):
    """The checkpoint meets a limit on the size of files: the one before it stays, the run continues to its end."""
    resource = pytest.importorskip("resource")
    place = tmp_path / "checkpoint.h5"
    here(**{**RUN, "photons": 1000}).save(place)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(stage, done, total):
        if stage == "trace":
            resource.setrlimit(resource.RLIMIT_FSIZE, (5000, limits[1]))

    often = RunOptions(threads=2, launch_size=2000, checkpoint=place, checkpoint_every=0.0)
    try:
        with pytest.warns(RuntimeWarning, match=r"the run continues: .*checkpoint\.h5: cannot be written"):
            result = here(**RUN, progress=fill, run=often)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    same(result, whole)
    saved = spadwarp.load(place)
    assert saved.photons == 1000 and [path.name for path in tmp_path.iterdir()] == ["checkpoint.h5"]
    longer = here(photons=PHOTONS, run=RunOptions(resume=saved))
    assert longer.tallies.tobytes() == whole.tallies.tobytes()


# Errors from batches


def test_squares_are_exact_to_128_bits(device):
    rng = np.random.default_rng(0)
    rows = [rng.integers(0, 2**61, size=(3, 50), dtype=np.int64) // [[1], [2**20], [2**40]] for _ in range(300)]
    rows[0][:] = 0
    tally = wp.zeros(150, dtype=wp.int64, device=device)
    batches = sk.Batches(tally, 3)
    for k, row in enumerate(rows, 1):
        tally.assign(row.ravel() // 3)
        batches.close(tally)
        assert not tally.numpy().any()
        if k % batches.MOST_SUMS == 0:
            assert batches.take_sums() == [[sum(map(int, part // 3)) for part in row] for row in rows[k - 16 : k]]
    assert len(batches.take_sums()) == 300 % 16 and batches.take_sums() == []
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
        batches = sk.Batches(tally, 2, signed=True)
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
    empty = wp.zeros(50, dtype=wp.int64, device=device)
    for other in (closed(np.zeros((1, 100), np.int64)).total, sk.Batches(empty, 1)):
        with pytest.raises(sk.ArgumentError):
            part.add(other)


@pytest.mark.slow
def test_standard_error_is_the_spread_between_seeds(device):
    """The error from the batches of one run against the spread of 64 runs, both pooled over bins: equal within 10 %."""
    # A lens of 0.4 m, as in the other tests, sees much light from next to it, whose sums are skewed.
    one = scene(transport={"estimator": "guided"}, camera={"aperture_diameter": 0.05})
    runs = [simulate(one, photons=2**14, seed=seed, device=device) for seed in range(64)]
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


def test_moments_of_the_components_are_those_of_the_batches(device):
    """A run of 8 or 32 batches against a run of each; merged runs have the same."""
    options = {"seed": 5, "device": device}
    whole = simulate(scene(), photons=32 * 1024, **options)
    size, count = whole.batch_size, whole.batches
    assert size * count == 32 * 1024 and count >= 8
    each = [simulate(scene(), photons=size, **options, run=RunOptions(first_photon=k * size)) for k in range(count)]
    totals = np.array([run.tallies.sum(axis=(1, 2, 3)) for run in each])
    for name, total in zip(("ballistic", "forward_scattered", "backscatter"), totals.T.tolist(), strict=True):
        assert whole.batch_moments[f"{name}_squares"] == sum(x * x for x in total)
        assert whole.batch_moments[f"{name}_smallest"] == min(total)
        assert whole.batch_moments[f"{name}_largest"] == max(total)
        error, share = component_errors(whole)[name]
        assert error == pytest.approx(np.std(total, ddof=1) / np.mean(total) / np.sqrt(count))
        squares = (np.array(total, float) - np.mean(total)) ** 2
        assert share == pytest.approx(count / (count - 1) * squares.max() / squares.sum())
    options |= {"photons": size * count}
    parts = [simulate(scene(), **options, run=RunOptions(shard=(k, 2))) for k in (1, 2)]
    assert merge(parts).batch_moments == whole.batch_moments


def test_a_heavy_batch_is_named(tmp_path):
    """Nothing is said of many equal photons; a batch with thirty times the light is, and files keep it."""
    plain = here(photons=2**15, seed=5)
    assert plain.warnings == () and plain.summary()["warnings"] == []
    heavy = dict(plain.batch_moments)
    spike = 30 * int(plain.tallies[2].sum()) // 32
    largest = heavy["backscatter_largest"]
    heavy["backscatter_largest"] = largest + spike
    heavy["backscatter_squares"] += (largest + spike) ** 2 - largest**2
    tallies = plain.tallies.copy()
    tallies[2, 0, 0, 0] += spike
    spiked = dataclasses.replace(plain, tallies=tallies, batch_moments=heavy)
    for one in (spiked, spadwarp.load(spiked.save(tmp_path / "heavy.h5"))):
        (text,) = one.warnings
        assert text.startswith("backscatter: one of 32 batches has 100 %") and "more photons" in text
        assert one.summary()["warnings"] == [text]


@pytest.mark.slow
def test_guided_warns_of_no_heavy_photons_where_next_event_does():
    """Narrow lens, forward-peaked water: next events close to the lens are rare and large."""

    def warned(estimator, seed):
        one = spadwarp.load_scene("plane_5m", {"transport.estimator": estimator})
        with warnings.catch_warnings(record=True) as caught:
            warnings.simplefilter("always")
            result = simulate(one, photons=50_000, seed=seed, device="cpu")
        texts = [str(warning.message) for warning in caught if "of the variance" in str(warning.message)]
        assert not texts  # no error was asked for
        return any("of the variance" in text for text in result.warnings)

    counts = {name: sum(warned(name, seed) for seed in range(8)) for name in ("guided", "next_event")}
    assert counts["guided"] == 0 and counts["next_event"] >= 1


# Runs with an error as their goal


@pytest.mark.slow
def test_a_run_stops_when_its_depth_bins_are_known_well_enough(device):
    one = scene(transport={"estimator": "guided"})
    found = simulate(one, photons=2**22, seed=1, device=device, relative_error=0.015)
    assert found.relative_error <= 0.015 and not found.partial
    assert found.photons < 2**22
    # Where the error so far said that the goal would be reached, not at the next power of two, and a part on.
    assert found.relative_error > 0.6 * 0.015
    never = simulate(one, photons=2**14, seed=1, device=device, relative_error=1e-6)
    assert never.photons == 2**14 and not never.partial and never.relative_error > 1e-6


def test_the_stopping_rule_does_not_see_how_many_devices_there_are():
    options, seen = {"photons": 2**20, "seed": 1, "relative_error": 0.05}, []
    one = here(**options, progress=lambda *report: seen.append(report))
    same(simulate(scene(), **options, device="cpu,cpu"), one)
    errors = [remark for remark, *_ in seen if remark.startswith("error")]
    assert "after 32 batches; about " in errors[0] and errors[0].endswith(" photons are needed")
    batches = one.photons // one.batch_size
    assert errors[-1] == f"error {100 * one.relative_error:.3g} % after {batches} batches"
    assert all(done <= total for _, done, total in seen) and seen[-1] == ("trace", one.photons, one.photons)


# Light that stays on its device


def test_light_and_derivatives_are_those_of_simulate():
    one = plate()
    names = ["medium.absorption", "medium.scattering", "targets[0].reflectance"]
    options = {"photons": 20_000, "seed": 5, "device": "cpu", "derivatives": names}
    tracer = LightTracer(one, **options, separate_targets=True)
    tracer(0, 20_000)  # what was traced before does not stay
    light, slopes = tracer(20_000, 20_000)
    result = simulate(one, **options, run=RunOptions(first_photon=20_000))
    scale = one.laser.photons_per_pulse * one.detections_per_photon
    np.testing.assert_allclose(light.total.numpy(), result.detections.reshape(64, -1), rtol=1e-6)
    target = result.component("ballistic") + result.component("forward_scattered")
    np.testing.assert_allclose(light.target.numpy(), scale * target.reshape(64, -1), rtol=1e-6)
    for name in names:
        parts = scale * result.derivatives[name].reshape(3, 64, -1)
        size = np.abs(parts).max()
        np.testing.assert_allclose(slopes[name].total.numpy(), parts.sum(axis=0), rtol=1e-6, atol=1e-9 * size)
        np.testing.assert_allclose(slopes[name].target.numpy(), parts[:2].sum(axis=0), rtol=1e-6, atol=1e-9 * size)
    assert tracer.truth.depth.shape == (8, 8)


# The rule by which a run with a relative error as its goal ends, on batches of invented scores of mean 1


RUNS, BATCHES = 1000, 1024


class Ends:
    """Where the runs whose batches are the rows end: batches, mean, standard error, and where first at the goal."""

    def __init__(self, values, goal):
        count = np.arange(1, values.shape[1] + 1)
        mean = values.cumsum(axis=1) / count
        spread = np.maximum((values**2).cumsum(axis=1) - count * mean**2, 0.0)
        furthest = np.maximum(np.maximum.accumulate(values, 1) - mean, mean - np.minimum.accumulate(values, 1)) ** 2
        with np.errstate(all="ignore"):
            error = np.sqrt(spread / (count - 1) / count)
            share = furthest / spread
        found = [self._ends(error[i] / mean[i], share[i], goal) for i in range(len(values))]
        self.searched, self.batches = np.array(found).T
        rows = np.arange(len(values))
        self.mean, self.error = mean[rows, self.batches - 1], error[rows, self.batches - 1]
        self.early = mean[rows, self.searched - 1]
        self.held = (abs(self.mean - 1.0) < 2.0 * self.error).mean()
        # The same numbers of batches, of other runs: what numbers that are fixed beforehand give.
        other = np.roll(rows, 1)
        fixed, its_error = mean[other, self.batches - 1], error[other, self.batches - 1]
        self.held_of_fixed = (abs(fixed - 1.0) < 2.0 * its_error).mean()

    @staticmethod
    def _ends(error, share, goal):
        rule, batches, searched = StoppingRule(goal), FIRST_LOOK, None
        while True:
            known = float(error[batches - 1])
            searched = batches if searched is None and known <= goal else searched
            wanted = rule.next_look(batches, known, partial(float, share[batches - 1]))
            if wanted is None or batches == len(error):
                return searched or batches, batches
            batches = min(wanted, len(error))


def test_many_equal_photons_cost_little_more_and_reach_the_goal():
    rng = np.random.default_rng(3)
    ends = Ends(rng.gamma(2.0, 0.5, (RUNS, BATCHES)), 0.05)  # 200 batches
    assert 1.0 <= ends.batches.mean() / ends.searched.mean() < 1.45
    assert np.quantile(ends.error / ends.mean, 0.99) < 0.05
    assert ends.mean.mean() == pytest.approx(1.0, abs=4 * 0.05 / math.sqrt(RUNS))
    assert ends.held == pytest.approx(0.95, abs=0.03)


def test_rare_bright_photons_are_waited_for():
    """Light of a next event whose distance r is even in r^3 goes as r^-2: a tail of exponent 3/2, no variance."""
    rng = np.random.default_rng(3)
    photons = rng.poisson(8.0, (RUNS, BATCHES))
    bright = np.zeros((RUNS, BATCHES))
    for k in range(int(photons.max())):
        bright += np.where(k < photons, rng.random((RUNS, BATCHES)) ** (-1 / 1.5) / 3.0, 0.0)  # mean 1
    ends = Ends(bright / 8.0, 0.05)
    assert ends.batches.max() <= BATCHES and (ends.batches <= 2 * ends.searched).all()
    # Ending where the goal is first met is too dark by more than half of the error; going on halves that.
    early, late = ends.early.mean() - 1.0, ends.mean.mean() - 1.0
    assert early < -0.02
    assert late > 0.7 * early
    assert ends.held > ends.held_of_fixed - 0.08


def test_looks_are_neither_too_many_nor_too_far_apart():
    rule = StoppingRule(0.01)
    assert rule.next_look(32, math.inf, lambda: 1.0) == 256
    assert rule.next_look(100, 0.0101, lambda: 1.0) == 108
    assert rule.next_look(100, 0.02, lambda: 1.0) == 420
    assert rule.next_look(160, 0.009, lambda: 0.05) == 192
    assert rule.next_look(192, 0.02, lambda: 0.05) is None
    assert StoppingRule(0.01).next_look(40, 0.005, lambda: 0.9) == 80
