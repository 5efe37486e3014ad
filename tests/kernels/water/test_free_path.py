"""Free paths follow Beer and Lambert's law, in the far tail too."""

import math

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import each, on_device, unit
from helpers.statistics_of_samples import chi2_p, sample_count
from spadwarp_kernels import free_path
from spadwarp_kernels.base.philox import u01_tail
from spadwarp_kernels.water.medium import layer_index, layered_extinction, layered_free_path

FAR = (14.0, 17.0, 20.0)  # mean free paths


def uniform(device, *words):
    return each(u01_tail, [on_device(word, device, wp.uint32) for word in words], device=device)


def drawn(device, count, extinction, zeros=0):
    """Free paths; of those whose uniform number has that many leading zeros."""
    words = np.random.default_rng(6).integers(0, 2**32, (2, count), np.uint32)
    return each(free_path, [uniform(device, words[0] >> zeros, words[1]).astype(np.float32), extinction], device=device)


@pytest.mark.physics
def test_free_paths_are_exponential(device):
    values = drawn(device, sample_count(device), 0.4)
    assert np.isfinite(values).all()
    assert chi2_p(values, lambda l: -np.expm1(-0.4 * l)) > 1e-4
    assert abs(values.mean() - 2.5) < 5 * 2.5 / math.sqrt(values.size)


@pytest.mark.physics
def test_the_uniform_number_of_a_free_path_is_in_0_to_1_and_has_40_bits(device):
    rng = np.random.default_rng(1)
    word = (rng.integers(0, 2**32, 100_000) >> rng.integers(0, 32, 100_000)).astype(np.uint32)
    word[:4], more = [0, 0, 2**32 - 1, 2**32 - 1], rng.integers(0, 2**32, word.size).astype(np.uint32)
    more[:4] = [0, 255, 0, 2**32 - 1]
    xi = uniform(device, word, more)
    np.testing.assert_allclose(xi, (word.astype(float) * 256 + (more & 255) + 0.5) / 2.0**40, rtol=2.0**-23)
    assert xi.min() == 2.0**-41 and xi.max() == 1.0
    l = each(free_path, [xi.astype(np.float32), 1.0], device=device)
    np.testing.assert_allclose(l, -np.log(xi), rtol=1e-5, atol=1e-7)
    assert l.min() == 0.0 and l.max() == pytest.approx(41 * math.log(2))


@pytest.mark.physics
def test_the_far_tail_of_free_paths_holds_over_all_its_words_and_in_draws(device):
    """Every pair of words that can lead beyond 14 mean free paths: the exact probability of each tail. Random words
    below 2^16, which are all those beyond 11.1 mean free paths: 4.5 standard errors each."""
    xi = uniform(device, *np.divmod(np.arange(4096 * 256, dtype=np.uint32), np.uint32(256)))
    every, count = each(free_path, [xi.astype(np.float32), 1.0], device=device), 4_000_000
    l = drawn(device, count, 1.0, zeros=16)
    assert every[-1] < min(FAR)  # larger words fly less far
    for far in FAR:
        # Half a word of 2^-40, and the rounding of the logarithm.
        assert (every > far).sum() / 2.0**40 == pytest.approx(math.exp(-far), abs=2.0**-40, rel=1e-5)
        expected = count * math.exp(-far) * 2.0**16
        assert abs((l > far).sum() - expected) < 4.5 * math.sqrt(expected)


# Layers: against sums in float64, and against the homogeneous functions bit for bit


AXIS = np.array([0.36, -0.48, 0.8])
START = [-9.0, -1.0, 0.5, 0.6, 3.0]  # the first is not read
EXTINCTION = [0.2, 1.5, 0.05, 4.0, 0.7]


def rays(count=20_000):
    rng = np.random.default_rng(4)
    x = rng.uniform(-4.0, 4.0, (count, 3)).astype(np.float32)
    u = rng.normal(size=(count, 3))
    u[:200] = np.cross(u[:200], AXIS)  # along the layers
    return x, unit(u).astype(np.float32), 1 - rng.random(count, dtype=np.float32)


def flown(device, extinction):
    """Free paths, mean extinction along them, layer at their begin."""
    x, u, xi = rays()
    medium = sk.Medium()
    medium.extinction = extinction[0]
    layers = sk.make_layers(START, extinction, [0.5] * 5, [0.9] * 5, axis=AXIS, device=device)
    distance = each(layered_free_path, [medium, layers, x, u, xi, 0], device=device)
    mean = each(layered_extinction, [medium, layers, x, u, distance.astype(np.float32), 0], device=device)
    return distance, mean, each(layer_index, [layers, (x @ AXIS).astype(np.float32)], [int], device)


def optical_depth(x, u, length):
    """Of the stretches of each ray in each layer, cut out one by one."""
    along, slope = x.astype(float) @ AXIS, u.astype(float) @ AXIS
    edges = np.array([-np.inf, *START[1:], np.inf])
    total = np.zeros(len(x))
    with np.errstate(divide="ignore", invalid="ignore"):
        for low, high, extinction in zip(edges[:-1], edges[1:], EXTINCTION, strict=True):
            cuts = np.sort([(low - along) / slope, (high - along) / slope], axis=0)
            stretch = np.minimum(cuts[1], length) - np.maximum(cuts[0], 0.0)
            total += extinction * np.maximum(stretch, 0.0)
    return total


def test_free_paths_end_where_the_optical_depth_is_reached(device):
    x, u, xi = rays()
    distance, mean, index = flown(device, EXTINCTION)
    assert np.isfinite(distance).all() and (distance >= 0.0).all() and (np.bincount(index) > 200).all()
    np.testing.assert_array_equal(index, np.searchsorted(START[1:], x.astype(float) @ AXIS, side="right"))
    wanted = -np.log(xi.astype(float))
    np.testing.assert_allclose(optical_depth(x, u, distance), wanted, rtol=1e-4, atol=1e-5)
    np.testing.assert_allclose(mean * distance, wanted, rtol=1e-4, atol=1e-5)


def test_layers_of_one_extinction_are_no_layers(device):
    """The same bits as without them, whatever the boundaries."""
    distance, mean, _ = flown(device, [0.7] * 5)
    np.testing.assert_array_equal(distance, each(sk.free_path, [rays()[2], 0.7], device=device))
    np.testing.assert_array_equal(mean, np.float32(0.7))
