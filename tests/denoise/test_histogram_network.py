"""The network for histograms: its log-likelihoods, its distribution, and what its weights make of light."""

import numpy as np
import pytest
import torch
from scipy.linalg import toeplitz
from scipy.ndimage import convolve1d, gaussian_filter
from scipy.stats import expon, norm

from helpers.stepped_frames import denoised
from spadwarp.denoise import estimate, inference, second_return, synthetic_noise
from spadwarp.denoise.classical import log_likelihood
from spadwarp.denoise.histogram_network import HistogramNet, answer, halved, light_channels
from spadwarp.denoise.histograms import count_frames, target_bins
from spadwarp.denoise.recipe import Noise

BINS, SIGMA = 128, 1.2  # bins of the gate, response [bins]
TAPS = norm.pdf(np.arange(-6, 7), scale=SIGMA)
GATE = (10.0, 12.56)


def histograms(place, photons, background, *, side=32, bins=BINS, seed=1, share=1.0, second=0.0):
    """Counts `[side, side, bins]` of returns at `place` [bins], and the background `[bins]`, which falls by e^2.

    A part 1 − `share` of the photons arrives `second` bins later.
    """
    edges = np.arange(bins + 1) - np.asarray(place)[..., None]
    law = norm(scale=SIGMA * bins / BINS)
    level = np.exp(-2 * np.arange(bins) / bins)
    level *= background / level.sum()
    light = (part * np.diff(law.cdf(edges - apart)) for part, apart in ((share, 0.0), (1.0 - share, second)))
    counts = np.random.default_rng(seed).poisson(np.broadcast_to(photons * sum(light) + level, (side, side, bins)))
    return counts.astype(np.float32), level.astype(np.float32)


def tensors(counts, level, taps=TAPS):
    level = np.reshape(level, (1, 1, -1)) if np.ndim(level) == 1 else level
    return [torch.tensor(np.asarray(values, np.float32))[None] for values in (counts, level, taps / taps.sum())]


def found_in(counts, level, taps=TAPS, gate=GATE):
    """Depth in bins, and probabilities; the depths given are those of the most counts."""
    bins = counts.shape[-1]
    depth = gate[0] + (gate[1] - gate[0]) * (counts.argmax(axis=-1) + 0.5) / bins
    given = {"background": level, "response": taps, "min_significance": 0.0, "device": "cpu"}
    found = estimate(depth, gate=gate, model="histograms", counts=counts, **given)
    return found._replace(depth=(found.depth - gate[0]) / (gate[1] - gate[0]) * bins)


def test_the_log_likelihood_is_that_of_poisson_counts():
    """Differences between bins, against the sum over bins in float64, for the mean signal of the frame."""
    counts, level = histograms(70.3, 5.0, 20.0, side=6)
    found = log_likelihood(*tensors(counts, level))[0].double().numpy()
    signal = float((counts - level).sum(axis=-1).mean())
    shape = norm.pdf(toeplitz(np.arange(BINS)), scale=SIGMA) * (np.abs(toeplitz(np.arange(BINS))) <= 6) / TAPS.sum()
    floor = level.astype(np.float64) + 0.3 * signal / BINS
    expected = (counts - level).astype(np.float64) @ np.log1p(signal * shape / floor[:, None])
    np.testing.assert_allclose(found, expected, atol=2e-3, rtol=1e-4)


@pytest.mark.parametrize("shape", [(1, 1, 1), (5, 9, 64), (16, 8, 33)])
def test_probabilities_of_any_size_add_up_to_one(shape):
    torch.manual_seed(2)
    network = HistogramNet((4, 8, 8, 8)).eval()
    counts = np.random.default_rng(1).poisson(0.2, shape)
    with torch.inference_mode():
        log_probability, target = network(*tensors(counts, np.full(shape[-1], 0.2)))
    assert log_probability.shape == (1, *shape) and target.shape == (1, *shape[:2])
    torch.testing.assert_close(log_probability.exp().sum(dim=-1), torch.ones(1, *shape[:2]))


def test_the_answer_is_the_mean_and_its_confidence_what_is_near():
    probability = torch.full((1, 1, 2, 100), 1e-12)
    probability[0, 0, 0, 40:42] = 0.5  # middle 0.41
    probability[0, 0, 1, [20, 80]] = 0.5
    depth, confidence = answer(probability.log())
    torch.testing.assert_close(depth[0, 0], torch.tensor([0.41, 0.505]))
    torch.testing.assert_close(confidence[0, 0], torch.tensor([1.0, 0.0]), atol=1e-6, rtol=0.0)


