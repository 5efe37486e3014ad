"""JSON Schema of our TOML files, with which editors complete and check them."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

from pydantic import BaseModel

from spadwarp.dataset import Recipe
from spadwarp.mesh import builtin_names
from spadwarp.scene import Laser, Medium, Scene, presets

__all__ = ["json_schema"]

# A number with a unit, as in `spadwarp.values.quantity`; which unit goes with which field is not in the schema.
_QUANTITY = {
    "description": 'a number with a unit, such as "150 nJ"',
    "type": "string",
    "pattern": r"^\s*[+-]?(\d+\.?\d*|\.\d+)([eE][+-]?\d+)?\s*[^\s\d].*$",
}
_WITH_UNIT = {"$ref": "#/$defs/Quantity"}
_SECTIONS = {name: name.lower() for name in ("Medium", "Laser", "Camera", "Port", "Detector", "Gate")}
_SECTIONS["Layer"] = "medium"
_INDICES = ("seawater", "fresh")


def json_schema(model: type[BaseModel]) -> dict[str, Any]:
    """JSON Schema (draft 2020-12) of a TOML file: of a `Scene`, of a dataset's or a training's recipe.

    It knows fields, kinds, ranges, choices, presets and built-in targets; what fields exclude each other is known to
    `spadwarp check` alone.
    """
    scene, dataset = model is Scene, model is Recipe
    schema: dict[str, Any] = _plain(model.model_json_schema(mode="validation"))
    title = "scene" if scene else "dataset" if dataset else "training"
    schema = {"$schema": "https://json-schema.org/draft/2020-12/schema", **schema, "title": f"spadwarp {title}"}
    if dataset:
        table = {**schema["$defs"]["Distribution"], "title": "table"}  # besides a number and a list of values
        kinds = [{"type": kind} for kind in ("number", "string", "boolean", "array")]
        schema["$defs"]["Distribution"] = {"title": "Distribution", "anyOf": [*kinds, table]}
    schema.setdefault("$defs", {})
    for table in (schema, *schema["$defs"].values()):
        if table is not schema or scene:
            table.pop("required", None)  # a preset may give what a file leaves out
        for name, field in table.get("properties", {}).items():
            table["properties"][name] = _widened(name, field, table.get("title", ""), scene=scene)
    if scene:
        schema["$defs"]["Quantity"] = _QUANTITY
    return schema


def _plain(value: Any) -> Any:
    """A value that TOML and JSON can write: no null, no infinity; and only defaults within the field's own range."""
    if isinstance(value, list | tuple):
        return [_plain(item) for item in value if item != {"type": "null"}]
    if not isinstance(value, Mapping):
        return value
    table = {name: _plain(item) for name, item in value.items() if item is not None and not _is_infinite(item)}
    if table.get("default") == 0.0 and table.get("exclusiveMinimum") == 0.0:
        del table["default"]
    if len(table.get("anyOf", ())) == 1:
        (only,) = table.pop("anyOf")
        table = {**only, **table}
    return table


def _is_infinite(value: Any) -> bool:
    if isinstance(value, list | tuple):
        return any(map(_is_infinite, value))
    return isinstance(value, float) and not math.isfinite(value)


def _widened(name: str, field: dict[str, Any], table: str, *, scene: bool) -> dict[str, Any]:
    """A field with all that validators take beyond its type: units, words, one number for three, presets."""
    extra: dict[str, Any] = {key: field[key] for key in ("description", "default") if key in field}
    kind = {key: value for key, value in field.items() if key not in ("description", "default", "title")}
    if name in (*Medium.alternatives, *Laser.alternatives[1:]):
        extra.pop("default", None)
    if name == "preset" and (names := [preset for preset in presets() if preset.split(".")[0] == _SECTIONS.get(table)]):
        return {"enum": [preset.partition(".")[2] for preset in names], **extra}
    if name == "builtin" and table == "Target":
        return {"enum": list(builtin_names()), **extra}
    also: list[dict[str, Any]] = []
    if scene and _takes(kind, "number"):
        also.append(_WITH_UNIT)
    if scene and name in ("phase_index", "group_index"):
        also.append({"enum": list(_INDICES)})
    if name in ("scale", "size", "lower", "upper") and table in ("Target", "Domain"):
        also.append({"type": "number"})
    if name == "distortion":
        also.append({"type": "array", "minItems": 4, "maxItems": 5, "items": {"type": "number"}})
    for vector in (option for option in (kind, *kind.get("anyOf", ())) if "prefixItems" in option):
        vector["prefixItems"] = [{"anyOf": [item, _WITH_UNIT]} for item in vector["prefixItems"]]
    return {"anyOf": [*kind.get("anyOf", [kind] if kind else []), *also], **extra} if also else {**kind, **extra}


def _takes(field: Mapping[str, Any], kind: str) -> bool:
    return field.get("type") == kind or any(_takes(option, kind) for option in field.get("anyOf", ()))
