"""Sequences of random numbers whose length is not known beforehand."""

import numpy as np
import warp as wp

from helpers.launch import Floats, Integers, launched
from spadwarp_kernels.base import u01
from spadwarp_kernels.base.philox import begin_sequence, join_words, sequence_word, step_sequence


@wp.kernel(enable_backward=False)
def _sequences(seeds: Integers, first: Floats, second: Floats, third: Floats):
    i = wp.tid()
    state = step_sequence(begin_sequence(join_words(wp.uint32(7), wp.uint32(seeds[i]))))
    first[i] = u01(sequence_word(state))
    state = step_sequence(state)
    second[i] = u01(sequence_word(state))
    third[i] = u01(sequence_word(step_sequence(state)))


def test_sequences_of_seeds_that_follow_each_other_are_even_and_independent(device):
    """Chi square of triples in 8 x 8 x 8 boxes, and correlations of neighbours; 4 standard deviations."""
    count = 100_000
    columns = np.array(launched(_sequences, [np.arange(count)], (float,) * 3, device))
    boxes = np.histogramdd(columns.T, bins=8, range=[(0.0, 1.0)] * 3)[0]
    chi2 = ((boxes - count / 512) ** 2).sum() / (count / 512)
    assert abs(chi2 - 511) < 4.0 * (2 * 511) ** 0.5
    neighbours = np.corrcoef(np.concatenate([columns[:, 1:], columns[:, :-1]]))
    assert np.abs(neighbours - np.eye(6))[np.triu_indices(6, 1)].max() < 4.0 / count**0.5
