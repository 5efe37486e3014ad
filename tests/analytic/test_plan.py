"""`spadwarp.plan`: the gate holds the target, the numbers are those of a simulated detector, limits are named."""

import dataclasses
import math

import numpy as np
import pytest

import spadwarp
from helpers.pages import ROOT
from helpers.planned import SCENE
from spadwarp.analytic import PILE_UP, axis_fluence, eye_limit, permissible_exposure, planning, safe_distance_in_water
from spadwarp.cli.planning import _verdict
from spadwarp.scene import Laser, Scene
from spadwarp.values import range_from_time

pytestmark = pytest.mark.usefixtures("shared_runs")


def make(**sections):
    return Scene.from_dict({**SCENE, **{name: {**SCENE.get(name, {}), **fields} for name, fields in sections.items()}})


def proposal(scene=None, **options):
    options = {"photons": 400_000, "device": "cpu", "largest_range": False} | options
    return spadwarp.plan(scene or make(), **options)


@pytest.fixture(scope="module")
def found(shared_runs):
    return proposal()


def test_the_gate_holds_the_target_and_its_margin(found):
    truth = spadwarp.truth_maps(found.scene, device="cpu").range
    assert found.target_range == (float(truth.min()), float(truth.max()))
    low, high = found.gate_range
    assert low < truth.min() - 0.25 and truth.max() + 0.25 < high < truth.max() + 0.5
    warnings = [str(message) for message in spadwarp.check(found.scene) if message.level == "warning"]
    assert not any("gate" in text for text in warnings), warnings
    assert found.scene.detector.pulses_per_frame == found.scene.pulses_per_depth_frame == found.pulses
    # A number of its own in the analytic model would hold against a change of the detector's.
    assert found.scene.analytic.pulses_per_depth_frame is None


def test_terms_add_up_and_go_into_json(found):
    terms = found.terms
    bound = math.hypot(terms["shot noise"], terms["background"])
    assert terms["Cramér–Rao bound"] == pytest.approx(bound)
    squares = bound, terms["estimator"], terms["forward scattering"], terms["pile-up"]
    assert terms["total"] == pytest.approx(math.hypot(*squares))
    assert found.frame_time == found.pulses / 1e5
    fields = found.to_dict()
    assert fields["values"]["gate.bins"] == found.scene.gate.bins and "scene" not in fields
    assert set(fields["pilot"]) == {field.name for field in dataclasses.fields(found.pilot)}


@pytest.mark.slow
@pytest.mark.physics
def test_a_short_run_has_the_bound_of_a_long_one(found):
    """And says how much of what it saw was noise."""
    short = proposal(photons=20_000).pilot
    assert found.pilot.information_noise < 0.02 < short.information_noise < 0.9
    assert short.bound == pytest.approx(found.pilot.bound, rel=0.15)


@pytest.mark.slow
@pytest.mark.physics
@pytest.mark.parametrize(("method", "error"), [("likelihood", 0.05), ("peak", 0.03)])
def test_few_photons_leave_the_pulses_of_many_within_their_range(method, error):
    """At a pulse energy that pile-up limits, so that noise of the brightest pixels is noise of the pulses."""
    bright, photons = make(laser={"pulse_energy": 1e-6}), (1_600_000, 10_000, 40_000, 160_000)
    many, *few = (proposal(bright, method=method, depth_error=error, photons=n, seed=n) for n in photons)
    assert many.judged and many.pulses_range[1] < 1.5 * many.pulses_range[0]
    for one in few:
        assert one.pulses_range[0] <= many.pulses <= one.pulses_range[1]


