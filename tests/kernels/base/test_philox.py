"""Random numbers: Philox4x32-10 against the known answers of its authors' Random123 library, and sequences."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

from helpers.launch import each, on_device
from spadwarp_kernels.base import random_block, u01
from spadwarp_kernels.base.binomial import binomial
from spadwarp_kernels.base.native import expm1, log1p
from spadwarp_kernels.base.philox import (
    PREFETCHED_WORDS,
    RoundKeys,
    begin_sequence,
    join_words,
    make_prefetch,
    prefetched_block,
    random_block_keyed,
    round_keys,
    sequence_word,
    step_sequence,
    u01_fine,
)


def blocks(function, seed, first_id, device="cpu", *, count=1000, event=3, stream=1):
    ids = on_device(np.arange(count, dtype=np.uint64) + np.uint64(first_id), device, wp.uint64)
    return each(function, [seed, ids, event, stream], [wp.vec4ui], device)


@pytest.mark.parametrize(
    ("counter_key", "expected"),
    [
        ("0 " * 6, "6627e8d5 e169c58d bc57ac4c 9b00dbd8"),
        ("ffffffff " * 6, "408f276d 41c83b0e a20bc7c6 6d5451fd"),
        ("243f6a88 85a308d3 13198a2e 03707344 a4093822 299f31d0", "d16cfe09 94fdcceb 5001e420 24126ea1"),
    ],
)
def test_known_answers(counter_key, expected):
    """The words of a counter, id, event and stream, and of a key, the seed."""
    low, high, event, stream, *key = (int(word, 16) for word in counter_key.split())
    found = blocks(random_block, key[1] << 32 | key[0], high << 32 | low, count=1, event=event, stream=stream)
    assert found[0].tolist() == [int(word, 16) for word in expected.split()]


def test_uniforms_stay_below_one_and_reach_their_grid():
    words = np.array([0, 1, 255, 256, 0x7FFFFFFF, 0xFFFFFF00, 0xFFFFFFFF], np.uint32)
    coarse, fine = (each(function, [on_device(words, dtype=wp.uint32)]) for function in (u01, u01_fine))
    assert coarse.max() < 1.0 and fine.max() < 1.0 and fine[1] == 2.0**-32
    np.testing.assert_array_equal(coarse, (words >> 8) / 2.0**24)


def test_ids_beyond_32_bits_have_streams_of_their_own():
    found = [blocks(random_block, 7, first) for first in (0, 1 << 32)]
    assert len(np.unique(np.concatenate(found), axis=0)) == 2000


@pytest.mark.parametrize("seed", [0, 1, 0x123456789ABCDEF0, 2**64 - 1])
def test_round_keys_give_the_blocks_of_their_seed(seed, device):
    keyed = blocks(random_block_keyed, round_keys(seed), 1 << 33, device)
    np.testing.assert_array_equal(keyed, blocks(random_block, seed, 1 << 33, device))


def ahead_kernel(*streams):
    events, prefetch = make_prefetch(*streams)

    @wp.kernel(enable_backward=False)
    def ahead(keys: RoundKeys, id: wp.uint64, event: wp.uint32, out: wp.array(dtype=wp.vec4ui)):
        words = wp.zeros(shape=PREFETCHED_WORDS, dtype=int)
        prefetch(words, keys, id, event)
        for lane in range(8):
            out[lane] = prefetched_block(words, lane)
            stream = wp.uint32(wp.static(streams[0]))
            if lane >= events:
                stream = wp.uint32(wp.static(streams[-1]))
            out[8 + lane] = random_block_keyed(keys, id, event + wp.uint32(lane % events), stream)

    return ahead


@pytest.mark.parametrize("streams", [(1,), (1, 2)])
def test_words_of_events_ahead_are_those_of_each_event(streams):
    kernel, keys = ahead_kernel(*streams), round_keys(0x9E3779B97F4A7C15)
    for id, event in ((7, 1), (2**64 - 2, 2**32 - 3)):
        out = wp.zeros(16, dtype=wp.vec4ui, device="cpu")
        wp.launch(kernel, dim=1, inputs=[keys, id, event], outputs=[out], device="cpu")
        together, alone = out.numpy().reshape(2, 8, 4)
        np.testing.assert_array_equal(together, alone)


@wp.func
def sequence(seed: int):
    state = step_sequence(begin_sequence(join_words(wp.uint32(7), wp.uint32(seed))))
    second = step_sequence(state)
    return u01(sequence_word(state)), u01(sequence_word(second)), u01(sequence_word(step_sequence(second)))


def test_sequences_of_seeds_that_follow_each_other_are_even_and_independent(device):
    """Chi square of triples in 8 x 8 x 8 boxes, and correlations of neighbours; 4 standard deviations."""
    count = 100_000
    columns = np.array(each(sequence, [np.arange(count)], (float,) * 3, device))
    boxes = np.histogramdd(columns.T, bins=8, range=[(0.0, 1.0)] * 3)[0]
    chi2 = ((boxes - count / 512) ** 2).sum() / (count / 512)
    assert abs(chi2 - 511) < 4.0 * (2 * 511) ** 0.5
    neighbours = np.corrcoef(np.concatenate([columns[:, 1:], columns[:, :-1]]))
    assert np.abs(neighbours - np.eye(6))[np.triu_indices(6, 1)].max() < 4.0 / count**0.5


# The binomial sampler against the exact law


@wp.func
def draw(n: int, hazard: wp.float64, seed: wp.uint64, id: int):
    count, _block = binomial(n, hazard, seed, wp.uint64(id), wp.uint32(0), wp.uint32(0))
    return count


def sample(n, hazard, *, seed=3, base=0, size=400_000):
    return each(draw, [n, hazard, seed, base + np.arange(size)], [int])


@pytest.mark.physics
@pytest.mark.parametrize(
    ("n", "p"),
    [
        *((1, 0.3), (5, 0.5), (40, 0.02), (40, 0.97), (30, 0.4), (20, 0.5), (21, 0.9)),
        *((100, 0.0999), (100, 0.1001)),  # the last of inversion, the first of rejection
        *((1000, 0.3), (1000, 0.985), (10_000, 5e-4), (1_000_000, 1.5e-5), (1_000_000, 5e-4)),
        *((100_000_000, 3e-7), (2**31 - 1, 1e-9), (2**31 - 1, 2e-8)),
    ],
)
def test_frequencies_follow_the_law(n, p):
    counts = sample(n, -np.log1p(-p))
    law = stats.binom(n, p)
    low, high = int(law.ppf(1e-4)), int(law.ppf(1 - 1e-4))
    edges = np.arange(low, high + 1)
    expected = law.pmf(edges) * counts.size
    expected[0] += law.cdf(low - 1) * counts.size
    expected[-1] += law.sf(high) * counts.size
    observed = np.bincount(np.clip(counts, low, high) - low, minlength=edges.size)
    # Merge neighbours until each class expects 10.
    classes = np.minimum.accumulate(np.cumsum(expected)[::-1])[::-1] // 10
    merged = np.unique(classes, return_inverse=True)[1]
    observed, expected = np.bincount(merged, observed), np.bincount(merged, expected)
    if observed.size > 1:
        assert stats.chisquare(observed, expected, sum_check=False).pvalue > 1e-4
    else:
        assert (counts == low).all()


@pytest.mark.physics
@pytest.mark.parametrize("p", [1e-6, 0.25, 0.5, 0.75, 1 - 1e-6])
def test_large_counts_have_the_right_moments(p):
    n = 2**31 - 1
    counts = sample(n, -np.log1p(-p), size=200_000).astype(np.float64)
    z = (counts - n * p) / np.sqrt(n * p * (1 - p))
    assert abs(z.mean()) < 4 / np.sqrt(z.size)
    assert abs(z.var() - 1) < 4 * np.sqrt(2 / z.size)
    skewness = (1 - 2 * p) / np.sqrt(n * p * (1 - p))
    assert abs(stats.skew(z) - skewness) < 4 * np.sqrt(6 / z.size)


@pytest.mark.physics
def test_limits():
    for n, hazard, count in ((100, 0.0, 0), (0, 1.0, 0), (100, np.inf, 100), (100, 800.0, 100)):
        assert (sample(n, hazard, size=100) == count).all()


@pytest.mark.physics
def test_draws_depend_on_seed_and_id_alone():
    whole = sample(1000, 0.2, size=200)
    np.testing.assert_array_equal(sample(1000, 0.2, base=50, size=100), whole[50:150])
    assert (sample(1000, 0.2, seed=4, size=200) != whole).any()


@pytest.mark.physics
def test_small_arguments_keep_their_digits():
    x = np.concatenate([-np.geomspace(1e-18, 0.9, 200), np.geomspace(1e-18, 30.0, 200)])
    grown, logged = (each(function, [on_device(x, dtype=wp.float64)], [wp.float64]) for function in (expm1, log1p))
    np.testing.assert_allclose(grown, np.expm1(x), rtol=1e-12)
    np.testing.assert_allclose(logged, np.log1p(x), rtol=1e-12)
