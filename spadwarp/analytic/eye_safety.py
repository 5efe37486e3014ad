"""Limits of laser power for the eye: maximum permissible exposure (MPE) after IEC 60825-1:2014. A guide, no more.

Table A.1 for a small source (C6 = 1), 400 to 1050 nm, radiant exposure H at the cornea for an exposure of t, with
C4 = 10^(0.002 (λ/nm − 700)) beyond 700 nm, else 1:

    100 fs ... 10 ps: 1e-3·C4 J/m²     10 ps ... 5 µs: 2e-3·C4 J/m²     5 µs ... 10 s: 18·t^0.75·C4 J/m²
    beyond 10 s: an irradiance of 10·C4 W/m²; from 400 to 600 nm also 100·C3 J/m² up to 100 s and C3 W/m² beyond,
    C3 = 10^(0.02 (λ/nm − 450)) from 450 nm on, else 1

A train of pulses must keep three limits (A.3): (1) each pulse the limit of its duration; (2) the mean over the exposure
the limit of that duration; (3) each pulse, the pulses within T_i = 5 µs counted as one of duration T_i, C5 times its
limit, C5 = max(0.4, 5·N^−0.25) for more than 600 pulses N of T_i at most in the exposure (10 s at most, T_2 of a small
source) if that is longer than 0.25 s, else 1; C5 is 1 also for longer pulses of a small source. An extended source may
have up to α/1.5 mrad times the thermal limits (C6), which is left out: these limits are on the safe side of it.
Exposures are means over a 7 mm aperture in the middle of the beam, in clear water.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from spadwarp.scene import Laser, Scene
from spadwarp.scene.camera import to_world
from spadwarp.scene.laser import load_profile
from spadwarp.scene.pose import rotation_matrix
from spadwarp.scene.scene import laser_port
from spadwarp.transport import simulate
from spadwarp.values import ArgumentError, check_real

__all__ = ["EyeLimit", "axis_fluence", "eye_limit", "permissible_exposure", "safe_distance_in_water"]

STANDARD = "IEC 60825-1:2014, Table A.1 and A.3, small source, 7 mm aperture; a guide, not a classification"

_APERTURE = 3.5e-3  # radius [m]
_AREA = math.pi * _APERTURE**2
_GROUP = 5e-6  # T_i [s]
_FARTHEST = 1e4  # [m]
_PLANES = 64  # at which `safe_distance_in_water` looks, 12 % apart


@dataclass(frozen=True, kw_only=True)
class EyeLimit:
    """The largest laser power at which an eye in the beam is within the MPE."""

    distance: float  # of the eye from where the beam begins [m]
    exposure: float  # how long it may look into the beam [s]
    pulse_energy: float  # largest energy of a pulse at the laser's repetition rate and duration [J]
    average_power: float  # the same as average power [W]
    criterion: str  # which of the limits decides: "single pulse", "average" or "pulse train"
    hazard_distance: float  # from where on the laser as it is keeps the limits [m]; 0: everywhere; infinite: nowhere
    water_distance: float = math.nan  # the same in the scene's water, see `safe_distance_in_water`; NaN: not sought
    standard: str = STANDARD  # the standard, and how it was read


def permissible_exposure(duration: float, wavelength_nm: float) -> float:
    """MPE of a single exposure of a duration [s]: radiant exposure at the cornea [J/m²], Table A.1.

    Raises `ArgumentError` outside 400 to 1050 nm.
    """
    if not 400.0 <= wavelength_nm <= 1050.0:
        raise ArgumentError(f"wavelength_nm = {wavelength_nm} is outside [400, 1050] nm, where eye limits are known")
    duration = check_real("duration", duration, "[0, inf) s")
    c4 = 10.0 ** (0.002 * max(wavelength_nm - 700.0, 0.0))
    if duration < 1e-11:
        return 1e-3 * c4 * min(1.0, duration / 1e-13)
    if duration < _GROUP:
        return 2e-3 * c4
    thermal = 18.0 * duration**0.75 * c4 if duration < 10.0 else 10.0 * duration * c4
    if duration < 10.0 or wavelength_nm > 600.0:
        return thermal
    c3 = 10.0 ** (0.02 * max(wavelength_nm - 450.0, 0.0))
    return min(thermal, c3 * max(100.0, duration))


def eye_limit(of: Laser | Scene, *, distance: float = 0.1, exposure: float = 100.0) -> EyeLimit:
    """The largest pulse energy and average power of a laser within the MPE, and its hazard distance.

    Args:
        of: A laser: its profile, divergence, wavelength, repetition rate and pulse duration; its energy for the
            distance. Of a scene, whose laser may be behind a port: then for an eye in the water.
        distance: Of the eye from where the beam begins [m], ≥ 0; 0.1 m is that of the standard's third condition.
        exposure: [s], in [1e-6, 3e4]; 100 s is the standard's time base where nobody means to look into the beam,
            0.25 s the time within which one turns away from visible light.

    Raises `ArgumentError`: a value out of its range, or a wavelength outside 400 to 1050 nm; `FileError`: the image of
    a measured beam.
    """
    laser = of if isinstance(of, Laser) else of.laser
    exposure = check_real("exposure", exposure, "[1e-6, 3e4] s")
    distance = check_real("distance", distance, "[0, 1e9] m")
    limit, criterion = _pulse_limit(laser, exposure)
    densest = _densest(laser)
    allowed = limit * _AREA / laser.pulse_energy  # share through the aperture

    def is_within(bare: float) -> bool:
        return _share(laser, bare, densest) <= allowed

    hazard = math.inf
    if is_within(_FARTHEST):
        hazard = bare = _first(is_within, _FARTHEST)
        if as_if_bare(of, bare) != bare:  # behind a port
            hazard = _first(lambda other: as_if_bare(of, other) >= bare, 1e9)
    energy = limit * _AREA / _share(laser, as_if_bare(of, distance), densest)
    return EyeLimit(
        distance=distance,
        exposure=exposure,
        pulse_energy=energy,
        average_power=energy * laser.repetition_rate,
        criterion=criterion,
        hazard_distance=hazard,
    )


def safe_distance_in_water(
    scene: Scene, *, exposure: float = 100.0, photons: int = 200_000, seed: int = 0, device: str | None = None
) -> float:
    """Distance from the laser [m] from which on an eye in the middle of the beam keeps the limits in a scene's water.

    A Monte Carlo run without targets tallies the irradiance, of scattered light too, on discs across the beam of 7 mm,
    or a tenth of the beam's width where that is more; twice its standard error is added. 0: everywhere safe; infinite:
    beyond 10 km. Raises as `eye_limit` and `simulate` do.
    """
    found, laser, beam = eye_limit(scene, exposure=exposure), scene.laser, scene.beam
    allowed = _pulse_limit(laser, exposure)[0] * _AREA / laser.pulse_energy
    lost = scene.medium.range.absorption
    farthest = min(found.hazard_distance, -math.log(allowed) / lost if lost > 0.0 and allowed < 1.0 else math.inf)
    if not 0.0 < farthest <= _FARTHEST:
        return math.inf if farthest else 0.0
    start, axis = to_world(scene.camera, beam.position), rotation_matrix(scene.camera.rotation_deg) @ beam.axis
    distances = np.geomspace(1e-3 * farthest, farthest, _PLANES)
    spot = 0.0 if beam.profile == "collimated" else 0.05 * math.tan(min(beam.half_angle, 1.5))
    discs = [
        {"name": f"eye{k}", "positions": [float(axis @ start + z)], "axis": axis.tolist(), "centre": start.tolist()}
        | {"radius": max(_APERTURE, spot * float(z))}
        for k, z in enumerate(distances)
    ]
    light = {"laser.polarisation": "none", "camera.polarisation": "none", "medium.scattering_matrix": "none"}
    own = {"flux": discs, "targets": [], "daylight": None, "transport.estimator": "none"}
    traced = scene.with_overrides(light | own | {"transport.axis_threshold": 1.0, "transport.max_path": None})
    result = simulate(traced, photons=photons, seed=seed, device=device)
    exposed = [result.flux[disc["name"]]["irradiance"] for disc in discs]
    share = np.array([one.values[0, 0] + 2.0 * (0.0 if one.errors is None else one.errors[0, 0]) for one in exposed])
    last = max(np.flatnonzero(share * _AREA > allowed), default=-1)
    return float(distances[min(last + 1, _PLANES - 1)])


def axis_fluence(of: Laser | Scene, distance: float) -> float:
    """Energy of a pulse through a unit of area in the middle of the beam, over the pulse's energy [1/m²].

    In clear water, at a distance [m] from where the beam begins; infinite for a pencil beam. Of a scene's laser behind
    its port, if it has one.
    """
    laser, distance = of if isinstance(of, Laser) else of.laser, as_if_bare(of, distance)
    if laser.profile == "collimated":
        return 1.0 / (math.pi * laser.beam_radius**2) if laser.beam_radius > 0.0 else math.inf
    if laser.profile == "gaussian":
        return 2.0 / (math.pi * (math.tan(laser.half_angle) * distance) ** 2)
    if laser.profile == "measured":
        return _densest(laser) / distance**2
    return 1.0 / (4.0 * math.pi * (math.sin(0.5 * laser.half_angle) * distance) ** 2)


def _pulse_limit(laser: Laser, exposure: float) -> tuple[float, str]:
    """Largest radiant exposure of a pulse [J/m²], and which limit it is."""
    rate, nm = laser.repetition_rate, laser.wavelength_nm
    pulse = max(laser.pulse_fwhm_ps * 1e-12, 1e-13)
    together = max(1.0, rate * _GROUP)  # pulses that count as one
    groups = rate / together * min(exposure, 10.0)
    counted = exposure > 0.25 and groups > 600.0 and pulse <= _GROUP
    c5 = max(0.4, 5.0 * groups**-0.25) if counted else 1.0
    limits = {
        "single pulse": permissible_exposure(pulse, nm),
        "average": permissible_exposure(exposure, nm) / max(rate * exposure, 1.0),
        "pulse train": c5 * permissible_exposure(_GROUP if together > 1.0 else pulse, nm) / together,
    }
    criterion = min(limits, key=limits.__getitem__)
    return limits[criterion], criterion


def _densest(laser: Laser) -> float:
    """Of a measured beam the largest share of the light per unit of the tangents' plane, else 0."""
    if laser.profile != "measured":
        return 0.0
    image = load_profile(laser)
    return float(image.max() / image.sum()) / (2.0 * math.tan(laser.half_angle) / image.shape[1]) ** 2