@pytest.mark.physics
def test_an_estimator_reaches_the_depth_error_with_the_pulses_that_are_proposed_for_it(found):
    """Photons of their own, all pixels. The bound alone promises `peak` too much."""
    assert found.terms["estimator"] == 0.0
    planned = proposal(method="peak")
    terms, bound = planned.terms, planned.pilot.bound
    assert planned.reached and terms["estimator"] > 0.5 * terms["Cramér–Rao bound"]
    result = spadwarp.simulate(planned.scene, photons=1_000_000, seed=99, device="cpu")
    few = math.ceil((bound / math.sqrt(0.01**2 - terms["forward scattering"] ** 2)) ** 2)
    error = {}
    for pulses in (few, planned.pulses):
        frames = spadwarp.detect(result, pulses=pulses, frames=4, seed=1, device="cpu")
        time = frames.arrival_time("peak", min_significance=0.0, device="cpu")
        depth = spadwarp.scene.sight.depth_from_time(time, scene=planned.scene)
        error[pulses] = float(np.nanmedian(np.abs(depth - result.truth.depth)))
    assert 0.004 < error[planned.pulses] < 0.01 < error[few]


@pytest.mark.physics
def test_counts_and_floor_are_those_of_the_whole_simulation(found):
    """Independent photons, all pixels; many pulses leave the floor alone."""
    whole = found.scene.with_overrides(transport={"photons": 1_000_000, "seed": 99})
    result = spadwarp.simulate(whole, device="cpu")
    detections = np.median(result.detections.sum(-1))
    assert found.pilot.target + found.pilot.backscatter == pytest.approx(detections, rel=0.1)
    with pytest.warns(spadwarp.SpadwarpWarning, match="not enough photons"):
        frames = spadwarp.detect(result, pulses=2_000_000_000, seed=1, device="cpu")
    time = frames.arrival_time("likelihood", device="cpu")[0]
    depth = spadwarp.scene.sight.depth_from_time(time, scene=whole)
    floor = np.nanmedian(np.abs(depth - result.truth.depth))
    assert found.pilot.floor["likelihood"] == pytest.approx(floor, rel=0.25)
    assert floor > 3 * found.pilot.unscattered_floor["likelihood"]


def test_typical_pixels_are_off_edges_and_the_verdict_names_the_surfaces(found):
    """Of a staircase with an edge on the axis; a plate that is turned has one surface."""
    scene = spadwarp.load_scene("staircase_5m").with_overrides({"targets[0].translation": [0.0, 0.0, 6.0]})
    edges = proposal(scene, photons=100_000, depth_error=0.02)
    assert edges.judged and edges.pilot.surfaces == pytest.approx((5.6, 5.7, 5.9, 6.0), abs=0.01)
    assert "between depths of 5.6, 5.7, 5.9, 6 m" in _verdict(edges)
    window = planning.window(scene)
    depth = spadwarp.truth_maps(window, device="cpu").depth
    for row, column in np.argwhere(planning.typical_pixels(window, "cpu")):
        assert np.ptp(depth[max(row - 1, 0) : row + 2, max(column - 1, 0) : column + 2]) < 1e-3
    assert len(found.pilot.surfaces) == 1 and "Edges" not in _verdict(found)


@pytest.mark.slow
@pytest.mark.physics
def test_clear_water_leaves_no_floor_and_its_bound_is_that_of_a_gaussian():
    clear = make(medium={"extinction": 0.1, "albedo": 0.0}, detector={"dark_count_rate": 0.0})
    clear = proposal(clear.with_overrides({"targets[0].rotation_deg": [0.0, 0.0, 0.0]}))
    bin_range = range_from_time(50e-12, 1.36)  # within a bin the run does not know where the light is
    assert all(floor <= clear.pilot.unscattered_floor[name] for name, floor in clear.pilot.floor.items())
    assert clear.pilot.floor["likelihood"] < 0.5 * bin_range and clear.limit in ("jitter", "shot noise")
    assert clear.pilot.backscatter == 0 and clear.terms["background"] < 0.2 * clear.terms["shot noise"]
    # Light is spread evenly over a bin of the run, one of the detector, and one to which pixels are aligned.
    sigma = range_from_time(1e-12 * math.hypot(85 / 2.3548, 200 / 2.3548, 50 / math.sqrt(4.0)), 1.36)
    assert clear.pilot.shot_noise == pytest.approx(sigma / math.sqrt(clear.pilot.target), rel=0.03)


