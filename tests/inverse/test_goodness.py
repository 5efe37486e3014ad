"""Goodness of fits: what its deviance is in the mean, what is flagged, what has no value, what is refused."""

import numpy as np
import pytest
from scipy.stats import kstest

import spadwarp
from helpers.cli import DEVICE, run, tables
from helpers.inverse import TRUTH, UNKNOWN, plate
from spadwarp.inverse.goodness import Lost, goodness_of, significance

pytestmark = [pytest.mark.physics, pytest.mark.filterwarnings("ignore::spadwarp.values.SpadwarpWarning")]
FREE = {"detector.mode": "free_running", "detector.dead_time_ns": 40.0, "laser.repetition_rate": 1e7}
NOTHING = Lost([np.zeros((0, 64, 100))] * 2, [np.zeros((0, 64, 100))] * 2, np.zeros((0, 0)), np.zeros((64, 0, 0)))


@pytest.fixture(scope="module")
def light():
    return spadwarp.simulate(plate(), photons=3_000_000, seed=1, device="cpu")


def detected(light, seed=3):
    return spadwarp.detect(light, pulses=500_000, seed=seed, device="cpu")


@pytest.mark.parametrize(("level", "photons"), [(0.05, 1e9), (1.0, 10), pytest.param(0.2, 50, marks=pytest.mark.slow)])
def test_p_of_right_models_is_uniform(level, photons):
    """100 draws of counts and of a model by so many photons a count: Kolmogorov–Smirnov p above 0.001."""
    random, bins = np.random.default_rng(int(photons + 100 * level)), np.arange(100)
    shape = 3 * np.exp(-(((bins - 50) / 6) ** 2)) + 0.5 * np.exp(-bins / 30) + 0.01
    true = level * np.outer(random.uniform(0.5, 1.5, 64), shape)
    p = []
    for _ in range(100):
        counts = random.poisson(true).reshape(8, 8, 100)
        batches = [(random.poisson(true * photons / 8) / photons * 8).astype(np.float32) for _ in range(8)]
        mean = np.mean(batches, axis=0)
        p.append(goodness_of(counts, mean, mean, batches, 1e9 + 0 * mean, NOTHING, [mean, 0 * mean, 0 * mean]).p)
    assert kstest(p, "uniform").pvalue > 1e-3


@pytest.mark.parametrize("width", [0.94, 1.0, 1.06])
def test_a_wrong_width_of_the_return_shows_in_its_bins(width):
    """Of 2.6e4 counts of returns among 160 bins of decaying water, whose amounts fit, in pixels at several ranges."""
    random, bins = np.random.default_rng(7), np.arange(160)
    places = random.uniform(90.0, 110.0, (64, 1))

    def mean_of(sigma):
        target = 2.5 * np.exp(-0.5 * ((bins - places) / sigma) ** 2) / sigma
        return np.stack([64 * target, np.tile(2.0 * np.exp(-bins / 30) + 0.05, (64, 1))])

    parts, found = mean_of(1.5).astype(np.float32), []
    for _ in range(20):
        counts = random.poisson(mean_of(1.5 * width).sum(axis=0)).reshape(8, 8, 160)
        mean = parts.sum(axis=0)
        nothing = Lost([np.zeros((0, 64, 160))] * 2, [np.zeros((0, 64, 160))] * 2, *NOTHING[2:])
        found.append(goodness_of(counts, mean, mean, [mean] * 8, 1e9 + 0 * mean, nothing, [*parts, 0 * mean]))
    flagged = sum(one.is_bad for one in found)
    assert flagged <= 1 if width == 1.0 else flagged >= 19


def test_the_width_of_first_photons_is_that_of_the_response():
    """Where a pulse in twenty is counted, later bins have fewer pulses: the score's square is 1 ± 0.26 in the mean."""
    random, shape = np.random.default_rng(5), (32, 32, 60)
    share = -np.expm1(-0.004 * np.exp(-0.5 * ((np.arange(60) - 30) / 5.0) ** 2))
    nothing = Lost([np.zeros((0, 1024, 60))] * 2, [np.zeros((0, 1024, 60))] * 2, NOTHING.matrix, np.zeros((1024, 0, 0)))
    squares = []
    for _ in range(30):
        trials, counts = np.full((1024, 60), 1200), np.zeros((1024, 60), int)
        for k in range(60):
            counts[:, k] = random.binomial(trials[:, k], share[k])
            trials[:, k + 1 :] -= counts[:, k, None]
        mean = (trials * share).astype(np.float32)
        given = counts.reshape(shape), mean, mean * (1.0 - share), [mean] * 8, trials.astype(np.float32)
        squares.append(goodness_of(*given, nothing, [mean, 0 * mean, 0 * mean]).parts["width"].deviance)
    assert 0.3 < np.mean(squares) < 2.0