def _share(laser: Laser, distance: float, densest: float) -> float:
    """Part of a pulse that passes the 7 mm aperture in the middle of the beam, at a distance [m]."""
    if laser.profile == "collimated":
        return min(1.0, (_APERTURE / laser.beam_radius) ** 2) if laser.beam_radius > 0.0 else 1.0
    if distance <= 0.0:
        return 1.0
    tangent = _APERTURE / distance
    if laser.profile == "gaussian":
        return -math.expm1(-2.0 * (tangent / math.tan(laser.half_angle)) ** 2)
    if laser.profile == "measured":
        return min(1.0, densest * math.pi * tangent**2)
    return min(1.0, (math.sin(0.5 * math.atan(tangent)) / math.sin(0.5 * laser.half_angle)) ** 2)


def _first(is_reached: Callable[[float], bool], high: float) -> float:
    """The least distance from 1e-6 m to `high` [m] from which on something is reached; 0 where it is there."""
    low = 1e-6
    if is_reached(low):
        return 0.0
    for _ in range(80):
        middle = math.sqrt(low * high)
        low, high = (low, middle) if is_reached(middle) else (middle, high)
    return high


def as_if_bare(of: Laser | Scene, distance: float) -> float:
    """The distance [m] at which the middle of the beam has the irradiance that it has at a distance behind the laser's
    port, if there were none: there it is narrower, and a little light is reflected. Above a sea as it is."""
    port, beam = (None, of) if isinstance(of, Laser) else (laser_port(of), of.beam)
    if port is None or beam.profile == "collimated":
        return distance
    lead = float(port.enter(beam.position, beam.axis)[2])
    if isinstance(of, Scene) and of.surface is not None and distance <= lead:
        return distance
    return 1.0 / math.sqrt(port.spread(beam.position, beam.axis, max(distance, lead + 1e-6)))
