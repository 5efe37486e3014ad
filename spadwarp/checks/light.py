"""The light: time of flight, spectrum, daylight, polarisation, and whether enough photons come back."""

from __future__ import annotations

import math

import numpy as np

from spadwarp.analytic import PILE_UP
from spadwarp.checks.survey import Survey
from spadwarp.errors import ConfigError
from spadwarp.scene import (
    Camera,
    Laser,
    Medium,
    daylight_rate,
    downwelling_irradiance,
    scattering_matrix,
    spectral_lines,
    water_lines,
)
from spadwarp.scene.medium import WATER_INDICES
from spadwarp.water import group_index

_FRESH, _SEA = WATER_INDICES["fresh"][1], WATER_INDICES["seawater"][1]
_MEMORY_LIMIT = 2 * 2**30  # [bytes] of one set of tallies, from which on it is mentioned


def check_timing(survey: Survey) -> None:
    """Range aliasing, the length of the gate, the width of its bins, and the group index."""
    laser, gate, wraps = survey.scene.laser, survey.scene.gate, survey.scene.detector.wrap
    unambiguous, period = survey.range_of(1.0 / laser.repetition_rate), 1e9 / laser.repetition_rate
    if survey.target_arrival_ns is not None and (last := survey.target_arrival_ns[1]) > period:
        text = (
            f"the target returns after up to {last:.5g} ns, later than the next pulse ({period:.5g} ns): the "
            f"unambiguous range is {unambiguous:.4g} m, "
            + ("time wraps" if wraps else "ignored, since detector.wrap is false")
        )
        report = survey.warn if wraps else survey.note
        report("laser.repetition_rate", text, unambiguous_range=unambiguous, last_ns=last, period_ns=period)
    if (length := (gate.stop - gate.start) * 1e9) > period * (1 + 1e-9):
        text = f"the gate of {length:.5g} ns is longer than the pulse period, {period:.5g} ns: time wraps within it"
        survey.note("gate.bins", text, gate_ns=length, period_ns=period)
    if gate.bin_width_ps > survey.irf_fwhm_ps:
        text = (
            f"bin_width_ps = {gate.bin_width_ps:.4g} is coarser than the instrument response, "
            f"{survey.irf_fwhm_ps:.4g} ps: depth is resolved to {survey.bin_range:.3g} m"
        )
        survey.note("gate.bin_width_ps", text, irf_fwhm_ps=survey.irf_fwhm_ps)
    _check_group_index(survey)


def _check_group_index(survey: Survey) -> None:
    medium, laser, index = survey.scene.medium, survey.scene.laser, survey.scene.medium.group_index
    distance = survey.target_range[0] if survey.target_range else survey.range_of(survey.scene.gate.stop)
    if index in (_FRESH, _SEA) and abs(laser.wavelength_nm - 532.0) > 10.0 and laser.is_visible:
        true = group_index(laser.wavelength_nm, salinity=35.0 * (index == _SEA))
        error = distance * (true / index - 1.0)
        text = (
            f"{index} is for 532 nm; at the laser's {laser.wavelength_nm:g} nm it is {true:.4f}: {error:.3f} m at "
            f"{distance:.3g} m; medium.temperature takes it from the laser"
        )
        survey.warn("medium.group_index", text, group_index=true, error=error)
    elif "group_index" not in medium.model_fields_set and not medium.follows_wavelength:
        survey.note("medium.group_index", f"not given: {index}, seawater at 532 nm, is used for the time of flight")
    elif 1.32 < index < 1.35:
        error = distance * (_SEA / index - 1.0)
        text = (
            f"{index} is a phase index; light pulses travel with the group index, {_SEA} in seawater and {_FRESH} in "
            f"fresh water at 532 nm: {error:.2f} m at {distance:.3g} m in seawater"
        )
        survey.warn("medium.group_index", text, error=error, distance=distance)


def check_spectrum(survey: Survey) -> None:
    """The part that the filter passes; what the Monte Carlo run, which traces one wavelength, leaves out."""
    scene, laser, detector = survey.scene, survey.scene.laser, survey.scene.detector
    lines = spectral_lines(laser, detector)
    passed = math.fsum(line.share for line in lines)
    if detector.has_filter and passed < 0.2:
        field = "filter_fwhm_nm" if detector.filter_table is None else "filter_table"
        text = f"the filter passes {100.0 * passed:.3g} % of the laser's light, which is at {laser.wavelength_nm:g} nm"
        survey.warn(f"detector.{field}", text, passed=passed)
    if len(lines) == 1 or survey.on_axis is None or passed == 0.0:
        return
    field = "laser.linewidth_nm" if laser.spectrum is None else "laser.spectrum"
    try:
        waters, path = water_lines(scene), 2.0 * survey.on_axis.distance
    except ConfigError as error:
        survey.note(field, f"the analytic simulator refuses it: {error.problems[0].removeprefix('laser: ')}")
        return
    if len(waters) == 1:
        return
    weights = [line.share * math.exp(-(line.extinction - scene.medium.extinction) * path) for line in waters]
    total = math.fsum(weights)
    if abs((ratio := total / passed) - 1.0) > 0.01:
        text = (
            f"over the spectrum the water leaves {ratio:.3g} times the target's unscattered light that it leaves at "
            f"{laser.wavelength_nm:g} nm, which is the wavelength that simulate traces; the analytic simulator takes "
            "the whole spectrum"
        )
        survey.note(field, text, ratio=ratio)
    mean = math.fsum(weight / line.speed for weight, line in zip(weights, waters, strict=True)) / total
    variance = math.fsum(w * (1.0 / line.speed - mean) ** 2 for w, line in zip(weights, waters, strict=True)) / total
    spread_ps = 2.0 * math.sqrt(2.0 * math.log(2.0)) * math.sqrt(variance) * path * 1e12
    if spread_ps > 0.3 * survey.irf_fwhm_ps:
        text = (
            f"dispersion spreads the target's light over {spread_ps:.3g} ps, and the response has "
            f"{survey.irf_fwhm_ps:.3g} ps: set pulse_fwhm_ps to both, the spread is left out"
        )
        survey.note(field, text, spread_ps=spread_ps)


