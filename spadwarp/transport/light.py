"""Expected light that stays on its device: for programs that render a scene again and again."""

from __future__ import annotations

import threading
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
import warp as wp

import spadwarp_kernels as sk
from spadwarp.device import pick_devices
from spadwarp.result import Truth
from spadwarp.result.tallies import photons_per_position
from spadwarp.scene import Scene
from spadwarp.transport.plan import RunOptions, make_plan
from spadwarp.transport.workers import LocalWorkers

__all__ = ["ExpectedLight", "LightTracer"]


class ExpectedLight(NamedTuple):
    """Expected detections per pulse, Warp float32 `[pixel, bin]`; of all light, and of the targets' alone, or None."""

    total: Any
    target: Any


class LightTracer:
    """Traces photons of one scene on one device, part after part, without copies to the host.

    Args:
        scene: What to trace.
        photons: Of a part at most.
        seed: 64 bits.
        device: As in `simulate`; the first of several.
        derivatives: Names, as in `simulate`.
        separate_targets: Whether the light of the targets alone is wanted, too.
        mesh_cache: As in `simulate`.
        tally: That of another tracer of as many pixels and bins, to save memory: a call empties it.

    Raises what `simulate` raises.
    """

    def __init__(
        self,
        scene: Scene,
        *,
        photons: int,
        seed: int,
        device: str | None = None,
        derivatives: Sequence[str] = (),
        separate_targets: bool = False,
        mesh_cache: dict[str, Any] | None = None,
        tally: Any = None,
    ) -> None:
        plan = make_plan(scene, RunOptions(), photons=photons, seed=seed, derivatives=derivatives or None)
        workers = LocalWorkers(plan, pick_devices(device)[:1], tallies=tally, mesh_cache=mesh_cache)
        self._scene, self._separate_targets, self._unit = scene, separate_targets, 1.0 / plan.scale
        self._names, self._worker = plan.derivatives, workers.tracers[0]
        self.truth: Truth = workers.truth

    @property
    def tally(self) -> Any:
        """Warp int64, of the photons traced last."""
        return self._worker.data.tally

    def __call__(self, first: int, photons: int) -> tuple[ExpectedLight, dict[str, ExpectedLight]]:
        """Light of the photons `first` … `first + photons`, and its derivatives by name with the same photons."""
        worker = self._worker
        worker.clear()
        worker.trace((first, first + photons), stopped=threading.Event())
        scene, data = self._scene, worker.data
        per_photon = scene.laser.photons_per_pulse * scene.detections_per_photon
        value = per_photon / photons_per_position(scene, ((first, first + photons),)).reshape(-1)
        slopes = {}
        for p, (name, unit) in enumerate(zip(self._names, worker.signed_units, strict=True)):
            slopes[name] = self._light(data.gradients, value * unit, len(self._names), p)
        return self._light(data.tally, value * self._unit, 1, 0), slopes

    def _light(self, tally: Any, value: Any, parameters: int, parameter: int) -> ExpectedLight:
        scale: Any = wp.array(np.asarray(value, np.float64), dtype=wp.float64, device=tally.device)
        which: Any = {"bins": self._scene.gate.bins, "parameters": parameters, "parameter": parameter}
        target = sk.tally_rates(tally, scale, components=(0, 2), **which) if self._separate_targets else None
        return ExpectedLight(sk.tally_rates(tally, scale, **which), target)
