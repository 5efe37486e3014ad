"""Low words of a large tally: who keeps them apart, and that the sums are those of additions of 64 bits."""

import dataclasses
import itertools

import numpy as np
import pytest
import warp as wp

import spadwarp
import spadwarp_kernels as sk
from helpers.scenes import ELSEWHERE, TREE, scene
from helpers.statistics_of_samples import DEVICES
from spadwarp.device import pick_device
from spadwarp.mesh import build_mesh
from spadwarp.transport.model import build_model, transport_spec
from spadwarp_kernels.tally.tally import add_pending, fold_accumulators

PENCIL = {
    "laser": {"profile": "collimated", "position": [0.0, 0.0, 0.0]},
    "camera": {"width": 1, "height": 1, "horizontal_fov_deg": 50.0},
    "gate": {"bins": 1, "bin_width_ps": 8 * 3335.64095},
}
CASES = {
    "water": {"targets": [], "transport": {"estimator": "next_event"}},
    "plate": {"transport": {"estimator": "guided"}},
    "analog": {"transport": {"estimator": "analog"}},
    "tree": {"targets": [TREE], "transport": {"estimator": "next_event"}},
    "guided tree": {"targets": [TREE], "transport": {"estimator": "guided"}},
    "points": {"targets": [TREE], "medium": {"layers": ELSEWHERE}, "transport": {"points_per_flight": 3}},
    "pencil": PENCIL,
}


@pytest.fixture
def always(monkeypatch):
    """Low words pay for every tally."""
    monkeypatch.setattr("spadwarp_kernels.tally.tally.CACHE_BYTES", 0)
    monkeypatch.setattr("spadwarp_kernels.tally.tally.PHOTONS_PER_VOXEL", 0)


def built(sections, device):
    one = scene(**sections)
    mesh = build_mesh(one)
    return transport_spec(one, mesh), build_model(one, pick_device(device), mesh)


def tally_of(spec, model, launches=2, photons=100_000):
    data = sk.make_data(model)
    sums = []
    for i in range(launches):
        sk.launch_transport(spec, model, data, seed=3, first_id=i * photons, photon_count=photons)
        sums.append(data.tally.numpy().copy())  # on a CPU the array is the tally itself
    return sums, data


@pytest.mark.slow
@pytest.mark.parametrize(("device", "case"), [("cpu", "water"), *itertools.product(DEVICES[1:], CASES)])
def test_the_tally_has_the_same_bits_after_every_launch(always, device, case):
    spec, model = built(CASES[case], device)
    assert model.split_accumulators
    sums, data = tally_of(spec, model)
    expected, plain = tally_of(spec, dataclasses.replace(model, split_accumulators=False))
    for found, other in zip(sums, expected, strict=True):
        np.testing.assert_array_equal(found, other)
    assert plain.split_accumulators is None and expected[-1].max() > 2**32
    if device == "cpu":
        assert data.split_accumulators is None
    else:
        assert data.split_accumulators.shape == data.tally.shape and not data.split_accumulators.numpy().any()


@pytest.mark.slow
def test_smaller_launches_after_a_large_one_give_the_same_bits(monkeypatch, device):
    """Only the second of the three is large enough to begin with low words."""
    monkeypatch.setattr("spadwarp_kernels.tally.tally.CACHE_BYTES", 0)
    spec, model = built(CASES["water"], device)
    kept, plain = sk.make_data(model), sk.make_data(model)
    first = 0
    for photons in (200, 100_000, 200):
        for data, one in ((kept, model), (plain, dataclasses.replace(model, split_accumulators=False))):
            sk.launch_transport(spec, one, data, seed=3, first_id=first, photon_count=photons)
        first += photons
        np.testing.assert_array_equal(kept.tally.numpy(), plain.tally.numpy())
        assert (kept.split_accumulators is None) == (device == "cpu" or photons == first)


@wp.kernel
def add_kernel(
    voxel: wp.array(dtype=int),
    value: wp.array(dtype=wp.int64),
    tally: wp.array(dtype=wp.int64),
    split_accumulators: wp.array(dtype=wp.uint32),
):
    i = wp.tid()
    _ = add_pending(tally, split_accumulators, wp.vec2l(), voxel[i], value[i])


@pytest.mark.parametrize("device", DEVICES[1:])
def test_carries_and_values_of_more_than_32_bits(device):
    """Each voxel has 10^5 contributions of 1 to 42 bits, so that its low word goes round some thousand times."""
    random = np.random.default_rng(1)
    voxels = random.integers(0, 4, 400_000).astype(np.int32)
    values = random.integers(0, 1 << random.integers(1, 43, voxels.size))
    values[:5] = 2**32 - 1, 1, 2**32, 2**33 + 5, 2**58
    start = np.array([0, 2**32 - 1, 2**50, 7])
    expected = start.copy()
    np.add.at(expected, voxels, values)
    tally = wp.array(start, dtype=wp.int64, device=device)
    split_accumulators = wp.zeros(4, dtype=wp.uint32, device=device)
    inputs = [wp.array(array, device=device) for array in (voxels, values)]
    wp.launch(add_kernel, dim=voxels.size, inputs=[*inputs, tally, split_accumulators], device=device)
    fold_accumulators(split_accumulators, tally)
    np.testing.assert_array_equal(tally.numpy(), expected)
    assert not split_accumulators.numpy().any()


def test_only_where_their_memory_is_left(monkeypatch):
    """Half as much again as the histograms take, on the CPU 16 bytes a voxel with copy and total."""
    needed = 16 * 3 * 4 * 4 * 8
    for part, fits in ((1.6, True), (1.4, False)):
        monkeypatch.setattr("spadwarp.transport.model.physical_memory", lambda part=part: part * needed)
        assert built({}, "cpu")[1].split_accumulators is fits
    monkeypatch.setattr("spadwarp.transport.model.physical_memory", lambda: 0.9 * needed)
    with pytest.raises(spadwarp.DeviceError, match="are available"):
        built({}, "cpu")