def test_light_that_is_not_there_is_rarely_significant():
    """Of 40 000 pixels of noise alone 4 are expected above the limit of a fit; of pixels with 20 photons in it, all."""
    random, light = np.random.default_rng(2), np.zeros((40_000, 30), np.float32)
    light[:, 10:16] = [1, 3, 6, 6, 3, 1]
    mean = light + np.float32(0.5)
    noise = random.poisson(0.5, light.shape)
    assert np.count_nonzero(significance(noise, mean, light) > 3.719) <= 10
    assert (significance(noise + random.poisson(light), mean, light) > 3.719).mean() > 0.99


@pytest.mark.slow
def test_wrong_models_are_flagged_and_right_ones_are_not(light):
    frames, options = detected(light), {"unknown": UNKNOWN, "initial_guess": TRUTH, "photons": 300_000, "device": "cpu"}
    right = spadwarp.fit(frames, plate(), **options)
    assert right.goodness.p > 1e-3 and not any("bad fit" in text for text in right.warnings)
    assert right.goodness.pixels.shape == (8, 8) and set(right.goodness.components) <= {"target", "water", "noise"}
    wrong = spadwarp.fit(frames, plate({"targets[0].translation": [0.0, 0.0, 1.6]}), **options)
    assert wrong.goodness.is_bad and wrong.warnings[0].startswith("bad fit: deviance of ")


@pytest.mark.slow
def test_where_nothing_was_seen_there_is_no_value(light):
    frames = detected(light)
    counts = frames.counts[0].copy()
    counts[0, :4] = 0
    counts[1, :4, 60:] = 0  # backscatter alone
    options = {"pulses": 500_000, "photons": 100_000, "device": "cpu"}
    found = spadwarp.fit(counts, plate(), unknown="depth:pixel", **options).maps["depth"]
    for map_of in (found.value, found.standard_error):
        assert np.isnan(map_of[:2, :4]).all() and np.isfinite(map_of[2:]).mean() > 0.95
    found = spadwarp.fit(np.where(np.arange(160) < 60, counts, 0), plate(), unknown="depth", **options)
    assert np.isnan(found.estimates["depth"].value) and np.isnan(found.depth).all() and found.goodness.is_bad
    with pytest.raises(spadwarp.ArgumentError, match="not one in any bin"):
        spadwarp.fit(0 * counts, plate(), unknown="depth", **options)


@pytest.mark.parametrize(
    ("overrides", "count", "words"),
    [
        ({}, 41, "41 counts of one pixel in 40 pulses; first-photon counting has at most 40"),
        ({}, 1e30, "1e\\+30 counts in all"),
        (FREE, 41, "41 counts of one pixel in 40 pulses; a dead time of 40 ns has at most 40"),
        ({"laser.repetition_rate": 8e7}, 1, "160 bins; the detector starts anew with each pulse, after 113 bins"),
        ({"gate.bins": 150}, 1, "160 bins; the detector has 150 in the scene's gate"),
    ],
)
def test_counts_that_cannot_be_are_refused(overrides, count, words):
    counts = np.zeros((8, 8, 160))
    counts[3, 3, 80] = count
    with pytest.raises(spadwarp.ArgumentError, match=words):
        spadwarp.fit(counts, plate(overrides), unknown="depth", pulses=40, device="cpu")


@pytest.mark.slow
def test_priors_are_of_the_depth_itself_and_of_a_width(light):
    frames = detected(light)
    for width in (1e-300, 1e300, 0.0):
        with pytest.raises(spadwarp.ArgumentError, match="standard deviation = "):
            spadwarp.fit(frames, plate(), unknown="depth", prior={"depth": (1.5, width)}, device="cpu")
    prior = {"depth": (1.503, 1e-5)}
    found = spadwarp.fit(frames, plate(), unknown="depth", prior=prior, photons=100_000, device="cpu")
    assert abs(found.estimates["depth"].value - 1.503) < 1e-4


@pytest.mark.slow
def test_command_says_how_good_the_fit_is(light, tmp_path):
    scene = tmp_path / "scene.toml"
    scene.write_text(plate({"targets[0].translation": [0.0, 0.0, 1.6]}).to_toml())
    light.save(tmp_path / "result.h5")
    run("detect", tmp_path / "result.h5", "--pulses", 500_000, "--out", tmp_path / "frames", "--quiet", *DEVICE)
    options = ("--unknown", "reflectance", "--photons", "1e5", "--json", tmp_path / "fit.json", *DEVICE)
    printed = run("fit", tmp_path / "frames", scene, *options, "--out", tmp_path / "fit")
    assert "bad fit: deviance of" in printed.stderr and "goodness of fit" in printed.stdout
    found = tables(tmp_path / "fit.json")["goodness"]
    assert (
        found["is_bad"]
        and found["p"] < 1e-3
        and set(found["parts"]) >= {"pixels and bins", "image", "time of the target"}
    )
    assert (tmp_path / "fit" / "fit.png").stat().st_size > 10_000
