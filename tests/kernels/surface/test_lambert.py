"""Diffuse reflection follows Lambert's law."""

import numpy as np
import pytest
import warp as wp

from helpers.launch import Vectors, launched
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels import random_block, u01
from spadwarp_kernels.surface.reflectance import sample_lambert

pytestmark = pytest.mark.physics


@wp.kernel(enable_backward=False)
def _lambert(normal: wp.vec3, v: Vectors):
    i = wp.tid()
    block = random_block(wp.uint64(9), wp.uint64(i), wp.uint32(0), wp.uint32(1))
    v[i] = sample_lambert(normal, u01(block[0]), u01(block[1]))


def test_lambert_follows_the_cosine_law(device):
    normal = np.array([0.48, -0.6, 0.64])
    (v,) = launched(_lambert, [wp.vec3(*normal)], [wp.vec3], device, sample_count(device))
    cosine = v @ normal
    assert cosine.min() > -1e-6
    # cos^2 is uniform under the cosine law.
    assert chi2_p(cosine, lambda c: np.clip(c, 0, 1) ** 2) > 1e-4