@pytest.mark.slow
def test_more_error_takes_fewer_pulses_and_the_floor_cannot_be_passed(found):
    first = proposal(depth_error=0.05)
    least = math.hypot(first.terms["forward scattering"], first.terms["pile-up"])
    worse, better = (proposal(depth_error=factor * least) for factor in (2.0, 1.5))
    assert worse.pulses < better.pulses and better.pulses_for == "depth error"
    assert better.terms["total"] == pytest.approx(better.depth_error, rel=0.02)
    coarse = proposal(depth_error=0.5)
    assert coarse.pulses_for == "false peaks" and coarse.terms["total"] < 0.5
    hopeless = proposal(depth_error=0.2 * found.pilot.floor["likelihood"])
    assert not hopeless.reached and hopeless.limit == "forward scattering"
    assert "do not help" in hopeless.advice
    assert hopeless.terms["total"] < 1.1 * hopeless.terms["forward scattering"]


@pytest.mark.slow
def test_coarse_bins_are_the_limit_of_coarse_bins_wherever_they_begin():
    """At three places of a plate square to the axis within a bin, which covers 110 mm."""
    scene = make(medium={"extinction": 0.05, "albedo": 0.2}, gate={"bin_width_ps": 1000.0})
    plates = ({"translation": [0.0, 0.0, z], "rotation_deg": [0.0, 0.0, 0.0]} for z in (6.0, 6.03, 6.06))
    found = [proposal(scene.with_overrides({"targets[0]": plate})) for plate in plates]
    assert all(one.limit == "bin width" and "bin_width_ps" in one.advice and not one.reached for one in found)
    floors = [one.pilot.floor["likelihood"] for one in found]
    assert max(floors) < 1.2 * min(floors)


@pytest.mark.slow
def test_a_rate_that_would_fold_is_lowered():
    fast, kept = (proposal(make(laser={"repetition_rate": 50e6}, detector={"wrap": wrap})) for wrap in (True, False))
    assert fast.scene.laser.repetition_rate <= fast.largest_rate < 50e6 == kept.scene.laser.repetition_rate
    assert fast.unambiguous_range > fast.target_range[1]


@pytest.mark.slow
def test_pulse_energy_keeps_the_limits():
    lowered = proposal(make(laser={"pulse_energy": 1e-3}))
    assert lowered.energy_limit == "pile-up" and lowered.scene.laser.pulse_energy <= lowered.pile_up_energy
    assert lowered.pilot.brightest == pytest.approx(PILE_UP, rel=0.01)
    safe = proposal(make(laser={"pulse_energy": 1e-3, "wavelength_nm": 450.0}), eye_distance=0.005)
    assert safe.energy_limit == "eye"
    assert eye_limit(safe.scene.laser, distance=0.1).hazard_distance <= 0.005


def test_the_hazard_distance_is_that_of_the_proposed_pulse_energy():
    weak = make(laser={"pulse_energy": 1e-12, "repetition_rate": 1e7})
    full = proposal(weak, full_power=True, photons=20_000)
    own, proposed = (eye_limit(scene).hazard_distance for scene in (weak, full.scene))
    assert full.scene.laser.pulse_energy > 1e-9 and full.eye.hazard_distance == proposed > own


@pytest.mark.slow
def test_largest_range_falls_with_the_extinction(monkeypatch):
    monkeypatch.setattr(planning, "_RESOLUTION", 1.2)
    options = {"largest_range": True, "depth_error": 0.1, "photons": 400_000}
    clear, turbid = (proposal(make(medium={"extinction": c}), **options) for c in (0.15, 0.3))
    assert 0 < turbid.largest_range < clear.largest_range
    assert turbid.range_limit


