"""The analytic simulator's kernels against closed forms, dense float64 references and Monte Carlo."""

import math

import numpy as np
import pytest
import warp as wp
from scipy import stats

from helpers.statistics_of_samples import DEVICES
from reference import crlb
from reference.single_scatter import Lidar as ReferenceLidar
from reference.single_scatter import single_scatter
from spadwarp_kernels import analytic

C0 = 299_792_458.0
AXIS = [0.0, 0.0, 1.0]


def lidar(**changes):
    """A coaxial lidar in clear air of index 1, one photon a pulse; `changes` are fields of the struct."""
    half_angle = changes.pop("half_angle", math.radians(5.0))
    fields = {
        "lu2024": 0,
        "photons": 1.0,
        "pde": 1.0,
        "extinction": 0.0,
        "scattering": 0.0,
        "speed": C0,
        "laser": (0.0, 0.0, 0.0),
        "axis": AXIS,
        "profile": 0,
        "spread": 2 * math.sin(half_angle / 2) ** 2,
        "tan2": math.tan(half_angle) ** 2,
        "radius": 0.0,
        "pixel_tangent": 1e-3,
        "aperture_area": 1e-4,
        "start": 0.0,
        "stop": 1e-7,
        "sigma": 1e-10,
        "dark": 0.0,
        "source": 0,
        "constant": 0.0,
        "nearest": 0.05,
        "bin_width": 1e-10,
    }
    struct = analytic.Lidar()
    for name, value in {**fields, **changes}.items():
        setattr(struct, name, wp.vec3d(*value) if name in ("laser", "axis") else value)
    return struct


def signals(one, points, normals, reflectance=0.5, device="cpu"):
    """Signal of surface points `[n, 3]` in the middle of their pixels."""
    points = np.asarray(points, float)
    distance = np.linalg.norm(points, axis=1)
    arrays = [points / distance[:, None], distance, np.asarray(normals, float), np.full(len(points), reflectance)]
    kinds = [wp.vec3d, wp.float64, wp.vec3d, wp.float64]
    inputs = [wp.array(array, dtype=kind, device=device) for array, kind in zip(arrays, kinds, strict=True)]
    return [out.numpy() for out in analytic.signal_map(one, *inputs)]


def statistics(one, signal, arrival, *, count_law="per_pulse", acquisitions=1000.0, pulses_per_frame=1.0, device="cpu"):
    """α, F, σ* and outlier probability of pixels on the axis, background constant."""
    count = len(signal)
    total = one.constant * (one.stop - one.start)
    kinds = {"dtype": wp.float64, "device": device}
    alpha, fisher, sigma_star, _, outlier = [
        out.numpy()
        for out in analytic.statistics_maps(
            one,
            wp.zeros(2, **kinds),
            wp.zeros((1, 1), dtype=wp.float32, device=device),
            wp.array([AXIS] * count, dtype=wp.vec3d, device=device),
            wp.array(signal, **kinds),
            wp.array(arrival, **kinds),
            wp.full(count, total, **kinds),
            count_law=count_law,
            acquisitions=acquisitions,
            pulses_per_frame=pulses_per_frame,
        )
    ]
    return alpha, fisher, sigma_star, outlier


# Photon budget


def test_equations_3_to_6_combine_to_equation_7():
    rng = np.random.default_rng(1)
    for _ in range(20):
        E0, c, R, gamma, q = 10 ** rng.uniform(-10, -6), rng.uniform(0, 2), rng.uniform(1, 50), rng.uniform(), 0.28
        tangent, f, f_number, pitch, fill = rng.uniform(0.01, 0.3), rng.uniform(0.005, 0.2), 2.8, 50e-6, 0.2
        W = H = pitch * math.sqrt(fill)
        chain = crlb.eq6(
            crlb.eq5(crlb.eq4(crlb.eq3(E0, c, R, tangent), R, W, H, f), gamma, c, R), q, f, f_number
        )  # fmt: skip
        expected = crlb.eq7(E0, 532e-9, q * fill, gamma, c, R, pitch, f_number, tangent)
        photons = 532e-9 / crlb.PLANCK_TIMES_C
        assert chain * photons == pytest.approx(expected, rel=1e-12)
        one = lidar(
            lu2024=1,
            photons=E0 * photons,
            pde=q * fill,
            extinction=c,
            half_angle=math.atan(tangent),
            pixel_tangent=pitch / f,
            aperture_area=math.pi * (f / 2 / f_number) ** 2,
        )
        for device in DEVICES:
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
    return (
        irradiance * reflectance / math.pi * cos_out * one.aperture_area * cos_psi / r**2 * area * attenuation
    ).sum()


