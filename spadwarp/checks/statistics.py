"""Memory, and whether enough photons come back."""

from __future__ import annotations

import math
from collections.abc import Iterator

from spadwarp.checks.message import CheckMessage, note, warning
from spadwarp.checks.survey import Survey

_MEMORY_LIMIT = 2 * 2**30  # [bytes] of one set of tallies, from which on it is mentioned


def check_statistics(survey: Survey) -> Iterator[CheckMessage]:
    """The size of the tallies, the expected signal, and the photons that a pixel gets."""
    scene, size = survey.scene, survey.histogram_bytes
    if size > _MEMORY_LIMIT:
        text = f"the tallies take {size / 2**30:.3g} GiB, and a run on the CPU needs twice that"
        yield warning("gate.bins", text, bytes=size)
    samples, signal = survey.samples_per_pixel, survey.signal_per_pulse
    if survey.distance is None or survey.optical_depth is None or samples is None or signal is None:
        return
    text = (
        f"optical depth to the nearest illuminated point {survey.optical_depth:.3g} one way ({survey.distance:.4g} m); "
        f"a pixel on the beam's axis detects {signal:.3g} unscattered photons a pulse"
    )
    yield note("medium.extinction", text, optical_depth=survey.optical_depth, signal_per_pulse=signal)
    if signal > 0.05:
        text = f"{signal:.3g} target detections per pulse and pixel: first-photon counting piles up"
        yield note("laser.pulse_energy", text, signal_per_pulse=signal)
    traced = scene.transport.photons
    if scene.transport.estimator == "analog":
        emitted = scene.laser.photons_per_pulse * scene.detections_per_photon or math.inf
        photons = signal * traced / scene.scan_positions / emitted
        if photons < 10.0:
            text = f"analog: only about {photons:.2g} of {traced:.3g} photons reach a pixel unscattered"
            yield warning("transport.estimator", text, photons_per_pixel=photons)
    elif samples < 10.0:
        text = f"only about {samples:.2g} of {traced:.3g} photons reach what a pixel sees unscattered"
        yield warning("transport.photons", text, samples_per_pixel=samples)
