"""Signal and backscatter of the analytic lidar against closed forms, plain radiometry and quadrature."""

import math

import numpy as np
import pytest
import warp as wp

from helpers.launch import on_device, unit
from helpers.lidar import AXIS, C0, lidar
from reference import crlb
from reference.single_scatter import Lidar as ReferenceLidar
from reference.single_scatter import single_scatter
from spadwarp_kernels import analytic


def grid(u):
    """Points (x, y, 1) with x and y of `u`, rows of x first."""
    x, y = np.meshgrid(u, u)
    return np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)


def signals(one, points, normals, reflectance=0.5, device="cpu"):
    """Signal and arrival of surface points `[n, 3]` in the middle of their pixels."""
    points = np.asarray(points, float)
    distance = np.linalg.norm(points, axis=1)
    vectors = [on_device(array, device, wp.vec3d) for array in (points / distance[:, None], normals)]
    numbers = [on_device(array, device, wp.float64) for array in (distance, np.full(len(points), reflectance))]
    return [out.numpy() for out in analytic.signal_map(one, vectors[0], numbers[0], vectors[1], numbers[1])]


def test_equations_3_to_6_combine_to_equation_7(device):
    rng = np.random.default_rng(1)
    for _ in range(20):
        E0, c, R, gamma, q = 10 ** rng.uniform(-10, -6), rng.uniform(0, 2), rng.uniform(1, 50), rng.uniform(), 0.28
        tangent, f, f_number, pitch, fill = rng.uniform(0.01, 0.3), rng.uniform(0.005, 0.2), 2.8, 50e-6, 0.2
        W = H = pitch * math.sqrt(fill)
        on_pixel = crlb.eq5(crlb.eq4(crlb.eq3(E0, c, R, tangent), R, W, H, f), gamma, c, R)
        chain = crlb.eq6(on_pixel, q, f, f_number)
        expected = crlb.eq7(E0, 532e-9, q * fill, gamma, c, R, pitch, f_number, tangent)
        photons = 532e-9 / crlb.PLANCK_TIMES_C
        assert chain * photons == pytest.approx(expected, rel=1e-12)
        sizes = {"pixel_tangent": pitch / f, "aperture_area": math.pi * (f / 2 / f_number) ** 2}
        sizes |= {"half_angle": math.atan(tangent), "photons": E0 * photons, "pde": q * fill}
        one = lidar(lu2024=1, extinction=c, **sizes)
        signal, arrival = signals(one, [[0, 0, R]], [[0, 0, -1]], gamma, device)
        assert signal[0] == pytest.approx(expected, rel=1e-12)
        assert arrival[0] == pytest.approx(2 * R / C0, rel=1e-14)


def by_area(one, centre, normal, half_angle, laser, reflectance=0.5, nodes=400):
    """Signal of a plane by plain radiometry: E·(Γ/π)·cosθ_out·A·cosψ/r² summed over what a pixel sees of the plane."""
    centre, normal, laser = (np.asarray(v, float) for v in (centre, normal, laser))
    u = (np.arange(nodes) + 0.5) / nodes - 0.5
    tangent = one.pixel_tangent
    rays = np.stack([*np.meshgrid(centre[0] / centre[2] + u * tangent, centre[1] / centre[2] + u * tangent)], -1)
    rays = np.concatenate([rays, np.ones((nodes, nodes, 1))], -1)
    x = rays * ((normal @ centre) / (rays @ normal))[..., None]  # on the plane
    r = np.linalg.norm(x, axis=-1)
    y = x - laser
    s = np.linalg.norm(y, axis=-1)
    lit = y[..., 2] / s >= math.cos(half_angle)
    irradiance = lit / (2 * math.pi * (1 - math.cos(half_angle)) * s**2) * np.maximum(-(y @ normal) / s, 0)
    cos_out, cos_psi = -(x @ normal) / r, x[..., 2] / r
    # Element of the plane: the image element (tangent/nodes)² seen at z = 1, projected onto the plane.
    area = (tangent / nodes) ** 2 * cos_psi**3 * r**2 / cos_out
    attenuation = np.exp(-one.extinction * (r + s))
    collected = reflectance / math.pi * cos_out * one.aperture_area * cos_psi / r**2
    return (irradiance * collected * area * attenuation).sum()


def test_radiometric_signal_is_the_integral_over_the_pixels_footprint(device):
    """Tilted faces, field corners, a laser beside the lens, the rim of the cone, and a spot smaller than the pixel."""
    cases = [
        (35.0, laser, 1e-3, (5 * x, 5 * y, 5.0), normal, 2e-3)
        for laser in [(0, 0, 0), (-0.4, 0.1, 0.2)]
        for x, y in [(0, 0), (0.25, -0.3), (0.4, 0.35)]
        for normal in ([0, 0, -1], [0.6, 0.2, -1], [-0.5, 0.5, -0.6])
    ]
    cases.append((10.0, (0, 0, 0), 0.01, (4 * math.tan(math.radians(10.0)), 0, 4.0), [0.2, 0, -1], 0.05))  # rim
    # A spot of a fifth of the pixel's side.
    cases += [(0.1, (0, 0, 0), 0.0175, (0, 0, 3.0), normal, 0.01) for normal in ([0, 0, -1], [0.8, 0.1, -1])]
    for angle, laser, tangent, centre, normal, tolerance in cases:
        normal = np.array(normal) / np.linalg.norm(normal)
        one = lidar(half_angle=math.radians(angle), laser=laser, pixel_tangent=tangent, extinction=0.2)
        expected = by_area(one, centre, normal, math.radians(angle), laser)
        signal, arrival = signals(one, [centre], [normal], device=device)
        assert expected > 0
        assert signal[0] == pytest.approx(expected, rel=tolerance), (angle, laser, centre, normal)
        path = np.linalg.norm(np.subtract(centre, laser)) + np.linalg.norm(centre)
        assert arrival[0] == pytest.approx(path / C0, rel=1e-14)
    # Faces turned away, and points outside the cone.
    assert not signals(lidar(), [[0, 0, 5], [2, 0, 5]], [[0, 0, 1], [0, 0, -1]])[0].any()


