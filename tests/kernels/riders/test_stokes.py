"""Stokes vectors of photons: rotations, one scattering, surfaces, windows, reciprocity; against float64."""

import itertools

import numpy as np
import pytest
import warp as wp

import spadwarp_kernels as sk
from helpers.launch import each, on_device, unit
from reference.refraction import amplitudes
from reference.stokes import MIRROR, block_matrix, scattered
from spadwarp_kernels.base.rotations import orthonormal_basis
from spadwarp_kernels.riders.polarisation import (
    Elements,
    fresnel_elements,
    passage_elements,
    table_elements,
    transport_stokes,
    turn_stokes,
    window_elements,
)

pytestmark = pytest.mark.physics


def directions(count, rng):
    return unit(rng.normal(size=(count, 3))).astype(np.float32)


def matrix(cosine):
    """Elements with all of them at work: m12, m22, m33, m34, m44 `[n, 5]`."""
    c = np.asarray(cosine)
    return np.stack([0.7 * (c**2 - 1.0), 0.9 + 0.1 * c, 0.6 * c, 0.3 * (1.0 - c**2), 0.1 + 0.5 * c], -1)


def rays(count, seed):
    """Directions before and after, and Stokes vectors."""
    rng = np.random.default_rng(seed)
    return directions(count, rng), directions(count, rng), rng.normal(size=(count, 4)).astype(np.float32)


@wp.func
def turn(
    stokes: wp.vec4, u: wp.vec3, v: wp.vec3, first: wp.array(dtype=wp.vec4), last: wp.array(dtype=float)
) -> wp.vec4:
    return turn_stokes(stokes, u, v, table_elements(first, last, sk.one_minus_cosine(u, v)))


def turned(u, v, stokes, device, elements=matrix):
    """`turn_stokes` of the kernels, and the reference directions that it takes before and after."""
    p = sk.make_polarisation(matrix=elements, device=device)
    out = each(turn, [on_device(stokes, device, wp.vec4), u, v, p.first, p.last], [wp.vec4], device)
    return out, *(each(orthonormal_basis, [one], (wp.vec3, wp.vec3), device)[0] for one in (u, v))


def reference(u, v, stokes, before, after):
    u, v = (unit(np.float64(one)) for one in (u, v))
    matrices = lambda c: block_matrix(*np.moveaxis(matrix(c), -1, 0))  # noqa: E731
    return scattered(stokes, before, u, v, after, matrices)


def test_one_scattering_is_that_of_the_reference(device):
    u, v, stokes = rays(20_000, 1)
    found, before, after = turned(u, v, stokes, device)
    np.testing.assert_allclose(found, reference(u, v, stokes, before, after), atol=3e-5)


@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize("angle", [1e-1, 1e-3, 1e-5, 1e-7, 0.0])
def test_light_that_hardly_turns_keeps_its_plane(sign, angle, device):
    """Nearly forward and backward, where float32 knows no plane of scattering: the whole is right nevertheless, since
    both rotations have the same error."""
    rng = np.random.default_rng(2)
    u, aside = directions(5000, rng), directions(5000, rng)
    v = unit(sign * u + angle * aside).astype(np.float32)
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
    u, v, stokes = rays(5000, 3)
    there = each(transport_stokes, [on_device(stokes, device, wp.vec4), u, v], [wp.vec4], device)
    back = each(transport_stokes, [on_device(there, device, wp.vec4), v, u], [wp.vec4], device)
    np.testing.assert_allclose(back, stokes, atol=2e-5)
    np.testing.assert_allclose(*(np.linalg.norm(one[:, 1:3], axis=1) for one in (stokes, there)), rtol=1e-5)


def test_the_way_back_is_p_m_transposed_p(device):
    """Chains of four scatterings: the matrix of the reversed way is P·Mᵀ·P, P = diag(1, 1, −1, 1)."""
    rng = np.random.default_rng(4)
    way = [directions(2000, rng) for _ in range(5)]

    def chain(path):
        columns = []
        for one in np.eye(4, dtype=np.float32):
            stokes = np.tile(one, (2000, 1))
            for u, v in itertools.pairwise(path):
                stokes = turned(u, v, stokes, device)[0]
            columns.append(stokes)
        return np.stack(columns, -1)

    there, back = chain(way), chain([-u for u in reversed(way)])
    np.testing.assert_allclose(back, MIRROR @ np.swapaxes(there, 1, 2) @ MIRROR, atol=2e-5)
    assert np.abs(back - np.swapaxes(there, 1, 2)).max() > 0.1  # the plain transpose fails


