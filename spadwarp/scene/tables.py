"""Tables of a scene before they are validated: presets, the file, overrides, and how they are put together.

Everything here works on plain dicts as `tomllib` gives them. A later layer wins field by field, except where fields
exclude each other: there a later one displaces the earlier ones (`merge_section`). A preset, `preset = "uwoc-harbour"`
inside a section, lies under the section's own fields; it need not fill its section.
"""

from __future__ import annotations

import re
import tomllib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from importlib.resources import files
from typing import Any, NamedTuple

from spadwarp.errors import ConfigError
from spadwarp.io.text import parse_toml
from spadwarp.limits import parse_number, shown, suggestion

__all__ = ["Preset", "parse_override", "presets"]

Table = dict[str, Any]
Key = tuple[str | int, ...]

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


COEFFICIENTS = ("absorption", "scattering", "extinction", "albedo")


def complete_coefficients(pair: Mapping[str, Any]) -> dict[str, Any]:
    """All four coefficients from exactly two of them, the given ones as they are.

    With `albedo = "lu2024"` absorption and scattering are the means (ω is uniform in (0, 0.97): mean 0.485).
    Raises `ValueError` whose text names the fields, without the section.
    """
    if len(pair) != 2:
        given = ", ".join(pair) or "none"
        raise ValueError(f"needs exactly two of {', '.join(COEFFICIENTS)}, or chlorophyll; given: {given}")
    a, b, c, albedo = (pair.get(name) for name in COEFFICIENTS)  # type: Any, Any, Any, Any
    if albedo == "lu2024":
        if c is None:
            raise ValueError("albedo = 'lu2024' goes with extinction only")
        return {"absorption": c * (1.0 - 0.485), "scattering": c * 0.485, "extinction": c, "albedo": albedo}
    if albedo is not None:
        if c is None:
            rest = albedo if a is None else 1.0 - albedo
            if rest <= 0.0:
                raise ValueError(f"albedo = {albedo} leaves the extinction undetermined; give extinction and albedo")
            c = (b if a is None else a) / rest
        a = c * (1.0 - albedo) if a is None else a
        b = c * albedo if b is None else b
    elif c is None:
        c = a + b
    else:
        part, value = ("scattering", b) if a is None else ("absorption", a)
        if value > c:
            raise ValueError(f"{part} = {value} is outside [0, {c}], {c} being the extinction")
        a = c - b if a is None else a
        b = c - a if b is None else b
    share = (b / c if c else 0.0) if albedo is None else albedo
    return {"absorption": a, "scattering": b, "extinction": c, "albedo": share}


class PhaseFields(NamedTuple):
    """Fields of `medium` that belong to a phase function: those that it needs and no other takes, None by default, and
    those with a default, which phase functions may share."""

    needed: tuple[str, ...] = ()
    optional: tuple[str, ...] = ()


PHASE_FIELDS = {
    "henyey_greenstein": PhaseFields(optional=("anisotropy",)),
    "two_term_henyey_greenstein": PhaseFields(needed=("g1", "g2", "alpha")),
    "fournier_forand": PhaseFields(optional=("particle_index", "junge_slope")),
    "rayleigh": PhaseFields(optional=("depolarisation_ratio",)),
    "tabulated": PhaseFields(needed=("phase_table",)),
}

# Overriding one coefficient of a complete medium keeps this other one.
_KEEPS = {"absorption": "scattering", "scattering": "absorption", "extinction": "albedo", "albedo": "extinction"}

# How the energy of a pulse is given.
ENERGIES = ("pulse_energy", "average_power", "peak_power")

# Tables within sections: (section, field) -> whose fields they have.
_TABLES = {
    ("camera", "port"): "port",
    ("laser", "port"): "port",
    ("domain", "outside_index"): "outside_index",
    ("medium", "grid"): "grid",
}

_INTRINSICS = ("fx", "fy", "cx", "cy", "calibration")

# Setting a field in a later layer drops these fields of the earlier ones.
_DISPLACES: dict[str, dict[str, tuple[str, ...]]] = {
    "medium": {
        **dict.fromkeys(COEFFICIENTS, ("chlorophyll",)),
        "chlorophyll": (*COEFFICIENTS, "preset"),
        "temperature": ("phase_index", "group_index"),
        "salinity": ("phase_index", "group_index"),
        "phase_function": tuple(name for fields in PHASE_FIELDS.values() for name in fields.needed),
    },
    "camera": {
        "horizontal_fov_deg": ("pixel_pitch_um", *_INTRINSICS),
        "pixel_pitch_um": ("horizontal_fov_deg", *_INTRINSICS),
        "fx": ("horizontal_fov_deg", "pixel_pitch_um"),
        "calibration": ("horizontal_fov_deg", "pixel_pitch_um", *_INTRINSICS, "distortion"),
        "aperture_diameter": ("f_number",),
        "f_number": ("aperture_diameter",),
    },
    "laser": {
        **{name: tuple(other for other in ENERGIES if other != name) for name in ENERGIES},
        "linewidth_nm": ("spectrum",),
        "spectrum": ("linewidth_nm",),
    },
    "detector": {
        "filter_fwhm_nm": ("filter_table",),
        "filter_table": ("filter_centre_nm", "filter_fwhm_nm", "filter_peak"),
    },
    "targets": {"builtin": ("mesh",), "mesh": ("builtin", "size")},
    "grid": {"file": ("shape", "cells", "turbulence", "eddy_size", "seed"), "shape": ("file",)},
    "port": {
        "shape": ("distance", "normal", "radius", "offset"),
        "material": ("index", "group_index"),
        "index": ("material",),
    },
}


