"""Runs on many devices, in parts and in spite of failures: all end with the bits of one run on one device."""

import signal
import threading

import numpy as np
import pytest
import warp as wp

import spadwarp
import spadwarp_kernels
from helpers.runs import PHOTONS, RUN, same
from helpers.scenes import scene
from helpers.statistics_of_samples import DEVICES
from spadwarp.result.photon_ids import IdQueue, count, joined, shard_of, without
from spadwarp_kernels.tally import tally

# Photon ids


def test_ids_are_handed_out_once():
    waiting = IdQueue([(100, 130), (0, 50)])
    first = waiting.take(40)
    assert first == (0, 40) and waiting.take(40) == (40, 50) and waiting.left == 30
    waiting.put_back([first])
    taken = []
    while ids := waiting.take(7):
        taken.append(ids)
    assert joined(taken) == ((0, 40), (100, 130)) and waiting.left == 0
    assert without((0, 200), joined(taken)) == ((40, 100), (130, 200))
    assert without((10, 30), ((0, 40),)) == ()


@pytest.mark.parametrize(("parts", "unit"), [(1, 1), (3, 1), (7, 64), (32, 1024)])
def test_shards_are_whole_units_and_together_the_run(parts, unit):
    span = 2048, 2048 + 32 * 1024
    shards = [shard_of(span, (number, parts), unit) for number in range(1, parts + 1)]
    assert joined(shards) == (span,)
    assert all(start % unit == 0 for start, _ in shards)
    assert max(map(count, [[s] for s in shards])) - min(map(count, [[s] for s in shards])) <= unit


# Several devices


SEVERAL = ["cpu,cpu", "cpu,cpu,cpu", *(["cuda:0,cuda:0", "cuda:all"] if "cuda:0" in DEVICES else [])]


@pytest.mark.parametrize("uncertainty", [False, True])
@pytest.mark.parametrize("device", SEVERAL)
def test_devices_with_tallies_of_their_own_add_up_to_one(device, uncertainty, whole):
    one = whole[uncertainty]
    if device.startswith("cuda"):
        one = spadwarp.simulate(scene(), **RUN, device="cuda:0", uncertainty=uncertainty)
    seen = []
    run = spadwarp.RunOptions(threads=4, launch_size=3000)
    options = {**RUN, "device": device, "uncertainty": uncertainty, "run": run}
    cut = spadwarp.simulate(scene(), **options, progress=lambda *report: seen.append(report))
    same(cut, one)
    assert cut.provenance["device"] == device or device == "cuda:all"
    traced = [done for stage, done, _ in seen if stage == "trace"]
    assert traced == sorted(traced) and traced[-1] == cut.photons


@pytest.mark.parametrize("other", sorted({"cpu", *DEVICES}))
def test_tallies_of_two_devices_are_added(other, device, monkeypatch):
    monkeypatch.setattr(tally, "_PIECE", 7)
    a, b = np.random.default_rng(0).integers(-(2**62), 2**62, size=(2, 30))
    total, more = wp.array(a, dtype=wp.int64, device=device), wp.array(b, dtype=wp.int64, device=other)
    spadwarp_kernels.add_tallies(total, more)
    assert np.array_equal(total.numpy(), a + b) and np.array_equal(more.numpy(), b)
    with pytest.raises(spadwarp_kernels.ArgumentError, match="shape \\(30,\\)"):
        spadwarp_kernels.add_tallies(total, wp.zeros(29, dtype=wp.int64, device=other))


def test_the_stopping_rule_does_not_see_how_many_devices_there_are():
    options = {"photons": 2**20, "seed": 1, "relative_error": 0.1}
    seen = []
    one = spadwarp.simulate(scene(), **options, device="cpu", progress=lambda *report: seen.append(report[0]))
    same(spadwarp.simulate(scene(), **options, device="cpu,cpu"), one)
    errors = [remark for remark in seen if remark.startswith("error")]
    batches = one.photons // one.batch_size
    assert "after 32 batches; about " in errors[0] and errors[0].endswith(" photons are needed")
    assert errors[-1] == f"error {100 * one.relative_error:.3g} % after {batches} batches"


