"""Free paths follow Beer and Lambert's law."""

import math

import numpy as np
import pytest
import warp as wp

from helpers.launch import Floats, launched
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels import (
    free_path,
    random_block,
    u01,
)

pytestmark = pytest.mark.physics


@wp.kernel(enable_backward=False)
def _free_paths(c: float, l: Floats):
    i = wp.tid()
    l[i] = free_path(u01(random_block(wp.uint64(6), wp.uint64(i), wp.uint32(0), wp.uint32(1))[0]), c)


def test_free_paths_are_exponential(device):
    (values,) = launched(_free_paths, [0.4], device=device, count=sample_count(device))
    assert np.isfinite(values).all()
    assert chi2_p(values, lambda l: -np.expm1(-0.4 * l)) > 1e-4
    assert abs(values.mean() - 2.5) < 5 * 2.5 / math.sqrt(values.size)
