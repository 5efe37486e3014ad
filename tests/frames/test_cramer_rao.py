"""Cramér–Rao bounds from the shape of histograms."""

import re

import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene
from reference import crlb
from spadwarp.frames import InstrumentResponse, crlb_from_histogram, information_from_histogram
from spadwarp.frames.response import FWHM_PER_SIGMA

BIN = 1e-11


def bound(signal, background=2.0, **options):
    return crlb_from_histogram(signal, background, **{"bin_width": BIN, "pulses": 1, **options})


def gaussian(sigma_bins, counts=300.0):
    return counts * crlb.binned_signal(np.arange(241.0), 120.0, sigma_bins)


def test_bound_of_a_histogram_is_the_continuous_bound_where_bins_are_fine():
    """300 photons of σ = 100 ps on 150 a σ: 12.898 ps, in bins of 0.1 σ 12.906 ps; pulses divide."""
    signal = np.stack([gaussian(10.0), np.zeros(240)])[None]
    sigma = bound(signal, 15.0)
    assert sigma.shape == (1, 2) and np.isnan(sigma[0, 1])
    assert round(sigma[0, 0] * 1e12, 3) == pytest.approx(12.906, abs=2e-3)
    fewer = bound(signal / 400, np.full(240, 15.0) / 400, pulses=400)
    assert fewer[0, 0] == pytest.approx(sigma[0, 0], rel=1e-6)


def test_the_response_is_applied_exactly():
    """A cube before the response gives the bound of the cube after it."""
    expected = bound(gaussian(np.sqrt(6.0**2 + 8.0**2 + 1 / 12)))
    assert bound(gaussian(6.0), irf=InstrumentResponse(sigma=8.0 * BIN)) == pytest.approx(expected, rel=2e-3)


def test_an_exponential_tail_is_applied_by_its_integrals():
    """Taps from the response's integrals against the same response by quadrature over each bin."""
    before = gaussian(3.0)
    irf = InstrumentResponse(sigma=4e-11, tail=1e-10)
    light = np.repeat(before, 100) / 100  # in hundredths of a bin
    response = irf.density(np.arange(-300, 6000) * 1e-13) * 1e-13
    after = np.convolve(light, response)[300 : 300 + 24000].reshape(240, 100).sum(axis=1)
    assert bound(before, irf=irf) == pytest.approx(bound(after), rel=2e-3)


def test_pile_up_loses_information():
    signal = gaussian(5.0, counts=2.0)
    assert bound(signal, 0.01, law="first_photon") > 1.2 * bound(signal, 0.01)
    faint = [bound(signal * 1e-5, 1e-7, law=law) for law in ("poisson", "first_photon")]
    assert faint[0] == pytest.approx(faint[1], rel=1e-4)


@pytest.mark.parametrize(
    ("changes", "match"),
    [
        ({"signal": [-1.0, 1.0]}, r"signal_cube holds -1.0, which is outside \[0, inf\)"),
        ({"background": [np.nan, 1.0]}, r"background_cube holds nan"),
        ({"background": np.zeros(3)}, r"background_cube has shape \(3,\)"),
        ({"bin_width": 0.0}, r"bin_width = 0.0 is outside"),
        ({"irf": [1.0, 1.0]}, r"irf = \[1.0, 1.0\] is not an InstrumentResponse"),
        ({"irf": InstrumentResponse(tail=1e-10)}, "irf has no width"),
    ],
)
def test_wrong_input_is_named(changes, match):
    with pytest.raises(ValueError, match=match):
        bound(**{"signal": [1.0, 2.0], **changes})
    with pytest.raises(ValueError, match="signal_halves = 5 is not of the type tuple"):  # and not the number before it
        information_from_histogram([1.0, 2.0], 2.0, bin_width=BIN, signal_halves=5)


def test_the_bound_of_a_monte_carlo_result_is_the_analytic_one_in_clear_water():
    """Little scattering, a plate square to the axis: both know the same return."""
    clear = scene(
        medium={"extinction": 0.02, "albedo": 0.01},
        laser={"half_angle_deg": 10.0, "position": [0.0, 0.0, 0.0], "pulse_energy": 1e-12},
        detector={"pdp": 0.2, "fill_factor": 0.1, "jitter_fwhm_ps": 400.0},
        camera={"width": 4, "height": 4, "horizontal_fov_deg": 4.0, "aperture_diameter": 0.02},
        gate={"start_ns": 10.0, "bin_width_ps": 50.0, "bins": 200},
        targets=[{"builtin": "plane", "size": [3, 3], "translation": [0, 0, 2.2], "reflectance": 1e-3}],
        transport={"estimator": "next_event", "max_collisions": 4},
    )
    found = spadwarp.crlb(spadwarp.simulate(clear, photons=350_000, seed=1, device="cpu"))
    expected = spadwarp.simulate_analytic(clear, frames=0).sigma_time
    assert found.shape == (4, 4)
    # 600 photons land on a pixel's part of the plate: 2 % on the bound.
    np.testing.assert_allclose(found, expected, rtol=0.1)
    assert np.median(found / expected) == pytest.approx(1, abs=0.03)