def merge_section(section: str, base: Mapping[str, Any], layer: Mapping[str, Any]) -> Table:
    """`layer` on top of `base`; a preset in the layer gives its fields, over which the layer's own lie.

    A value of None takes the field back to its default.
    """
    preset = _preset(section, layer)
    if preset is not None:
        base = merge_section(section, base, preset.values)
    merged = dict(base)
    if section == "medium":
        _merge_coefficients(merged, layer)
    displaces = _DISPLACES.get(section, {})
    for name, value in layer.items():
        if value is not None:
            for displaced in displaces.get(name, ()):
                merged.pop(displaced, None)
    for (owner, name), inner in _TABLES.items():
        if owner == section and isinstance(layer.get(name), Mapping):
            within = base.get(name)
            layer = {**layer, name: merge_section(inner, within if isinstance(within, Mapping) else {}, layer[name])}
    merged.update(layer)
    dropped = [name for name, value in layer.items() if value is None]
    for name in dropped:
        del merged[name]
    current = _preset(section, merged)
    if current is not None and any(name in current.values for name in dropped):
        del merged["preset"]  # no longer that preset
    return merged


def _preset(section: str, fields: Mapping[str, Any]) -> Preset | None:
    name = fields.get("preset")
    return PRESETS.get(section, {}).get(name) if isinstance(name, str) else None


def preset_hint(section: str, word: Any) -> str:
    """A hint where a word stands in place of a table: how a preset is taken."""
    known = PRESETS.get(section, {})
    if word in known:
        return f'; a preset is taken by {{preset = "{word}"}}'
    return suggestion(word, list(known)) or ("" if len(known) > 8 else f"; presets are {', '.join(map(repr, known))}")


def _merge_coefficients(merged: Table, layer: Mapping[str, Any]) -> None:
    """Drops from `merged` the coefficients that the layer replaces; a clash is left for validation to report."""
    new = [name for name in COEFFICIENTS if layer.get(name) is not None]
    old = {name: merged[name] for name in COEFFICIENTS if name in merged}
    keep = {}
    if len(new) == 1:
        kept = _KEEPS[new[0]]
        if len(old) < 2 or (old.get("albedo") == "lu2024" and kept not in old and new[0] not in old):
            return
        try:
            keep[kept] = old[kept] if kept in old else complete_coefficients(old)[kept]
        except (TypeError, ValueError):
            return
    if new:
        for name in old:
            del merged[name]
        merged.update(keep)


def merge_scene(base: Mapping[str, Any], layer: Mapping[str, Any]) -> Table:
    """`layer` on top of `base`, section by section; `targets` may be a list, which replaces, or `{index: fields}`.

    Raises `ConfigError` for an index that is neither a target's nor the next free one.
    """
    merged = dict(base)
    for section, fields in layer.items():
        old = merged.get(section)
        if section == "targets" and isinstance(fields, Mapping):
            merged[section] = _merge_targets(old or [], fields)
        elif isinstance(fields, Mapping):
            whole = merge_section(section, {}, old) if isinstance(old, Mapping) else {}  # its own preset first
            merged[section] = merge_section(section, whole, fields)
        else:
            merged[section] = fields
    return merged


def _merge_targets(old: Any, layer: Mapping[int, Any]) -> list[Any]:
    if not (isinstance(old, list | tuple) and all(isinstance(target, Mapping) for target in old)):
        raise ConfigError(f"targets = {shown(old)} is not a list of tables, [[targets]]")
    targets = list(old)
    for index, target in sorted(layer.items()):
        if index > len(targets):
            raise ConfigError(f"targets[{index}] does not exist; the scene has {len(targets)}")
        targets[index : index + 1] = [merge_section("targets", dict(*targets[index : index + 1]), target)]
    return targets


def parse_override(text: str) -> tuple[Key, Any]:
    """The key and the value of one `section.field=value`.

    The value is in TOML syntax; what is not TOML is taken as a bare string. Targets are written
    `targets[0].reflectance` or `targets.0.reflectance`. `parse_override("medium.extinction=0.9")` is
    `(("medium", "extinction"), 0.9)`. Raises `ConfigError`.
    """
    name, equals, value = (part.strip() for part in text.partition("="))
    if not equals or not value:
        raise ConfigError(f"override {shown(text)} is not of the form section.field=value")
    return parse_key(name), _parse_value(value, text)


