"""Stokes vectors of photons: rotations, one scattering, surfaces, windows, reciprocity; against float64."""

import itertools

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from reference.stokes import MIRROR, block_matrix, scattered
from spadwarp_kernels.base.arguments import ArgumentError
from spadwarp_kernels.base.rotations import orthonormal_basis
from spadwarp_kernels.riders.polarisation import (
    fresnel_elements,
    table_elements,
    transport_stokes,
    turn_stokes,
    window_elements,
)

pytestmark = pytest.mark.physics


@wp.kernel
def _turn_kernel(
    u: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    stokes: wp.array(dtype=wp.vec4),
    first: wp.array(dtype=wp.vec4),
    last: wp.array(dtype=float),
    out: wp.array(dtype=wp.vec4),
    reference_u: wp.array(dtype=wp.vec3),
    reference_v: wp.array(dtype=wp.vec3),
):
    i = wp.tid()
    m = table_elements(first, last, sk.one_minus_cosine(u[i], v[i]))
    out[i] = turn_stokes(stokes[i], u[i], v[i], m)
    a, _a2 = orthonormal_basis(u[i])
    b, _b2 = orthonormal_basis(v[i])
    reference_u[i] = a
    reference_v[i] = b


@wp.kernel
def _transport_kernel(
    u: wp.array(dtype=wp.vec3),
    v: wp.array(dtype=wp.vec3),
    stokes: wp.array(dtype=wp.vec4),
    out: wp.array(dtype=wp.vec4),
):
    i = wp.tid()
    out[i] = transport_stokes(stokes[i], u[i], v[i])


@wp.kernel
def _fresnel_kernel(cosine: wp.array(dtype=float), index: float, out: wp.array2d(dtype=float)):
    i = wp.tid()
    m = fresnel_elements(cosine[i], index)
    out[i, 0] = m.m12
    out[i, 1] = m.m22
    out[i, 2] = m.m33
    out[i, 3] = m.m34
    out[i, 4] = m.m44


@wp.kernel
def _window_kernel(n: wp.vec4, q: wp.array(dtype=wp.vec4), out: wp.array(dtype=wp.vec2)):
    i = wp.tid()
    m = window_elements(n, q[i])
    out[i] = wp.vec2(m.m12, m.m33)


def directions(count, rng):
    u = rng.normal(size=(count, 3))
    return (u / np.linalg.norm(u, axis=1, keepdims=True)).astype(np.float32)


def matrix(cosine):
    """Elements with all of them at work: m12, m22, m33, m34, m44 `[n, 5]`."""
    c = np.asarray(cosine)
    return np.stack([0.7 * (c**2 - 1.0), 0.9 + 0.1 * c, 0.6 * c, 0.3 * (1.0 - c**2), 0.1 + 0.5 * c], -1)


def turned(u, v, stokes, device, elements=matrix):
    """`turn_stokes` of the kernels, and the reference directions that it takes before and after."""
    p = sk.make_polarisation(matrix=elements, device=device)
    count = len(u)
    arrays = [wp.array(one, dtype=kind, device=device) for one, kind in ((u, wp.vec3), (v, wp.vec3), (stokes, wp.vec4))]
    out = wp.zeros(count, dtype=wp.vec4, device=device)
    before, after = (wp.zeros(count, dtype=wp.vec3, device=device) for _ in range(2))
    wp.launch(_turn_kernel, count, [*arrays, p.first, p.last], [out, before, after], device=device)
    return out.numpy(), before.numpy(), after.numpy()


def reference(u, v, stokes, before, after):
    u, v = (one / np.linalg.norm(one, axis=-1, keepdims=True) for one in (np.float64(u), np.float64(v)))
    matrices = lambda c: block_matrix(*np.moveaxis(matrix(c), -1, 0))  # noqa: E731
    return scattered(stokes, before, u, v, after, matrices)