def test_devices_that_do_not_go_together_are_refused():
    with pytest.raises(spadwarp.DeviceError, match="not one of cpu"):
        spadwarp.simulate(scene(), photons=10, device="cpu,cuda:99")
    if not any(one["name"] == "cuda:0" for one in spadwarp.device.devices()):
        with pytest.raises(spadwarp.DeviceError, match="cuda:0"):
            spadwarp.simulate(scene(), photons=10, device="cuda:all")


# Parts


@pytest.mark.parametrize("uncertainty", [False, True])
def test_shards_add_up_to_the_run_and_gaps_can_be_filled(uncertainty, whole):
    parts = [
        spadwarp.simulate(
            scene(), **RUN, device="cpu", uncertainty=uncertainty, run=spadwarp.RunOptions(shard=(number, 5))
        )
        for number in (4, 1, 5, 2)
    ]
    assert [part.requested[0] for part in parts] != sorted(part.requested[0] for part in parts)
    gap = spadwarp.merge(parts)
    assert len(gap.photon_ranges) == 2 and gap.requested == whole[uncertainty].requested
    assert len(gap.provenance["parts"]) == 4
    third = spadwarp.simulate(
        scene(), **RUN, device="cpu", uncertainty=uncertainty, run=spadwarp.RunOptions(shard=(3, 5))
    )
    same(spadwarp.merge([gap, third]), whole[uncertainty])
    filled = spadwarp.simulate(scene(), device="cpu", run=spadwarp.RunOptions(resume=gap))
    same(filled, whole[uncertainty])
    assert [part["photon_ranges"] for part in filled.provenance["parts"]][-1] == [list(third.requested)]


