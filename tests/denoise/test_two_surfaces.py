"""Pixels with two returns follow the others that see the same two surfaces."""

import numpy as np
import pytest
import torch
from scipy.stats import norm

from spadwarp.denoise import estimate
from spadwarp.denoise.histogram_features import FEATURES, SEEN
from spadwarp.denoise.networks import follow_the_others

NEAR, FAR = 0.4, 0.5


def seen(answers, own=60.0, other=50.0):
    """Answers `[H, W]`, and features: each pixel has both returns, that of its answer by `own` nats, the other by
    `other`."""
    found = torch.as_tensor(answers, dtype=torch.float32)[None, None]
    features = torch.zeros(1, FEATURES, *found.shape[-2:])
    features[:, :1], features[:, 1:2] = found - 0.5, NEAR + FAR - found - 0.5
    features[:, SEEN], features[:, SEEN + 1] = 0.1 * own, 0.1 * other
    return found, features


def one_of(others, own, size=9):
    answers = np.full((size, size), others)
    answers[size // 2, size // 2] = own
    return answers


@pytest.mark.parametrize("others, own", [(NEAR, FAR), (FAR, NEAR)])
def test_a_single_pixel_follows_the_others(others, own):
    assert torch.allclose(follow_the_others(*seen(one_of(others, own))), torch.tensor(others))


@pytest.mark.parametrize("third", [0.2, 0.43, 0.6])
def test_an_answer_that_is_neither_return_moves_if_it_is_far(third):
    """Three other depths: before both returns, between them and nearer the one not taken, and behind both."""
    found, features = seen(one_of(FAR, NEAR))
    found[:, :, 4, 4] = third
    assert torch.allclose(follow_the_others(found, features), torch.tensor(FAR))
    features[:, SEEN + 1] = 0.0  # one return
    assert torch.equal(follow_the_others(found, features), found)


def test_what_stays():
    """A pixel whose photons differ by more than chance, one whose neighbours do not see both surfaces, half an image,
    and an answer within 5 % of the gate of the surface."""
    # 400 nats are about 80 photons: 4400 against 3600 differ by four deviations.
    bright, lonely = seen(one_of(FAR, NEAR), own=4400.0, other=3600.0), seen(one_of(FAR, NEAR))
    lonely[1][:, SEEN + 1] = 0.0
    lonely[1][:, SEEN + 1, 4, 4] = 5.0
    edge, close = seen(np.where(np.arange(9) < 4, NEAR, FAR) + np.zeros((9, 1))), seen(one_of(FAR, NEAR))
    close[0][:, :, 4, 4] = 0.46
    for found, features in (bright, lonely, edge, close):
        assert torch.equal(follow_the_others(found, features), found)


def test_it_moves_at_corners_and_turns_with_the_image():
    answers = np.full((7, 8), FAR)
    answers[0, 0] = answers[3, 6] = answers[6, 2] = NEAR
    found, features = seen(answers)
    assert torch.allclose(follow_the_others(found, features), torch.tensor(FAR))
    assert torch.allclose(follow_the_others(found.flip(2).mT, features.flip(2).mT), torch.tensor(FAR))


def test_of_two_returns_the_stronger_one_is_found():
    """65 and 35 % of 30 photons a pixel: by photons alone one pixel in 20 takes the weaker, in the end one in 500.

    The weaker return is 20 bins nearer. 19.5 and 10.5 photons: P(second > first) = P(z > 9 / √30) = 0.05.
    """
    bins, edges = 128, np.arange(129.0)
    first, second = (np.diff(norm.cdf(edges - place, scale=1.2)) for place in (80.3, 60.3))
    rate = np.broadcast_to(19.5 * first + 10.5 * second + 6.0 / bins, (48, 48, bins))
    counts = np.random.default_rng(4).poisson(rate).astype(np.float32)
    taps = np.diff(norm.cdf(np.arange(-4.5, 5.0), scale=1.2))
    depth = 10.0 + 2.56 * (counts.argmax(axis=-1) + 0.5) / bins
    assert np.mean(np.abs(depth - 11.606) > 0.2) > 0.01
    given = {"counts": counts, "background": np.full(bins, 6.0 / bins), "response": taps / taps.sum()}
    found = estimate(depth, gate=(10.0, 12.56), model="histograms", **given)
    assert np.mean(np.abs(found.depth - 11.606) > 0.2) < 0.002