@pytest.mark.parametrize("law", ["poisson", "first_photon"])
@pytest.mark.parametrize("shared", [1, 4])
def test_noise_of_the_simulation_does_not_count_as_information(law, shared):
    """Histograms with Poisson noise: the mean of the information is that of the expected one, not above it.

    Products of halves have no noise whatever the bins share; of events that leave light in four bins, variances alone
    would say too little noise.
    """
    rng, events = np.random.default_rng(4), 30.0 if shared == 1 else 60.0

    def spread(cube):
        return sum(np.roll(cube, shift, axis=-1) for shift in range(shared)) / shared

    def information(cube, **noise):
        return bound(cube, 0.05, law=law, irf=InstrumentResponse(sigma=3.0 * BIN), **noise) ** -2

    expected = gaussian(6.0, counts=1.0)
    halves = [spread(rng.poisson(expected * events, (600, 240)) / events) for _ in range(2)]
    middle, variance = 0.5 * (halves[0] + halves[1]), np.square(0.5 * (halves[0] - halves[1]))
    truth = information(spread(expected))
    by_halves = information(middle, signal_halves=halves)
    by_variance = information(middle, signal_variance=middle / (2 * events) if shared == 1 else variance)
    error = 4 * by_halves.std() / np.sqrt(len(middle)) + 0.02 * truth  # the denominators' noise is of second order
    assert by_halves.mean() == pytest.approx(truth, abs=error)
    if shared == 1:
        assert information(middle).mean() > 1.1 * truth
        assert by_variance.mean() == pytest.approx(truth, abs=error)
    else:
        assert abs(by_variance.mean() - truth) > 2 * abs(by_halves.mean() - truth)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:.*one of")
def test_a_bound_that_is_noise_is_refused_with_the_photons_that_it_needs():
    """Against a run of many photons: what is given is near its bound, what would not be is refused."""
    murky = scene(
        laser={"pulse_energy": 1e-12},
        detector={"jitter_fwhm_ps": 200.0},
        camera={"width": 4, "height": 4, "horizontal_fov_deg": 4.0},
        transport={"estimator": "next_event"},
    )

    def run(photons, seed):
        return spadwarp.simulate(murky, photons=photons, seed=seed, device="cpu")

    truth = np.median(spadwarp.crlb(run(1_000_000, 0), device="cpu"))
    given, refused = [], 0
    for seed in range(1, 6):
        for photons in (2_000, 10_000, 50_000):
            try:
                given.append(np.nanmedian(spadwarp.crlb(run(photons, seed), device="cpu")) / truth)
            except spadwarp.values.ArgumentError as error:
                found = re.search(
                    r"result: \d+ % of the information .* about (\S+) photons instead of (\S+) would", str(error)
                )
                assert photons == float(found[2]) and photons < float(found[1]) < 1_000_000
                refused += 1
    assert refused >= 3 and len(given) >= 8
    assert 0.9 < np.median(given) < 1.25 and max(given) < 1.6 and min(given) > 0.6


def test_light_of_a_known_truth_has_its_bound_up_to_half_noise():
    """Photons of uneven weights at random times of an exponential return: the median bound, and where it goes wrong."""
    rng = np.random.default_rng(0)
    shape = np.exp(-np.arange(64) / 10.0) / 10.0 * (np.arange(64) < 60)
    expected = np.concatenate([np.zeros(40), 0.3 * shape])
    options = {"background": 1e-3, "irf": InstrumentResponse(sigma=3.0 * BIN / FWHM_PER_SIGMA), "law": "first_photon"}
    truth = bound(expected, **options)
    ratio = {}
    for photons in (10, 100, 1000):
        number = rng.poisson(photons * expected / expected.sum(), (300, expected.size))
        light, variance = np.zeros(number.shape), np.zeros(number.shape)
        for k in range(number.max()):
            weight = (number > k) * np.exp(rng.normal(size=number.shape) - 0.5) * expected.sum() / photons
            light, variance = light + weight, variance + weight**2
        with_noise, without = bound(light, **options), bound(light, signal_variance=variance, **options)
        ratio[photons] = np.median(without) / truth
        assert np.median(with_noise) < np.median(without)
    assert ratio[1000] == pytest.approx(1.0, abs=0.05) and ratio[100] == pytest.approx(1.0, abs=0.2)
    assert ratio[10] > 1.2  # most of it is noise: `crlb` refuses such a result
