"""Faces that reflect: Fresnel's formulas, and images in them against reflections followed one by one."""

import itertools

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from spadwarp_kernels.water.limits import (
    Limits,
    fresnel_reflectance,
    image_direction,
    image_point,
    image_reflectance,
    next_face,
    to_next_face,
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


@wp.kernel
def reflectance_kernel(cosine: wp.array(dtype=float), index: wp.array(dtype=float), out: wp.array(dtype=float)):
    k = wp.tid()
    out[k] = fresnel_reflectance(cosine[k], index[k])


def test_reflectance_is_fresnels(device):
    cosines = np.concatenate([np.linspace(0.02, 1.0, 50), [np.cos(np.arcsin(1 / 1.34)) * 0.999]])
    pairs = np.array(list(itertools.product(cosines, (1 / 1.34, 1.02, 1.52 / 1.34, 3.0))), np.float32)
    out = wp.zeros(len(pairs), dtype=float, device=device)
    columns = [wp.array(np.ascontiguousarray(pairs[:, i]), dtype=float, device=device) for i in range(2)]
    wp.launch(reflectance_kernel, len(pairs), columns, outputs=[out], device=device)
    expected = [reflectance(float(c), float(m)) for c, m in pairs]
    np.testing.assert_allclose(out.numpy(), expected, rtol=2e-3, atol=2e-6)


def test_a_very_large_index_is_a_mirror(device):
    out = wp.zeros(3, dtype=float, device=device)
    cosines = wp.array([0.01, 0.5, 1.0], dtype=float, device=device)
    index = wp.full(3, 1e9, dtype=float, device=device)
    wp.launch(reflectance_kernel, 3, [cosines, index], outputs=[out], device=device)
    np.testing.assert_allclose(out.numpy(), 1.0, atol=1e-6)


def test_images_are_all_chains_of_reflections():
    """All words of faces whose mirrored lens is reached over just these faces, in this order, each within its
    bounds."""
    rng = np.random.default_rng(1)
    low, high = np.array([0.7, 0.0, 0.8]), np.array([0.9, 1.2, 1.1])  # no face at y_low
    x, o = rng.uniform(LOWER, UPPER, (2, 3))
    found = []
    faces = [(axis, side) for axis in range(3) for side in range(2) if (low, high)[side][axis] > 0]
    for count in (1, 2, 3):
        for word in itertools.product(faces, repeat=count):
            image = o.copy()
            for axis, side in reversed(word):
                image[axis] = 2 * (LOWER, UPPER)[side][axis] - image[axis]
            met, _, end, _ = follow(x, image - x, count)
            if met == list(word) and np.allclose(end, o):
                found.append(np.linalg.norm(image - x))
    numbers = chains(low, high, 3)
    images = [np.linalg.norm(_image(x, number) - o) for number in numbers]
    assert len(found) == len(images) > 30
    np.testing.assert_allclose(sorted(found), sorted(images), rtol=1e-12)


def follow(x, way, count):
    """Faces met by the light that leaves x along `way` and is reflected `count` times, cosines, end and heading."""
    x, way, met, cosines = x.copy(), way.copy(), [], []
    length = np.linalg.norm(way)
    heading, rest = way / length, length
    for _ in range(count):
        with np.errstate(divide="ignore"):
            steps = np.where(heading > 0, UPPER - x, LOWER - x) / heading
        axis = int(np.argmin(steps))
        side = int(heading[axis] > 0)
        x = x + steps[axis] * heading
        rest -= steps[axis]
        met.append((axis, side))
        cosines.append(abs(heading[axis]))
        heading = heading.copy()
        heading[axis] *= -1
    return met, cosines, x + rest * heading, heading


def _image(x, number):
    """By mirroring again and again, from the lens outwards."""
    seen = np.array(x, float)
    for axis, n in enumerate(number):
        walls = [(LOWER, UPPER)[(n > 0) ^ (k % 2)][axis] for k in range(abs(n))]  # the lens's wall first
        for wall in reversed(walls):
            seen[axis] = 2 * wall - seen[axis]
    return seen


@wp.kernel
def image_kernel(
    limits: Limits,
    images: wp.array(dtype=wp.vec3i),
    x: wp.array(dtype=wp.vec3),
    o: wp.array(dtype=wp.vec3),
    seen: wp.array(dtype=wp.vec3),
    heading: wp.array(dtype=wp.vec3),
    passes: wp.array(dtype=float),
    first: wp.array(dtype=wp.vec2),
):
    k = wp.tid()
    seen[k] = image_point(limits.lower, limits.upper, images[k], x[k])
    along = wp.normalize(o[k] - seen[k])
    heading[k] = image_direction(images[k], along)
    passes[k] = image_reflectance(limits.boundary, images[k], along)
    first[k] = wp.vec2(to_next_face(limits, x[k], heading[k]), float(next_face(limits, 1e30, x[k], heading[k]).face))


def test_images_are_what_reflections_one_by_one_lead_to(device):
    """Image, direction at the point, product of reflectances and first face, for all images of up to four
    reflections."""
    rng = np.random.default_rng(2)
    indices = np.array([[0.75, 1.3, 0.9], [1.1, 0.75, 2.0]])
    numbers = chains(*indices, 4)
    x, o = rng.uniform(LOWER, UPPER, (2, len(numbers), 3))
    limits = Limits()
    limits.lower, limits.upper = wp.vec3(*LOWER), wp.vec3(*UPPER)
    limits.boundary = sk.make_boundary(*indices, max_reflections=4, device=device)
    outs = [wp.zeros(len(numbers), dtype=kind, device=device) for kind in (wp.vec3, wp.vec3, float, wp.vec2)]
    points = [wp.array(a.astype(np.float32), dtype=wp.vec3, device=device) for a in (x, o)]
    wp.launch(image_kernel, len(numbers), [limits, limits.boundary.images, *points], outputs=outs, device=device)
    seen, heading, passes, first = (out.numpy() for out in outs)
    for k, number in enumerate(numbers):
        np.testing.assert_allclose(seen[k], _image(x[k], number), atol=2e-5)
        length = np.linalg.norm(o[k] - seen[k])
        met, cosines, end, last = follow(x[k], heading[k].astype(float) * length, sum(map(abs, number)))
        np.testing.assert_allclose(end, o[k], atol=2e-5)
        np.testing.assert_allclose(last, (o[k] - seen[k]) / length, atol=1e-5)  # as the lens sees it
        expected = np.prod([reflectance(c, indices[side][axis]) for c, (axis, side) in zip(cosines, met, strict=True)])
        assert passes[k] == pytest.approx(expected, rel=2e-3, abs=1e-6)
        axis, side = met[0]
        assert int(first[k][1]) == 1 + 2 * axis + side


def test_a_single_face_is_met_once():
    assert chains([0, 0.7, 0], [0, 0, 0], 4) == [(0, -1, 0)]
    assert len(chains([1, 1, 1], [1, 1, 1], 2)) == 24


@pytest.mark.parametrize(
    ("low", "high", "reflections", "message"),
    [
        ([0, 0], [1, 1, 1], 2, "low = "),
        ([0, 0, 0], [0, 0, 0], 2, "all faces let all light out"),
        ([0, -1, 0], [0, 0, 0], 2, "low, y, = -1 is outside"),
        ([0, 1, 0], [0, 0, 0], 9, "max_reflections = 9 is outside"),
    ],
)
def test_boundaries_that_are_none_are_refused(low, high, reflections, message):
    with pytest.raises(sk.ArgumentError, match=message):
        sk.make_boundary(low, high, max_reflections=reflections, device="cpu")
