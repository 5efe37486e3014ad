"""The weights of the package: what they make of frames, and their metadata."""

import os
from pathlib import Path

import numpy as np
import pytest
import torch

from helpers.stepped_frames import GATE, denoised, noisy_frame, scene, scores
from spadwarp import ArgumentError, DeviceError, FileError
from spadwarp.denoise import baselines, estimate, inference, networks, weights_metadata
from spadwarp.denoise.frames import depth_frames
from spadwarp.denoise.network_files import MODELS, WEIGHTS
from spadwarp.denoise.networks import corrected_target, gates_of_target
from spadwarp.evaluation.drawn_scenes import evaluation_scene, noisy_depth, water_profile
from spadwarp.frames.backgrounds import bins_of_target, profile_of_depth
from spadwarp.io.arrays import read_exr

OF_DEPTH = [name for name in MODELS if name != "histograms"]
of_depth = pytest.mark.parametrize("model", OF_DEPTH)


CLEAN = scene(96, 128)
HALF = np.where((np.arange(96)[:, None] < 40) & (np.arange(128) < 40), np.nan, CLEAN)  # a corner sees nothing


def estimated(frames, **options):
    return inference.estimate_frames(frames, model="pyramid", device="cpu", **options)


def found_by_pyramid(frames):
    """Depth, and which pixels see a target."""
    found = estimated(frames)
    return found.depth, found.target_probability >= inference.target_threshold("pyramid")


@of_depth
def test_each_network_improves_a_frame_it_has_never_seen(model):
    noisy = noisy_frame(CLEAN)
    found = np.where(np.isfinite(CLEAN), denoised(noisy, model=model), np.nan)
    before, after = scores(CLEAN, noisy), scores(CLEAN, found)
    assert after.psnr > before.psnr + 3 and after.ssim > before.ssim


def test_pyramid_beats_the_median_and_knows_where_no_target_is():
    frames = depth_frames(noisy_frame(HALF, 0.48), gate=GATE)
    found, seen = found_by_pyramid(frames)
    assert np.isfinite(found).all()
    assert scores(HALF, found[0]).psnr > scores(HALF, baselines.median_filter(frames, window=5)[0]).psnr + 6
    assert np.mean(seen[0] == np.isfinite(HALF)) > 0.97


@pytest.mark.parametrize("shape", [(1, 1), (2, 5), (41, 67), (8, 100)])
@of_depth
def test_frames_of_any_size_are_denoised_independently(model, shape):
    frames = np.stack([noisy_frame(np.full(shape, 15.0), seed=seed) for seed in range(2)])
    found = denoised(frames, model=model)
    assert found.shape == (2, *shape) and found.dtype == np.float32
    for frame, one in zip(frames, found, strict=True):
        assert np.nanmax(np.abs(denoised(frame, model=model) - one)) < 1e-4


def test_a_large_frame():
    """Of more pixels than are computed at once."""
    found = denoised(np.full((400, 512), 15.0, np.float32))
    assert found.shape == (400, 512) and abs(np.nanmedian(found) - 15.0) < 0.01


@pytest.mark.parametrize("size", [(97, 129), (49, 113)])
def test_sides_that_are_not_multiples_of_16_invent_no_target(size):
    """Of a target in open water, where copies of the last row and column would agree as pixels of a target do."""
    target = evaluation_scene("vase", "open water", size=size)
    noisy = noisy_depth(target, water="uniform", level=0.1, seed=3)
    seen = found_by_pyramid(depth_frames(noisy, gate=GATE))[1][0]
    assert seen[~np.isfinite(target.clean)].mean() < 0.015


@pytest.mark.parametrize("missing", [0.5, 0.9])
@of_depth
def test_frames_with_few_reports(model, missing):
    """Nine of ten pixels may be missing: the median error is at most 1.5 times what it is when all report."""
    clean = np.nan_to_num(CLEAN, nan=15.0)
    noisy = noisy_frame(clean, 0.05)
    few = np.where(np.random.default_rng(5).random(noisy.shape) < missing, np.nan, noisy)
    errors = []
    for depth in (noisy, few):
        found = inference.estimate_frames(depth_frames(depth, gate=GATE), model=model, device="cpu")
        assert model != "pyramid" or (found.target_probability >= inference.target_threshold(model)).mean() > 0.94
        errors.append(np.median(np.abs(found.depth[0] - clean)))
    assert errors[1] < 1.5 * errors[0] + 0.001