def parse_key(name: str) -> Key:
    """`("targets", 0, "reflectance")` from `targets[0].reflectance` or `targets.0.reflectance`.

    Raises `ConfigError`.
    """
    parts = re.sub(r"\[([0-9]+)\]", r".\1", name).split(".")
    if not all(re.fullmatch(r"[a-zA-Z_]\w*|[0-9]{1,9}", part, re.ASCII) for part in parts) or _is_index(parts[0]):
        raise ConfigError(f"override {shown(name)} does not name a field; write section.field or targets[0].field")
    return tuple(int(part) if _is_index(part) else part for part in parts)


def _parse_value(value: str, text: str) -> Any:
    try:
        table = parse_toml(f"value = {value}")
    except ConfigError as error:
        if value[0] in "\"'[{":
            hint = "; TOML writes a table as {name = value}" if re.search(r"[\"'\w]\s*:", value) else ""
            raise ConfigError(f"override {shown(text)}: {error}{hint}") from None
        try:
            return parse_number(value)  # .9 and 5. are not TOML, but mean numbers
        except ValueError:
            return value
    return table["value"] if len(table) == 1 else value


def override_layer(overrides: Mapping[str, Any] | Sequence[str]) -> tuple[Table, dict[Key, Any]]:
    """A layer for `merge_scene` from `["medium.extinction=0.9"]`, `{"medium.extinction": 0.9}` or nested mappings; and
    for `set_item` the overrides that name an item: `targets[0].translation[2]`, `medium.layers[1].extinction`.

    Raises `ConfigError`.
    """
    if isinstance(overrides, str):
        overrides = [overrides]
    if isinstance(overrides, Mapping):
        pairs = [(parse_key(str(name)), value) for name, value in overrides.items()]
    elif isinstance(overrides, Sequence) and all(isinstance(text, str) for text in overrides):
        pairs = [parse_override(text) for text in overrides]
    else:
        raise ConfigError(f"overrides = {shown(overrides)} are neither a dict nor texts such as 'section.field=value'")
    layer: Table = {}
    items: dict[Key, Any] = {}
    for key, value in pairs:
        if any(isinstance(part, int) for part in key[2:]):
            items[key] = value
        else:
            _insert(layer, key, value)
    return layer, items


def _insert(layer: dict[Any, Any], key: Key, value: Any) -> None:
    """Sets a field, or the fields of a section, a target, all targets or a table within a section."""
    is_target, in_table = key[0] == "targets", key[:2] in _TABLES
    if isinstance(value, Mapping) and len(key) < (3 if is_target or in_table else 2):
        for name, inner in value.items():
            _insert(layer, (*key, int(name) if _is_index(name) else str(name)), inner)
        return
    whole, shape = f"override {shown(key_text(key))}", tuple(map(type, key))
    fits = shape in ((str,), (str, int, str) if is_target else (str, str)) or (in_table and len(key) == 3)
    if not fits or (len(key) > 1 and not isinstance(layer.setdefault(key[0], {}), dict)):
        raise ConfigError(f"{whole} does not name a field; write section.field or targets[0].field")
    for depth, part in enumerate(key[:-1], 1):
        layer = layer.setdefault(part, {})
        if not isinstance(layer, dict):
            hint = preset_hint(_TABLES[str(key[0]), str(key[1])], layer)
            raise ConfigError(f"{whole}: {key_text(key[:depth])} = {shown(layer)} is not a table{hint}")
    layer[key[-1]] = value


def set_item(place: Any, key: Key, value: Any, *, done: Key = ()) -> Any:
    """A scene's complete tables with an item of a list replaced, or a field of a table in a list.

    `done` is the part of the key that leads to `place`. Raises `ConfigError` for an item that is not there.
    """
    part, rest, here = key[0], key[1:], (*done, key[0])
    if isinstance(part, int):
        if not isinstance(place, list | tuple):
            raise ConfigError(f"{key_text(here)} does not exist: {key_text(done)} = {shown(place)} is not a list")
        if part >= len(place):
            raise ConfigError(f"{key_text(here)} does not exist; {key_text(done)} has {len(place)} values, from 0 on")
        new = set_item(place[part], rest, value, done=here) if rest else value
        return [new if index == part else item for index, item in enumerate(place)]
    if not rest:  # a layer of water
        return merge_section("medium", place, {part: value}) if isinstance(place, Mapping) else {part: value}
    inner = place.get(part) if isinstance(place, Mapping) else None
    return {**(place if isinstance(place, Mapping) else {}), part: set_item(inner, rest, value, done=here)}


def _is_index(name: Any) -> bool:
    return re.fullmatch(r"[0-9]{1,9}", str(name)) is not None


def key_text(key: Sequence[str | int]) -> str:
    """`targets[0].reflectance` from `("targets", 0, "reflectance")`."""
    return "".join(f"[{part}]" if isinstance(part, int) else f".{part}" for part in key).removeprefix(".")


def toml_text(tables: Mapping[str, Any]) -> str:
    """TOML of a scene's or a recipe's tables, each array on one line."""
    import tomli_w

    # Strings are escaped to one line: a line that begins with a space, or with ] after a comma, belongs to an array.
    return re.sub(r"\n +", " ", re.sub(r",\n *(?=\])|(?<=\[)\n +", "", tomli_w.dumps(tables)))
