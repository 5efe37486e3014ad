"""Detection significance: its distribution under background alone, and against exact tails."""

import numpy as np
import pytest
import warp as wp
from scipy import stats

import spadwarp_kernels as sk

BINS = 256
DECAY = 70.0 * np.exp(-np.arange(BINS) / 12.0) / 12.0 + 1.7 / BINS


def significance(counts, device="cpu", **options):
    found, window = (wp.empty(len(counts), dtype=kind, device=device) for kind in (float, int))
    for name in {"background", "profile"} & set(options):
        rows = np.atleast_2d(options[name]).astype(np.float32)
        options[name] = wp.array(rows, dtype=float, device=device)
    counts = wp.array(counts.astype(np.int32), device=device)
    sk.DetectionTest(counts.shape[1], device, **options)(counts, found, window)
    return found.numpy()


def first_photons(rng, pixels, background, pulses):
    left, counts = np.full(pixels, pulses), np.empty((pixels, BINS), np.int32)
    for k, mean in enumerate(background):
        counts[:, k] = rng.binomial(left, -np.expm1(-mean / pulses))
        left -= counts[:, k]
    return counts


@pytest.mark.parametrize(
    ("background", "options"),
    [
        (np.full(BINS, 0.2 / BINS), {}),
        pytest.param(np.full(BINS, 20.0 / BINS), {"width": 10.0}, marks=pytest.mark.slow),
        pytest.param(np.full(BINS, 2e4 / BINS), {}, marks=pytest.mark.slow),
        (DECAY, {}),
        pytest.param(100.0 * DECAY, {"pulses": 20_000}, marks=pytest.mark.slow),  # which leaves 2 of 3 pulses
        (20.0 * DECAY, {"profile": 3.0 * DECAY}),
        pytest.param(np.full(BINS, 0.3 / BINS), {"profile": np.ones(BINS)}, marks=pytest.mark.slow),
    ],
    ids=["few counts", "wide", "many counts", "backscatter", "pile-up", "level unknown", "few counts, level unknown"],
)
def test_false_alarms_of_background_alone_are_as_many_as_asked_for(background, options, device):
    """4 standard errors, and a tenth by which the bound on the union of windows may be above. A pixel without a count
    has no alarm where the level is that of its own counts."""
    rng, pixels = np.random.default_rng(7), 60_000
    pulses = options.get("pulses", 0)
    counts = first_photons(rng, pixels, background, pulses) if pulses else rng.poisson(background, (pixels, BINS))
    known = {} if "profile" in options else {"background": background}
    found = significance(counts, device, **{"width": 1.4, **known, **options})
    tested = np.count_nonzero(counts.any(axis=1)) if "profile" in options else pixels
    for asked in (1e-2, 1e-3, 1e-4):
        expected = asked * tested
        number = np.count_nonzero(found >= -np.log10(asked))
        assert 0.9 * expected - 4.0 * np.sqrt(expected) < number < expected + 4.0 * np.sqrt(expected)


@pytest.mark.parametrize(
    ("law", "options"),
    [
        (stats.poisson(3.0), {"background": [[0.75]]}),
        (stats.binom(40, -np.expm1(-3.0 / 40.0)), {"background": [[0.75]], "pulses": 40}),
    ],
)
def test_one_window_has_the_tail_of_its_counts(law, options):
    """Four bins are one window: p lies between P(N > n) and P(N >= n), evenly."""
    for n in (9, 20, 36):
        counts = np.random.default_rng(n).multinomial(n, [0.25] * 4, 2000)
        p = 10.0 ** -significance(counts, width=2.0, **options).astype(float)
        low, high = law.sf(n), law.sf(n - 1)
        assert (p > low * 0.995).all() and (p < high * 1.005).all()
        if n < 20:  # of more than that, few bins hold all patterns
            assert np.mean((p - low) / (high - low)) == pytest.approx(0.5, abs=0.06)


def test_a_pixel_of_a_frame_does_not_depend_on_the_others():
    counts = np.random.default_rng(3).poisson(0.02, (60, BINS))
    options = {"width": 2.0, "background": [[0.02]], "pixels": 20}
    parts = [significance(part, **options) for part in np.split(counts, 3)]
    np.testing.assert_array_equal(np.concatenate(parts), significance(counts, **options))


@pytest.mark.parametrize("method", ["peak", "centroid", "matched", "likelihood"])
def test_estimators_report_what_was_detected(method, device):
    """A return of 25 counts far behind a ramp of backscatter that has more in every bin."""
    rng = np.random.default_rng(5)
    place, spread = rng.uniform(120, 200, 2000), 1.5
    edges = np.arange(BINS + 1)
    signal = 25.0 * np.diff(stats.norm.cdf((edges - place[:, None]) / spread), axis=1)
    signal[::2] = 0.0
    background = 400.0 * np.exp(-edges[:-1] / 15.0) + 0.02
    counts = wp.array(rng.poisson(signal + background).astype(np.int32), device=device)
    shifts = np.arange(-10, 12)[None] - np.arange(int(sk.PHASES))[:, None] / int(sk.PHASES)
    options = {
        "method": method,
        "background": wp.array(background[None], dtype=float, device=device),
        "response": np.diff(stats.norm.cdf(shifts / spread), axis=1),
        "lowest_tap": -10,
        "half_width": 5,
        "width": 2.355 * spread,
    }
    found = wp.empty(2000, dtype=float, device=device)
    error = sk.arrival_bins(counts, significance=found, **options).numpy() - place
    assert np.isnan(error[::2]).sum() >= 998 and np.isnan(error[1::2]).mean() < 0.01
    assert np.nanmax(np.abs(error[1::2])) < 6
    np.testing.assert_array_equal(np.isnan(error), found.numpy() < 4.0)
    every = sk.arrival_bins(counts, min_significance=0.0, **options).numpy()
    assert np.isfinite(every).mean() > 0.99


def test_rates_have_no_significance():
    rates = wp.full((1, 8), 0.5, dtype=float, device="cpu")
    assert np.isfinite(sk.arrival_bins(rates).numpy()).all()
    with pytest.raises(sk.ArgumentError, match=r"counts is a wp\.array of float32"):
        sk.arrival_bins(rates, min_significance=4.0)


SMALL = {"width": 80, "height": 60}


@pytest.mark.parametrize(
    ("method", "world"),
    [
        pytest.param("peak", "water", marks=pytest.mark.slow),
        ("centroid", "air"),
        pytest.param("matched", "dark counts", marks=pytest.mark.slow),
        ("likelihood", "water"),
    ],
)
def test_a_camera_sees_nothing_in_an_empty_world(method, world, device):
    """One false alarm in a hundred pixels, which shows in few of them."""
    clear = {"absorption": 0.0, "scattering": 0.0, "group_index": 1.0003}
    options = {"water": {}, "air": clear, "dark counts": {"pulse_energy": 0.0, "dark_rate": 2e4}}[world]
    camera = sk.SpadCamera(sk.SpadConfig(**SMALL, method=method, min_significance=2.0, **options), 4, device=device)
    camera.update_from_images(wp.full(camera.depth.shape, wp.nan, dtype=float, device=device))
    depth, found = camera.depth.numpy(), camera.significance.numpy()
    np.testing.assert_array_equal(np.isfinite(depth), found >= 2.0)
    assert np.isfinite(depth).sum() == pytest.approx(0.01 * depth.size, abs=4 * np.sqrt(0.01 * depth.size))
