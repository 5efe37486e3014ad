"""Statistics that the tests share: χ² of samples against a law, equality of means between seeds."""

import numpy as np
import warp as wp
from scipy import stats

# Every kernel test runs on each of these; bits are never compared between them.
DEVICES = ["cpu", *(["cuda:0"] if wp.get_cuda_device_count() else [])]


def sample_count(device):
    """Samples that show a departure from a law of 1 % (rms over 200 bins, at p < 1e-4) on a CPU, of 0.4 % on a GPU."""
    return 10_000_000 if device != "cpu" else 2_000_000


def chi2_p(samples, cdf, bins=200):
    """p-value of samples against a distribution function, in bins of equal count by sample quantiles of the law.

    `cdf` maps samples to uniform numbers if the law is right; the χ² is over `bins` equal parts of [0, 1].
    """
    counts, _ = np.histogram(cdf(np.asarray(samples, np.float64)), bins=bins, range=(0.0, 1.0))
    assert counts.sum() == len(samples)
    return stats.chisquare(counts).pvalue


def equal_means_p(a, b, converged=0.2):
    """Family-wise p-value that two estimators have the same mean in every cell in which both have converged.

    a, b: `[seeds, cells]`. Converged: the standard error from the spread between seeds is below that part of the mean
    (a cell that hardly ever scores has no normal mean). Welch's t a cell, Bonferroni over the cells.
    """
    a, b = np.asarray(a, np.float64), np.asarray(b, np.float64)
    known = [x.std(axis=0, ddof=1) / np.sqrt(len(x)) < converged * np.abs(x.mean(axis=0)) for x in (a, b)]
    a, b = a[:, known[0] & known[1]], b[:, known[0] & known[1]]
    assert a.size, "nothing has converged"
    return min(1.0, stats.ttest_ind(a, b, equal_var=False).pvalue.min() * a.shape[1])