def test_one_scattering_is_that_of_the_reference(device):
    rng = np.random.default_rng(1)
    u, v, stokes = directions(20_000, rng), directions(20_000, rng), rng.normal(size=(20_000, 4)).astype(np.float32)
    found, before, after = turned(u, v, stokes, device)
    np.testing.assert_allclose(found, reference(u, v, stokes, before, after), atol=3e-5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("angle", [1e-1, 1e-3, 1e-5, 1e-7, 0.0])
def test_light_that_hardly_turns_keeps_its_plane(sign, angle, device):
    """Nearly forward and backward, where float32 knows no plane of scattering: the whole is right nevertheless, since
    both rotations have the same error."""
    rng = np.random.default_rng(2)
    u, aside = directions(5000, rng), directions(5000, rng)
    v = sign * u + angle * aside
    v = (v / np.linalg.norm(v, axis=1, keepdims=True)).astype(np.float32)
    stokes = rng.normal(size=(5000, 4)).astype(np.float32)
    # As molecules forward and spheres backward: m33 = m22 and m33 = -m22 there.
    same = lambda c: np.tile([0.0, 1.0, sign, 0.0, sign], (len(c), 1))  # noqa: E731
    found, before, after = turned(u, v, stokes, device, same)
    # The reference across u, carried to v: by parallel transport, or by a mirror.
    rest = np.float64(u) if sign > 0.0 else -np.float64(u)
    e1 = before - (before * v).sum(1, keepdims=True) / (1.0 + (rest * v).sum(1, keepdims=True)) * (rest + v)
    e2, f2 = np.cross(e1, v), np.cross(after, v)
    cosine, sine = (after * e1).sum(1), (after * e2).sum(1)
    assert np.abs(cosine**2 + sine**2 - 1.0).max() < 1e-4 and np.abs((f2 * e1).sum(1) + sine).max() < 1e-4
    q, w = stokes[:, 1], sign * stokes[:, 2]
    cos2, sin2 = cosine**2 - sine**2, 2.0 * cosine * sine
    expected = np.stack([stokes[:, 0], cos2 * q + sin2 * w, cos2 * w - sin2 * q, sign * stokes[:, 3]], 1)
    np.testing.assert_allclose(found, expected, atol=2e-4 + 3.0 * angle)


def test_transport_there_and_back_changes_nothing(device):
    rng = np.random.default_rng(3)
    u, v, stokes = directions(5000, rng), directions(5000, rng), rng.normal(size=(5000, 4)).astype(np.float32)
    u, v, stokes = (wp.array(one, dtype=k, device=device) for one, k in ((u, wp.vec3), (v, wp.vec3), (stokes, wp.vec4)))
    there, back = (wp.zeros(5000, dtype=wp.vec4, device=device) for _ in range(2))
    wp.launch(_transport_kernel, 5000, [u, v, stokes], [there], device=device)
    wp.launch(_transport_kernel, 5000, [v, u, there], [back], device=device)
    np.testing.assert_allclose(back.numpy(), stokes.numpy(), atol=2e-5)
    degree = [np.linalg.norm(one.numpy()[:, 1:3], axis=1) for one in (stokes, there)]
    np.testing.assert_allclose(*degree, rtol=1e-5)


def test_the_way_back_is_p_m_transposed_p(device):
    """Chains of four scatterings: the matrix of the reversed way is P·Mᵀ·P, P = diag(1, 1, −1, 1)."""
    rng = np.random.default_rng(4)
    way = [directions(2000, rng) for _ in range(5)]

    def chain(path):
        columns = []
        for unit in np.eye(4, dtype=np.float32):
            stokes = np.tile(unit, (2000, 1))
            for u, v in itertools.pairwise(path):
                stokes = turned(u, v, stokes, device)[0]
            columns.append(stokes)
        return np.stack(columns, -1)

    there, back = chain(way), chain([-u for u in reversed(way)])
    np.testing.assert_allclose(back, MIRROR @ np.swapaxes(there, 1, 2) @ MIRROR, atol=2e-5)
    assert np.abs(back - np.swapaxes(there, 1, 2)).max() > 0.1  # the plain transpose fails


def amplitudes(cosine, index):
    """Fresnel's reflection amplitudes r_s and r_p, complex beyond the critical angle (Bohren & Huffman, eq 2.67)."""
    behind = np.sqrt(np.asarray(1.0 - (1.0 - cosine**2) / index**2, np.complex128))
    s = (cosine - index * behind) / (cosine + index * behind)
    p = (index * cosine - behind) / (index * cosine + behind)
    return s, p


@pytest.mark.parametrize("index", [1.12, 0.7463, 1.5])
def test_reflection_has_fresnels_matrix(index, device):
    cosine = np.linspace(0.01, 1.0, 200).astype(np.float32)
    out = wp.zeros((200, 5), dtype=float, device=device)
    wp.launch(_fresnel_kernel, 200, [wp.array(cosine, dtype=float, device=device), index], [out], device=device)
    s, p = amplitudes(np.float64(cosine), index)
    whole = 0.5 * (abs(s) ** 2 + abs(p) ** 2)
    cross = p * s.conj()
    expected = [0.5 * (abs(p) ** 2 - abs(s) ** 2), whole, cross.real, cross.imag, cross.real]
    np.testing.assert_allclose(out.numpy(), np.stack(expected, 1) / whole[:, None], atol=3e-4)


def test_a_window_has_the_transmissions_of_both_polarisations(device):
    air, glass, water = 1.0, 1.52, 1.34
    sine = np.linspace(0.0, 0.95, 50)
    n = np.array([air, glass, glass, water])
    q = np.sqrt(n**2 - sine[:, None] ** 2)  # n cosθ
    out = wp.zeros(50, dtype=wp.vec2, device=device)
    wp.launch(_window_kernel, 50, [wp.vec4(*n), wp.array(q, dtype=wp.vec4, device=device)], [out], device=device)
    s, p = np.ones(50), np.ones(50)
    for a, b in ((0, 1), (2, 3)):
        s = s * 4.0 * q[:, a] * q[:, b] / (q[:, a] + q[:, b]) ** 2
        one, two = q[:, a] / n[a] ** 2, q[:, b] / n[b] ** 2
        p = p * 4.0 * one * two / (one + two) ** 2
    np.testing.assert_allclose(out.numpy()[:, 0], (p - s) / (p + s), atol=1e-5)
    np.testing.assert_allclose(out.numpy()[:, 1], 2.0 * np.sqrt(p * s) / (p + s), atol=1e-5)


def test_what_no_light_and_no_matrix_can_be_is_refused():
    with pytest.raises(ArgumentError, match="polarised by more than 1"):
        sk.make_polarisation(laser=(1.0, 0.9, 0.9, 0.0), device="cpu")
    with pytest.raises(ArgumentError, match="beyond m11"):
        sk.make_polarisation(matrix=lambda c: np.full((len(c), 5), 1.5), device="cpu")
    with pytest.raises(ArgumentError, match="cosines"):
        sk.make_polarisation(matrix=lambda c: np.zeros((3, 5)), device="cpu")
    with pytest.raises(ArgumentError, match="rows of 4"):
        sk.make_polarisation(channels=[[1.0, 0.0]], device="cpu")