@pytest.mark.parametrize("device", DEVICES)
def test_radiometric_signal_is_the_integral_over_the_pixels_footprint(device):
    """Tilted faces, field corners, a laser beside the lens, the rim of the cone, and a spot smaller than the pixel."""
    cases = []
    for angle, laser, tangent in [(35.0, (0, 0, 0), 1e-3), (35.0, (-0.4, 0.1, 0.2), 1e-3)]:
        for x, y in [(0, 0), (0.25, -0.3), (0.4, 0.35)]:
            for normal in ([0, 0, -1], [0.6, 0.2, -1], [-0.5, 0.5, -0.6]):
                cases.append((angle, laser, tangent, (5 * x, 5 * y, 5.0), normal, 2e-3))
    cases.append((10.0, (0, 0, 0), 0.01, (4 * math.tan(math.radians(10.0)), 0, 4.0), [0.2, 0, -1], 0.05))  # rim
    for normal in ([0, 0, -1], [0.8, 0.1, -1]):  # a spot of a fifth of the pixel's side
        cases.append((0.1, (0, 0, 0), 0.0175, (0, 0, 3.0), normal, 0.01))
    for angle, laser, tangent, centre, normal, tolerance in cases:
        normal = np.array(normal) / np.linalg.norm(normal)
        one = lidar(half_angle=math.radians(angle), laser=laser, pixel_tangent=tangent, extinction=0.2)
        expected = by_area(one, centre, normal, math.radians(angle), laser)
        signal, arrival = signals(one, [centre], [normal], device=device)
        assert expected > 0
        assert signal[0] == pytest.approx(expected, rel=tolerance), (angle, laser, centre, normal)
        path = np.linalg.norm(np.subtract(centre, laser)) + np.linalg.norm(centre)
        assert arrival[0] == pytest.approx(path / C0, rel=1e-14)


def test_faces_turned_away_and_points_outside_the_cone_return_nothing():
    one = lidar(half_angle=math.radians(5.0))
    signal, _ = signals(one, [[0, 0, 5], [2, 0, 5]], [[0, 0, 1], [0, 0, -1]])
    assert (signal == 0).all()


@pytest.mark.parametrize("profile", [1, 2])
def test_gaussian_and_collimated_beams_put_all_their_light_on_a_wide_plane(profile):
    """The sum over pixels of S·r²/cosψ⁴-weights is the beam's energy: irradiance integrates to 1."""
    half, distance, tangent = math.radians(2.0), 4.0, 2e-3
    one = lidar(half_angle=half, profile=profile, radius=0.15, pixel_tangent=tangent)
    u = (np.arange(200) - 99.5) * tangent
    x, y = np.meshgrid(u, u)
    points = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3) * distance
    signal, _ = signals(one, points, np.tile([0, 0, -1.0], (len(points), 1)), reflectance=1.0)
    cos = distance / np.linalg.norm(points, axis=1)
    per_energy = one.aperture_area * cos**4 / (math.pi * distance**2)  # Lambertian, fills the pixel, seen at ψ
    assert (signal / per_energy).sum() == pytest.approx(1.0, rel=3e-3)


# Backscatter


def scatter_table(one, view, distance, g, device="cpu"):
    angles = np.linspace(0, np.pi, 4097)
    phase = (1 - g * g) / (4 * math.pi * (1 + g * g - 2 * g * np.cos(angles)) ** 1.5)
    out = analytic.single_scatter_table(
        one,
        wp.array(phase, dtype=wp.float64, device=device),
        wp.array(view, dtype=wp.vec3d, device=device),
        wp.array(distance, dtype=wp.float64, device=device),
    )
    return [array.numpy() for array in out]


