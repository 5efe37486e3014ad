"""The pulse period, the gate and the index for the time of flight."""

from __future__ import annotations

from collections.abc import Iterator

from spadwarp.checks.message import CheckMessage, note, warning
from spadwarp.checks.survey import Survey
from spadwarp.scene.tables import WATER_INDICES
from spadwarp.water import group_index

_FRESH, _SEA = WATER_INDICES["fresh"][1], WATER_INDICES["seawater"][1]


def check_timing(survey: Survey) -> Iterator[CheckMessage]:
    """Range aliasing, the length of the gate, the width of its bins, and the group index."""
    scene = survey.scene
    laser, gate, wraps = scene.laser, scene.gate, scene.detector.wrap
    unambiguous, period = survey.range_of(1.0 / laser.repetition_rate), 1e9 / laser.repetition_rate
    if survey.target_arrival_ns is not None and (last := survey.target_arrival_ns[1]) > period:
        text = (
            f"the target returns after up to {last:.5g} ns, later than the next pulse ({period:.5g} ns): the "
            f"unambiguous range is {unambiguous:.4g} m, "
            + ("time wraps" if wraps else "ignored, since detector.wrap is false")
        )
        found = warning if wraps else note
        yield found("laser.repetition_rate", text, unambiguous_range=unambiguous, last_ns=last, period_ns=period)
    if (length := (gate.stop - gate.start) * 1e9) > period * (1 + 1e-9):
        text = f"the gate of {length:.5g} ns is longer than the pulse period, {period:.5g} ns: time wraps within it"
        yield note("gate.bins", text, gate_ns=length, period_ns=period)
    if gate.bin_width_ps > survey.irf_fwhm_ps:
        text = (
            f"bin_width_ps = {gate.bin_width_ps:.4g} is coarser than the instrument response, "
            f"{survey.irf_fwhm_ps:.4g} ps: depth is resolved to {survey.bin_range:.3g} m"
        )
        yield note("gate.bin_width_ps", text, irf_fwhm_ps=survey.irf_fwhm_ps)
    yield from _check_group_index(survey)


def _check_group_index(survey: Survey) -> Iterator[CheckMessage]:
    medium, laser, index = survey.scene.medium, survey.scene.laser, survey.scene.medium.group_index
    distance = survey.target_range[0] if survey.target_range else survey.range_of(survey.scene.gate.stop)
    if index in (_FRESH, _SEA) and abs(laser.wavelength_nm - 532.0) > 10.0 and laser.is_visible:
        true = group_index(laser.wavelength_nm, salinity=35.0 * (index == _SEA))
        error = distance * (true / index - 1.0)
        text = (
            f"{index} is for 532 nm; at the laser's {laser.wavelength_nm:g} nm it is {true:.4f}: {error:.3f} m at "
            f"{distance:.3g} m; medium.temperature takes it from the laser"
        )
        yield warning("medium.group_index", text, group_index=true, error=error)
    elif "group_index" not in medium.model_fields_set and not medium.follows_wavelength:
        text = f"not given: {index}, seawater at 532 nm, is used for the time of flight"
        yield note("medium.group_index", text)
    elif 1.32 < index < 1.35:
        error = distance * (_SEA / index - 1.0)
        text = (
            f"{index} is a phase index; light pulses travel with the group index, {_SEA} in seawater and {_FRESH} in "
            f"fresh water at 532 nm: {error:.2f} m at {distance:.3g} m in seawater"
        )
        yield warning("medium.group_index", text, error=error, distance=distance)
