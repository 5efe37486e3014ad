"""Features of histograms, and the scattered light that networks are trained on."""

import numpy as np
import pytest
import torch
from scipy.linalg import toeplitz
from scipy.stats import exponnorm, norm

from helpers.stepped_frames import denoised
from spadwarp.denoise import apply, synthetic_noise
from spadwarp.denoise import histograms as histogram_inputs
from spadwarp.denoise.classical import GUIDES
from spadwarp.denoise.histogram_features import EDGES, FEATURES, SEEN, WINDOWS, extract_features, log_likelihood
from spadwarp.denoise.recipe import Noise

BINS, SIGMA = 128, 1.2  # bins of the gate, response [bins]
TAPS = norm.pdf(np.arange(-6, 7), scale=SIGMA)


def histograms(place, photons, background, *, law=None, side=32, bins=BINS, seed=1):
    """Counts `[side, side, bins]` of returns at `place` [bins], and the background `[bins]`, which falls by e^2."""
    edges = np.arange(bins + 1)
    law = law or norm(scale=SIGMA * bins / BINS)
    level = np.exp(-2 * edges[:-1] / bins)
    level *= background / level.sum()
    rate = photons * np.diff(law.cdf(edges - np.asarray(place)[..., None]), axis=-1) + level
    counts = np.random.default_rng(seed).poisson(np.broadcast_to(rate, (side, side, bins)))
    return counts.astype(np.float32), level.astype(np.float32)


def features_of(counts, level, taps=TAPS):
    level = np.reshape(level, (1, 1, -1)) if np.ndim(level) == 1 else level
    arrays = (torch.tensor(np.asarray(values, np.float32))[None] for values in (counts, level, taps / taps.sum()))
    return extract_features(*arrays)[0].numpy()


def best_bin(counts, level):
    """Place of the largest log-likelihood of a return of one photon, pixel by pixel [bins]."""
    template = np.log1p(norm.pdf(toeplitz(np.arange(BINS)), scale=SIGMA) / level[:, None])
    return (counts @ template).argmax(axis=-1) + 0.5


def test_pooled_histograms_find_what_pixels_cannot():
    """One signal photon among twenty of the background: nine and 49 pixels have 9 and 49 of them in a few bins."""
    counts, level = histograms(70.3, 1.0, 20.0)
    found = features_of(counts, level)
    assert found.shape == (FEATURES, 32, 32) and len(WINDOWS) == 3
    places = best_bin(counts - level, level), *(BINS * found[3:5])
    right = [np.mean(np.abs(place - 70.3) < 2) for place in places]
    assert right[0] < 0.4 < 0.7 < right[1] < right[2] and right[2] > 0.99
    # Centroid of 49 photons on their background: some tenths of a bin.
    assert np.std(BINS * found[4]) < 0.6


def test_many_photons_give_depth_to_fractions_of_a_bin():
    slope = np.linspace(40.0, 80.0, 32) + np.zeros((32, 1))
    found = BINS * features_of(*histograms(slope, 500.0, 5.0))[3]
    # A window of 3 pixels sees 2.6 bins of slope.
    assert np.sqrt(np.mean((found - slope)[4:-4, 4:-4] ** 2)) < 0.3


def test_the_shape_of_the_return_is_that_of_its_light():
    """Exponential tail: shares about the found depth as the law of the arrival times has them."""
    delay = 8.0  # bins
    law = exponnorm(delay / SIGMA, scale=SIGMA)
    counts, level = histograms(60.0, 300.0, 30.0, law=law)
    found = features_of(counts, level)
    anchor = BINS * found[5, 16, 16]
    expected = np.diff(law.cdf(anchor - 60.0 + BINS * np.array(EDGES)))
    shares = found[SEEN - GUIDES - len(EDGES) - 1 : SEEN - GUIDES - 2, 16, 16]
    assert np.abs(shares - expected / expected.sum()).max() < 0.03
    assert abs(anchor - 60.0) < delay  # the template has a tail of its own


def test_fine_histograms_are_rebinned():
    taps = norm.pdf(np.arange(-60, 61), scale=SIGMA * 1000 / BINS)
    counts, level = histograms(603.0, 20.0, 20.0, bins=1000, side=16)
    found = features_of(counts, level, taps)
    assert abs(np.median(1000 * found[4]) - 603.0) < 1.0


def test_each_pixel_may_have_its_background():
    """Backscatter of a narrow beam: most in the middle of the image, a fifteenth of it at the sides."""
    counts, level = histograms(70.3, 1.0, 20.0)
    beam = np.abs(np.linspace(-1, 1, 32))[:, None]
    beam = 15.0 * np.exp(-beam * np.log(15.0))
    generator = np.random.default_rng(3)
    counts += generator.poisson(np.maximum(beam - 1.0, 0.0) * level, (32, 32, BINS))
    each = np.broadcast_to(np.maximum(beam, 1.0) * level, (32, 32, BINS))
    sides = np.abs(np.linspace(-1, 1, 32)) > 0.6
    places = (BINS * features_of(counts, one)[5] for one in (each, each.mean((0, 1))))
    own, common = (np.mean(np.abs(place - 70.3)[:, sides] > 4) for place in places)
    assert own < 0.1 < common