def test_coaxial_backscatter_is_the_single_scatter_formula():
    """C_back = (λE0/hc)·PDE·v·b·p(π)·pitch²·e^{−2cR}/(8N²tan²θ·R²); in radiometry 2π(1−cosθ) stands for πtan²θ."""
    g, half, c = 0.924, math.radians(3.0), 0.4
    for lu2024 in (0, 1):
        one = lidar(
            lu2024=lu2024, half_angle=half, extinction=c, scattering=0.3, photons=1e9, pde=0.1, start=1.2e-8, stop=4e-8
        )
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


@pytest.mark.parametrize("device", DEVICES)
def test_backscatter_of_a_laser_beside_the_lens_agrees_with_quadrature(device):
    """The overlap of beam and view: paths of 2 to 7 m, against an integral over each pixel's cone."""
    reference = ReferenceLidar(pixels=24, edges=np.array([2.0, 7.0]))
    tangent = math.tan(reference.field_of_view / 2)
    one = lidar(
        half_angle=reference.half_angle,
        laser=reference.laser_position,
        pixel_tangent=2 * tangent / 24,
        extinction=reference.extinction,
        scattering=reference.extinction * reference.albedo,
        start=2.0 / C0,
        stop=7.0 / C0,
        nearest=0.01,
    )
    u = (np.arange(24) - 11.5) / 12 * tangent
    x, y = np.meshgrid(u, u)
    view = np.stack([x, y, np.ones_like(x)], -1).reshape(-1, 3)
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    total = scatter_table(one, view, np.zeros(576), reference.anisotropy, device)[2].reshape(24, 24)
    expected = single_scatter(reference)[:, :, 0]
    assert total.sum() == pytest.approx(expected.sum(), rel=0.02)
    inner = np.zeros((24, 24), bool)
    inner[8:16] = expected[8:16] > 0.4 * expected.max()  # not cut by the rim of the beam
    assert inner.sum() >= 60
    np.testing.assert_allclose(total[inner], expected[inner], rtol=0.02)


# Information


@pytest.mark.parametrize("device", DEVICES)
def test_fisher_information_is_exact_to_1e_4(device):
    """σ from 10 ps to 2 ns, signal to background from 1e-6 to 1e6, pulses up to and across the window's edges."""
    start, stop = 5e-9, 8e-8
    ratios = 10.0 ** np.arange(-6, 7, 2)
    for sigma in (1e-11, 1.5e-10, 2e-9):
        places = [start + k * sigma for k in (-4, -1, 0, 0.3, 2, 6)] + [3.3e-8]
        places += [stop + k * sigma for k in (-5, -0.7, 0, 3)]
        background = 1e7
        one = lidar(sigma=sigma, start=start, stop=stop, dark=0.4 * background, constant=0.6 * background)
        cases = [(ratio * background * (stop - start), mu) for ratio in ratios for mu in places]
        alpha, fisher, sigma_star, _ = statistics(one, *map(np.array, zip(*cases, strict=True)), device=device)
        expected = [crlb.fisher_per_photon(s, background, mu, sigma, (start, stop)) for s, mu in cases]
        np.testing.assert_allclose(fisher, expected, rtol=1e-4)
        np.testing.assert_allclose(
            alpha, [crlb.alpha(s, background, mu, sigma, (start, stop)) for s, mu in cases], rtol=1e-12
        )
        np.testing.assert_allclose(sigma_star, 1 / np.sqrt(-1000 * np.expm1(-alpha) * fisher), rtol=1e-10)


def test_without_background_the_information_is_that_of_counting():
    """F·σ² → S/α as the background goes to 0."""
    for dark in (1e-3, 1e-6, 0.0):
        alpha, fisher, *_ = statistics(lidar(dark=dark), np.array([0.01]), np.array([5e-8]))
        assert fisher[0] * 1e-20 == pytest.approx(0.01 / alpha[0], rel=1e-4)


