"""The columns of a dataset's files: name, unit, meaning, and where a scene's values come from."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from spadwarp.dataset.rendered import PROFILE_BINS, RenderedScene
from spadwarp.dataset.sampling import Plan
from spadwarp.scene import phase_function
from spadwarp.scene.sight import port_advance
from spadwarp.units import range_from_time

__all__ = [
    "FORMAT_VERSION",
    "FRAME_COLUMNS",
    "HISTOGRAM_COLUMNS",
    "PACKED",
    "Column",
    "describe",
    "scene_columns",
    "scene_row",
]

FORMAT_VERSION = 1

PACKED: dict[str, Any] = {"compression": "gzip", "compression_opts": 1, "shuffle": True}
"""How HDF5 packs arrays."""

FRAME_COLUMNS: dict[str, tuple[str, str]] = {
    "depth": ("m", "noisy planar depth = offset + step * code; code 0: no return"),
    "label": ("1", "the pixel reports backscatter or other background: np.packbits along rows, first pixel highest"),
    "intensity": ("1", "recorded photons = intensity_step of the frame * code, cut at 255"),
    "scene": ("1", "index into scenes.h5"),
    "sample": ("1", "id of the frame in the whole dataset"),
    "seed": ("1", "key of the frame's random numbers, together with its sample id"),
    "target": ("1", "index into the targets of manifest.json"),
    "backscatter_fraction": ("1", "requested part of the pixels that report backscatter; NaN: the photon rates decide"),
    "attenuation_lengths": ("1", "extinction times distance, one way"),
    "distance": ("m", "of the target's centre along the optical axis"),
    "pulses": ("1", "laser pulses of the frame"),
    "intensity_step": ("1", "recorded photons per unit of intensity"),
}
"""Datasets of a frames file, all with one first dimension: unit and meaning."""

HISTOGRAM_COLUMNS: dict[str, tuple[str, str]] = {
    "scene": ("1", "index into scenes.h5"),
    "expected": ("1", "expected counts of a frame before pile-up: target, scattered light, dark counts, ambient light"),
    "polarisation": ("1", "degree of polarisation of each bin's light, by both channels; NaN where none arrives"),
    "gate_start": ("s", "start of bin 0 after the pulse left the laser"),
    "bin_width": ("s", "width of a bin"),
    "sample": ("1", "id of the frame in the whole dataset"),
    "counts": ("1", "counts of the frame"),
    "event_start": ("1", "first event of each frame; one entry more than frames"),
    "event_index": ("1", "y * W * T + x * T + bin"),
    "event_count": ("1", "counts in that bin"),
}
"""Datasets of a histograms file: unit and meaning."""

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


@dataclass(frozen=True)
class Column:
    """A field of an exported frame: shape, type (`object`: text), unit and meaning."""

    shape: tuple[int, ...]
    kind: np.dtype[Any]
    unit: str
    meaning: str

    @property
    def is_text(self) -> bool:
        return self.kind.kind == "O"


def describe(file: Any, columns: Mapping[str, tuple[str, str]]) -> None:
    """Writes unit and meaning to the datasets that an open HDF5 file holds."""
    for name, stored in file.items():
        unit, text = columns[name]
        stored.attrs.update({"unit": unit, "description": text})


def scene_columns(shape: tuple[int, int]) -> dict[str, tuple[tuple[int, ...], Any, str, str]]:
    """Datasets of `scenes.h5`, all with one first dimension: shape of a row, type, unit, meaning.

    `shape`: height and width of the images.
    """
    height, width = shape
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


def scene_row(plan: Plan, rendered: RenderedScene) -> dict[str, Any]:
    """A scene's values of `scene_columns`."""
    scene, draw = rendered.scene, rendered.draw
    medium, source, advance = scene.medium, plan.targets[draw.target], port_advance(scene)
    placed: Any = scene.targets[0] if scene.targets else None
    vectors = {name: getattr(placed, name, (np.nan,) * 3) for name in ("translation", "rotation_deg", "scale")}
    config = scene.to_toml()
    if source.mesh is not None:
        config = config.replace(str(source.mesh), source.mesh.name)  # without the folders of this machine
    return {
        "depth": rendered.truth.depth,
        "bound": rendered.bound,
        "normal": rendered.truth.normal,
        "albedo": rendered.truth.reflectance,
        "backscatter_profile": rendered.profile[0],
        "profile_edges": rendered.profile[1],
        "target": draw.target,
        "target_name": source.name,
        **vectors,
        "laser_position": scene.beam.position,
        "distance": draw.distance,
        "attenuation_lengths": draw.attenuation_lengths,
        **{name: getattr(medium, name) for name in ("absorption", "scattering", "extinction", "group_index")},
        "anisotropy": phase_function(medium).mean_cosine,
        "gate_near": range_from_time(scene.gate.start, medium.group_index) + advance,
        "gate_far": range_from_time(scene.gate.stop, medium.group_index) + advance,
        "reflectance": getattr(placed, "reflectance", np.nan),
        "pulses": scene.pulses_per_depth_frame,
        "photons": draw.photons or 0,
        "signal": rendered.signal,
        "backscatter": rendered.backscatter,
        "pulse_energy": scene.laser.pulse_energy,
        "pulse_fwhm": 1e-12 * scene.laser.pulse_fwhm_ps,
        "jitter_fwhm": 1e-12 * scene.detector.jitter_fwhm_ps,
        "pde": scene.detections_per_photon,
        "dark_count_rate": scene.detector.dark_count_rate,
        "config": config.encode(),
    }