@pytest.mark.parametrize("width", [128, 300])
def test_a_bright_target_far_away_changes_no_likelihood(width):
    """The log-likelihood at its candidate of a pixel of water, 100 pixels or more from a target of 500 counts in the
    last columns, is that in a frame of water alone. Narrower frames have one signal."""
    counts = np.random.default_rng(1).poisson(0.05, (1, 4, width, 64)).astype(np.float32)
    bright = counts.copy()
    bright[..., -20:, 30] += 500.0
    background = torch.full((1, 1, 1, 64), 0.05)
    response = torch.tensor([[0.2, 0.6, 0.2]])
    water, beside = (
        extract_features(torch.from_numpy(c), background, response)[:, SEEN, :, :40] for c in (counts, bright)
    )
    alone = log_likelihood(torch.from_numpy(counts), background, response).amax(dim=-1)[..., :40]
    assert torch.allclose(10.0 * water, alone, rtol=0.05, atol=0.02)
    assert torch.allclose(beside, water, rtol=1e-4, atol=1e-4) == (width > 128)


def test_scattered_light_is_delayed_and_spread():
    plain = Noise(delay=(0.01, 0.01), spread=(2.0, 2.0))
    rate = torch.zeros(6, 33, 33, 192)
    rate[:, 16, 16, 60] = 1.0
    found = synthetic_noise._scattered(rate, plain, torch.Generator().manual_seed(2))
    bins = torch.arange(192)
    assert torch.allclose(found.sum(dim=(1, 2, 3)), torch.ones(6), atol=2e-3)
    assert (found[..., :60] == 0).all()
    mean = (found.sum(dim=(1, 2)) * bins).sum(dim=1) - 60
    assert (mean > 0.1).all() and (mean < 0.01 * 192 * 6 * 1.7).all()
    assert (found[:, 16, 16].sum(dim=1) < 1.0).all() and (found[:, 16, 20].sum(dim=1) > 0).all()
    assert torch.allclose(found[:, 12], found[:, 20]) and torch.allclose(found[:, :, 12], found[:, :, 20])


def test_histograms_help_where_photons_are_few():
    """Two planes, one photon a pixel among three: the error of depth with and without the histograms."""
    place = np.where(np.arange(48) < 24, 60.0, 75.0) + np.zeros((48, 1))
    counts, level = histograms(place, 1.0, 3.0, side=48)
    clean = 13.5 + 2.5 * place / BINS
    depth = 13.5 + 2.5 * best_bin(counts, level) / BINS
    alone = denoised(depth, profile=level)
    together = denoised(depth, profile=level, counts=counts, background=level, response=TAPS)
    before, after = (np.sqrt(np.nanmean((found - clean) ** 2)) for found in (alone, together))
    assert after < before and after < 0.025


def test_depths_far_from_the_counts_are_answered():
    """All reports before the bins that hold the returns: the answer comes from the whole gate, for both frames."""
    counts, level = histograms(90.0, 5.0, 3.0)
    given = {"counts": np.stack([counts, counts]), "background": level, "response": TAPS}
    depth = np.stack([np.full((32, 32), 13.6), np.full((32, 32), 13.5 + 2.5 * 90.0 / BINS)])
    assert histogram_inputs.target_bins(given["counts"], level, TAPS, (13.5, 16.0))[:2] != (0, BINS)
    assert np.isfinite(denoised(depth, **given)).all()


def test_masked_pixels_and_tensors_are_depth_too():
    values, options = np.full((16, 16), 15.0), {"gate": (14.0, 16.0), "model": "median"}
    masked, holes = np.ma.masked_array(values, np.eye(16) > 0), np.where(np.eye(16) > 0, np.nan, values)
    np.testing.assert_array_equal(apply(masked, **options), apply(holes, **options))
    learned = torch.tensor(values, requires_grad=True)
    np.testing.assert_array_equal(apply(learned, **options), values.astype(np.float32))


def test_shapes_of_features():
    counts = np.random.default_rng(1).poisson(0.1, (2, 9, 10, 32))
    counts[1, :4] = 0  # pixels without counts are no error
    options = {"background": np.full(32, 0.1), "response": np.ones(3), "device": "cpu"}
    found = histogram_inputs.features_of_histograms(counts, **options)
    assert found.shape == (2, FEATURES, 9, 10) and found.dtype == np.float32 and np.isfinite(found).all()
    assert np.array_equal(histogram_inputs.features_of_histograms(counts[1], **options)[0], found[1])
    empty = histogram_inputs.features_of_histograms(0 * counts[0], **options)
    assert np.isfinite(empty).all()