@pytest.mark.parametrize("share", [0.1, 0.4])
@pytest.mark.parametrize("decay", [0.0, 5.0])
def test_backscatter_alone_is_no_target(share, decay):
    """In a frame of open water, where few pixels report and none of them a target, no target is invented."""
    generator = np.random.default_rng(6)
    profile = np.exp(-decay * np.arange(64) / 64)
    place = generator.choice(64, size=(96, 128), p=profile / profile.sum()) + generator.random((96, 128))
    depth = GATE[0] + (GATE[1] - GATE[0]) * place / 64
    depth[generator.random(depth.shape) >= share] = np.nan
    assert np.isfinite(denoised(depth, profile=profile, mask=0.5)).mean() < 0.01


def test_the_profile_of_backscatter_is_seen_in_the_depths():
    """Near-range backscatter alone, whose depths agree more often than those of uniform backscatter."""
    noisy = noisy_depth(evaluation_scene("nothing", "open water"), water="near-range", level=0.13, seed=3)
    found = inference.estimate(noisy, gate=GATE, device="cpu")
    assert (found.target_probability >= 0.08).mean() < 0.01
    profile = profile_of_depth(noisy, GATE)
    truth = water_profile("near-range", profile.size)
    assert np.abs(profile / profile.mean() - truth).mean() < 0.1
    uniform = noisy_depth(evaluation_scene("vase", "wall"), water="uniform", level=0.13, seed=3)
    assert profile_of_depth(uniform, GATE) is None


@pytest.mark.parametrize("water", ["near-range", "uniform"])
def test_rare_backscatter_alone_is_no_target(water):
    """Nor where so few pixels report that they could be those of a target that hardly reports."""
    noisy = noisy_depth(evaluation_scene("nothing", "open water"), water=water, level=0.042, seed=3)
    assert found_by_pyramid(depth_frames(noisy, gate=GATE, profile=water_profile(water)))[1].mean() < 0.01


def test_pixels_that_reported_outside_the_part_of_the_gate_are_more_likely_target_than_those_that_did_not():
    """All pixels of the target report, a tenth of those of the water: a frame whose answer Bayes' rule gives."""
    generator = np.random.default_rng(4)
    hit = np.arange(100 * 100).reshape(100, 100) % 100 < 50
    beyond = generator.random(hit.shape) < np.where(hit, 0.3, 0.1)
    absent = ~hit & ~beyond
    sure = generator.random(hit.shape) < 0.9
    logit = torch.from_numpy(np.where(sure, np.where(hit, 3.0, -5.0), -1.0))[None]
    depth, given = np.where(absent, np.nan, 0.5), ~absent & ~beyond
    found = corrected_target(logit, torch.from_numpy(depth)[None], torch.from_numpy(given)[None].float(), torch.ones(1))
    change = (found - logit)[0].numpy()
    assert np.all(change[given] == 0.0) and np.all(change[absent] == -3.0)  # the largest correction
    # Reported outside that part: 1 of the target's pixels without a depth in it, 0.1 of the water's.
    assert np.allclose(change[beyond], np.log(1.0 / 0.1), atol=0.1)
    less = corrected_target(logit, torch.zeros_like(logit), torch.ones_like(logit), torch.tensor([0.1]))
    assert torch.allclose(less, logit + np.log(0.1))


def test_every_pixel_has_a_depth_and_the_mask_is_a_choice():
    noisy = np.where(np.isnan(HALF), np.nan, noisy_frame(HALF, 0.1))
    found = estimate(noisy, gate=GATE, device="cpu")
    assert np.isfinite(found.depth).all() and np.array_equal(denoised(noisy), found.depth)
    assert found.target_probability.min() >= 0 and found.confidence.max() <= 1
    masked = denoised(noisy, mask=0.5)
    assert np.array_equal(np.isnan(masked), found.target_probability < 0.5)
    assert np.mean(np.isnan(masked) == np.isnan(HALF)) > 0.98
    found = estimate(np.where(np.isnan(HALF), np.nan, noisy_frame(HALF, 0.55)), gate=GATE, device="cpu")
    right = np.abs(found.depth - HALF) < 0.01 * 2.5
    assert found.confidence[right].mean() > found.confidence[np.isfinite(HALF) & ~right].mean()


def test_layers_in_bfloat16_answer_as_those_in_float32():
    target = evaluation_scene("rings", "open water", size=(96, 128))
    frames = depth_frames(noisy_depth(target, water="uniform", level=0.264, seed=5), gate=GATE)
    seen = np.isfinite(target.clean)
    first, second = (estimated(frames, precision=precision) for precision in ("float32", "bfloat16"))
    assert np.median(np.abs(first.depth - second.depth)[0, seen]) < 1e-4
    errors = [10.0 * np.log10(np.mean((one.depth[0] - target.clean)[seen] ** 2)) for one in (first, second)]
    assert abs(errors[0] - errors[1]) < 0.5
    assert np.abs(first.target_probability - second.target_probability).mean() < 1e-3


