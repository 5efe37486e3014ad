"""JSON Schema of our TOML files, with which editors complete and check them."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from typing import Any

from pydantic import BaseModel

from spadwarp.errors import ArgumentError
from spadwarp.mesh import builtin_names
from spadwarp.scene import Scene, presets
from spadwarp.scene.tables import COEFFICIENTS, ENERGIES

__all__ = ["SCHEMAS", "json_schema"]

SCHEMAS = ("scene", "dataset", "training")
"""Kinds of TOML files."""

# A number with a unit, as in `spadwarp.units.quantity`; which unit goes with which field is not in the schema.
_QUANTITY = {
    "description": 'a number with a unit, such as "150 nJ"',
    "type": "string",
    "pattern": r"^\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*[^\s\d].*$",
}
_WITH_UNIT = {"$ref": "#/$defs/Quantity"}
_SECTIONS = {name: name.lower() for name in ("Medium", "Laser", "Camera", "Port", "Detector", "Gate")} | {
    "Layer": "medium"
}
_INDICES = ("seawater", "fresh")


def json_schema(kind: str) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a scene, a dataset recipe or a training recipe: kind of `SCHEMAS`.

    It knows fields, kinds, ranges, choices, presets and built-in targets; what fields exclude each other is known to
    `spadwarp check` alone. Raises `ArgumentError` for another kind.
    """
    if kind not in SCHEMAS:
        raise ArgumentError(f"kind = {kind!r} is not one of {', '.join(map(repr, SCHEMAS))}")
    schema: dict[str, Any] = _plain(_model(kind).model_json_schema(mode="validation"))
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": f"spadwarp {kind}"}
    if kind == "dataset":
        schema["$defs"]["Distribution"] = _distribution(schema["$defs"]["Distribution"])
    schema.setdefault("$defs", {})
    for table in (schema, *schema["$defs"].values()):
        if table is not schema or kind == "scene":
            table.pop("required", None)  # a preset may give what a file leaves out
        for name, field in table.get("properties", {}).items():
            table["properties"][name] = _widened(name, field, table.get("title", ""), scene=kind == "scene")
    if kind == "scene":
        schema["$defs"]["Quantity"] = _QUANTITY
    return schema


def _model(kind: str) -> type[BaseModel]:
    if kind == "scene":
        return Scene
    if kind == "dataset":
        from spadwarp.dataset import Recipe

        return Recipe
    from spadwarp.denoise import TrainingRecipe

    return TrainingRecipe


def _plain(value: Any) -> Any:
    """What TOML and JSON can write: no null, no infinity; and only defaults within the field's own range."""
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value if item != {"type": "null"}]
    if not isinstance(value, Mapping):
        return value
    kept = {name: _plain(item) for name, item in value.items() if item is not None and not _is_infinite(item)}
    if kept.get("default") == 0.0 and kept.get("exclusiveMinimum") == 0.0:
        del kept["default"]
    if len(kept.get("anyOf", ())) == 1:
        (only,) = kept.pop("anyOf")
        kept = {**only, **kept}
    return kept


def _is_infinite(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return any(map(_is_infinite, value))
    return isinstance(value, float) and not math.isfinite(value)


def _widened(name: str, field: dict[str, Any], table: str, *, scene: bool) -> dict[str, Any]:
    """A field with what validators take beyond its type: units, words, one number for three, presets."""
    about: dict[str, Any] = {key: field[key] for key in ("description", "default") if key in field}
    kind = {key: value for key, value in field.items() if key not in ("description", "default", "title")}
    if name in (*COEFFICIENTS, *ENERGIES[1:]):
        about.pop("default", None)
    if name == "preset" and (names := [one for one in presets() if one.split(".")[0] == _SECTIONS.get(table)]):
        return {"enum": [one.partition(".")[2] for one in names], **about}
    if name == "builtin" and table == "Target":
        return {"enum": list(builtin_names()), **about}
    also: list[dict[str, Any]] = []
    if scene and _takes(kind, "number"):
        also.append(_WITH_UNIT)
    if scene and name in ("phase_index", "group_index"):
        also.append({"enum": list(_INDICES)})
    if name in ("scale", "size", "lower", "upper") and table in ("Target", "Domain"):
        also.append({"type": "number"})
    if name == "distortion":
        also.append({"type": "array", "minItems": 4, "maxItems": 5, "items": {"type": "number"}})
    for vector in _vectors(kind):
        vector["prefixItems"] = [{"anyOf": [item, _WITH_UNIT]} for item in vector["prefixItems"]]
    return {"anyOf": [*kind.get("anyOf", [kind] if kind else []), *also], **about} if also else {**kind, **about}


def _takes(field: Mapping[str, Any], kind: str) -> bool:
    return field.get("type") == kind or any(_takes(one, kind) for one in field.get("anyOf", ()))


def _vectors(field: Mapping[str, Any]) -> Iterator[dict[str, Any]]:
    for one in (field, *field.get("anyOf", ())):
        if isinstance(one, dict) and "prefixItems" in one:
            yield one


def _distribution(table: dict[str, Any]) -> dict[str, Any]:
    """A number, a list of values, or a table with low and high."""
    choices = [{"type": kind} for kind in ("number", "string", "boolean", "array")]
    return {"title": "Distribution", "anyOf": [*choices, {**table, "title": "table"}]}
