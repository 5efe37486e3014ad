"""Named waters, lasers, cameras, detectors and gates, each with the source of its numbers.

A scene takes one by `preset = "uwoc-harbour"` inside a section; every field can still be overridden there.
The field names and units are those of `spadwarp.scene`. A preset need not fill its section: what it leaves out is the
scene's to give.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

__all__ = ["PHASE_TABLES", "PRESETS", "WATER_INDICES", "Preset", "presets"]

# (phase index, group index) of water at 532 nm and 20 °C, seawater of salinity 35, after Quan & Fry 1995 (`water`).
# Time of flight uses the group index.
WATER_INDICES: dict[str, tuple[float, float]] = {"seawater": (1.3415, 1.3638), "fresh": (1.3350, 1.3566)}

_AVERAGE_PARTICLE = (
    "Petzold 1972 (SIO Ref. 72-78), mean of three stations in San Diego harbour without the water's own scattering, "
    "as tabulated by Mobley et al., Appl. Opt. 32, 7484 (1993)"
)

# Tabulated phase functions: name -> (file in spadwarp/tables, source).
PHASE_TABLES: dict[str, tuple[str, str]] = {
    "petzold-average-particle": ("petzold_average_particle.csv", _AVERAGE_PARTICLE)
}

_WATER_G = (
    0.924  # mean cosine of Petzold's average particle phase function; the paper and most of the literature use it
)


@dataclass(frozen=True)
class Preset:
    """Fields of one section of a scene, `values`, and where they come from, `source`."""

    section: str
    name: str
    values: Mapping[str, Any]
    source: str


def _waters(
    names: str, table: Mapping[str, tuple[float, float]], source: str, water: str = "seawater"
) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Media from a table of (absorption, scattering) [1/m]; `names` holds a `{}` for the table's key."""
    phase, group = WATER_INDICES[water]
    for key, (absorption, scattering) in table.items():
        values = {
            "absorption": absorption,
            "scattering": scattering,
            "anisotropy": _WATER_G,
            "phase_index": phase,
            "group_index": group,
        }
        yield names.format(key), values, source


_PETZOLD = {
    "autec-8": (0.114, 0.037),
    "haoce-11": (0.179, 0.219),
    "nuc-2040": (0.366, 1.824),
    "nuc-2240": (0.125, 1.205),
}
_UWOC = {"pure-sea": (0.053, 0.003), "clear": (0.069, 0.080), "coastal": (0.088, 0.216), "harbour": (0.295, 1.875)}
_WILLIAMSON = {
    "IB": (0.0530, 0.124),
    "II": (0.0616, 0.180),
    "III": (0.0810, 0.291),
    "1C": (0.0949, 0.431),
    "3C": (0.128, 0.651),
    "5C": (0.168, 1.208),
}
_SOLONENKO = {
    "I": (0.0505, 0.0020),
    "IA": (0.0511, 0.0039),
    "IB": (0.0512, 0.0557),
    "II": (0.0512, 0.379),
    "III": (0.0546, 1.038),
    "1C": (0.0702, 0.387),
    "3C": (0.0791, 1.125),
    "5C": (0.124, 1.409),
    "7C": (0.222, 2.487),
    "9C": (0.407, 3.307),
}
_MACCARONE = {"1.7m-1.2": 0.71, "1.7m-4.4": 2.59, "1.7m-5.7": 3.35, "3m-7.5": 2.5}  # extinction [1/m]

_LU2024 = "A Simulation Method for Underwater SPAD Depth Imaging Datasets, Sensors 24, 3886 (2024)"
_PETZOLD_SOURCE = (
    "Petzold 1972 (SIO Ref. 72-78), 530 nm: AUTEC-8 clear ocean, HAOCE-11 coastal, NUC-2040 harbour, NUC-2240 harbour"
)
_UWOC_SOURCE = (
    "532 nm values in common use for underwater optical communication, e.g. Gabriel et al., J. Opt. Commun. Netw. 5, 1 "
    "(2013); g = 0.924 is of particles, the little scattering of pure sea is mostly molecular and nearly symmetric"
)
_WILLIAMSON_SOURCE = "Jerlov water types as measured, 532 nm: Williamson & Hollins, Appl. Opt. 61, 9951 (2022)"
_SOLONENKO_SOURCE = "Jerlov water types as modelled, 532 nm: Solonenko & Mobley, Appl. Opt. 54, 5392 (2015)"
_MACCARONE_SOURCE = (
    "Heriot-Watt tank experiments with a scattering agent (Maccarone et al., Opt. Express 27, 28437 (2019) at 1.7 m, "
    "31, 16690 (2023) at 3 m): the extinction is theirs (attenuation lengths over distance); the absorption is assumed "
    "to be that of pure water at 532 nm (in red light it is higher: set it, 0.45 1/m at 670 nm), fresh water, g = 0.924"
)
_PF32_SOURCE = (
    "Photon Force PF32: 32 x 32 pixels of 50 um, 1024 bins of 55 ps, PDP about 24.7 % at 532 nm, jitter about 200 ps"
)
_PF32 = {"pdp": 0.247, "jitter_fwhm_ps": 200.0, "dark_count_rate": 100.0}


