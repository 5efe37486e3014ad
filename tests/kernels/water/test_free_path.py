"""Free paths follow Beer and Lambert's law, in the far tail too."""

import math

import numpy as np
import pytest
import warp as wp

from helpers.launch import Floats, launched, on_device
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels import free_path, random_block
from spadwarp_kernels.base.philox import u01_tail

pytestmark = pytest.mark.physics

Words = wp.array(dtype=wp.uint32)
FAR = (14.0, 17.0, 20.0)  # mean free paths


@wp.kernel(enable_backward=False)
def _free_paths(c: float, zeros: wp.uint32, l: Floats):
    """Free paths; of those whose uniform number has that many leading zeros."""
    i = wp.tid()
    block = random_block(wp.uint64(6), wp.uint64(i), wp.uint32(0), wp.uint32(1))
    l[i] = free_path(u01_tail(block[0] >> zeros, block[2]), c)


@wp.kernel(enable_backward=False)
def _of_words(word: Words, more: Words, xi: Floats, l: Floats):
    i = wp.tid()
    xi[i] = u01_tail(word[i], more[i])
    l[i] = free_path(xi[i], 1.0)


def _from_words(device, *words):
    return launched(_of_words, [on_device(a, device, wp.uint32) for a in words], (float, float), device, words[0].size)


def test_free_paths_are_exponential(device):
    (values,) = launched(_free_paths, [0.4, 0], device=device, count=sample_count(device))
    assert np.isfinite(values).all()
    assert chi2_p(values, lambda l: -np.expm1(-0.4 * l)) > 1e-4
    assert abs(values.mean() - 2.5) < 5 * 2.5 / math.sqrt(values.size)


def test_the_uniform_number_of_a_free_path_is_in_0_to_1_and_has_40_bits(device):
    rng = np.random.default_rng(1)
    word = (rng.integers(0, 2**32, 100_000) >> rng.integers(0, 32, 100_000)).astype(np.uint32)
    word[:4], more = [0, 0, 2**32 - 1, 2**32 - 1], rng.integers(0, 2**32, word.size).astype(np.uint32)
    more[:4] = [0, 255, 0, 2**32 - 1]
    xi, l = _from_words(device, word, more)
    exact = (word.astype(float) * 256 + (more & 255) + 0.5) / 2.0**40
    np.testing.assert_allclose(xi, exact, rtol=2.0**-23)
    assert xi.min() == 2.0**-41 and xi.max() == 1.0
    np.testing.assert_allclose(l, -np.log(xi), rtol=1e-5, atol=1e-7)
    assert l.min() == 0.0 and l.max() == pytest.approx(41 * math.log(2))


def test_the_far_tail_of_free_paths_holds_over_all_its_words(device):
    """Every pair of words that can lead beyond 14 mean free paths: the exact probability of each tail."""
    word, more = np.divmod(np.arange(4096 * 256, dtype=np.uint32), np.uint32(256))
    _, l = _from_words(device, word, more)
    assert l[-1] < min(FAR)  # larger words fly less far
    for far in FAR:
        # Half a word of 2^-40, and the rounding of the logarithm.
        assert (l > far).sum() / 2.0**40 == pytest.approx(math.exp(-far), abs=2.0**-40, rel=1e-5)


def test_the_far_tail_of_free_paths_holds_in_draws(device):
    """Of random words below 2^16, which are all those beyond 11.1 mean free paths; 4.5 standard errors each."""
    count = 4_000_000
    (l,) = launched(_free_paths, [1.0, 16], device=device, count=count)
    for far in FAR:
        expected = count * math.exp(-far) * 2.0**16
        assert abs((l > far).sum() - expected) < 4.5 * math.sqrt(expected)
