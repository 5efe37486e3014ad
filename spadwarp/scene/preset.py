"""Named waters, lasers, cameras, detectors and gates, each with the source of its numbers: `presets.toml`.

A scene takes one by `preset = "uwoc-harbour"` inside a section, whose own fields lie over those of the preset. A preset
need not fill its section: what it leaves out is the scene's to give.
"""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from dataclasses import dataclass
from importlib.resources import files
from typing import Any

__all__ = ["PHASE_TABLES", "PRESETS", "WATER_INDICES", "Preset", "presets"]

# (phase index, group index) of water at 532 nm and 20 °C, seawater of salinity 35, after Quan & Fry 1995 (`water`).
# Time of flight uses the group index.
WATER_INDICES: dict[str, tuple[float, float]] = {"seawater": (1.3415, 1.3638), "fresh": (1.3350, 1.3566)}

# Tabulated phase functions: name -> (file in spadwarp/water/tables, source).
PHASE_TABLES: dict[str, tuple[str, str]] = {
    "petzold-average-particle": (
        "petzold_average_particle.csv",
        "Petzold 1972 (SIO Ref. 72-78), mean of three stations in San Diego harbour without the water's own "
        "scattering, as tabulated by Mobley et al., Appl. Opt. 32, 7484 (1993)",
    )
}


@dataclass(frozen=True)
class Preset:
    """Fields of one section of a scene, `values`, and where they come from, `source`."""

    section: str
    name: str
    values: Mapping[str, Any]
    source: str


def _read_presets() -> dict[str, dict[str, Preset]]:
    tables = tomllib.loads((files("spadwarp.scene") / "presets.toml").read_text(encoding="utf-8"))
    sources: dict[str, str] = tables.pop("sources")

    def source(entry: Mapping[str, Any]) -> str:
        text = sources.get(entry["source"], entry["source"])
        return f"{text}; {entry['note']}" if "note" in entry else text

    return {
        section: {name: Preset(section, name, entry["values"], source(entry)) for name, entry in entries.items()}
        for section, entries in tables.items()
    }


PRESETS = _read_presets()


def presets(section: str | None = None) -> dict[str, Preset]:
    """The presets of one section by name, or of all sections by `section.name`.

    Raises `KeyError` for a section without presets.
    """
    if section is not None:
        return dict(PRESETS[section])
    return {f"{section}.{name}": preset for section, rows in PRESETS.items() for name, preset in rows.items()}