def test_an_interrupted_shard_knows_where_it_ends(whole):
    def interrupt(stage, done, total):
        if stage == "trace" and done > 0 and not fired:
            fired.append(total)
            signal.raise_signal(signal.SIGTERM)

    fired = []
    # Few threads: many would have walked all photons before the first of them is reported.
    options = {**RUN, "device": "cpu", "run": spadwarp.RunOptions(threads=2, shard=(2, 2), launch_size=1000)}
    part = spadwarp.simulate(scene(), **options, progress=interrupt)
    assert part.partial and part.requested == (PHOTONS // 2, PHOTONS) and fired == [PHOTONS // 2]
    rest = spadwarp.simulate(scene(), device="cpu", run=spadwarp.RunOptions(resume=part))
    assert not rest.partial
    first = spadwarp.simulate(scene(), **RUN, device="cpu", run=spadwarp.RunOptions(shard=(1, 2)))
    same(spadwarp.merge([rest, first]), whole[False])


def test_parts_that_make_no_sense_are_refused(whole):
    for shard, words in {(0, 4): "0/4", (5, 4): "5/4", (1, 10**6): "too few"}.items():
        with pytest.raises((spadwarp.ArgumentError, spadwarp.ConfigError), match=words):
            spadwarp.simulate(scene(), **RUN, device="cpu", run=spadwarp.RunOptions(shard=shard))
    for shard in (3, (1, 2, 3), (1.5, 2), ("1", 2)):
        with pytest.raises(spadwarp.ArgumentError, match=r"^shard"):
            spadwarp.simulate(scene(), **RUN, device="cpu", run=spadwarp.RunOptions(shard=shard))
    with pytest.raises(spadwarp.ConfigError, match="relative_error"):
        spadwarp.simulate(scene(), **RUN, device="cpu", relative_error=0.1, run=spadwarp.RunOptions(shard=(1, 2)))
    with pytest.raises(spadwarp.ConfigError, match="shard"):
        spadwarp.simulate(scene(), device="cpu", run=spadwarp.RunOptions(shard=(1, 2), resume=whole[False]))


# Checkpoints and failures


def failing_after(calls, monkeypatch, error):
    """Lets the launches after so many fail as a device does."""
    launch, left = spadwarp_kernels.launch_transport, [calls]
    lock = threading.Lock()

    def fail(*arguments, **options):
        with lock:
            left[0] -= 1
        if left[0] < 0:
            raise RuntimeError(error)
        launch(*arguments, **options)

    monkeypatch.setattr(spadwarp_kernels, "launch_transport", fail)


@pytest.mark.parametrize("device", ["cpu", "cpu,cpu"])
@pytest.mark.parametrize("uncertainty", [False, True])
def test_a_device_that_disappears_costs_what_was_not_kept(device, uncertainty, whole, tmp_path, monkeypatch):
    place = tmp_path / "checkpoint.h5"
    failing_after(120, monkeypatch, "CUDA error 719: unspecified launch failure")
    options = {**RUN, "device": device, "uncertainty": uncertainty}
    with pytest.raises(spadwarp.DeviceError) as caught:
        spadwarp.simulate(
            scene(),
            **options,
            run=spadwarp.RunOptions(threads=2, launch_size=1000, checkpoint=place, checkpoint_every=0.0),
        )
    monkeypatch.undo()
    kept = spadwarp.load_result(place)
    assert kept.partial and 0 < kept.photons <= 120_000 and kept.energy_report()["exact"]
    assert "cpu failed: CUDA error 719" in str(caught.value)
    assert f"{place}: the {kept.photons} photons that were done" in str(caught.value)
    same(spadwarp.simulate(scene(), device="cpu", run=spadwarp.RunOptions(resume=kept)), whole[uncertainty])


def test_a_device_without_memory_is_named(monkeypatch):
    def full(*arguments, **options):
        raise RuntimeError("Failed to allocate 1207959552 bytes on device 'cuda:0'")

    monkeypatch.setattr(spadwarp_kernels, "make_data", full)
    with pytest.raises(spadwarp.DeviceError, match="cpu has too little memory left: Failed to allocate 1207959552"):
        spadwarp.simulate(scene(), **RUN, device="cpu")


def test_a_full_disk_costs_no_photons(whole, tmp_path):
    """The checkpoint meets a limit on the size of files: the one before it stays, the run continues to its end."""
    resource = pytest.importorskip("resource")
    place = tmp_path / "checkpoint.h5"
    spadwarp.simulate(scene(), **{**RUN, "photons": 1000}, device="cpu").save(place)
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)

    def fill(stage, done, total):
        if stage == "trace":
            resource.setrlimit(resource.RLIMIT_FSIZE, (5000, limits[1]))

    # Few threads: many would have walked all photons before the first checkpoint is due.
    options = {**RUN, "device": "cpu", "progress": fill}
    try:
        with pytest.warns(RuntimeWarning, match=r"the run continues: .*checkpoint\.h5: cannot be written"):
            result = spadwarp.simulate(
                scene(),
                **options,
                run=spadwarp.RunOptions(threads=2, launch_size=2000, checkpoint=place, checkpoint_every=0.0),
            )
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    same(result, whole[False])
    kept = spadwarp.load_result(place)
    assert kept.photons == 1000 and [path.name for path in tmp_path.iterdir()] == ["checkpoint.h5"]
    same(spadwarp.simulate(scene(), photons=PHOTONS, device="cpu", run=spadwarp.RunOptions(resume=kept)), whole[False])


def test_a_resumed_run_counts_all_batches_for_its_stopping_rule(whole):
    part = whole[True]
    seen = []
    options = {
        "photons": 64 * part.batch_size,
        "device": "cpu",
        "run": spadwarp.RunOptions(resume=part),
        "relative_error": 1e-6,
    }
    run = spadwarp.simulate(scene(), **options, progress=lambda *report: seen.append(report[0]))
    assert run.photons == 64 * part.batch_size
    assert [remark.split(" after ")[1] for remark in seen if remark.startswith("error")][-1].startswith(
        "64 batches; about "
    )
