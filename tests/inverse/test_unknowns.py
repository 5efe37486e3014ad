"""Names of unknowns, and counts that fit a scene."""

import numpy as np
import pytest

import spadwarp
from helpers.inverse import plate
from spadwarp.frames import first_photon_probabilities
from spadwarp.inverse import read_exposure, read_unknowns
from spadwarp.inverse.equations import Equations, Law, solve
from spadwarp.inverse.rendering import subbin_shift
from spadwarp.inverse.unknowns import moved, scene_value, with_values


def test_short_names_stand_for_fields():
    found = read_unknowns(plate(), "absorption, reflectance,depth:pixel,background")
    names = ["medium.absorption", "targets[0].reflectance", "depth", "detector.ambient_rate"]
    expected = zip(names, (False, False, True, False), ("1/m", "", "m", "1/s"), strict=True)
    assert [(one.name, one.per_pixel, one.unit) for one in found] == list(expected)


@pytest.mark.parametrize(
    ("names", "words"),
    [
        ("", "is not one of"),
        ([], "no name is given"),
        ("absorbtion", "did you mean 'absorption'"),
        ("depth,depth:pixel", "named twice"),
        ("absorption:pixel", "of the whole water"),
        ("depth:row", "':pixel'"),
        ("targets[3].reflectance", "has 1 target"),
    ],
)
def test_other_names_are_refused(names, words):
    with pytest.raises(spadwarp.SpadwarpError, match=f"unknown: .*{words}"):
        read_unknowns(plate(), names)


def test_concentrations_are_unknowns_by_the_names_of_constituents():
    parts = [{"name": "algae", "scattering": 0.5, "concentration": n} for n in (0.5, 0.0)]
    law = dict.fromkeys(("absorption", "scattering", "anisotropy"))
    one = plate({"medium": {**law, "constituents": [parts[0], {**parts[1], "name": "sand"}]}})
    (found,) = read_unknowns(one, "algae")
    assert found.name == "medium.constituents[0].concentration" and found.is_positive and found.is_light
    assert scene_value(one, found) == 0.5
    assert with_values(one, {found.name: 0.7}).medium.scattering == pytest.approx(0.35)
    for name, words in (("sand", "is 0"), ("scattering", "medium has constituents")):
        with pytest.raises(spadwarp.SpadwarpError, match=f"unknown: .*{words}"):
            read_unknowns(one, name)
    with pytest.raises(spadwarp.SpadwarpError, match="has 0 constituents"):
        read_unknowns(plate(), "medium.constituents[0].concentration")


def test_what_has_no_derivative_is_refused():
    for changes, name, words in (
        ({"medium.phase_function": "fournier_forand"}, "anisotropy", "henyey_greenstein"),
        ({"targets": []}, "depth", "no targets"),
    ):
        with pytest.raises(spadwarp.ConfigError, match=words):
            read_unknowns(plate(changes), name)


def test_values_go_into_the_scene():
    scene = with_values(plate(), {"medium.absorption": 0.5, "targets[0].reflectance": 0.1, "depth": 0.25})
    assert (scene.medium.absorption, scene.medium.scattering) == (0.5, 0.7)
    assert scene.targets[0].reflectance == 0.1 and scene.targets[0].translation == (0.0, 0.0, 1.75)
    turned = plate({"camera.rotation_deg": [0.0, 90.0, 0.0]})
    np.testing.assert_allclose(moved(turned, 1.0).targets[0].translation, (1.0, 0.0, 1.5), atol=1e-12)


def test_counts_have_to_fit_the_scene(tmp_path):
    scene = plate()
    counts = np.zeros((2, 8, 8, 160), np.int32)
    counts[:, 3, 3, 5] = 4
    exposure = read_exposure(counts, scene, pulses=10)
    assert exposure.pulses == 20 and exposure.counts.sum() == 8
    assert exposure.left()[27, 5] == 20 and exposure.left()[27, 6] == 12
    np.save(tmp_path / "counts.npy", counts[0])
    stored = read_exposure(tmp_path / "counts.npy", scene, pulses=10, gate_start=6e-9)
    assert stored.counts.sum() == 4 and stored.window == (6e-9, 160)
    for wrong, words in (
        (counts[:, :4], r"an image of \(4, 8\)"),
        (counts + 0.5, "rates"),
        (counts - 1, "outside"),
        (counts[0, 0], r"\[H, W, T\]"),
    ):
        with pytest.raises(spadwarp.ArgumentError, match=words):
            read_exposure(wrong, scene)
    with pytest.raises(spadwarp.ArgumentError, match="110"):
        read_exposure(tmp_path / "counts.npy", scene, pulses=10, gate_start=0.0, bin_width=55e-12)
    with pytest.warns(spadwarp.SpadwarpWarning, match="20000 a frame are assumed"):
        read_exposure(counts, scene)
    time = {"gate_start": 0.0, "bin_width": 1e-10}
    frames = spadwarp.detect(np.zeros((8, 8, 160)), pulses=9, seed=0, laser=scene.laser, **time)
    with pytest.raises(spadwarp.ArgumentError, match="pulses = 10; its frames are of 9"):
        read_exposure(frames, scene, pulses=10)


