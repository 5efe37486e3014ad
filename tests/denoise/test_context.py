"""Both sides of depth edges, the wide view that weighs them, and what tells scattered light from a target."""

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from scipy.ndimage import convolve1d, gaussian_filter
from scipy.stats import expon, norm

from spadwarp.denoise import estimate
from spadwarp.denoise.frames import POOLED, SCORED, SIDES
from spadwarp.denoise.histogram_features import FEATURES, REACHES, beside_edges, light_channels
from spadwarp.denoise.network_files import WEIGHTS
from spadwarp.denoise.networks import ANSWERS, Context, answer

BINS = 96
TAPS = np.diff(norm.cdf(np.arange(-4.5, 5.0), scale=1.2))
RESPONSE = TAPS / TAPS.sum()
GATE = (10.0, 12.4)


def counts_of(bin_of, photons, background, seed, share=1.0, second=0.0):
    """Poisson counts of returns at `bin_of`, and of a part 1 − share of them `second` bins later, `[H, W, BINS]`."""
    edges = np.arange(BINS + 1.0)
    first, late = (np.diff(norm.cdf(edges - (bin_of + apart)[..., None], scale=1.2)) for apart in (0.0, second))
    rate = photons * (share * first + (1.0 - share) * late) + background / BINS
    return np.random.default_rng(seed).poisson(rate).astype(np.float32)


def found_in(counts, background, gate=GATE, weights=None):
    """Depth and probabilities of the network; the depths given are those of the most counts."""
    depth = gate[0] + (gate[1] - gate[0]) * (counts.argmax(axis=-1) + 0.5) / counts.shape[-1]
    given = {"background": np.full(counts.shape[-1], background / BINS), "response": RESPONSE, "weights": weights}
    return estimate(depth, gate=gate, model="histograms", counts=counts, device="cpu", **given)


def bins_of(depth):
    return (depth - GATE[0]) / (GATE[1] - GATE[0]) * BINS


def stepped(height=48, width=48, bins=(30.5, 60.5)):
    """A step of depth along a column, in bins."""
    return np.where(np.arange(width) < width // 2, *bins) + np.zeros((height, 1))


def test_both_sides_of_a_step_are_named_up_to_the_reach():
    """Beside the edge the two surfaces, elsewhere the same depth twice; the nearer one always first."""
    usual = torch.from_numpy(stepped() / BINS).float()[None]
    depths = beside_edges(torch.zeros(1, 48, 48, BINS), usual)
    for number, reach in enumerate(REACHES):
        front, back = depths[0, 20, :, 2 * number].numpy() * BINS, depths[0, 20, :, 2 * number + 1].numpy() * BINS
        beside = slice(24 - reach, 24 + reach)
        np.testing.assert_allclose(front[beside], 30.5, atol=1e-3)
        np.testing.assert_allclose(back[beside], 60.5, atol=1e-3)
        elsewhere = np.r_[0 : 24 - reach, 24 + reach : 48]
        np.testing.assert_allclose(front[elsewhere], back[elsewhere], atol=1e-4)


@pytest.mark.parametrize("turn, mirrored", [(0, True), (1, False), (3, True)])
def test_turned_frames_give_the_turned_answer(turn, mirrored):
    """To rounding: the depth, and both probabilities."""

    def turned(image):
        return np.ascontiguousarray(np.rot90(np.flip(image, 1) if mirrored else image, turn))

    counts = counts_of(stepped(), 4.0, 4.0, seed=3)
    plain, other = found_in(counts, 4.0), found_in(turned(counts), 4.0)
    apart = np.abs(turned(plain.depth) - other.depth)
    assert np.quantile(apart, 0.99) < 1e-5 * (GATE[1] - GATE[0])  # of ties between candidates either may be taken
    for name in ("target_probability", "confidence"):
        assert np.quantile(np.abs(turned(getattr(plain, name)) - getattr(other, name)), 0.99) < 1e-3


def test_the_answer_moves_with_the_gate():
    counts = counts_of(stepped(), 5.0, 4.0, seed=4)
    plain, moved = found_in(counts, 4.0), found_in(counts, 4.0, gate=(110.0, 112.4))
    np.testing.assert_allclose(moved.depth - 100.0, plain.depth, atol=1e-4)


@pytest.mark.parametrize("shape", [(8, 8), (9, 30), (33, 17)])
def test_any_size(shape):
    found = found_in(counts_of(stepped(*shape), 20.0, 4.0, seed=5), 4.0)
    assert found.depth.shape == shape and np.isfinite(found.depth).all()


def test_with_many_photons_one_candidate_is_the_answer_and_with_few_their_mean():
    depths, scores, features = (torch.zeros(1, channels, 8, 8) for channels in (ANSWERS, ANSWERS, FEATURES))
    depths[:, ::2], depths[:, 1::2], scores[:, 1] = 0.3, 0.6, 0.1
    place = POOLED + SCORED * POOLED  # a tenth of the highest log-likelihood of the pixel
    for likelihood, low, high in ((2.0, 0.5999, 0.6001), (0.1, 0.4, 0.5)):
        features[:, place] = likelihood
        found = answer(depths, scores, features)
        assert ((found > low) & (found < high)).all()


def test_two_returns_are_not_averaged():
    """Of two returns with 60 and 40 % of 200 photons, 20 bins apart, each pixel has one, mostly the first."""
    counts = counts_of(np.full((32, 32), 30.5), 200.0, 4.0, seed=6, share=0.6, second=20.0)
    place = bins_of(found_in(counts, 4.0).depth)
    assert not ((place > 31.5) & (place < 49.5)).any()
    assert np.mean(np.abs(place - 30.5) < 1.0) > 0.99


@pytest.mark.slow
def test_few_photons_beside_an_edge_are_answered_better_with_the_wide_view(tmp_path):
    """Two signal photons a pixel among ten of the background; over six noises 0.75 ± 0.05 times the squared error."""
    torch.manual_seed(1)
    new = {f"context.{name}": value for name, value in Context().state_dict().items()}  # keeps the answer before
    save_file({**load_file(WEIGHTS / "histograms.safetensors"), **new}, tmp_path / "without", {"model": "histograms"})
    row, column = np.mgrid[:64, :64]
    place = np.where((row - 30) ** 2 + (column - 33) ** 2 < 400, 30.5, 60.5)
    errors = []
    for seed in range(10, 16):
        counts = counts_of(place, 2.0, 10.0, seed=seed)
        both = (bins_of(found_in(counts, 10.0, weights=one).depth) for one in (tmp_path / "without", None))
        errors.append([np.nanmean((found - place) ** 2) for found in both])  # two of 24 576 pixels have no detection
    without, whole = np.mean(errors, axis=0)
    assert whole < 0.9 * without


def test_new_layers_change_nothing():
    """A new wide view answers nearly as the network did before, and the view leaves the target's logit."""
    torch.manual_seed(1)
    features = torch.randn(1, FEATURES, 17, 24)
    features[:, -SIDES:] = torch.rand(1, SIDES, 17, 24)
    found, logits = torch.rand(1, 1, 17, 24), torch.randn(1, 3, 17, 24)
    depths, scores, target = Context()(found, logits, features)
    assert depths.shape == scores.shape == (1, ANSWERS, 17, 24) and not target.any()
    assert (torch.softmax(scores, dim=1)[:, 0].median() > 0.4).all()


def test_scattered_light_is_dimmer_and_later_than_a_target():
    """Light from a target in the left half, 5 % of it delayed by 8 bins on average in the right half; many photons."""
    edges = np.arange(BINS + 1.0)
    direct = np.diff(norm.cdf(edges - 30.5, scale=1.2))
    late = np.convolve(direct, np.diff(expon.cdf(np.arange(41.0), scale=8.0)))[:BINS]
    above = torch.from_numpy(1000.0 * np.where(np.arange(48)[:, None] < 24, direct, 0.05 * late)).float()
    above = above.expand(1, 48, 48, BINS).contiguous()
    level = torch.full((1, BINS), 0.1)
    place = above.argmax(dim=-1).add(0.5) / BINS
    channels = torch.stack(light_channels(above, level, place, torch.from_numpy(RESPONSE).float()[None]))[:, 0, 24]
    left, right = channels[:, 4], channels[:, 40]
    dimmer = (right[3] - left[3]) / 0.3  # ln of the brightness relative to the brightest within 30 pixels
    assert abs(float(dimmer) - np.log(0.05)) < 0.15
    assert left[8] > 0.9 and right[8] < 0.5 and left[10] < 0.01 and right[10] > 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("size", "wrong"), [(64, 0.05), (192, 0.01)])