@pytest.mark.parametrize("rho, expected", [(200, 6.060), (20, 7.263), (2, 12.898), (0.5, 22.869)])
def test_published_bounds_in_continuous_time(rho, expected):
    """σ = 100 ps, 300 signal photons, 300/ρ background photons per σ, spread over 1e12 pulses."""
    one = lidar(dark=300e-12 / rho / 1e-10)
    _, _, sigma_star, _ = statistics(one, np.array([300e-12]), np.array([5e-8]), acquisitions=1e12)
    assert round(sigma_star[0] * 1e12, 3) == pytest.approx(expected, abs=1.001e-3)


@pytest.mark.parametrize("rho, expected", [(200, 6.062), (2, 12.906)])
def test_published_bounds_in_bins_of_a_tenth_of_sigma(rho, expected):
    """The same in bins of 0.1 σ; with 300/ρ background photons per σ there are 30/ρ in a bin."""
    edges = np.linspace(-10, 10, 201)
    signal = 300 * crlb.binned_signal(edges, 0.0, 1.0)
    device = "cpu"
    information = analytic.histogram_information(
        wp.array(signal[None], dtype=wp.float32, device=device),
        wp.full((1, 1), 30.0 / rho, dtype=wp.float32, device=device),
        wp.ones(1, dtype=wp.float64, device=device),
        wp.array(np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12, dtype=wp.float64, device=device),
        first_photon=False,
    ).numpy()[0]
    assert round(10.0 / math.sqrt(information), 3) == pytest.approx(expected, abs=1.001e-3)


def test_information_of_first_photons_is_that_of_their_law():
    """Σ (dP_k)²/P_k over the bins and the empty pulse, by differences of the exact first-photon law."""
    edges = np.linspace(-15, 15, 301)

    def law(mu):
        rate = 0.4 * crlb.binned_signal(edges, mu, 1.0) + 0.01
        before = np.concatenate([[0], np.cumsum(rate)])
        return np.append(np.exp(-before[:-1]) * -np.expm1(-rate), np.exp(-before[-1]))

    h = 1e-5
    slope = (law(0.03 + h) - law(0.03 - h)) / (2 * h) * 0.1  # per bin of 0.1 σ
    expected = (slope**2 / law(0.03)).sum()
    information = analytic.histogram_information(
        wp.array(0.4 * crlb.binned_signal(edges, 0.03, 1.0)[None], dtype=wp.float32, device="cpu"),
        wp.full((1, 1), 0.01, dtype=wp.float32, device="cpu"),
        wp.ones(1, dtype=wp.float64, device="cpu"),
        wp.array(np.array([1.0, -8.0, 0.0, 8.0, -1.0]) / 12, dtype=wp.float64, device="cpu"),
        first_photon=True,
    ).numpy()[0]
    assert information == pytest.approx(expected, rel=1e-4)


def test_no_signal_in_the_gate_is_no_estimate():
    """No signal, nothing hit, or a return far outside the gate: F = 0 and NaN, not infinity."""
    alpha, fisher, sigma_star, outlier = statistics(
        lidar(dark=100.0), np.array([0.0, 0.0, 0.1]), np.array([5e-8, np.nan, 2e-7])
    )
    assert (fisher == 0).all() and np.isnan(sigma_star).all() and np.isnan(outlier).all()
    np.testing.assert_allclose(alpha, 100.0 * 1e-7)


def test_count_laws():
    """Recorded photons: N(1 − e^{−α}), N(1 − e^{−αην}) and the paper's N(1 − (1 − α)^{ην})."""
    for level in (1e-7, 1e-3, 0.3):
        alpha = level
        for law, recorded in {
            "per_pulse": 500 * -math.expm1(-alpha),
            "per_frame": 500 * -math.expm1(-alpha * 40),
            "per_frame_lu2024": 500 * (1 - (1 - alpha) ** 40),
        }.items():
            _, fisher, sigma_star, _ = statistics(
                lidar(), np.array([level]), np.array([5e-8]), count_law=law, acquisitions=500, pulses_per_frame=40
            )
            assert 1 / (sigma_star[0] ** 2 * fisher[0]) == pytest.approx(recorded, rel=1e-6)


# Reachability


_HARD = [
    (20, 20, 50),
    (40, 20, 50),
    (20, 20, 200),
    (8, 1, 1000),
    (12, 1, 1000),
    (5, 0.1, 1000),
    (60, 200, 100),
    (3, 0.03, 500),
]