def test_the_brightest_pixel_has_light_where_a_run_is_so_short_that_few_have():
    scene = make(gate={"start_ns": 40.0, "bins": 600})
    runs = planning.trace(planning.window(scene), 20_000, 1, "cpu")
    row, column = np.unravel_index(runs[0].detections.sum(axis=-1).argmax(), runs[0].detections.shape[:2])
    for run in runs:
        kept = run.tallies[:, row, column].copy()
        run.tallies[...] = 0
        run.tallies[:, row, column] = kept
    typical = planning.typical_pixels(planning.window(scene), "cpu")
    detected = sum(run.detections[row, column].sum() for run in runs) / len(runs) / (typical.size // 20)
    measured = planning.measure(runs, scene, typical, "cpu").brightest
    assert measured == pytest.approx(detected, rel=1e-9) and detected > 0.0


@pytest.mark.slow
def test_ranges_stand_for_an_unknown_target():
    anywhere = proposal(ranges=(3.0, 5.0))
    assert anywhere.target_range == (3.0, 5.0) and anywhere.gate_range[0] < 2.75 and anywhere.gate_range[1] > 5.25
    assert anywhere.scene.targets[0].translation == (0.0, 0.0, 5.0)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"depth_error": "2 ns"}, "depth_error = '2 ns' is a time; a length is needed"),
        ({"ranges": ("3 m", "2 m")}, "least <= largest"),
        ({"depth_error": 0.0}, "depth_error = 0.0"),
        ({"depth_error": 10}, "depth_error = 10 m is more than the range of the target, 5.93 m; numbers are in m"),
        ({"ranges": 5.0}, "ranges = 5.0 is not of the type tuple"),
        ({"method": "guess"}, "'guess' is not one of"),
        ({"margin": -1.0}, "margin = -1.0"),
        ({"eye_exposure": 1e9}, "exposure = 1000000000.0"),
        ({"scene": make().with_overrides(targets=[])}, "no target is in view"),
    ],
)
def test_wrong_arguments_are_named(options, words):
    with pytest.raises((spadwarp.ArgumentError, spadwarp.ConfigError), match=words.replace("(", r"\(")):
        proposal(**options)


@pytest.mark.slow
def test_daylight_is_noise(found):
    """Counts of daylight in the gate, from a window of the image; the return stays as it is."""
    scene = make(daylight={"sun_elevation_deg": 40.0, "depth": 40.0}, detector={"filter_fwhm_nm": 1.0})
    lit = proposal(scene)
    window = lit.scene.gate.stop - lit.scene.gate.start
    rate = np.median(spadwarp.scene.noise_rate(scene, spadwarp.truth_maps(scene, device="cpu")))
    assert lit.pilot.noise == pytest.approx(rate * window, rel=0.1)
    assert lit.pilot.target == pytest.approx(found.pilot.target, rel=1e-6)
    assert lit.pilot.bound > found.pilot.bound


# Eye safety. The accessible emission limits of class 1 (IEC 60825-1:2014, Table 3) are the MPE times the area of 7 mm.

PENCIL = {"profile": "collimated", "wavelength_nm": 532.0}