def check_daylight(survey: Survey) -> None:
    """How much daylight a pixel that looks into open water along the optical axis detects, and what leaves it out."""
    scene = survey.scene
    if scene.daylight is None:
        return
    rate = float(daylight_rate(scene, view=np.array([[0.0, 0.0, 1.0]]))[0])
    per_pulse = rate * min(scene.gate.stop - scene.gate.start, 1.0 / scene.laser.repetition_rate)
    text, report = (
        f"a pixel on the optical axis detects {rate:.3g} photons of daylight per second in open water",
        survey.note,
    )
    if scene.laser.is_visible:
        irradiance = downwelling_irradiance(scene, scene.laser.wavelength_nm)
        text += f"; the irradiance from above is {irradiance:.3g} W/m²/nm at {scene.laser.wavelength_nm:g} nm"
    if per_pulse > PILE_UP:
        text += f"; that is {per_pulse:.2g} a pulse, and more than {PILE_UP:g} distort the histogram (pile-up)"
        text += "" if scene.detector.has_filter else ": there is no filter (detector.filter_fwhm_nm)"
        report = survey.warn
    report("daylight", text, rate=rate, per_pulse=per_pulse)
    if scene.medium.phase_index < 1.3:
        text = f"phase_index = {scene.medium.phase_index:g} is not water's: light from above is not refracted to it"
        survey.note("medium.phase_index", text, phase_index=scene.medium.phase_index)


def check_polarisation(survey: Survey) -> None:
    """Polarised light that no channel records, and fields without their choice; reads the matrix's table."""
    scene, medium, camera, laser = survey.scene, survey.scene.medium, survey.scene.camera, survey.scene.laser
    scattering_matrix(medium)
    measured, cameras = camera.polarisation != "none", "polarisation = 'analyser' or 'stokes'"
    if scene.polarised and not measured:
        text = "light is polarised, but the result will have no channels: 'analyser' or 'stokes' records them"
        survey.note("camera.polarisation", text)
    if measured and laser.polarisation == "none":
        survey.note("laser.polarisation", "the camera measures polarisation, but the laser's light is not polarised")
    rayleigh = "rayleigh" in (medium.scattering_matrix, medium.phase_function)
    scaled = medium.scattering_matrix == "scaled_rayleigh"
    for section, model, field, used, needed in (
        ("laser", Laser, "polarisation_angle_deg", laser.polarisation == "linear", "polarisation = 'linear'"),
        ("medium", Medium, "depolarisation_ratio", rayleigh, "scattering_matrix or phase_function = 'rayleigh'"),
        ("medium", Medium, "largest_polarisation", scaled, "scattering_matrix = 'scaled_rayleigh'"),
        ("camera", Camera, "analyser_angle_deg", measured, cameras),
        ("camera", Camera, "analyser_extinction_ratio", measured, cameras),
    ):
        value = getattr(getattr(scene, section), field)
        if not used and value != model.model_fields[field].default:
            survey.note(f"{section}.{field}", f"{field} = {value:g} is not used: it goes with {section}.{needed}")


def check_statistics(survey: Survey) -> None:
    """The size of the tallies, the expected signal, and the photons that a pixel gets."""
    scene, size, axis = survey.scene, survey.histogram_bytes, survey.on_axis
    if size > _MEMORY_LIMIT:
        text = f"the tallies take {size / 2**30:.3g} GiB, and a run on the CPU needs twice that"
        survey.warn("gate.bins", text, bytes=size)
    if axis is None:
        return
    signal, samples, traced = axis.signal_per_pulse, axis.samples_per_pixel, scene.transport.photons
    text = (
        f"optical depth to the nearest illuminated point {axis.optical_depth:.3g} one way ({axis.distance:.4g} m); "
        f"a pixel on the beam's axis detects {signal:.3g} unscattered photons a pulse"
    )
    survey.note("medium.extinction", text, optical_depth=axis.optical_depth, signal_per_pulse=signal)
    if signal > 0.05:
        text = f"{signal:.3g} target detections per pulse and pixel: first-photon counting piles up"
        survey.note("laser.pulse_energy", text, signal_per_pulse=signal)
    if scene.transport.estimator == "analog":
        emitted = scene.laser.photons_per_pulse * scene.detections_per_photon or math.inf
        photons = signal * traced / scene.scan_positions / emitted
        if photons < 10.0:
            text = f"analog: only about {photons:.2g} of {traced:.3g} photons reach a pixel unscattered"
            survey.warn("transport.estimator", text, photons_per_pixel=photons)
    elif samples < 10.0:
        text = f"only about {samples:.2g} of {traced:.3g} photons reach what a pixel sees unscattered"
        survey.warn("transport.photons", text, samples_per_pixel=samples)
