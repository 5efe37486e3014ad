"""torch: the same numbers, in shared memory, wherever they lie."""

import dataclasses
import functools

import numpy as np
import pytest
import warp as wp

import spadwarp
from helpers.scenes import scene as make_scene
from spadwarp.frames.spad import first_photon_probabilities

torch = pytest.importorskip("torch")

SECTIONS = {
    "laser": {"half_angle_deg": 20.0, "position": [-0.1, 0.0, 0.0], "pulse_energy": 1e-14, "repetition_rate": 1e7},
    "detector": {"dark_count_rate": 1e4, "pulses_per_frame": 2000},
    "transport": {"photons": 20_000, "seed": 1, "max_collisions": 12, "axis_threshold": 1.0},
}
SHAPE = (3, 4, 4, 8)


@pytest.fixture(scope="module")
def scene():
    return make_scene(**SECTIONS)


@pytest.fixture(scope="module")
def result(scene):
    return spadwarp.simulate(scene, device="cpu")


@pytest.mark.parametrize("kind", ["torch", "warp"])
def test_tallies_of_the_caller(scene, result, kind):
    """They are overwritten, and hold the bits of any run of the seed."""
    if kind == "torch":
        mine = torch.full(SHAPE, 5, dtype=torch.int64)
    else:
        mine = wp.full(int(np.prod(SHAPE)), 5, dtype=wp.int64, device="cpu")
    seen = mine.numpy().reshape(SHAPE)
    filled = spadwarp.simulate(scene, device="cpu", tallies=mine)
    assert np.array_equal(filled.tallies, seen) and np.shares_memory(filled.tallies, seen)
    assert np.array_equal(seen, result.tallies)


def test_results_stay_on_the_device(scene, device):
    """Tallies, histograms and frames are tensors where the photons were traced, with the numbers of the host's."""
    mine = torch.full(SHAPE, 5, dtype=torch.int64, device=device)
    traced = spadwarp.simulate(scene, device=device, tallies=mine)
    expected = spadwarp.simulate(scene, device=device)
    view = spadwarp.result.to_torch(traced, tallies=mine)
    frames, host = spadwarp.detect(view, seed=5), spadwarp.detect(expected, seed=5, device=device)
    for tensor, numbers in (
        (view.tallies, expected.tallies),
        (view.histogram, expected.histogram),
        (frames.counts, host.counts),
        (frames.arrival_time("matched"), host.arrival_time("matched", device=device)),
    ):
        assert tensor.device == mine.device
        assert np.array_equal(tensor.cpu().numpy(), numbers, equal_nan=numbers.dtype.kind == "f")


def test_results_and_frames_share_their_memory(result):
    view = spadwarp.result.to_torch(result)
    for one, other in ((view.tallies, result.tallies), (view.truth.depth, result.truth.depth)):
        assert np.shares_memory(one.numpy(), other)
    assert np.array_equal(view.histogram.numpy(), result.histogram)
    assert np.array_equal(view.component("backscatter").numpy(), result.component("backscatter"))
    assert np.allclose(view.detections.numpy(), result.detections, rtol=1e-15)
    assert np.allclose(view.intensity.numpy(), result.intensity, rtol=1e-12)
    with pytest.raises(ValueError, match="'fog' is not one of"):
        view.component("fog")

    flat = torch.from_numpy(result.tallies).flatten()
    assert spadwarp.result.to_torch(result, tallies=flat).tallies.shape == SHAPE
    with pytest.raises(ValueError, match=r"torch\.int32 \(384,\); torch\.int64 \(3, 4, 4, 8\) is needed"):
        spadwarp.result.to_torch(result, tallies=flat.int())

    frames = spadwarp.detect(result, seed=5, device="cpu")
    view = spadwarp.result.to_torch(frames)
    for name in ("counts", "expected", "background"):
        assert np.shares_memory(getattr(view, name).numpy(), getattr(frames, name))
    assert dataclasses.replace(view, counts=frames.counts).seed == frames.seed


@pytest.mark.parametrize(
    ("mode", "summed"),
    [("first_photon", False), ("free_running", True), pytest.param("daylight", False, marks=pytest.mark.slow)],
)
def test_frames_are_the_same_in_torch(result, mode, summed):
    sections = {"detector.mode": "free_running", "detector.dead_time_ns": 20.0} if mode == "free_running" else {}
    sections |= {"daylight": {"sun_elevation_deg": 30.0, "depth": 20.0}} if mode == "daylight" else {}
    result = dataclasses.replace(result, scene=result.scene.with_overrides(sections))
    options = {"frames": 3, "seed": 5, "device": "cpu", "summed": summed}
    expected, frames = (spadwarp.detect(one, **options) for one in (result, spadwarp.result.to_torch(result)))
    for name in ("counts", "expected", "background", "intensity"):
        one, other = getattr(frames, name), getattr(expected, name)
        assert isinstance(one, torch.Tensor) and one.numpy().dtype == other.dtype, name
        assert np.array_equal(one.numpy(), other), name
    for method in ("centroid", "matched", "likelihood"):
        times = frames.arrival_time(method, device="cpu")
        assert isinstance(times, torch.Tensor) and times.dtype == torch.float64
        assert np.array_equal(times.numpy(), expected.arrival_time(method, device="cpu"), equal_nan=True)
    if mode == "first_photon" and not summed:
        undone = frames.arrival_time(undo_pile_up=True)
        again = expected.arrival_time(undo_pile_up=True, device="cpu")
        assert np.array_equal(undone.numpy(), again, equal_nan=True)

    mine = torch.full(expected.counts.shape, -1, dtype=torch.int32)
    filled = spadwarp.detect(result, out=mine, **options)
    assert filled.counts.data_ptr() == mine.data_ptr() and np.array_equal(mine.numpy(), expected.counts)


def test_laws_are_the_same_in_torch():
    random = np.random.default_rng(2)
    hazard, counts = random.uniform(0.0, 0.2, (2, 3, 8)), random.poisson(3.0, (2, 3, 8))
    coates = functools.partial(spadwarp.frames.coates, pulses=1000)
    for law, values in ((first_photon_probabilities, hazard), (coates, counts)):
        found = law(torch.from_numpy(values))
        assert isinstance(found, torch.Tensor) and np.array_equal(found.numpy(), law(values, device="cpu"))


@pytest.mark.parametrize(
    ("tallies", "words"),
    [
        (torch.zeros(SHAPE, dtype=torch.int32), r"int32 \(3, 4, 4, 8\) on cpu; contiguous int64"),
        (torch.zeros(2, dtype=torch.int64), r"int64 \(2,\)"),
        (torch.zeros((*SHAPE, 2), dtype=torch.int64)[..., 0], "contiguous int64"),
        (np.zeros(SHAPE, np.int64), "a torch tensor or a Warp array is needed"),
    ],
)
def test_tallies_that_do_not_fit_are_refused(scene, tallies, words):
    with pytest.raises(ValueError, match=words):
        spadwarp.simulate(scene, photons=10, device="cpu", tallies=tallies)


@pytest.mark.parametrize(
    ("out", "words"),
    [
        (torch.zeros((1, 4, 4, 8), dtype=torch.int64), r"torch\.int64 \(1, 4, 4, 8\) on cpu; contiguous torch\.int32"),
        (np.zeros((1, 4, 4, 8), np.int32), "out is a ndarray; a torch tensor is needed"),
    ],
)
def test_counts_that_do_not_fit_are_refused(result, out, words):
    with pytest.raises(ValueError, match=words):
        spadwarp.detect(result, out=out, seed=5, device="cpu")
