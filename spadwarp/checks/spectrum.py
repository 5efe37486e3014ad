"""The laser's spectrum and the filter before the detector."""

from __future__ import annotations

import math
from collections.abc import Iterator

from spadwarp.checks.message import CheckMessage, note, warning
from spadwarp.checks.survey import Survey
from spadwarp.errors import ConfigError
from spadwarp.scene import spectral_lines, water_lines


def check_spectrum(survey: Survey) -> Iterator[CheckMessage]:
    """What the filter passes; what of the spectrum the Monte Carlo run, which traces one wavelength, leaves out."""
    scene = survey.scene
    laser, detector = scene.laser, scene.detector
    lines = spectral_lines(laser, detector)
    passed = math.fsum(line.share for line in lines)
    if detector.has_filter and passed < 0.2:
        field = "filter_fwhm_nm" if detector.filter_table is None else "filter_table"
        text = f"the filter passes {100.0 * passed:.3g} % of the laser's light, which is at {laser.wavelength_nm:g} nm"
        yield warning(f"detector.{field}", text, passed=passed)
    if len(lines) == 1 or survey.distance is None or passed == 0.0:
        return
    field = "laser.linewidth_nm" if laser.spectrum is None else "laser.spectrum"
    try:
        waters, path = water_lines(scene), 2.0 * survey.distance
    except ConfigError as error:
        yield note(field, f"the analytic simulator refuses it: {error.problems[0].removeprefix('laser: ')}")
        return
    if len(waters) == 1:
        return
    weights = [line.share * math.exp(-(line.extinction - scene.medium.extinction) * path) for line in waters]
    ratio = math.fsum(weights) / passed
    if abs(ratio - 1.0) > 0.01:
        text = (
            f"over the spectrum the water leaves {ratio:.3g} times the target's unscattered light that it leaves at "
            f"{laser.wavelength_nm:g} nm, which is the wavelength that simulate traces; the analytic simulator takes "
            "the whole spectrum"
        )
        yield note(field, text, ratio=ratio)
    total = math.fsum(weights)
    mean = math.fsum(weight / line.speed for weight, line in zip(weights, waters, strict=True)) / total
    variance = math.fsum(w * (1.0 / line.speed - mean) ** 2 for w, line in zip(weights, waters, strict=True)) / total
    spread_ps = 2.0 * math.sqrt(2.0 * math.log(2.0)) * math.sqrt(variance) * path * 1e12
    if spread_ps > 0.3 * survey.irf_fwhm_ps:
        text = (
            f"dispersion spreads the target's light over {spread_ps:.3g} ps, and the response has "
            f"{survey.irf_fwhm_ps:.3g} ps: set pulse_fwhm_ps to both, the spread is left out"
        )
        yield note(field, text, spread_ps=spread_ps)