def test_values_beyond_the_range_of_float16_are_computed_in_float32_or_refused(monkeypatch):
    frames = depth_frames(noisy_frame(scene(64, 64)), gate=GATE)
    load = networks.load_network

    def overflowing(model, weights=None, device="cpu", precision="float32"):
        network = load(model, weights, device, "float32")
        return network if precision == "float32" else lambda given: network(given) * torch.inf

    monkeypatch.setattr(networks, "load_network", overflowing)
    monkeypatch.setattr(inference, "fast_precision", lambda device: "float16")
    exact = estimated(frames, precision="float32")
    np.testing.assert_array_equal(estimated(frames).depth, exact.depth)
    with pytest.raises(ArgumentError, match="precision = 'float16': the network 'pyramid' gave values that are not"):
        estimated(frames, precision="float16")


def test_a_shift_by_a_pixel_hardly_changes_the_answer():
    noisy = noisy_frame(np.nan_to_num(scene(97, 129), nan=15.0))
    first, second = denoised(noisy[:-1, :-1]), denoised(noisy[1:, 1:])
    assert np.median(np.abs(first[1:, 1:] - second[:-1, :-1])) < 1e-3


def test_a_gate_twice_too_wide_changes_little():
    target = evaluation_scene("vase", "open water", size=(96, 128))
    noisy, seen = noisy_depth(target, water="front", level=0.264, seed=3), np.isfinite(target.clean)
    own, wide = (np.linalg.norm((denoised(noisy, gate=gate) - target.clean)[seen]) for gate in (GATE, (12.25, 17.25)))
    assert wide < 1.3 * own


def test_a_line_one_pixel_wide_is_kept_where_backscatter_is_rare():
    clean = np.full((64, 96), 14.6, np.float32)
    clean[:, 20::25] = 14.95
    noisy = noisy_frame(clean, 0.042, seed=4)
    found, line = denoised(noisy), clean > 14.9
    assert np.mean(np.abs(found - clean)[line] < 0.05) > 0.8  # the others report backscatter, or one beside them does


def test_the_gate_is_narrowed_to_where_depths_agree():
    def gates(frames):
        return gates_of_target(torch.from_numpy(frames.scaled), torch.from_numpy(frames.density))

    target, water = evaluation_scene("spiral", "open water"), evaluation_scene("nothing", "open water")
    noisy = [noisy_depth(scene, water="uniform", level=0.264, seed=1) for scene in (target, water)]
    starts, widths, parts = gates(depth_frames(np.stack(noisy), gate=(12.0, 20.0)))
    start, stop = 12.0 + 8.0 * starts[0], 12.0 + 8.0 * (starts[0] + widths[0])
    assert 12.5 < start < np.nanmin(target.clean) and np.nanmax(target.clean) < stop < 17.5
    assert (starts[1], widths[1], parts[0]) == (0.0, 1.0, 1.0)
    assert gates(depth_frames(noisy[1], gate=GATE))[2][0] < 0.01  # of water, no target takes more than this part


def test_a_small_steep_target_is_seen_whole():
    random = np.random.default_rng(5)
    target = np.full((48, 64), np.nan)
    target[16:31, 20:44] = np.linspace(13.9, 15.2, 24)  # 2.3 % of the gate from pixel to pixel
    noisy = np.where(random.random(target.shape) < 0.3, random.uniform(13.5, 16.0, target.shape), target)
    noisy += random.normal(0.0, 0.01, target.shape)
    found = estimate(noisy, gate=(13.5, 16.0))
    seen = np.isfinite(target)
    assert np.mean(found.target_probability[seen] > inference.target_threshold("pyramid")) > 0.95
    assert np.mean(found.target_probability[~seen] > inference.target_threshold("pyramid")) < 0.1
    assert np.mean(np.abs(found.depth - target)[seen] < 0.06) > 0.8  # steps from pixel to pixel are 0.057 m


def test_the_bins_of_the_target_are_those_of_the_excess():
    generator, level = np.random.default_rng(2), np.full(512, 0.1)
    rate = np.full((24, 24, 512), 0.1)
    water = generator.poisson(rate)
    rate[..., 200:240] += 0.05
    first, stop = bins_of_target(generator.poisson(rate), level, np.ones(5))
    assert 170 < first <= 200 and 240 <= stop < 270
    assert bins_of_target(water, level, np.ones(5)) == (0, 512)


@pytest.mark.parametrize("model", [*OF_DEPTH, "median", "gating"])
def test_an_empty_frame_stays_empty(model):
    for empty in (np.full((32, 40), np.nan), np.zeros((2, 32, 40), np.float32)):
        assert np.isnan(denoised(empty, model=model)).all()


