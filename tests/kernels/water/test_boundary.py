"""Faces that reflect: Fresnel's formulas, and images in them against reflections followed one by one."""

import itertools

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import each, unit
from spadwarp_kernels.water.limits import (
    Exit,
    Limits,
    fresnel_reflectance,
    image_direction,
    image_point,
    image_reflectance,
    next_face,
)

LOWER, UPPER = np.array([-0.7, -0.4, -1.0]), np.array([0.5, 0.9, 1.6])


def chains(low, high, most):
    """Numbers of reflections across each axis, of all chains of at most so many."""
    boundary = sk.make_boundary(low, high, max_reflections=most, device="cpu")
    return [tuple(map(int, image)) for image in boundary.images.numpy()]


def reflectance(cosine, index):
    """Unpolarised, from the angles."""
    sine = np.sqrt(1 - cosine**2) / index
    if sine >= 1:
        return 1.0
    a, b = np.arccos(cosine), np.arcsin(sine)
    if a == 0:
        return ((1 - index) / (1 + index)) ** 2
    return 0.5 * ((np.sin(a - b) / np.sin(a + b)) ** 2 + (np.tan(a - b) / np.tan(a + b)) ** 2)


@pytest.mark.slow
def test_reflectance_is_fresnels_and_that_of_a_very_large_index_is_a_mirrors(device):
    cosines = np.concatenate([np.linspace(0.02, 1.0, 50), [np.cos(np.arcsin(1 / 1.34)) * 0.999]])
    pairs = np.array(list(itertools.product(cosines, (1 / 1.34, 1.02, 1.52 / 1.34, 3.0))), np.float32)
    expected = [reflectance(float(c), float(m)) for c, m in pairs]
    found = each(fresnel_reflectance, list(pairs.T), device=device)
    np.testing.assert_allclose(found, expected, rtol=2e-3, atol=2e-6)
    mirror = each(fresnel_reflectance, [np.array([0.01, 0.5, 1.0]), 1e9], device=device)
    np.testing.assert_allclose(mirror, 1.0, atol=1e-6)


def follow(x, way, count):
    """Faces met by the light that leaves x along `way` and is reflected `count` times, cosines, end and heading."""
    x, met, cosines = x.copy(), [], []
    length = np.linalg.norm(way)
    heading, rest = way / length, length
    for _ in range(count):
        with np.errstate(divide="ignore"):
            steps = np.where(heading > 0, UPPER - x, LOWER - x) / heading
        axis = int(np.argmin(steps))
        x = x + steps[axis] * heading
        rest -= steps[axis]
        met.append((axis, int(heading[axis] > 0)))
        cosines.append(abs(heading[axis]))
        heading = np.where(np.arange(3) == axis, -heading, heading)
    return met, cosines, x + rest * heading, heading


def mirrored(x, number):
    """By mirroring again and again, from the lens outwards."""
    seen = np.array(x, float)
    for axis, n in enumerate(number):
        walls = [(LOWER, UPPER)[(n > 0) ^ (k % 2)][axis] for k in range(abs(n))]  # the lens's wall first
        for wall in reversed(walls):
            seen[axis] = 2 * wall - seen[axis]
    return seen


def test_images_are_all_chains_of_reflections():
    """All words of faces whose mirrored lens is reached over just these faces, in this order, each within its
    bounds."""
    low, high = np.array([0.7, 0.0, 0.8]), np.array([0.9, 1.2, 1.1])  # no face at y_low
    x, o = np.random.default_rng(1).uniform(LOWER, UPPER, (2, 3))
    found = []
    faces = [(axis, side) for axis in range(3) for side in range(2) if (low, high)[side][axis] > 0]
    for word in itertools.chain.from_iterable(itertools.product(faces, repeat=count) for count in (1, 2, 3)):
        image = o.copy()
        for axis, side in reversed(word):
            image[axis] = 2 * (LOWER, UPPER)[side][axis] - image[axis]
        met, _, end, _ = follow(x, image - x, len(word))
        if met == list(word) and np.allclose(end, o):
            found.append(np.linalg.norm(image - x))
    images = [np.linalg.norm(mirrored(x, number) - o) for number in chains(low, high, 3)]
    assert len(found) == len(images) > 30
    np.testing.assert_allclose(sorted(found), sorted(images), rtol=1e-12)
    assert chains([0, 0.7, 0], [0, 0, 0], 4) == [(0, -1, 0)]  # a single face is met once
    assert len(chains([1, 1, 1], [1, 1, 1], 2)) == 24


def test_images_are_what_reflections_one_by_one_lead_to(device):
    """Image, direction at the point, product of reflectances and first face, for all images of up to four
    reflections."""
    indices = np.array([[0.75, 1.3, 0.9], [1.1, 0.75, 2.0]])
    numbers = chains(*indices, 4)
    x, o = np.random.default_rng(2).uniform(LOWER, UPPER, (2, len(numbers), 3)).astype(np.float32)
    limits = Limits()
    limits.lower, limits.upper = wp.vec3(*LOWER), wp.vec3(*UPPER)
    limits.boundary = sk.make_boundary(*indices, max_reflections=4, device=device)
    images = limits.boundary.images
    seen = each(image_point, [limits.lower, limits.upper, images, x], [wp.vec3], device)
    along = unit(o - seen)
    heading = each(image_direction, [images, along], [wp.vec3], device)
    passes = each(image_reflectance, [limits.boundary, images, along], device=device)
    first = each(next_face, [limits, 1e30, x, heading], [Exit], device)["face"]
    for k, number in enumerate(numbers):
        np.testing.assert_allclose(seen[k], mirrored(x[k], number), atol=2e-5)
        way = heading[k] * np.linalg.norm(o[k] - seen[k])
        met, cosines, end, last = follow(x[k], way, sum(map(abs, number)))
        np.testing.assert_allclose(end, o[k], atol=2e-5)
        np.testing.assert_allclose(last, along[k], atol=1e-5)  # as the lens sees it
        expected = np.prod([reflectance(c, indices[side][axis]) for c, (axis, side) in zip(cosines, met, strict=True)])
        assert passes[k] == pytest.approx(expected, rel=2e-3, abs=1e-6)
        axis, side = met[0]
        assert first[k] == 1 + 2 * axis + side