def test_large_frames_are_computed_in_parts(monkeypatch):
    """Beyond the reach of the weights a pixel has the same depth in a part as in the whole."""
    counts, level = histograms(np.linspace(40.0, 80.0, 96) + np.zeros((96, 1)), 30.0, 5.0, side=96)
    whole = found_in(counts, level).depth
    monkeypatch.setattr(inference, "_LEAST_PART", 48)
    monkeypatch.setattr(inference, "_AT_ONCE", 1)
    assert np.quantile(np.abs(found_in(counts, level).depth - whole), 0.99) < 0.05


def test_many_photons_give_depth_to_fractions_of_a_bin():
    slope = np.linspace(40.0, 80.0, 32) + np.zeros((32, 1))
    found = found_in(*histograms(slope, 500.0, 5.0)).depth
    assert np.sqrt(np.mean((found - slope)[2:-2, 2:-2] ** 2)) < 0.2  # the bound is 0.06


def test_neighbours_find_what_pixels_cannot():
    """One signal photon among twenty of the background."""
    counts, level = histograms(70.3, 1.0, 20.0)
    alone = log_likelihood(*tensors(counts, level))[0].argmax(dim=-1).numpy() + 0.5
    assert np.mean(np.abs(alone - 70.3) < 2) < 0.4
    assert np.mean(np.abs(found_in(counts, level).depth - 70.3) < 2) > 0.98


def test_fine_histograms_are_rebinned():
    taps = norm.pdf(np.arange(-60, 61), scale=SIGMA * 1000 / BINS)
    counts, level = histograms(603.0, 20.0, 20.0, bins=1000, side=16)
    assert abs(np.median(found_in(counts, level, taps).depth) - 603.0) < 1.0


def test_halves_of_bins_keep_counts_and_the_place_of_returns():
    """A response symmetric about time zero stays so, twice as wide in halves; a quarter of each tap is beside it."""
    counts, level, taps = halved(
        torch.tensor([[[[4.0, 2.0]]]]), torch.ones(1, 1, 1, 2), torch.tensor([[0.2, 0.6, 0.2]])
    )
    torch.testing.assert_close(counts, torch.tensor([[[[2.0, 2.0, 1.0, 1.0]]]]))
    torch.testing.assert_close(level, torch.full((1, 1, 1, 4), 0.5))
    torch.testing.assert_close(taps, torch.tensor([[0.05, 0.1, 0.2, 0.3, 0.2, 0.1, 0.05]]))


def test_of_a_narrow_response_neighbours_tell_the_place_within_a_bin(monkeypatch):
    """A slanted plane, 24 photons, σ of 0.6 bins: the mean of a pixel's photons has an error of 0.17 bins."""
    slope, response = np.linspace(30.0, 36.0, 32) + np.linspace(0.0, 3.0, 32)[:, None], norm(scale=0.6)
    light = np.diff(response.cdf(np.arange(65) - slope[..., None]), axis=-1)
    counts = np.random.default_rng(5).poisson(24.0 * light + 0.4).astype(np.float32)
    given = counts, np.full(64, 0.4, np.float32), np.diff(response.cdf(np.arange(-4, 6) - 0.5))
    halves = np.sqrt(np.mean((found_in(*given).depth - slope) ** 2))
    monkeypatch.setattr("spadwarp.denoise.histograms._NARROWEST", 0.0)
    whole = np.sqrt(np.mean((found_in(*given).depth - slope) ** 2))
    assert halves < 0.07 and halves < 0.9 * whole


def test_each_pixel_may_have_its_background():
    """Backscatter of a narrow beam: most in the middle of the image, a fifteenth of it at the sides."""
    counts, level = histograms(70.3, 1.0, 20.0)
    beam = np.abs(np.linspace(-1, 1, 32))[:, None]
    beam = 15.0 * np.exp(-beam * np.log(15.0))
    generator = np.random.default_rng(3)
    counts += generator.poisson(np.maximum(beam - 1.0, 0.0) * level, (32, 32, BINS))
    each = np.ascontiguousarray(np.broadcast_to(np.maximum(beam, 1.0) * level, (32, 32, BINS)))
    sides = np.abs(np.linspace(-1, 1, 32)) > 0.6
    own = found_in(counts, each).depth
    assert np.mean(np.abs(own - 70.3)[:, sides] > 4) < 0.1


