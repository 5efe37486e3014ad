"""Verdicts of `spadwarp.plan`: of few photons none, of hopeless water one before a photon is traced."""

import dataclasses
import math

import pytest

import spadwarp
from helpers.pages import ROOT
from helpers.planned import SCENE
from spadwarp.analytic import planning
from spadwarp.cli.planning import _verdict
from spadwarp.scene import Scene

pytestmark = pytest.mark.usefixtures("shared_runs")


def plan(photons, extinction=0.4, **options):
    scene = Scene.from_dict(SCENE).with_overrides({"medium.extinction": extinction})
    return spadwarp.plan(scene, photons=photons, device="cpu", largest_range=False, **options)


@pytest.mark.slow
@pytest.mark.parametrize("depth_error", [0.002, 0.3])
def test_few_photons_say_that_they_do_not_judge_or_judge_as_many_do(depth_error):
    many = plan(400_000, depth_error=depth_error, seed=9)
    assert many.judged
    for seed in range(2):
        for photons in (1_000, 30_000):
            few = plan(photons, depth_error=depth_error, seed=seed)
            assert not few.judged or few.reached == many.reached
            if not few.judged:
                assert few.photons_needed > few.pilot.photons and "not enough photons to judge" in repr(few)


@pytest.mark.parametrize("start", [0.7, 6.0, 60.0])
@pytest.mark.parametrize("unjudged", [None, (3.0, 5.0), (5.0, 9.0), (20.0, 80.0), (3.0, math.inf), (0.0, 30.0)])
def test_a_range_that_is_not_judged_counts_neither_as_reached_nor_as_not(start, unjudged):
    """Of a depth error that is reached up to 23 m, and ranges at which photons do not tell."""
    low, high = unjudged or (0.0, 0.0)
    asked = []

    def judge(distance):
        asked.append(distance)
        return None if low < distance < high else distance <= 23.0

    near, far, gap = planning.bracket(judge, start)
    assert near <= 23.0 < far and len(asked) <= 30
    if low < 23.0 < high:
        assert gap is not None and low < gap[0] <= gap[1] < min(high, far)
        assert near in (0.0, pytest.approx(low, rel=0.04)) and far in (math.inf, pytest.approx(high, rel=0.04))
        assert (near > 0.0) == (low > 0.0) and (far < math.inf) == (high < math.inf)
    else:
        assert gap is None and near == pytest.approx(23.0, rel=0.04) == far


@pytest.mark.slow
def test_the_page_shows_verdicts_as_they_are_printed():
    page = (ROOT / "docs" / "planning.md").read_text(encoding="utf-8")
    found, terms = plan(20_000), dict.fromkeys(("shot noise", "total"), 0.0)
    reached = {"reached": True, "pulses_for": "depth error", "pulses_range": (450, 470), "terms": terms}
    said = [
        {"pulses": 460, "frame_time": 46e-6, "limit": "shot noise", "terms": terms | {"total": 0.0099}},
        {
            "pulses": 18_000,
            "pulses_range": (15_000, 22_000),
            "frame_time": 1.8,
            "limit": "backscatter",
            "reached": False,
        },
        {"pulses": 900, "pulses_for": "floor", "frame_time": 45e-6, "limit": "bin width", "reached": False}
        | {"terms": terms | {"total": 0.161}},
        {"pulses_for": "not judged", "pilot": dataclasses.replace(found.pilot, photons=3_200_000)}
        | {"photons_needed": 5.1e7, "seconds_needed": 340.0},
    ]
    for changes in said:
        assert f"- `{_verdict(dataclasses.replace(found, **(reached | changes)))}`" in page


def test_hopeless_water_is_named_before_a_photon_is_traced(monkeypatch):
    monkeypatch.setattr(planning, "trace", None)
    with pytest.raises(
        spadwarp.ConfigError, match=r"at 5\.9.* m a pixel detects .* photons at most in all 1e\+05 pulses"
    ):
        plan("auto", extinction=6.0)


@pytest.mark.slow
def test_the_bound_before_tracing_is_above_what_is_traced():
    """Light of the target that is traced, of all scatterings, against the bound's 1 in all pulses: it names no water
    in which a pixel detects more."""
    found = plan(400_000, extinction=1.2)
    hopeful = found.pilot.target * 1e5
    for time in (1.0 / hopeful, 3.0 / hopeful):
        planning._refuse_hopeless(found.scene, found.target_range[0], time)  # these pulses bring a photon or more
    with pytest.raises(spadwarp.ConfigError):
        planning._refuse_hopeless(found.scene, found.target_range[0], 1e-9 * time)
    assert math.isfinite(found.pilot.light_noise)