def test_scattered_light_beside_a_bright_target_and_far_from_it_is_water(size, wrong):
    """A ball in open water, 800 counts a pixel, and three tenths more light that is late and beside.

    With the mean signal of the whole wide frame, the network invents targets in 37 % of the water.
    """
    row, column = np.mgrid[:size, :size] - 0.5 * (size - 1)
    seen = row**2 + column**2 < 15.0**2
    place = 40.5 - 3.0 * np.sqrt(np.maximum(0.0, 1.0 - (row**2 + column**2) / 15.0**2))
    direct = 800.0 * seen[..., None] * np.diff(norm.cdf(np.arange(BINS + 1.0) - place[..., None], scale=1.2))
    delays = np.diff(expon.cdf(np.arange(41.0), scale=6.0))
    late = convolve1d(gaussian_filter(direct, (8.0, 8.0, 0.0)), delays, axis=-1, mode="constant", origin=-20)
    counts = np.random.default_rng(8).poisson(direct + 0.3 * late + 11.0 / BINS).astype(np.float32)
    found = found_in(counts, 11.0)
    assert np.mean(found.target_probability[seen] < 0.5) < wrong
    assert np.mean(found.target_probability[~seen] > 0.5) < wrong
    assert size > 64 or np.median(np.abs(bins_of(found.depth) - place)[seen]) < 0.2


@pytest.mark.parametrize("photons", [1.0, 30.0])
def test_a_wall_in_a_frame_wider_than_the_crops_of_the_training_is_target(photons):
    """Also where no border is near: only wide crops have such a place, and none one 72 pixels from its border."""
    place = 24.0 + 3.0 * np.sin(np.arange(144.0) / 40.0)
    light = np.diff(norm.cdf(np.arange(BINS + 1.0) - place[:, None, None], scale=1.2))
    rate = photons * light + 0.2 * photons / BINS
    counts = np.random.default_rng(4).poisson(np.broadcast_to(rate, (144, 144, BINS))).astype(np.float32)
    assert np.mean(found_in(counts, 0.2 * photons).target_probability < 0.5) < 0.01