def test_of_two_returns_the_stronger_one_is_found():
    """65 and 35 % of 30 photons a pixel: by photons alone one pixel in 20 takes the weaker, in the end one in 100.

    19.5 and 10.5 photons: P(second > first) = P(z > 9 / √30) = 0.05.
    """
    counts, level = histograms(60.3, 30.0, 6.0, side=48, seed=4, share=0.65, second=20.0)
    found = found_in(counts, level).depth
    assert np.mean(np.abs(found - 60.3) > 8) < 0.01


@pytest.mark.parametrize(("tail", "share", "columns"), [(0, 0, 24), (0.1, 0, 24), (0.1, 0.35, 24), (0, 0.35, 48)])
def test_second_returns_are_told_from_a_late_tail(tail, share, columns):
    """8 photons, of which a part is 30 bins later in some columns; and in all pixels one that is late by 12 bins.

    A response with such a tail is given as its Gaussian alone.
    """
    place, bins = np.full((48, 48, 1), 40.3), np.arange(BINS + 1)
    share = np.where(np.arange(48) < columns, share, 0.0)[:, None]
    part, late = np.diff(norm(scale=SIGMA).cdf(bins - place)), np.diff(expon(scale=12.0).cdf(bins - place))
    behind = np.diff(norm(scale=SIGMA).cdf(bins - place - 30))
    light = (1.0 - tail) * ((1.0 - share) * part + share * behind) + tail * late
    counts = np.random.default_rng(2).poisson(8.0 * light + 0.02).astype(np.float32)
    (found,) = second_return(place[..., 0] / BINS, counts, background=0.02, response=TAPS, device="cpu")
    left, right = (np.isfinite(part) for part in (found[:, 3 : columns - 3], found[:, columns + 3 :]))
    assert right.sum() < 0.01 * right.size + 1 and (left.mean() > 0.95 if share.any() else left.mean() < 0.01)


def test_scattered_light_is_delayed_and_spread():
    plain = Noise(delay=(0.01, 0.01), spread=(1.0, 1.0), events=(1e9, 1e9))
    rate, bins = torch.zeros(6, 33, 33, 192), torch.arange(192)
    rate[:, 16, 16, 60] = 1.0
    found = synthetic_noise._scattered(rate, torch.ones(6), plain, torch.Generator().manual_seed(2))
    # Weights are normalised for where light arrives, not for where it comes from, which differs near borders.
    assert torch.allclose(found.sum(dim=(1, 2, 3)), torch.ones(6), atol=0.04) and (found[..., :60] == 0).all()
    mean, light = (found.sum(dim=(1, 2)) * bins).sum(dim=1) - 60, found.sum(dim=-1)
    assert (mean > 0.02).all() and (mean < 0.01 * 192 * 1.7).all() and (light[:, 16, 16] < 1.0).all()
    assert (light[:, 16, 20] > 0).all() and torch.allclose(light[:, 12], light[:, 20], atol=1e-4)
    # Light scattered near the camera is seen far away and is early: no light beside is much later than the target's.
    own, near, far = ((one * bins).sum(dim=1) / one.sum(dim=1) for one in (found[:, 16, x] for x in (16, 17, 19)))
    assert torch.allclose(near, far, atol=0.1) and (near > own).all() and (near - own < 0.01 * 192 * 0.7).all()
    few, photons = plain.model_copy(update={"events": (1.0, 1.0)}), torch.ones(99)
    found = synthetic_noise._scattered(rate[:1].expand(99, -1, -1, -1), photons, few, torch.Generator().manual_seed(2))
    assert (found[:, 16, 17:] > 0).float().mean() < 0.01 and abs(float(found.sum(dim=(1, 2, 3)).mean()) - 1.0) < 0.3


def test_scattered_light_is_dimmer_and_later_than_a_target():
    """Light from a target in the left half, 5 % of it delayed by 8 bins on average in the right half; many photons."""
    direct = np.diff(norm.cdf(np.arange(BINS + 1.0) - 30.5, scale=SIGMA))
    late = np.convolve(direct, np.diff(expon.cdf(np.arange(41.0), scale=8.0)))[:BINS]
    light = 1000.0 * np.where(np.arange(48)[:, None] < 24, direct, 0.05 * late)
    above, level, response = tensors(np.broadcast_to(light, (48, 48, BINS)), np.full(BINS, 0.1))
    place = above.argmax(dim=-1).add(0.5) / BINS
    channels = torch.stack(light_channels(above, level[:, 0, 0], place, response))[:, 0, 24]
    left, right = channels[:, 4], channels[:, 40]
    dimmer = (right[3] - left[3]) / 0.3  # ln of the brightness relative to the brightest within 30 pixels
    assert abs(float(dimmer) - np.log(0.05)) < 0.15
    assert left[8] > 0.9 and right[8] < 0.5 and left[10] < 0.01 and right[10] > 0.2