def test_distance_does_not_matter_but_the_place_in_the_gate_does():
    noisy = noisy_frame(scene())
    exact = {"precision": "float32"}  # rounding of the depths at 50 m remains
    far = denoised(noisy + 35.0, gate=(GATE[0] + 35.0, GATE[1] + 35.0), **exact)
    assert np.nanmax(np.abs(far - 35.0 - denoised(noisy, **exact))) < 2e-3


def test_depth_outside_the_gate_is_left_out_with_a_warning():
    depth = np.full((32, 32), 15.0, np.float32)
    depth[:4] = 40.0
    with pytest.warns(UserWarning, match="128 of 1024 depths lie outside the gate of 13.5 to 16 m"):
        found = denoised(depth)
    assert np.nanmax(found) <= 16.0


HISTOGRAMS = {"counts": np.zeros((16, 16, 8)), "background": np.ones(8), "response": np.ones(3)}
REFUSED = {
    r"depth has shape \(5,\)": {"depth": np.zeros(5)},
    "depth is <U1": {"depth": np.full((16, 16), "a")},
    "at least one frame of one pixel": {"depth": np.ones((0, 40))},
    "outside": {"depth": -np.ones((16, 16))},
    r"gate = \(16.0, 13.5\) m is not \(start, stop\)": {"gate": (16.0, 13.5)},
    "gate": {"gate": (1.0, np.inf)},
    "model = 'unet'": {"model": "unet"},
    "profile": {"profile": [-1.0, 2.0]},
    r"mask = 1\.5": {"mask": 1.5},
    "precision = 'float8' is not one of": {"precision": "float8"},
    "no such file": {"weights": Path("none.safetensors")},
    "of 'usdn', not of 'dncnn'": {"model": "dncnn", "weights": WEIGHTS / "usdn.safetensors"},
    "cuda:77": {"device": "cuda:77"},
    "counts are float64": HISTOGRAMS | {"counts": np.zeros((16, 16))},
    "background has shape": HISTOGRAMS | {"background": np.zeros(5)},
    "needs counts and response": HISTOGRAMS | {"response": None},
    "response has shape": HISTOGRAMS | {"response": np.ones(4)},
    r"depth has shape \(16, 16\); \(20, 16\) is needed": HISTOGRAMS | {"counts": np.zeros((20, 16, 8))},
    r"counts = -1.0 … -1.0 are outside \[0, inf\)": HISTOGRAMS | {"counts": -np.ones((16, 16, 8))},
    "counts = nan": HISTOGRAMS | {"counts": np.full((16, 16, 8), np.nan)},
    "counts are complex128": HISTOGRAMS | {"counts": np.zeros((16, 16, 8), complex)},
    "response = 'gaussian' is not an array of real numbers": HISTOGRAMS | {"response": "gaussian"},
    "weights are for a network, not for 'likelihood'": HISTOGRAMS | {"model": "likelihood", "weights": "a.safetensors"},
}


@pytest.mark.parametrize("message", REFUSED)
def test_errors_name_what_is_wrong(message):
    with pytest.raises((ArgumentError, DeviceError, FileError), match=message):
        denoised(**{"depth": np.full((16, 16), 15.0), **REFUSED[message]})


@pytest.mark.parametrize("model", MODELS)
def test_weights_hold_how_they_were_made(model):
    metadata = weights_metadata(model)
    assert metadata["model"] == metadata["recipe"]["model"] == model
    assert metadata["recipe"].get("data") == (None if model in ("pyramid", "histograms") else "data/training")
    assert float(metadata["hours"]) < 10 / 60
    assert min(metadata["validation_psnr"].values()) > 10
    assert sum(file.stat().st_size for file in WEIGHTS.iterdir()) < 8e6


EXTRA = Path(os.environ.get("SPADWARP_EXTRA_DATA", "/nowhere")) / "ue_exr"


@pytest.mark.skipif(not EXTRA.is_dir(), reason="SPADWARP_EXTRA_DATA holds no ue_exr")
@pytest.mark.parametrize("name", ["babiao", "cat"])
def test_exports_of_an_engine_are_denoised_as_well_as_other_frames(name):
    """A game engine's depth, in steps of 1 cm, with outliers: 18 dB are gained at a backscatter fraction of 0.264."""
    channels, _ = read_exr(EXTRA / f"{name}_RGBD.EXR")
    clean = channels["A"].astype(np.float32) / 100
    clean[(clean < GATE[0]) | (clean >= GATE[1])] = np.nan
    noisy = noisy_frame(clean, 0.264)
    found, _ = found_by_pyramid(depth_frames(noisy, gate=GATE))
    assert scores(clean, found[0]).psnr > scores(clean, noisy).psnr + 18
