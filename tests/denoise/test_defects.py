"""Defects of a camera in its counts: found by exact tests, left out, and no more than chance allows where none are."""

import numpy as np
import pytest

from spadwarp.denoise import estimate
from spadwarp.denoise.histograms import FALSE_ALARMS, find_defects, repaired
from spadwarp.frames import estimate_background
from spadwarp.values import SpadwarpWarning

SIDE, BINS = 32, 96
RESPONSE = np.exp(-0.5 * (np.arange(-6, 7) / 1.5) ** 2)
RESPONSE /= RESPONSE.sum()
LEVEL = np.exp(-3.0 * np.arange(BINS) / BINS)
LEVEL *= 8.0 / LEVEL.sum()


def _counts(random):
    rate = np.tile(LEVEL, (SIDE, SIDE, 1))
    rate[8:24, 10:26, 54:67] += 8.0 * RESPONSE
    rate[:, 26:, 24:37] += 5.0 * RESPONSE
    return random.poisson(rate)


def _damaged(kind, random):
    counts, pixels, bins = _counts(random), np.zeros((SIDE, SIDE), bool), np.zeros(BINS, bool)
    if kind == "stuck column":
        counts[:, 5, 33] += random.poisson(30, SIDE)
        pixels[:, 5] = True
    elif kind == "dead row":
        counts[7] = 0
        pixels[7] = True
    elif kind == "hot pixels":
        pixels[2:30:9, 2] = True
        counts[pixels] += random.poisson(0.8, (4, BINS))
    elif kind == "stuck pixels":
        pixels[2:30:9, 12] = True
        counts[pixels, 80] += 60
    else:
        counts[..., 40] += random.poisson(3, (SIDE, SIDE))
        bins[40] = True
    return counts, pixels, bins


@pytest.mark.parametrize("kind", ["stuck column", "dead row", "hot pixels", "stuck pixels", "stuck bin"])
def test_defects_are_found_and_no_count_of_theirs_is_used(kind):
    counts, pixels, bins = _damaged(kind, np.random.default_rng(1))
    for level in (LEVEL, estimate_background(counts, RESPONSE).counts):
        found = find_defects(counts, level, RESPONSE)
        assert np.array_equal(found.pixels, pixels)
        assert np.array_equal(found.bins, bins)
        changed = counts.copy()
        changed[pixels] += 1000
        changed[..., bins] += 1000
        assert np.array_equal(repaired(counts, found), repaired(changed, found))


def test_a_frame_without_defects_has_none():
    # At most 45 times three kinds of test at a level of 1e-3: 0.14 false alarms are expected.
    alarms = 0
    for seed in range(15):
        counts = _counts(np.random.default_rng(seed))
        for wrong in (0.6, 1.0, 1.8):  # the background is not known well
            found = find_defects(counts, wrong * LEVEL, RESPONSE)
            alarms += bool(found.summary)
    assert alarms <= 2 + 15 * 3 * 3 * FALSE_ALARMS


def test_a_wall_at_one_time_and_a_response_that_is_narrower_than_given_are_no_defects():
    random = np.random.default_rng(2)
    narrow = np.exp(-0.5 * (np.arange(-6, 7) / 0.8) ** 2)
    rate = np.tile(LEVEL, (SIDE, SIDE, 1))
    rate[..., 54:67] += 40.0 * narrow / narrow.sum()
    assert not find_defects(random.poisson(rate), LEVEL, RESPONSE).summary


def test_a_warning_says_how_many_and_depth_stays_as_it_is_without_defects():
    counts, pixels, _ = _damaged("stuck column", np.random.default_rng(3))
    truth = np.full((SIDE, SIDE), np.nan)
    truth[8:24, 10:26], truth[:, 26:] = 60.5, 30.5
    depth = counts.argmax(axis=-1) + 0.5
    with pytest.warns(SpadwarpWarning, match=f"{pixels.sum()} of {pixels.size} pixels are stuck"):
        found = estimate(
            depth, gate=(0.0, float(BINS)), counts=counts, response=RESPONSE, model="belief-propagation", device="cpu"
        )
    seen = np.isfinite(truth)
    assert np.sqrt(np.nanmean((found.depth - truth)[seen] ** 2)) < 0.6  # bins: those of the column do not count


@pytest.mark.parametrize("shape", [(1, 1, 64), (1, 9, 1), (7, 3, 2)])
def test_counts_of_any_size_have_a_depth(shape):
    counts = np.random.default_rng(0).poisson(3.0, shape)
    given = {"gate": (1.0, 2.0), "counts": counts, "response": RESPONSE, "device": "cpu"}
    for model in ("belief-propagation", "histograms"):
        found = estimate(np.full(shape[:2], 1.5), model=model, min_significance=0.0, **given)
        assert np.isfinite(found.depth).all()