@pytest.mark.parametrize("signal, level, window", _HARD)
def test_outlier_probability_within_a_fifth_of_monte_carlo(signal, level, window):
    """Maximum likelihood with known signal and background, error over 4 σ; allowed: 20 % and two standard errors."""
    trials = 2000 if window > 300 else 8000
    errors = crlb.likelihood_errors(signal, level, window, trials, seed=7)
    measured = np.mean(np.abs(errors) > 4)
    one = [wp.array([float(value)], dtype=wp.float64, device="cpu") for value in (signal, level, window)]
    predicted = analytic.outlier_probabilities(*one).numpy()[0]
    assert abs(predicted - measured) < 0.2 * measured + 2 * math.sqrt(measured * (1 - measured) / trials)


def test_outliers_of_a_decaying_background_are_bounded_by_the_model():
    """Backscatter decays up to the return, dark counts follow, the fit knows both: right to twice as large."""
    step, window, delay, trials = 0.1, 200, 120.0, 800
    t = (np.arange(int(window / step)) + 0.5) * step
    level = np.where(t < delay, 5 * np.exp(-t / delay * math.log(25)), 0.02)  # counts per σ
    reach = 80
    near = np.arange(len(t))[:, None] + np.arange(-reach, reach + 1)
    shape = np.exp(-0.5 * (np.arange(-reach, reach + 1) * step) ** 2) / math.sqrt(2 * math.pi)
    rng = np.random.default_rng(4)
    for signal in (4.0, 6.0):
        weight = np.where(
            (near >= 0) & (near < len(t)), np.log1p(signal * shape / level[np.clip(near, 0, len(t) - 1)]), 0
        )
        missed = signal * (stats.norm.cdf(-t) + stats.norm.cdf(t - window))  # of the pulse, beyond the window
        outliers = 0
        for _ in range(trials):
            counts = rng.poisson(level * step).astype(float)
            hits = (delay + rng.standard_normal(rng.poisson(signal))) / step
            np.add.at(counts, hits.astype(int), 1)
            score = (weight * counts[np.clip(near, 0, len(t) - 1)]).sum(axis=1) + missed
            outliers += abs(t[np.argmax(score)] - delay) > 4
        under = (level * np.exp(-0.5 * (t - delay) ** 2)).sum() / math.sqrt(2 * math.pi) * step
        one = [wp.array([float(value)], dtype=wp.float64, device="cpu") for value in (signal, under, window)]
        predicted = analytic.outlier_probabilities(*one).numpy()[0]
        measured = outliers / trials
        error = math.sqrt(measured * (1 - measured) / trials)
        assert measured - 2 * error < predicted < 2 * (measured + 2 * error)


def test_maximum_likelihood_meets_the_bound_where_it_is_reachable():
    """300 signal photons on 150 a σ: no outliers, and an error within 5 % of σ*."""
    trials = 3000
    errors = crlb.likelihood_errors(300, 150, 60, trials, seed=3)
    one = lidar(sigma=1e-10, start=0.0, stop=60e-10, dark=150e-6 / 1e-10)
    _, _, sigma_star, outlier = statistics(one, np.array([300e-6]), np.array([30e-10]), acquisitions=1e6)
    assert outlier[0] < 1e-4 and (np.abs(errors) < 4).all()
    measured = errors.std()
    assert measured == pytest.approx(sigma_star[0] / 1e-10, rel=0.05)
    assert abs(errors.mean()) < 4 * measured / math.sqrt(trials)


def test_outlier_probability_falls_with_signal_and_rises_with_background_and_window():
    def p(signal, level, window):
        arrays = [
            wp.array(np.broadcast_to(v, (12,)).astype(float), dtype=wp.float64, device="cpu")
            for v in (signal, level, window)
        ]
        return analytic.outlier_probabilities(*arrays).numpy()

    ladder = np.geomspace(0.5, 500, 12)
    for level in (1e-6, 1e-2, 1.0, 1e4):
        values = p(ladder, level, 500)
        assert (np.diff(values) <= 1e-9).all() and (values >= 0).all() and (values <= 1).all()
    assert (np.diff(p(30, np.geomspace(0.1, 1e3, 12), 500)) >= 0).all()
    assert (np.diff(p(20, 10, np.geomspace(20, 1e5, 12))) > 0).all()
    assert (p(5, 0, 500) == 0).all()
    for faint in (0, 1e-30, 1e-6):  # a blind fit is within 4 σ of the truth by chance
        np.testing.assert_allclose(p(faint, 1, 500), 1 - 8 / 500, rtol=1e-3)


