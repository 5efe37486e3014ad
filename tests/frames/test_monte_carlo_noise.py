"""Noise of the simulation in frames of counts: it is the same in every frame, and it is said."""

import warnings

import numpy as np
import pytest

import spadwarp
from helpers.scenes import scene
from spadwarp.errors import SpadwarpWarning
from spadwarp.frames import monte_carlo_noise
from spadwarp.scene import Laser

WEAK = Laser(pulse_energy=1e-15)  # far from pile-up


def test_frames_of_two_runs_differ_by_what_is_said(whole):
    """Pixel by pixel, the mean over frames is off by the standard error, in units of the shot noise of a frame."""
    result = whole[True]
    pulses = 100_000
    noise = monte_carlo_noise(result, pulses=pulses, laser=WEAK)
    part = 10  # runs of a tenth of the photons, whose spread is larger by its root
    others = [spadwarp.simulate(scene(), photons=result.photons // part, seed=k, device="cpu") for k in range(100, 124)]
    scale = pulses * WEAK.photons_per_pulse * result.scene.detector.pde
    spread = np.std([other.intensity for other in others], axis=0, ddof=1) * scale / np.sqrt(part)
    dark = pulses * result.scene.detector.noise_rate * (result.scene.gate.stop - result.scene.gate.start)
    ratio = spread / np.sqrt(result.intensity * scale + dark)
    # Each spread has a relative standard error of 1/sqrt(2 * 23), and so has the standard error from the batches.
    assert noise.ratio == pytest.approx(np.quantile(ratio, 0.95), rel=0.3)
    assert noise.photons_needed == pytest.approx(noise.photons * (noise.ratio / 0.5) ** 2)


def test_longer_exposures_show_more_of_it(whole):
    one, hundred = (monte_carlo_noise(whole[True], pulses=pulses, laser=WEAK) for pulses in (10**4, 10**6))
    # Shot noise of a pixel grows with the square root of the pulses, the standard error with their number.
    assert hundred.ratio == pytest.approx(10 * one.ratio)
    assert hundred.photons_needed == pytest.approx(100 * one.photons_needed)


def test_a_warning_with_numbers_or_a_note_that_nobody_knows(whole):
    keywords = {"laser": WEAK, "seed": 1, "device": "cpu"}
    with pytest.warns(SpadwarpWarning, match=r"Monte Carlo noise.* of the pixels, and .* photons instead of") as caught:
        frames = spadwarp.detect(whole[True], pulses=10**8, **keywords)
    assert len(caught) == 1 and frames.notes == ()
    with warnings.catch_warnings(action="error"):
        quiet = spadwarp.detect(whole[True], pulses=1000, **keywords)
        unknown = spadwarp.detect(whole[False], pulses=1000, **keywords)
    assert quiet.notes == () and "Monte Carlo noise is unknown" in unknown.notes[0]