@pytest.mark.parametrize(
    ("laser", "exposure", "energy", "power", "criterion"),
    [
        ({"repetition_rate": 1.0, "pulse_fwhm_ps": 1000.0}, 0.25, 77e-9, None, "single pulse"),  # class 1: 7.7e-8 J
        ({"repetition_rate": 1.0, "pulse_fwhm_ps": 5.0}, 0.25, 38e-9, None, "single pulse"),  # 3.8e-8 J
        ({"repetition_rate": 1e8}, 100.0, None, 0.39e-3, "average"),  # class 1: 0.39 mW
        ({"repetition_rate": 1e8}, 0.25, None, 1.0e-3, "average"),  # class 2: 1 mW
        ({"repetition_rate": 1e8, "wavelength_nm": 450.0}, 100.0, None, 3.9e-5, "average"),  # photochemical, 39 µW
        ({"repetition_rate": 1e3}, 10.0, 0.5 * 77e-9, None, "pulse train"),  # C5 = 5·10⁴^-0.25 = 0.5
        ({"repetition_rate": 1e3}, 0.25, 77e-9, None, "single pulse"),  # C5 = 1 up to 0.25 s
        ({"repetition_rate": 59.0}, 10.0, 77e-9, None, "single pulse"),  # and up to 600 pulses
        ({"repetition_rate": 1e5}, 10.0, 3.9e-9, 0.39e-3, "average"),  # 0.4·77 nJ is more
        # Longer than T_i = 5 µs: C5 = 1 for a small source, 7e-4·t^0.75 J.
        ({"repetition_rate": 70.0, "pulse_fwhm_ps": 1e7}, 10.0, 7e-4 * 1e-5**0.75, None, "single pulse"),
        ({"repetition_rate": 1e8, "wavelength_nm": 905.0}, 100.0, None, 0.39e-3 * 10**0.41, "average"),  # C4
        ({"repetition_rate": 1.0, "wavelength_nm": 905.0}, 0.25, 77e-9 * 10**0.41, None, "single pulse"),
        ({"repetition_rate": 1e8, "wavelength_nm": 480.0}, 100.0, None, 3.9e-5 * 10**0.6, "average"),  # C3
        ({"repetition_rate": 1e8, "wavelength_nm": 640.0}, 30_000.0, None, 0.39e-3, "average"),
    ],
)
def test_eye_limits_are_those_of_the_classes(laser, exposure, energy, power, criterion):
    found = eye_limit(Laser(**PENCIL | laser), exposure=exposure)
    assert found.criterion == criterion
    assert energy is None or found.pulse_energy == pytest.approx(energy, rel=0.03)
    assert power is None or found.average_power == pytest.approx(power, rel=0.03)


@pytest.mark.parametrize(
    ("duration", "nm", "energy"),
    [(1.0, 532.0, 7e-4), (1e-3, 640.0, 7e-4 * 1e-3**0.75), (50.0, 440.0, 3.9e-3), (50.0, 480.0, 3.9e-3 * 10**0.6)],
)
def test_single_exposures_are_those_of_class_1(duration, nm, energy):
    """Table 3 of IEC 60825-1:2014, energy through 7 mm [J]."""
    assert permissible_exposure(duration, nm) * np.pi * 3.5e-3**2 == pytest.approx(energy, rel=0.02)
    below, above = (permissible_exposure(10.0 * factor, nm) for factor in (1 - 1e-9, 1))
    assert nm < 500.0 or above == pytest.approx(below, rel=0.02)  # continuous


@pytest.mark.parametrize(
    ("duration", "nm", "words"), [(1.0, 1550.0, r"outside \[400, 1050\]"), (-1.0, 532.0, "duration = ")]
)
def test_mpe_has_a_range(duration, nm, words):
    with pytest.raises(spadwarp.ArgumentError, match=words):
        permissible_exposure(duration, nm)


@pytest.mark.parametrize("profile", ["uniform_cone", "gaussian"])
def test_the_hazard_distance_is_where_the_limit_is(profile):
    """Far away the aperture sees the fluence on the axis."""
    laser = Laser(profile=profile, half_angle_deg=5.0)
    distance = eye_limit(laser).hazard_distance
    assert eye_limit(laser, distance=distance).pulse_energy == pytest.approx(laser.pulse_energy, rel=1e-6)
    assert distance < eye_limit(laser.model_copy(update={"pulse_energy": 1e-6})).hazard_distance
    per_area = permissible_exposure(100.0, 532.0) / (100.0 * laser.repetition_rate)
    assert eye_limit(laser, distance=5.0).pulse_energy == pytest.approx(per_area / axis_fluence(laser, 5.0), rel=1e-4)


