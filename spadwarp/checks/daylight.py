"""Daylight in the pixels."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from spadwarp.checks.message import CheckMessage, note, warning
from spadwarp.checks.survey import Survey
from spadwarp.scene import daylight_rate, downwelling_irradiance

_PILE_UP = 0.05  # detections a pulse


def check_daylight(survey: Survey) -> Iterator[CheckMessage]:
    """How much daylight a pixel that looks into open water along the optical axis detects, and what leaves it out."""
    scene = survey.scene
    if scene.daylight is None:
        return
    rate = float(daylight_rate(scene, view=np.array([[0.0, 0.0, 1.0]]))[0])
    period = min(scene.gate.stop - scene.gate.start, 1.0 / scene.laser.repetition_rate)
    text = f"a pixel on the optical axis detects {rate:.3g} photons of daylight per second in open water"
    if scene.laser.is_visible:
        irradiance = downwelling_irradiance(scene, scene.laser.wavelength_nm)
        text += f"; the irradiance from above is {irradiance:.3g} W/m²/nm at {scene.laser.wavelength_nm:g} nm"
    if rate * period > _PILE_UP:
        text += f"; that is {rate * period:.2g} a pulse, and more than {_PILE_UP:g} distort the histogram (pile-up)"
        if not scene.detector.has_filter:
            text += ": there is no filter (detector.filter_fwhm_nm)"
        yield warning("daylight", text, rate=rate, per_pulse=rate * period)
    else:
        yield note("daylight", text, rate=rate, per_pulse=rate * period)
    if scene.medium.phase_index < 1.3:
        text = f"phase_index = {scene.medium.phase_index:g} is not water's: light from above is not refracted to it"
        yield note("medium.phase_index", text, phase_index=scene.medium.phase_index)