@pytest.mark.parametrize("index", [1.12, 0.7463, 1.5])
def test_reflection_has_fresnels_matrix(index, device):
    cosine = np.linspace(0.01, 1.0, 200).astype(np.float32)
    out = each(fresnel_elements, [cosine, index], [Elements], device)
    s, p = amplitudes(np.float64(cosine), index)
    whole = 0.5 * (abs(s) ** 2 + abs(p) ** 2)
    cross = p * s.conj()
    expected = [0.5 * (abs(p) ** 2 - abs(s) ** 2), whole, cross.real, cross.imag, cross.real]
    for name, values in zip(("m12", "m22", "m33", "m34", "m44"), expected, strict=True):
        np.testing.assert_allclose(out[name], values / whole, atol=3e-4, err_msg=name)


def test_a_window_has_the_transmissions_of_both_polarisations(device):
    air, glass, water = 1.0, 1.52, 1.34
    sine = np.linspace(0.0, 0.95, 50)
    n = np.array([air, glass, glass, water])
    q = np.sqrt(n**2 - sine[:, None] ** 2)  # n cosθ
    out = each(window_elements, [wp.vec4(*n), on_device(q, device, wp.vec4)], [Elements], device)
    s, p = np.ones(50), np.ones(50)
    for a, b in ((0, 1), (2, 3)):
        s = s * 4.0 * q[:, a] * q[:, b] / (q[:, a] + q[:, b]) ** 2
        one, two = q[:, a] / n[a] ** 2, q[:, b] / n[b] ** 2
        p = p * 4.0 * one * two / (one + two) ** 2
    np.testing.assert_allclose(out["m12"], (p - s) / (p + s), atol=1e-5)
    np.testing.assert_allclose(out["m33"], 2.0 * np.sqrt(p * s) / (p + s), atol=1e-5)


@wp.func
def pass_sea(stokes: wp.vec4, u: wp.vec3, v: wp.vec3, sea: sk.Sea) -> wp.vec4:
    return turn_stokes(stokes, u, v, passage_elements(sea, u, v))


def test_facets_of_the_sea_reflect_and_refract_the_field(device):
    """From both sides, by the field's components along and across the plane of incidence."""
    rng, index = np.random.default_rng(5), 1.34
    sea = sk.make_sea((0.01, 0.01), index=index, normal=(0.0, 0.0, 1.0), height=0.0, device=device)
    u = unit(np.float64(directions(20_000, rng)))
    m = unit(np.column_stack([0.2 * rng.normal(size=(20_000, 2)), np.ones(20_000)]))
    m *= np.where(u[:, 2:] < 0.0, 1.0, -1.0)  # to the side of the light
    ratio, cosine = np.where(u[:, 2] < 0.0, index, 1.0 / index), -(u * m).sum(axis=1)
    rest = 1.0 - (1.0 - cosine**2) / ratio**2
    for reflects in (True, False):
        v = u + 2.0 * cosine[:, None] * m
        if not reflects:
            v = (u + cosine[:, None] * m) / ratio[:, None] - np.sqrt(np.maximum(rest, 0.0))[:, None] * m
        kept = (cosine > 0.05) & (u[:, 2] * v[:, 2] * (-1.0 if reflects else 1.0) > 0.0) & (reflects | (rest > 1e-4))
        s, p = np.array([amplitudes(c, n) for c, n in zip(cosine[kept], ratio[kept], strict=True)]).T
        if not reflects:
            s, p = 1.0 + s, (1.0 + p) / ratio[kept]
        whole, cross = 0.5 * (abs(s) ** 2 + abs(p) ** 2), p * s.conj()
        elements = [0.5 * (abs(p) ** 2 - abs(s) ** 2), whole, cross.real, cross.imag, cross.real]
        stokes = rng.normal(size=(kept.sum(), 4)).astype(np.float32)
        rays = [one[kept].astype(np.float32) for one in (u, v)]
        found = each(pass_sea, [on_device(stokes, device, wp.vec4), *rays, sea], [wp.vec4], device)
        before, after = (each(orthonormal_basis, [one], (wp.vec3, wp.vec3), device)[0] for one in rays)
        expected = scattered(stokes, before, u[kept], v[kept], after, lambda c: block_matrix(*elements / whole))  # noqa: B023
        assert kept.sum() > 5000
        np.testing.assert_allclose(found, expected, atol=2e-3)
        assert np.median(np.abs(found - expected)) < 1e-5