@pytest.mark.slow
@pytest.mark.parametrize(("size", "wrong"), [(64, 0.05), (160, 0.02)])
def test_scattered_light_beside_a_bright_target_and_far_from_it_is_water(size, wrong):
    """A ball in open water, 800 counts a pixel, and three tenths more light that is late and beside."""
    row, column = np.mgrid[:size, :size] - 0.5 * (size - 1)
    seen = row**2 + column**2 < 15.0**2
    place = 40.5 - 3.0 * np.sqrt(np.maximum(0.0, 1.0 - (row**2 + column**2) / 15.0**2))
    direct = 800.0 * seen[..., None] * np.diff(norm.cdf(np.arange(BINS + 1.0) - place[..., None], scale=SIGMA))
    delays = np.diff(expon.cdf(np.arange(41.0), scale=6.0))
    late = convolve1d(gaussian_filter(direct, (8.0, 8.0, 0.0)), delays, axis=-1, mode="constant", origin=-20)
    counts = np.random.default_rng(8).poisson(direct + 0.3 * late + 11.0 / BINS).astype(np.float32)
    found = found_in(counts, np.full(BINS, 11.0 / BINS))
    assert np.mean(found.target_probability[seen] < 0.5) < wrong
    assert np.mean(found.target_probability[~seen] > 0.5) < wrong
    assert size > 64 or np.median(np.abs(found.depth - place)[seen]) < 0.3


@pytest.mark.parametrize("photons", [1.0, 30.0])
def test_a_wall_in_a_frame_wider_than_the_crops_of_the_training_is_target(photons):
    """Also where no border is near: only wide crops have such a place."""
    place = 24.0 + 3.0 * np.sin(np.arange(144.0) / 40.0)[:, None] + np.zeros(144)
    counts, level = histograms(place, photons, 0.2 * photons, side=144, bins=64)
    assert np.mean(found_in(counts, level, TAPS[3:-3]).target_probability < 0.5) < 0.01


def test_histograms_help_where_photons_are_few():
    """Two planes, one photon a pixel among three: the error of depth with and without the histograms."""
    place = np.where(np.arange(48) < 24, 60.0, 75.0) + np.zeros((48, 1))
    counts, level = histograms(place, 1.0, 3.0, side=48)
    template = np.log1p(norm.pdf(toeplitz(np.arange(BINS)), scale=SIGMA) / level[:, None])
    clean, depth = (13.5 + 2.5 * one / BINS for one in (place, (counts @ template).argmax(axis=-1) + 0.5))
    alone = denoised(depth, profile=level)
    together = denoised(depth, profile=level, counts=counts, background=level, response=TAPS)
    before, after = (np.sqrt(np.nanmean((found - clean) ** 2)) for found in (alone, together))
    assert after < before and after < 0.025


def test_depths_far_from_the_counts_are_answered():
    """All reports before the bins that hold the returns: the answer comes from the counts, for both frames."""
    counts, level = histograms(90.0, 5.0, 3.0)
    given = {"counts": np.stack([counts, counts]), "background": level, "response": TAPS}
    depth = np.stack([np.full((32, 32), 13.6), np.full((32, 32), 13.5 + 2.5 * 90.0 / BINS)])
    assert target_bins(count_frames(*given.values())) != slice(0, BINS)
    found = denoised(depth, **given)
    assert np.array_equal(*found) and abs(np.median(found) - depth[1, 0, 0]) < 0.01


def test_masked_pixels_and_tensors_are_depth_too():
    values, options = np.full((16, 16), 15.0), {"gate": (14.0, 16.0), "model": "median"}
    masked, holes = np.ma.masked_array(values, np.eye(16) > 0), np.where(np.eye(16) > 0, np.nan, values)
    np.testing.assert_array_equal(*(denoised(depth, **options) for depth in (masked, holes)))
    learned = torch.tensor(values, requires_grad=True)
    np.testing.assert_array_equal(denoised(learned, **options), values.astype(np.float32))
