"""Camera calibrations as OpenCV writes them: XML, YAML or JSON of `cv::FileStorage`, and ROS's `camera_info` YAML."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any
from xml.etree import ElementTree

import yaml

from spadwarp.errors import ArgumentError, ConfigError, FileError
from spadwarp.io.text import parse_json, read_text, write_text
from spadwarp.limits import check_integer, check_real, parse_number, shown

if TYPE_CHECKING:
    from spadwarp.scene.camera import Camera

__all__ = ["CALIBRATION_ENDINGS", "load_calibration", "save_calibration"]

CALIBRATION_ENDINGS = (".xml", ".yml", ".yaml", ".json")
"""Of files that `save_calibration` writes."""

_LARGEST = 1 << 19  # bytes; one with all corners of 100 views has 300 kB

# What programs call the same thing.
_NAMES = {
    "camera_matrix": ("camera_matrix", "cameraMatrix", "intrinsic_matrix", "mtx", "K", "M"),
    "distortion": (
        "distortion_coefficients",
        "dist_coeffs",
        "dist_coeff",
        "distCoeffs",
        "distortion",
        "dist",
        "D",
    ),
    "width": ("image_width", "width"),
    "height": ("image_height", "height"),
}


def load_calibration(path: str | Path) -> dict[str, Any]:
    """Fields of the scene's `camera` section from a calibration file.

    Reads `camera_matrix` (3 × 3), `distortion_coefficients` (k1, k2, p1, p2[, k3]) and, if there, `image_width` and
    `image_height`, under these or the other usual names.

    Returns:
        `fx`, `fy`, `cx`, `cy`, `distortion` [pixels, 1], and `width` and `height` if the file has them.

    Raises:
        FileError: The file cannot be read.
        ConfigError: It holds no calibration, one of a lens model other than Brown's, or numbers that are not finite.
    """
    try:
        text = read_text(path, largest=_LARGEST)
    except FileError as error:
        raise FileError(f"camera.calibration = {error}") from None
    try:
        return _fields(_entries(text))
    except ValueError as error:
        raise ConfigError(f"camera.calibration = {str(path)!r}: {error}") from None


def save_calibration(camera: Camera, path: str | Path) -> Path:
    """Writes a camera's calibration as OpenCV's `cv::FileStorage` reads it: XML, YAML or JSON by the ending.

    Holds `image_width`, `image_height`, `camera_matrix` and `distortion_coefficients` (k1, k2, p1, p2, k3), as
    `cv2.calibrateCamera` gives them: 0 is the centre of the first pixel.

    Raises:
        ArgumentError: Another ending.
        FileError: The file cannot be written.
    """
    from spadwarp.scene.intrinsics import camera_attributes

    path = Path(path)
    if (ending := path.suffix.lower()) not in CALIBRATION_ENDINGS:
        raise ArgumentError(f"{path}: ending {path.suffix!r} is not one of {', '.join(CALIBRATION_ENDINGS)}")
    numbers: Any = camera_attributes(camera, None)
    size = {"image_width": camera.width, "image_height": camera.height}
    matrices = {
        "camera_matrix": (3, 3, [float(number) for number in numbers["camera_matrix"]]),
        "distortion_coefficients": (1, 5, [float(number) for number in numbers["camera_distortion"]]),
    }
    if ending == ".xml":
        lines = [f"<{name}>{value}</{name}>" for name, value in size.items()]
        for name, (rows, columns, values) in matrices.items():
            lines += [f'<{name} type_id="opencv-matrix">', f"  <rows>{rows}</rows>", f"  <cols>{columns}</cols>"]
            lines += ["  <dt>d</dt>", f"  <data>{' '.join(map(repr, values))}</data></{name}>"]
        text = "\n".join(['<?xml version="1.0"?>', "<opencv_storage>", *lines, "</opencv_storage>", ""])
    elif ending == ".json":
        tables = {
            name: {"type_id": "opencv-matrix", "rows": rows, "cols": columns, "dt": "d", "data": values}
            for name, (rows, columns, values) in matrices.items()
        }
        text = json.dumps({**size, **tables}, indent=1) + "\n"
    else:
        lines = [f"{name}: {value}" for name, value in size.items()]
        for name, (rows, columns, values) in matrices.items():
            lines += [f"{name}: !!opencv-matrix", f"   rows: {rows}", f"   cols: {columns}", "   dt: d"]
            lines += [f"   data: [ {', '.join(map(repr, values))} ]"]
        text = "\n".join(["%YAML:1.0", "---", *lines, ""])
    write_text(text, path)
    return path


def _entries(text: str) -> dict[str, Any]:
    if text.lstrip().startswith("<"):
        return _xml_entries(text)
    is_json = text.lstrip().startswith("{")
    try:  # OpenCV's first line is no YAML
        entries = parse_json(text) if is_json else yaml.load(text.removeprefix("%YAML:1.0"), Loader=_Loader)
    except (ValueError, yaml.YAMLError) as error:
        raise ValueError(f"not valid {'JSON' if is_json else 'YAML'}: {' '.join(str(error).split())}") from None
    except RecursionError:
        raise ValueError("not valid YAML: lists or tables are nested too deeply") from None
    return entries if isinstance(entries, dict) else {}


def _xml_entries(text: str) -> dict[str, Any]:
    """The entries of OpenCV's XML, its matrices as `_numbers` takes them."""
    if "<!DOCTYPE" in text or "<!ENTITY" in text:  # with entities a small file can be huge
        raise ValueError("not OpenCV's XML: it declares a document type")
    try:
        root = ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        raise ValueError(f"not valid XML: {error}") from None
    entries: dict[str, Any] = {}
    for element in root:
        if element.find("data") is not None:  # a matrix
            parts = {part.tag: (part.text or "").split() for part in element}
            entries[element.tag] = {**parts, "rows": _one(parts.get("rows")), "cols": _one(parts.get("cols"))}
        else:
            entries[element.tag] = _one((element.text or "").split())
    return entries


