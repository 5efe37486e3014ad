"""Where the gate has to be open for a target, and how often a laser may pulse without range aliasing."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from spadwarp.analytic.model import source_name
from spadwarp.errors import ConfigError
from spadwarp.frames import detector_response
from spadwarp.scene.sight import lines_of_sight
from spadwarp.transport import truth_maps
from spadwarp.units import time_from_path, time_from_range

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["GateProposal", "propose_gate", "target_span"]

_MOST_BINS = 1_000_000
_LEAST = 1e-6  # Beyond a port [m]


class GateProposal(NamedTuple):
    """A gate: start [ns], as a file holds it, and bins; and the largest rate at which a pulse's gate ends before the
    next pulse [Hz]."""

    start_ns: float
    bins: int
    largest_rate: float


def target_span(scene: Scene, device: str | None = None) -> tuple[float, float]:
    """Least and largest range of the targets in view [m]. Raises `ConfigError` without any."""
    distance = truth_maps(scene, device=device).range
    if np.isnan(distance).all():
        raise ConfigError(
            "no target is in view: give one in [[targets]], or the ranges where it may be", source=source_name(scene)
        )
    return float(np.nanmin(distance)), float(np.nanmax(distance))


def propose_gate(scene: Scene, span: tuple[float, float], margin: float) -> GateProposal:
    """A gate for returns from a span of ranges [m], with `margin` [m] and the instrument response on both sides.

    The bins keep their width. Raises `ConfigError` for a gate of more than a million bins.
    """
    lines, index = lines_of_sight(scene).flat(), scene.medium.group_index
    # A pixel whose light does not get through the port has no time; one that is still in the port has that of its end.
    times = [time_from_path(lines.path_from_range(np.maximum(r, lines.lead + _LEAST)), index) for r in span]
    spread = time_from_range(margin, index)
    before, after = detector_response(scene.detector, scene.laser).support
    width = scene.gate.bin_width
    start = max(0.0, math.floor((np.nanmin(times[0]) + before - spread) / width) * width)
    start_ns = round(start * 1e9, 6)
    bins = math.ceil((np.nanmax(times[1]) + after + spread - start_ns * 1e-9) / width)
    if bins > _MOST_BINS:
        raise ConfigError(
            f"gate.bin_width_ps = {scene.gate.bin_width_ps:g}: a gate for {span[0]:.4g} to {span[1]:.4g} m takes "
            f"{bins} bins, more than {_MOST_BINS}",
            source=source_name(scene),
        )
    return GateProposal(start_ns, bins, 1.0 / (start_ns * 1e-9 + bins * width))