@pytest.mark.parametrize("profile", [1, 2])
def test_gaussian_and_collimated_beams_put_all_their_light_on_a_wide_plane(profile):
    """The sum over pixels of S·r²/cosψ⁴-weights is the beam's energy: irradiance integrates to 1."""
    half, distance, tangent = math.radians(2.0), 4.0, 2e-3
    one = lidar(half_angle=half, profile=profile, radius=0.15, pixel_tangent=tangent)
    points = grid((np.arange(200) - 99.5) * tangent) * distance
    signal, _ = signals(one, points, np.tile([0, 0, -1.0], (len(points), 1)), reflectance=1.0)
    cos = distance / np.linalg.norm(points, axis=1)
    per_energy = one.aperture_area * cos**4 / (math.pi * distance**2)  # Lambertian, fills the pixel, seen at ψ
    assert (signal / per_energy).sum() == pytest.approx(1.0, rel=3e-3)


def scatter_table(one, view, distance, g, device="cpu"):
    angles = np.linspace(0, np.pi, 4097)
    phase = (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * np.cos(angles)) ** 1.5)
    arrays = [on_device(phase, device, wp.float64), on_device(view, device, wp.vec3d)]
    out = analytic.single_scatter_table(one, *arrays, on_device(distance, device, wp.float64))
    return [array.numpy() for array in out]


def test_coaxial_backscatter_is_the_single_scatter_formula():
    """C_back = (λE0/hc)·PDE·v·b·p(π)·pitch²·e^{−2cR}/(8N²tan²θ·R²); in radiometry 2π(1−cosθ) stands for πtan²θ."""
    g, half, c = 0.924, math.radians(3.0), 0.4
    for lu2024 in (0, 1):
        water = {"extinction": c, "scattering": 0.3, "photons": 1e9, "pde": 0.1}
        one = lidar(lu2024=lu2024, half_angle=half, **water, start=1.2e-8, stop=4e-8)
        paths, cumulative, total = scatter_table(one, [AXIS, AXIS], [0.0, 3.0], g)
        back = (1 - g * g) / (4 * math.pi * (1 + g) ** 3)
        pitch2_per_n2 = 4 * one.aperture_area * one.pixel_tangent**2 / math.pi
        cone = math.tan(half) ** 2 if lu2024 else 2 * (1 - math.cos(half))
        for row, stop in enumerate((4e-8, 6.0 / C0)):
            t = np.linspace(1.2e-8, stop, 200_001)
            R = C0 * t / 2
            rate = 1e9 * 0.1 * C0 * 0.3 * back * pitch2_per_n2 * np.exp(-2 * c * R) / (8 * cone * R**2)
            assert total[row] == pytest.approx(np.trapezoid(rate, t), rel=1e-5)
            assert paths[row, 0] == pytest.approx(1.2e-8 * C0, rel=1e-6)
            assert paths[row, -1] == pytest.approx(stop * C0, rel=1e-6)
            share = np.concatenate([[0], np.cumsum(0.5 * (rate[1:] + rate[:-1]) * np.diff(t))])
            expected = np.interp(paths[row] / C0, t, share / share[-1])
            np.testing.assert_allclose(cumulative[row], expected, atol=2e-5)


def test_backscatter_of_a_laser_beside_the_lens_agrees_with_quadrature(device):
    """The overlap of beam and view: paths of 2 to 7 m, against an integral over each pixel's cone."""
    reference = ReferenceLidar(pixels=24, edges=np.array([2.0, 7.0]))
    tangent = math.tan(reference.field_of_view / 2)
    water = {"extinction": reference.extinction, "scattering": reference.extinction * reference.albedo}
    beam = {"half_angle": reference.half_angle, "laser": reference.laser_position}
    one = lidar(**water, **beam, pixel_tangent=2 * tangent / 24, start=2.0 / C0, stop=7.0 / C0, nearest=0.01)
    view = unit(grid((np.arange(24) - 11.5) / 12 * tangent))
    total = scatter_table(one, view, np.zeros(576), reference.anisotropy, device)[2].reshape(24, 24)
    expected = single_scatter(reference)[:, :, 0]
    assert total.sum() == pytest.approx(expected.sum(), rel=0.02)
    inner = np.zeros((24, 24), bool)
    inner[8:16] = expected[8:16] > 0.4 * expected.max()  # not cut by the rim of the beam
    assert inner.sum() >= 60
    np.testing.assert_allclose(total[inner], expected[inner], rtol=0.02)