def _one(words: list[str] | None) -> list[str] | str | None:
    """The word of a list of one, else the list."""
    return words[0] if words is not None and len(words) == 1 else words


class _Loader(yaml.BaseLoader):
    """Every scalar as text, every tag ignored (`!!opencv-matrix`), no aliases: with them a small file can be huge."""

    def compose_node(self, parent: Any, index: Any) -> Any:
        if self.check_event(yaml.AliasEvent):
            raise ValueError(f"an alias stands in line {self.peek_event().start_mark.line + 1}")
        return super().compose_node(parent, index)


def _fields(entries: Mapping[str, Any]) -> dict[str, Any]:
    def find(key: str) -> list[float] | None:
        name = next((name for name in _NAMES[key] if name in entries), None)
        return None if name is None else _numbers(name, entries[name])

    model = entries.get("distortion_model", entries.get("camera_model", "plumb_bob"))
    if str(model).lower() not in ("plumb_bob", "brown", "pinhole", "opencv", "radtan"):
        raise ValueError(f"the lens model {shown(model)} is not Brown's (k1, k2, p1, p2, k3)")
    matrix = find("camera_matrix")
    if matrix is None or len(matrix) != 9:
        raise ValueError("holds no camera_matrix of 3 x 3 numbers")
    fx, skew, cx, zero, fy, cy, *last = matrix
    if skew or zero or last != [0, 0, 1] or fx <= 0 or fy <= 0:
        raise ValueError(f"camera_matrix = {shown(matrix)} is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
    distortion = find("distortion") or []
    if any(distortion[5:]) or len(distortion) not in (0, 4, 5, 8, 12, 14):
        raise ValueError(
            f"distortion_coefficients = {shown(distortion)}: k1, k2, p1, p2, k3 are known, no rational, prism or tilt"
            " terms"
        )
    coefficients = tuple([*distortion, 0.0, 0.0, 0.0, 0.0, 0.0][:5])
    fields: dict[str, Any] = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": coefficients}
    for name in ("width", "height"):
        if (pixels := find(name)) is not None:
            fields[name] = check_integer(f"image_{name}", pixels[0] if len(pixels) == 1 else pixels, "[1, 16384]")
    return fields


def _numbers(name: str, value: Any) -> list[float]:
    """The numbers of a matrix as OpenCV and ROS write it, of a list of rows, or of a list; or the one number."""
    data = value.get("data") if isinstance(value, Mapping) else value
    items = data if isinstance(data, list) else [data]
    cells = [cell for item in items for cell in (item if isinstance(item, list) else [item])]
    numbers = [_number(name, cell) for cell in cells]
    if isinstance(value, Mapping) and value.get("rows") is not None and value.get("cols") is not None:
        rows, columns = (_number(f"{name}.{side}", value[side]) for side in ("rows", "cols"))
        if rows * columns != len(numbers):
            raise ValueError(f"{name} has {len(numbers)} numbers in {rows:g} rows and {columns:g} columns")
    return numbers


def _number(name: str, cell: Any) -> float:
    try:
        number = parse_number(cell) if isinstance(cell, str) else cell
    except ValueError as error:
        raise ValueError(f"{name} = {shown(cell)} {error}") from None
    return check_real(name, number, "[-1e9, 1e9]")