# The parts of the equations: laws of counting, arrow-shaped systems, shifts in time


LAWS = {"first photon": Law(True, 0.0, 20), "free running": Law(False, 0.6, 18)}


@pytest.fixture
def rates():
    return np.random.default_rng(1).uniform(0.0, 0.1, (3, 20)).astype(np.float32)


@pytest.mark.parametrize("law", LAWS.values(), ids=LAWS)
def test_slopes_of_the_mean_are_its_derivatives(law, rates):
    slopes = np.random.default_rng(2).normal(size=(3, 1, 20)).astype(np.float32)
    trials, step = np.full((3, law.recorded), 1e4, np.float32), 1e-3
    more, less = (law.mean(rates + sign * step * slopes[:, 0], trials).astype(np.float64) for sign in (1, -1))
    found = law.slopes(rates, slopes, trials)[:, 0]
    np.testing.assert_allclose(found, (more - less) / (2 * step), rtol=2e-2, atol=3.0)


def test_mean_of_first_photons_is_their_law(rates):
    law = LAWS["first photon"]
    mean = law.mean(rates, law.planned(rates, 1000))
    np.testing.assert_allclose(mean, 1000 * first_photon_probabilities(rates, device="cpu"), rtol=1e-5)
    # What is left varies as a binomial.
    trials = law.planned(rates, 1000)
    share = mean / trials
    np.testing.assert_allclose(law.variance(mean, trials), trials * share * (1 - share), rtol=1e-5)


def test_an_arrow_is_solved_as_the_whole_matrix():
    random = np.random.default_rng(3)
    pixels, is_per_pixel = 5, np.array([False, True, False, True])
    factor = random.normal(size=(pixels, 4, 12))
    slope = factor @ factor.transpose(0, 2, 1)
    score = random.normal(size=(pixels, 4))
    batches = [np.zeros((1, pixels, 4))] * 2
    weights = np.zeros((pixels, 4, 1), np.float32)
    found = solve(Equations(score, slope, slope, batches, weights), is_per_pixel)
    size = 2 + 2 * pixels
    matrix, right = np.zeros((size, size)), np.zeros(size)
    for p in range(pixels):
        place = np.array([0, 2 + 2 * p, 1, 3 + 2 * p])
        matrix[np.ix_(place, place)] += slope[p]
        right[place] += score[p]
    whole, inverse = np.linalg.solve(matrix, right), np.linalg.inv(matrix)
    np.testing.assert_allclose(found.shared, whole[:2], rtol=1e-9)
    np.testing.assert_allclose(found.pixels.ravel(), whole[2:], rtol=1e-9)
    np.testing.assert_allclose(found.covariance, inverse[:2, :2], rtol=1e-9)
    own = [inverse[2 + 2 * p : 4 + 2 * p, 2 + 2 * p : 4 + 2 * p] for p in range(pixels)]
    np.testing.assert_allclose(found.pixel_bound, own, rtol=1e-9)
    np.testing.assert_allclose(found.gain, 0.5 * whole[:2] @ np.linalg.inv(inverse[:2, :2]) @ whole[:2], rtol=1e-9)


def test_a_shift_keeps_sum_and_shape():
    bins, delay = np.arange(40.0), np.array([0.0, 3.0, 0.3, -2.6])
    rows = np.exp(-0.5 * ((bins - 20) / 1.5) ** 2)[None].repeat(4, axis=0).astype(np.float32)
    later = subbin_shift(rows, delay)
    np.testing.assert_allclose(later.sum(axis=1), rows.sum(axis=1), rtol=1e-6)
    np.testing.assert_allclose(later @ bins / later.sum(axis=1), 20 + delay, atol=1e-5)
    np.testing.assert_allclose(later, np.exp(-0.5 * ((bins - 20 - delay[:, None]) / 1.5) ** 2), atol=1e-2)
