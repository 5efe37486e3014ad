"""What a result knows of its own noise: batches of unequal size, two halves, and the noise against that of a frame."""

import math
import time

import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene
from spadwarp.result import NOISE_GOAL, merge, noise_problem, photons_needed
from spadwarp.transport import simulation
from spadwarp.transport.workers import trace_block

# Tens of counts in a frame, over several bins of a response.
DIM = {"laser": {"pulse_energy": 2e-16}, "gate": {"bin_width_ps": 400.0, "bins": 60}}
DIM |= {"detector": {"pulses_per_frame": 10_000, "jitter_fwhm_ps": 1500.0, "wrap": False, "dark_count_rate": 1e4}}
CPU = {"device": "cpu"}


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:not enough photons")
@pytest.mark.parametrize("mode", ["first_photon", "free_running"])
def test_ratio_is_that_of_seeds_and_frames(mode):
    """The variance of a matched filter's output over 40 seeds, over its variance in frames of counts of one seed."""
    one = scene(**{**DIM, "detector": {**DIM["detector"], "mode": mode}})
    runs = [spadwarp.simulate(one, photons=6000, seed=seed, **CPU) for seed in range(40)]
    many = spadwarp.simulate(one, photons=400_000, seed=99, **CPU)
    pulses = one.detector.pulses_per_frame
    frames = spadwarp.detect(many, pulses=pulses, frames=400, seed=1, **CPU)
    noise = one.detector.noise_rate * one.gate.bin_width
    light = frames.expected - noise
    kept = 1.0 - np.cumsum(frames.expected, axis=-1) if mode == "first_photon" else 1.0
    drawn = (spadwarp.detect(run, pulses=pulses, seed=1, **CPU) for run in runs)
    of_runs = [(light * kept * one.expected).sum(axis=-1) for one in drawn]
    of_frames = (light * frames.counts.reshape(400, *light.shape)).sum(axis=-1)
    ratio = np.var(of_runs, axis=0, ddof=1) * pulses**2 / np.var(of_frames, axis=0, ddof=1)
    found = np.mean([run.noise_ratio for run in runs], axis=0)
    # 16 pixels of 39 and 399 degrees of freedom: 24 % each, 6 % of their mean logarithm.
    assert np.log(found / ratio).mean() == pytest.approx(0.0, abs=0.2)
    assert runs[0].target_noise_ratio == pytest.approx(np.median(runs[0].noise_ratio))


def test_ratio_falls_with_the_photons_and_names_those_that_would_do():
    few = spadwarp.simulate(scene(**DIM), photons=5000, seed=1, **CPU)
    photons, seconds = photons_needed(few)
    assert photons == pytest.approx(5000 * few.target_noise_ratio / NOISE_GOAL)
    assert seconds == pytest.approx(few.timing["trace"] * photons / 5000)
    assert f"about {photons:.1e} photons instead of 5.0e+03" in noise_problem(few)
    enough = spadwarp.simulate(scene(**DIM), photons=2 * round(photons), seed=2, **CPU)
    assert enough.target_noise_ratio < NOISE_GOAL and noise_problem(enough) == ""
    one = spadwarp.simulate(scene(**DIM), photons=1, **CPU)
    assert one.batches == 1 and "not known" in noise_problem(one) and one.summary()["noise_ratio"] is None


def test_batches_of_different_sizes_have_the_error_of_equal_ones():
    """Standard errors are within 15 % of those of one run, over the bins."""
    first, parts = 0, []
    for count in (7000, 100_000, 3001):
        run = spadwarp.RunOptions(first_photon=first)
        parts.append(spadwarp.simulate(scene(), photons=count, seed=3, **CPU, run=run))
        first += count
    both, whole = merge(parts), spadwarp.simulate(scene(), photons=first, seed=3, **CPU)
    assert both.batches == sum(part.batches for part in parts) and both.photons == whole.photons
    assert both.tallies.tobytes() == whole.tallies.tobytes()
    lit = whole.histogram > 0.01 * whole.histogram.max()
    error = [np.square(result.standard_error[lit]).sum() for result in (both, whole)]
    assert math.sqrt(error[0] / error[1]) == pytest.approx(1.0, abs=0.15)


def test_halves_are_two_runs_that_add_up():
    """Their difference is four times the variance of the whole: over the bins of 4 runs within 0.3, four times the
    standard error that 12 runs had."""
    squares = []
    for seed in range(4):
        result = spadwarp.simulate(scene(), photons=65_000, seed=seed, **CPU)
        even, odd = result.halves
        assert even.photons + odd.photons == 65_000 and np.array_equal(even.tallies + odd.tallies, result.tallies)
        one, other = (half.tallies.sum(axis=0) * half.tally_value[..., None] for half in (even, odd))
        lit = result.histogram > 0.01 * result.histogram.max()
        squares.append(np.square((one - other)[lit] / (2.0 * result.standard_error[lit])).mean())
    assert np.mean(squares) == pytest.approx(1.0, abs=0.3)


@pytest.mark.slow
def test_auto_stops_at_the_goal_or_in_time_with_the_bits_of_its_photons(monkeypatch):
    one = scene(**DIM, transport={"photons": "auto"})
    seen = []
    found = spadwarp.simulate(one, seed=1, **CPU, progress=lambda stage, done, total: seen.append((stage, done, total)))
    assert found.target_noise_ratio < NOISE_GOAL and not found.partial and noise_problem(found) == ""
    assert any(stage.startswith("noise ratio ") for stage, *_ in seen)
    assert all(done <= found.photons for _, done, _ in seen)
    again = spadwarp.simulate(one, photons=found.photons, seed=1, **CPU)
    assert again.tallies.tobytes() == found.tallies.tobytes() and found.requested == (0, found.photons)
    bright = scene(**{**DIM, "laser": {"pulse_energy": 1e-9}}, transport={"photons": "auto"})

    def ever_slower(*arguments):
        time.sleep(0.1 * len(slept))
        slept.append(trace_block(*arguments))
        return slept[-1]

    seen.clear()
    spadwarp.simulate(bright, seed=1, time=1e-3, **CPU, progress=lambda stage, *_: seen.append(stage))
    assert seen and not any("inf" in stage for stage in seen)  # of one batch no noise ratio is known

    slept = []
    monkeypatch.setattr(simulation, "trace_block", ever_slower)
    cut = spadwarp.simulate(bright, seed=1, time=1.5, **CPU)
    monkeypatch.undo()
    assert cut.target_noise_ratio > NOISE_GOAL and not cut.partial and 1.0 < cut.timing["trace"] < 4.0
    longer = spadwarp.simulate(bright, photons="auto", time=1.0, **CPU, run=spadwarp.RunOptions(resume=cut))
    assert longer.photons > cut.photons and longer.photon_ranges == ((0, longer.photons),)
    with pytest.raises(spadwarp.ConfigError, match="time = 2 goes with photons = 'auto'"):
        spadwarp.simulate(one, photons=1000, time=2, **CPU)
    with pytest.raises(spadwarp.ConfigError, match="'auto' cannot be combined with shard"):
        spadwarp.simulate(one, **CPU, run=spadwarp.RunOptions(shard=(1, 2)))