@pytest.mark.slow
def test_the_safe_distance_in_water_is_that_of_absorption_alone_where_nothing_scatters():
    """Of a beam narrower than the pupil, which `plan` reports as well; on the safe side, by 12 % at most."""
    laser = {"profile": "collimated", "beam_radius": 0.002, "half_angle_deg": None, "pulse_energy": 1e-7}
    scene = make(laser=laser | {"repetition_rate": 1e6}, medium={"extinction": 0.3, "albedo": 1e-6})
    allowed = eye_limit(scene).pulse_energy / scene.laser.pulse_energy
    expected = -math.log(allowed) / 0.3
    found = safe_distance_in_water(scene, photons=20_000, device="cpu")
    assert 0.99 * expected <= found <= 1.13 * expected
    assert safe_distance_in_water(scene.with_overrides({"laser.pulse_energy": 1e-15}), device="cpu") == 0.0


# Verdicts: of few photons none, of hopeless water one before a photon is traced


@pytest.mark.slow
@pytest.mark.parametrize("depth_error", [0.002, 0.3])
def test_few_photons_say_that_they_do_not_judge_or_judge_as_many_do(depth_error):
    many = proposal(depth_error=depth_error, seed=9)
    assert many.judged
    for seed in range(2):
        for photons in (1_000, 30_000):
            few = proposal(photons=photons, depth_error=depth_error, seed=seed)
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
    page = " ".join((ROOT / "docs" / "planning.md").read_text(encoding="utf-8").split())
    found, terms = proposal(photons=20_000), dict.fromkeys(("shot noise", "total"), 0.0)
    edges = dataclasses.replace(found.pilot, surfaces=(4.6, 4.7, 4.9, 5.0))
    few = dataclasses.replace(found.pilot, photons=3_200_000)
    found = dataclasses.replace(found, reached=True, pulses_for="depth error", terms=terms, limit="forward scattering")
    first = {"pulses": 310, "pulses_range": (250, 410), "frame_time": 15.7e-6, "terms": terms | {"total": 0.00998}}
    long = {"pulses": 18_000, "pulses_range": (15_000, 22_000), "frame_time": 1.8, "limit": "backscatter"}
    out = {"pulses": 900, "pulses_range": (890, 910), "frame_time": 45e-6, "limit": "bin width", "pulses_for": "floor"}
    out |= {"terms": terms | {"total": 0.161}}
    unjudged = {"pulses_for": "not judged", "pilot": few, "photons_needed": 5.1e7, "seconds_needed": 340.0}
    for changes in (first, long | {"reached": False}, out | {"reached": False}, unjudged):
        assert f"- `{_verdict(dataclasses.replace(found, **changes))}`" in page
    assert f"`{_verdict(dataclasses.replace(found, pilot=edges, **first)).partition('. ')[2]}`" in page


def test_hopeless_water_is_named_before_a_photon_is_traced(monkeypatch):
    monkeypatch.setattr(planning, "trace", None)
    with pytest.raises(spadwarp.ConfigError, match=r"at 5\.9.* m a pixel detects .* photons at most in all 1e\+05 pul"):
        proposal(make(medium={"extinction": 6.0}), photons="auto")


@pytest.mark.slow
def test_the_bound_before_tracing_is_above_what_is_traced():
    """Light of the target that is traced, of all scatterings, against the bound's 1 in all pulses: it names no water
    in which a pixel detects more."""
    found = proposal(make(medium={"extinction": 1.2}))
    hopeful = found.pilot.target * 1e5
    for time in (1.0 / hopeful, 3.0 / hopeful):
        planning._refuse_hopeless(found.scene, found.target_range[0], time)  # these pulses bring a photon or more
    with pytest.raises(spadwarp.ConfigError):
        planning._refuse_hopeless(found.scene, found.target_range[0], 1e-9 * time)
    assert math.isfinite(found.pilot.light_noise)
