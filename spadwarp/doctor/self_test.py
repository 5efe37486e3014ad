"""Two small scenes whose answer is known, traced and compared."""

from __future__ import annotations

import math
import time
from collections.abc import Callable
from dataclasses import dataclass

from spadwarp.scene import Scene
from spadwarp.transport import simulate, trace

__all__ = ["SelfTest", "run_self_test"]

_LARGEST_Z = 4.5  # a correct simulator exceeds it once in 150 000 tests
_PHOTONS = 400_000

# A pencil beam at normal incidence on a plate in turbid water, seen by one pixel.
_PENCIL = {"profile": "collimated", "beam_radius": 0.0, "position": [0.0, 0.0, 0.0]}
_PLATE = {
    "medium": {"extinction": 0.5, "albedo": 0.8, "anisotropy": 0.924},
    "laser": _PENCIL,
    "camera": {"width": 1, "height": 1, "horizontal_fov_deg": 10.0, "aperture_diameter": 0.01},
    "gate": {"start_ns": 17.0, "bin_width_ps": 500.0, "bins": 8},
    "targets": [{"builtin": "plane", "size": [4.0, 4.0], "translation": [0.0, 0.0, 2.0], "reflectance": 0.5}],
    "transport": {"axis_threshold": 1.0},
}
# Index-matched slab, normal incidence, g 0.75, albedo 0.9, optical depth 2 (van de Hulst, Multiple Light Scattering,
# 1980).
_SLAB = {
    "medium": {"extinction": 1.0, "albedo": 0.9, "anisotropy": 0.75},
    "laser": _PENCIL,
    "domain": {"shape": "slab", "lower": [0.0, 0.0, 0.0], "upper": [0.0, 0.0, 2.0]},
    "camera": {"width": 1, "height": 1, "horizontal_fov_deg": 1.0, "aperture_diameter": 0.01},
    "gate": {"start_ns": 0.0, "bin_width_ps": 1e6, "bins": 1},
    "transport": {"axis_threshold": 1.0, "termination": "roulette", "weight_cutoff": 0.05},
}
_REFLECTED, _TRANSMITTED = 0.09739, 0.66096
_ROUNDING = 5e-6  # of the published values


@dataclass(frozen=True)
class SelfTest:
    """A measured value beside its known value.

    Attributes:
        name: What was measured.
        value: By the simulator.
        reference: The known value.
        standard_error: Of `value`.
        passed: Whether they differ by less than 4.5 standard errors.
    """

    name: str
    value: float
    reference: float
    standard_error: float
    passed: bool


def run_self_test(device: str, progress: Callable[[str], None]) -> tuple[list[SelfTest], dict[str, float]]:
    """The tests, and the seconds that it took to `compile` or load the kernels and to `run`."""
    plate, slab = map(Scene.from_dict, (_PLATE, _SLAB))
    progress("loading kernels; the first time they are compiled")
    began = time.perf_counter()
    simulate(plate, photons=1, seed=1, device=device)
    trace(slab, photons=1, seed=1, device=device)
    ready = time.perf_counter()
    progress("tracing")
    result = simulate(plate, photons=_PHOTONS, seed=1, device=device)
    records = trace(slab, photons=_PHOTONS, seed=1, device=device)
    seconds = {"compile": ready - began, "run": time.perf_counter() - ready}

    # The photons that arrive without a collision are binomial; each gives Γ A / (π z²) exp(−c z) to the lens.
    arrive = math.exp(-plate.medium.extinction * 2.0)
    returned = 0.5 / math.pi * plate.camera.aperture_area / 2.0**2 * arrive
    ballistic = float(result.component("ballistic").sum()) / returned
    tests = [
        _compared("ballistic light from the plate", ballistic, arrive, math.sqrt(arrive * (1 - arrive) / _PHOTONS))
    ]
    for name, face, reference in (
        ("reflected by the slab", "exit_z_low", _REFLECTED),
        ("transmitted by the slab", "exit_z_high", _TRANSMITTED),
    ):
        weight = records.weight * records.ended(face)
        error = float(weight.std()) / math.sqrt(_PHOTONS)
        tests.append(_compared(name, float(weight.mean(dtype=float)), reference, math.hypot(error, _ROUNDING)))
    difference = float(result.energy_report()["difference"])
    tests.append(SelfTest("energy that is not accounted for", difference, 0.0, 0.0, difference == 0))
    return tests, seconds


def _compared(name: str, value: float, reference: float, standard_error: float) -> SelfTest:
    return SelfTest(name, value, reference, standard_error, abs(value - reference) < _LARGEST_Z * standard_error)
