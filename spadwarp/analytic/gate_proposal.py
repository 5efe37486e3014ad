"""Where the gate has to be open for a target, and how often a laser may pulse without range aliasing."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from spadwarp.analytic.model import source_name
from spadwarp.errors import ConfigError
from spadwarp.frames import detector_response
from spadwarp.scene.geometry import path_from_range, pixel_directions
from spadwarp.transport import truth_maps
from spadwarp.units import time_from_path, time_from_range

if TYPE_CHECKING:
    from spadwarp.scene import Scene

__all__ = ["GateProposal", "propose_gate", "target_span"]

_MOST_BINS = 1_000_000


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
    view = pixel_directions(scene.camera).reshape(-1, 3)
    index = scene.medium.group_index
    times = [time_from_path(path_from_range(np.float64(r), view, scene.beam.position), index) for r in span]
    spread = time_from_range(margin, index)
    before, after = detector_response(scene.detector, scene.laser).support
    width = scene.gate.bin_width
    start = max(0.0, math.floor((times[0].min() + before - spread) / width) * width)
    start_ns = round(start * 1e9, 6)
    bins = math.ceil((times[1].max() + after + spread - start_ns * 1e-9) / width)
    if bins > _MOST_BINS:
        raise ConfigError(
            f"gate.bin_width_ps = {scene.gate.bin_width_ps:g}: a gate for {span[0]:.4g} to {span[1]:.4g} m takes "
            f"{bins} bins, more than {_MOST_BINS}",
            source=source_name(scene),
        )
    return GateProposal(start_ns, bins, 1.0 / (start_ns * 1e-9 + bins * width))
