"""Camera calibrations as OpenCV writes them: YAML or JSON of `cv::FileStorage`, and ROS's `camera_info` YAML."""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from spadwarp.errors import ConfigError, FileError

__all__ = ["load_calibration"]

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
_NUMBER = r"[-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?"


def load_calibration(path: str | Path) -> dict[str, Any]:
    """Fields of the scene's `camera` section from a calibration file.

    Reads `camera_matrix` (3 × 3), `distortion_coefficients` (k1, k2, p1, p2[, k3]) and, if there, `image_width` and
    `image_height`, under these or the other usual names.

    Returns:
        `fx`, `fy`, `cx`, `cy`, `distortion` [pixels, 1], and `width` and `height` if the file has them.

    Raises:
        FileError: The file cannot be read.
        ConfigError: It holds no calibration, or one of a lens model other than Brown's.
    """
    try:
        text = Path(path).read_text(encoding="utf-8")
    except OSError as error:
        raise FileError(f"{path}: cannot be read: {error.strerror}") from None
    except UnicodeDecodeError:
        raise FileError(f"{path}: not a text file") from None
    try:
        entries = _json_entries(text) if text.lstrip().startswith("{") else _yaml_entries(text)
        return _fields(entries)
    except ValueError as error:
        raise ConfigError(f"camera.calibration = {str(path)!r}: {error}") from None


def _fields(entries: Mapping[str, Any]) -> dict[str, Any]:
    def find(key: str) -> Any:
        return next((entries[name] for name in _NAMES[key] if name in entries), None)

    model = entries.get("distortion_model", entries.get("camera_model", "plumb_bob"))
    if str(model).lower() not in ("plumb_bob", "brown", "pinhole", "opencv", "radtan"):
        raise ValueError(f"the lens model {model!r} is not Brown's (k1, k2, p1, p2, k3)")
    matrix = find("camera_matrix")
    if matrix is None or len(matrix) != 9:
        raise ValueError("holds no camera_matrix of 3 x 3 numbers")
    fx, skew, cx, zero, fy, cy, *last = matrix
    if skew or zero or last != [0, 0, 1] or fx <= 0 or fy <= 0:
        raise ValueError(f"camera_matrix = {matrix} is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]")
    distortion = find("distortion") or []
    if any(distortion[5:]) or len(distortion) not in (0, 4, 5, 8, 12, 14):
        raise ValueError(
            f"distortion_coefficients = {distortion}: k1, k2, p1, p2, k3 are known, no rational, prism or tilt terms"
        )
    coefficients = tuple([*distortion, 0.0, 0.0, 0.0, 0.0, 0.0][:5])
    fields: dict[str, Any] = {"fx": fx, "fy": fy, "cx": cx, "cy": cy, "distortion": coefficients}
    for name in ("width", "height"):
        if (pixels := find(name)) is not None:
            fields[name] = int(pixels)
    return fields


def _json_entries(text: str) -> dict[str, Any]:
    try:
        tables = json.loads(text)
    except ValueError as error:
        raise ValueError(f"not valid JSON: {error}") from None
    entries: dict[str, Any] = {}
    for name, value in tables.items():
        if isinstance(value, Mapping):
            value = value.get("data", value)
        if isinstance(value, list):
            flat = [one for row in value for one in (row if isinstance(row, list) else [row])]
            flat = [one for row in flat for one in (row if isinstance(row, list) else [row])]
            if all(isinstance(one, (int, float)) for one in flat):
                entries[name] = [float(one) for one in flat]
        elif isinstance(value, (int, float, str)):
            entries[name] = value
    return entries


def _yaml_entries(text: str) -> dict[str, Any]:
    """Top-level numbers, words and matrices of the YAML that OpenCV and ROS write; nothing else of YAML."""
    entries: dict[str, Any] = {}
    for match in re.finditer(r"^(\w+)\s*:[ \t]*(.*(?:\n[ \t]+.*|\n(?=\s*$))*)", text, re.MULTILINE):
        name, body = match.groups()
        data = re.search(r"(?:\bdata\s*:\s*)?\[([^\]]*)\]", body)
        if data is not None:
            entries[name] = [float(number) for number in re.findall(_NUMBER, data.group(1))]
        elif re.fullmatch(_NUMBER, body.strip()):
            entries[name] = float(body)
        elif body.strip():
            entries[name] = body.strip().strip("\"'")
    return entries