# Frames


def draw(device, *, frames, first=0, seed=5, probability=0.0, flat=0.0, pixels=50, out=None):
    view = np.zeros((pixels, 3))
    view[:, 0] = np.linspace(-0.3, 0.3, pixels)
    view[:, 2] = 1.0
    view /= np.linalg.norm(view, axis=1, keepdims=True)
    sigma = np.linspace(0.01, 0.2, pixels)
    sigma[0] = np.nan
    paths = np.linspace(4.0, 20.0, 9)
    cumulative = np.array([0, 0.5, 0.7, 0.8, 0.86, 0.9, 0.94, 0.97, 1.0])

    def flat_array(value):
        return wp.array(np.broadcast_to(value, pixels).astype(np.float32), dtype=wp.float32, device=device)

    depth, labels = analytic.sample_frames(
        wp.array(view.astype(np.float32), dtype=wp.vec3, device=device),
        flat_array(np.where(np.isnan(sigma), np.nan, 7.0)),
        flat_array(sigma),
        flat_array(probability),
        flat_array(flat),
        wp.array(paths[None].astype(np.float32), dtype=wp.float32, device=device),
        wp.array(cumulative[None].astype(np.float32), dtype=wp.float32, device=device),
        laser=(0.3, 0.0, 0.0),
        gate_paths=(4.0, 20.0),
        first_frame=first,
        frames=frames,
        seed=seed,
    )
    return depth.numpy(), labels.numpy(), view, sigma, (paths, cumulative)


@pytest.mark.parametrize("device", DEVICES)
def test_frames_are_normal_about_the_truth_with_the_bound_as_deviation(device):
    depth, labels, _, sigma, _ = draw(device, frames=4001)
    assert np.isnan(depth[:, 0]).all() and not labels.any()
    z = ((depth[:, 1:] - 7.0) / sigma[1:]).ravel()
    assert stats.kstest(z, "norm").pvalue > 1e-3
    pairs = (depth[:-1:2, 1:] - 7.0) * (depth[1::2, 1:] - 7.0) / sigma[1:] ** 2  # two frames of one random block
    assert abs(pairs.mean()) * math.sqrt(pairs.size) < 4


@pytest.mark.parametrize("device", DEVICES)
@pytest.mark.parametrize("flat", [0.0, 1.0])
def test_stray_pixels_have_the_given_share_and_the_backscatters_times(device, flat):
    depth, labels, view, _, (paths, cumulative) = draw(device, frames=2000, probability=0.3, flat=flat)
    share = labels.mean()
    assert abs(share - 0.3) < 4 * math.sqrt(0.21 / labels.size)
    points = depth[labels][:, None] / view[:, 2][np.nonzero(labels)[1], None] * view[np.nonzero(labels)[1]]
    path = np.linalg.norm(points, axis=1) + np.linalg.norm(points - [0.3, 0, 0], axis=1)
    law = (paths[[0, -1]], [0, 1]) if flat else (paths, cumulative)
    assert stats.kstest(path, lambda x: np.interp(x, *law)).pvalue > 1e-3


@pytest.mark.parametrize("device", DEVICES)
def test_a_frame_depends_on_seed_and_number_alone(device):
    whole = draw(device, frames=11, probability=0.2)
    for first, count in [(0, 1), (3, 5), (4, 7), (10, 1)]:
        part = draw(device, frames=count, first=first, probability=0.2)
        np.testing.assert_array_equal(part[0], whole[0][first : first + count])
        np.testing.assert_array_equal(part[1], whole[1][first : first + count])
    assert not np.array_equal(draw(device, frames=11, seed=6, probability=0.2)[1], whole[1])