def _media() -> Iterator[tuple[str, dict[str, Any], str]]:
    yield from _waters("petzold-{}", _PETZOLD, _PETZOLD_SOURCE)
    measured = {"phase_function": "tabulated", "phase_table": "petzold-average-particle"}
    harbours = {key: value for key, value in _PETZOLD.items() if key.startswith("nuc")}
    for name, values, _ in _waters("petzold-{}-tabulated", harbours, _PETZOLD_SOURCE):
        yield name, {**values, **measured}, f"{_PETZOLD_SOURCE}; phase function: {_AVERAGE_PARTICLE}"
    yield from _waters("uwoc-{}", _UWOC, _UWOC_SOURCE)
    yield from _waters("jerlov-{}-williamson", _WILLIAMSON, _WILLIAMSON_SOURCE)
    yield from _waters("jerlov-{}-solonenko", _SOLONENKO, _SOLONENKO_SOURCE)
    phase, group = WATER_INDICES["fresh"]
    for key, extinction in _MACCARONE.items():
        tank = {"absorption": 0.0445, "extinction": extinction, "anisotropy": _WATER_G}
        yield f"maccarone-{key}", {**tank, "phase_index": phase, "group_index": group}, _MACCARONE_SOURCE
    numbers = {"extinction": 0.035, "albedo": "lu2024", "anisotropy": _WATER_G}
    yield "lu2024", numbers, f"{_LU2024}: albedo uniform in (0, 0.97) at each collision; 0.035 1/m is below pure water"


def _lasers() -> Iterator[tuple[str, dict[str, Any], str]]:
    visuv = {"wavelength_nm": 532.0, "pulse_energy": 37.5e-9, "repetition_rate": 20e6, "pulse_fwhm_ps": 85.0}
    yield "picoquant-visuv-532", visuv, "PicoQuant VisUV-532 as used in published work: 85 ps, 20 MHz, 750 mW (37.5 nJ)"
    numbers = {"wavelength_nm": 532.0, "pulse_energy": 4e-9, "repetition_rate": 10e6, "pulse_fwhm_ps": 72.0}
    cone = {"profile": "uniform_cone", "half_angle_deg": 1.9702}  # atan 0.0344
    yield "lu2024", {**numbers, **cone}, f"{_LU2024}, released numbers: 4 nJ, 10 MHz, 72 ps, cone of tangent 0.0344"


def _cameras() -> Iterator[tuple[str, dict[str, Any], str]]:
    # 256 pixels of 9.2 um subtend 20 degrees at a focal length of 128 * 9.2 um / tan 10 deg = 6.678 mm.
    numbers = {"width": 256, "height": 192, "horizontal_fov_deg": 20.0, "focal_length": 6.678e-3, "f_number": 2.0}
    yield (
        "lu2024",
        numbers,
        f"{_LU2024}: 256 x 192 pixels, 20 degrees, f/2; focal length from pixels of 9.2 um",
    )
    pf32 = {"width": 32, "height": 32, "pixel_pitch_um": 50.0}
    yield "photon-force-pf32", pf32, f"{_PF32_SOURCE}; the lens (focal_length, f_number) is the scene's"


def _detectors() -> Iterator[tuple[str, dict[str, Any], str]]:
    yield "photon-force-pf32", {**_PF32, "fill_factor": 0.015}, f"{_PF32_SOURCE}; fill factor 1.5 %"
    yield (
        "photon-force-pf32-microlens",
        {**_PF32, "fill_factor": 0.2},
        f"{_PF32_SOURCE}; fill factor 20 % with microlenses",
    )
    numbers = {"pdp": 0.28, "fill_factor": 1.0, "jitter_fwhm_ps": 0.0, "dark_count_rate": 126.0}
    yield (
        "lu2024",
        numbers,
        f"{_LU2024}, released numbers: q 0.28, dark counts 126 1/s, fill factor within the pixel's 9.2 um",
    )


def _gates() -> Iterator[tuple[str, dict[str, Any], str]]:
    yield "photon-force-pf32", {"bin_width_ps": 55.0, "bins": 1024}, f"{_PF32_SOURCE}; give start_ns for far targets"
    yield "lu2024", {"start_ns": 0.0, "bin_width_ps": 150.0, "bins": 10000}, f"{_LU2024}, released numbers"


_SECTIONS = {"medium": _media, "laser": _lasers, "camera": _cameras, "detector": _detectors, "gate": _gates}

PRESETS: dict[str, dict[str, Preset]] = {
    section: {name: Preset(section, name, values, source) for name, values, source in rows()}
    for section, rows in _SECTIONS.items()
}


def presets(section: str | None = None) -> dict[str, Preset]:
    """The presets of one section by name, or of all sections by `section.name`.

    Raises `KeyError` for a section without presets.
    """
    if section is not None:
        return dict(PRESETS[section])
    return {f"{section}.{name}": preset for section, rows in PRESETS.items() for name, preset in rows.items()}
