"""Flights through layers against sums in float64, and against the homogeneous functions bit for bit."""

import numpy as np

import spadwarp_kernels as sk
from helpers.launch import each, unit
from spadwarp_kernels.water.medium import layer_index, layered_extinction, layered_free_path

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
