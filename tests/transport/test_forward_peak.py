"""A forward peak without a width: what the estimators see of it, and what they say that they have not seen."""

import math

import numpy as np
import pytest

import spadwarp
from helpers.estimators import cells
from helpers.scenes import scene
from spadwarp.checks import check
from spadwarp.scene import phase_function

pytestmark = pytest.mark.physics

SEEDS = 16
WATER = {"phase_function": "fournier_forand"}


def peaked(water, estimator, **transport):
    return scene(medium=water, transport={"estimator": estimator, **transport})


def scattered(water, estimator, photons, device):
    """Mean and standard error of the scattered fraction of the emitted photons, without ballistic light."""
    rows = cells(peaked(water, estimator), device, photons, SEEDS).reshape(SEEDS, 3, -1)[:, 1:].sum(axis=(1, 2))
    return rows.mean(), rows.std(ddof=1) / math.sqrt(SEEDS)


@pytest.mark.slow
def test_what_the_estimators_miss_of_fournier_forand_is_what_they_say(device):
    """Against analog, which misses nothing: by no more than the unseen share of all photons and 3 standard errors;
    guided misses less than half of what next_event does."""
    photons = {"guided": 20_000, "next_event": 50_000}
    truth, deviation = scattered(WATER, "analog", 100_000, device)
    missing = {}
    for estimator, number in photons.items():
        mean, error = scattered(WATER, estimator, number, device)
        share = peaked(WATER, estimator).unseen_peak(SEEDS * number, 2.2)[1]
        noise = 3.0 * math.hypot(error, deviation)
        missing[estimator] = 1.0 - mean / truth
        assert -noise < truth - mean < share * truth + noise, (estimator, missing, share)
    assert missing["guided"] < 0.5 * missing["next_event"]


def test_unseen_share_is_the_peak_within_the_angle_of_ten_photons():
    """Fournier-Forand by quadrature in the angle; next to nothing of a peak that is wider than that."""
    law = phase_function(peaked(WATER, "next_event").medium)
    angle, share = law.unseen_share(1e6)
    assert math.sin(0.5 * angle) ** 2 == pytest.approx(1e-5)
    theta = np.geomspace(1e-14, angle, 200_001)
    within = np.trapezoid(2.0 * np.pi * np.sin(theta) * law.density(theta) * theta, np.log(theta))
    assert share == pytest.approx(within - 4e-5 * np.pi * float(law.density(angle)), rel=1e-3)
    assert 0.05 < share < 0.2
    wide = phase_function(scene().medium)
    assert wide.unseen_share(1e6)[1] < 1e-5
    assert wide.unseen_share(1.0)[1] > 0.9


def test_the_peak_of_a_layer_counts_as_the_mediums_own():
    layered = {"layers": [{"start": 1.0, "extinction": 1.0, "albedo": 0.8, "anisotropy": 0.9999}]}
    found = peaked(layered, "next_event").unseen_peak(1e5)
    assert found == peaked({"anisotropy": 0.9999}, "next_event").unseen_peak(1e5)
    assert found[1] > 0.3 > peaked({}, "next_event").unseen_peak(1e5)[1]


def test_check_and_the_run_say_what_is_not_seen(device):
    water = {"anisotropy": 0.98}  # whose kernel others take
    one = peaked(water, "next_event", photons=20_000)
    (message,) = [found for found in check(one) if "forward peak" in found.text]
    assert message.level == "warning" and message.field == "transport.estimator"
    with pytest.warns(spadwarp.SpadwarpWarning, match="next_event: up to [0-9.]+ % of the scattered light"):
        result = spadwarp.simulate(one, device=device)
    share = result.summary()["unseen_share"]
    assert share == result.unseen_share == one.unseen_peak(result.photons, 2.2)[1]
    assert share == pytest.approx(message.values["unseen"], rel=0.02)
    peak = result.tallies.sum(axis=0).argmax(axis=2)[None, ..., None]
    parts = np.take_along_axis(result.tallies, peak, axis=3)[..., 0]
    error = np.take_along_axis(result.standard_error, peak[0], axis=2)[..., 0] / result.tally_value
    missing = parts[1:].sum(axis=0) * share / (1.0 - share)
    assert result.relative_error == pytest.approx(np.quantile((error + missing) / parts.sum(axis=0), 0.95))
    for estimator, medium in (("analog", water), ("guided", {}), ("next_event", {})):
        assert not [found for found in check(peaked(medium, estimator)) if "forward peak" in found.text]
