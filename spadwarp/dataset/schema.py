"""What the files of a dataset hold, name by name."""

from __future__ import annotations

from typing import Any

import numpy as np

from spadwarp.dataset.render_analytic import PROFILE_BINS, RenderedScene
from spadwarp.dataset.sampling import Plan
from spadwarp.scene import phase_function
from spadwarp.units import range_from_time

__all__ = ["FORMAT_VERSION", "FRAME_COLUMNS", "scene_columns", "scene_row"]

FORMAT_VERSION = 1

FRAME_COLUMNS: dict[str, tuple[str, str]] = {
    "depth": ("m", "noisy planar depth = offset + step * code; code 0: no return"),
    "label": ("1", "the pixel reports backscatter or other background: np.packbits along rows, first pixel highest"),
    "intensity": ("1", "recorded photons = intensity_step of the frame * code, cut at 255"),
    "scene": ("1", "index into scenes.h5"),
    "sample": ("1", "id of the frame in the whole dataset"),
    "seed": ("1", "key of the frame's random numbers, together with its sample id"),
    "target": ("1", "index into the targets of manifest.json"),
    "backscatter_fraction": ("1", "BS, requested part of the pixels that report backscatter; NaN: by the photon rates"),
    "attenuation_lengths": ("1", "extinction times distance, one way"),
    "distance": ("m", "of the target's centre along the optical axis"),
    "pulses": ("1", "laser pulses of the frame"),
    "intensity_step": ("1", "recorded photons per unit of intensity"),
}
"""Datasets of a frames file, all with one first dimension: unit and meaning."""

_SCENE_NUMBERS: dict[str, tuple[str, str]] = {
    "distance": ("m", "of the target's centre along the optical axis"),
    "attenuation_lengths": ("1", "extinction times distance, one way"),
    "absorption": ("1/m", "a"),
    "scattering": ("1/m", "b"),
    "extinction": ("1/m", "c = a + b"),
    "anisotropy": ("1", "g, mean cosine of the scattering angle"),
    "group_index": ("1", "light travels at 299792458 m/s over this"),
    "gate_near": ("m", "range at which the gate opens"),
    "gate_far": ("m", "range at which the gate closes"),
    "reflectance": ("1", "of the target; NaN where each pixel has its own"),
    "pulses": ("1", "laser pulses of a frame"),
    "photons": ("1", "photons that were traced; 0: analytic"),
    "signal": ("1", "expected detections of the return per pulse, median over the target's pixels"),
    "backscatter": ("1", "expected backscatter detections per pulse within the gate, median over pixels"),
    "pulse_energy": ("J", "of the laser"),
    "pulse_fwhm": ("s", "of the laser"),
    "jitter_fwhm": ("s", "of the detector"),
    "pde": ("1", "photon detection efficiency"),
    "dark_count_rate": ("1/s", "of a pixel"),
}


def scene_columns(plan: Plan) -> dict[str, tuple[tuple[int, ...], Any, str, str]]:
    """Datasets of `scenes.h5`, all with one first dimension: shape of a row, type, unit, meaning."""
    height, width = plan.shape
    real: Any = np.float32
    return {
        "depth": ((height, width), real, "m", "true planar depth; NaN where nothing is hit"),
        "bound": ((height, width), real, "m", "Cramér–Rao bound of the depth in one frame; NaN for no estimate"),
        "normal": ((height, width, 3), np.float16, "1", "unit normals towards the camera"),
        "albedo": ((height, width), np.float16, "1", "Lambertian reflectance"),
        "backscatter_profile": ((PROFILE_BINS,), real, "1/m", "density of the water's backscatter over depth, on axis"),
        "profile_edges": ((PROFILE_BINS + 1,), real, "m", "edges of the profile's bins"),
        "target": ((), np.int32, "1", "index into the targets of manifest.json"),
        "target_name": ((), "S64", "1", "its name"),
        "translation": ((3,), real, "m", "of the target"),
        "rotation_deg": ((3,), real, "deg", "of the target about its own x, y, z"),
        "scale": ((3,), real, "1", "of the target"),
        "laser_position": ((3,), real, "m", "in the camera frame"),
        **{name: ((), np.float64, unit, text) for name, (unit, text) in _SCENE_NUMBERS.items()},
        "config": ((), "S8192", "1", "the scene as TOML"),
    }


def scene_row(plan: Plan, one: RenderedScene) -> dict[str, Any]:
    """A scene's values of `scene_columns`."""
    scene, draw = one.scene, one.draw
    medium, none = scene.medium, (np.nan,) * 3
    target = scene.targets[0] if scene.targets else None
    config = scene.to_toml()
    if (mesh := plan.targets[draw.target].mesh) is not None:
        config = config.replace(str(mesh), mesh.name)  # where it lies on this machine is nobody's business
    return {
        "depth": one.truth.depth,
        "bound": one.bound,
        "normal": one.truth.normal,
        "albedo": one.truth.reflectance,
        "backscatter_profile": one.profile[0],
        "profile_edges": one.profile[1],
        "target": draw.target,
        "target_name": plan.targets[draw.target].name,
        "translation": none if target is None else target.translation,
        "rotation_deg": none if target is None else target.rotation_deg,
        "scale": none if target is None else target.scale,
        "laser_position": scene.beam.position,
        "distance": draw.distance,
        "attenuation_lengths": draw.attenuation_lengths,
        "absorption": medium.absorption,
        "scattering": medium.scattering,
        "extinction": medium.extinction,
        "anisotropy": phase_function(medium).mean_cosine,
        "group_index": medium.group_index,
        "gate_near": range_from_time(scene.gate.start, medium.group_index),
        "gate_far": range_from_time(scene.gate.stop, medium.group_index),
        "reflectance": np.nan if target is None else target.reflectance,
        "pulses": scene.analytic.pulses_per_depth_frame,
        "photons": draw.photons or 0,
        "signal": one.signal,
        "backscatter": one.backscatter,
        "pulse_energy": scene.laser.pulse_energy,
        "pulse_fwhm": 1e-12 * scene.laser.pulse_fwhm_ps,
        "jitter_fwhm": 1e-12 * scene.detector.jitter_fwhm_ps,
        "pde": scene.detector.pde,
        "dark_count_rate": scene.detector.dark_count_rate,
        "config": config.encode(),
    }
